"""Calibrations: one file a format, each read into a `geometry.rig.Rig`, and what can be wrong with one.

`read_calibration.py` tells the formats apart and `write_calibration.py` writes them; `rig_json.py` is ours.
`assemble.py` makes a rig of a file's cameras; `camera_values.py` and `lens_values.py` check what every format
holds, camera by camera. `hypotheses.py` finds out which mistake (`mistakes.py`) a rig or its key points show,
`view_agreement.py` which cameras do not show what the others show, and why (`exchanged_images.py`,
`lens_mistakes.py`, `time_offsets.py`, `one_camera.py`), `rig_alone.py` what a rig shows by itself; all say it
as `findings.Finding`. `refinement.py` corrects extrinsics from the hands.
"""

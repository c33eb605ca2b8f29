"""Calibrations: one file a format, each read into a `geometry.rig.Rig`, and what can be wrong with one.

`rig_json.py` reads and writes our own `rig.json`; `camera_values.py` checks what every format holds, camera
by camera. `hypotheses.py` finds out which mistake (`mistakes.py`) a rig or its key points show,
`view_agreement.py` which cameras do not show what the others show, and why (`exchanged_images.py`,
`lens_mistakes.py`, `time_offsets.py`, `one_camera.py`), `rig_alone.py` what a rig shows by itself; all say it
as `findings.Finding`. `refinement.py` corrects extrinsics from the hands.
"""

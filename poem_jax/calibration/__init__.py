"""Calibrations: one file a format, each read into a `geometry.rig.Rig`, and what can be wrong with one.

`rig_json.py` reads and writes our own `rig.json`; `camera_values.py` checks what every format holds, camera
by camera. `hypotheses.py` finds out which mistake a rig or its key points show, `view_agreement.py` which
cameras do not show what the others show; both say it as `findings.Finding`.
"""

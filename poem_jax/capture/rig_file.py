"""Where scripts outside the package open a rig file: the door to `calibration/rig_json.py`."""

from poem_jax.calibration.rig_json import read_rig

__all__ = ["read_rig"]

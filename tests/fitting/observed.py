from poem_jax.fitting import Observations
from poem_jax.synthetic.keypoint_takes import KeypointTake


def observed(take: KeypointTake, **changes) -> Observations:
    """What a fit sees of a take."""
    return Observations(take.uv_px, None, take.K, take.T_cam_from_world)._replace(**changes)

"""The benchmark distribution of synthetic captures: fixed, and committed before any training.

What: crops of 128 x 128 from 1 to 8 cameras around one right hand (shipped hand model, natural poses,
shapes ~ N(0, 1)) with forearm, objects, lights and sensors drawn at random. Training, the table of the
shipped weights, and the bundled demo (sample 0 of seed 0) all draw from it; seeds keep them apart.

What stands here are the numbers that `SyntheticConfig` has. The rest of the distribution is code: pose limits
and families (poem_jax/synthetic/poses.py), where objects are put, the forearm, skin and light
(poem_jax/synthetic/), the sensor's inner workings, the shipped hand itself. None of it may change without
training anew; tests/synthetic/test_benchmark.py compares the first samples of seed 0 with stored statistics
and fails if it did.

Spread (asserted by tests/synthetic/test_benchmark.py):
    angles       every joint angle's standard deviation is at least half that of a uniform spread over its
                 limits
    cameras      uniform on the sphere around the hand, in the world's and in the hand's own axes; any roll;
                 no filter on baselines
    hidden       35 % of the views have more than 20 % of the hand hidden by objects, by the end of the
                 full frame or by the crop; what hand and forearm hide themselves does not count
    boxes        square, 1.5 x the longer side of the projected joints' extent, jittered by N(0, 0.05) of the
                 side in place and N(0, 0.06) in size
    backgrounds  textured: standard deviation over a whole picture at least 18 of 255 in the strongest
                 channel (12 seeds); a crop may look closely at a smooth part of it: 0.2 % of the crops'
                 backgrounds are below 4

Speed: 178 four-view samples per second by 2 threads on 2 cores, 215 by 2 processes (benchmarks/synthetic.py).
"""

from poem_jax.synthetic.config import (
    BodyConfig,
    CameraConfig,
    CropConfig,
    LightConfig,
    OccluderConfig,
    SensorConfig,
    SyntheticConfig,
)

benchmark = SyntheticConfig(
    image_hw=(128, 128),
    num_views=8,
    supersample=2,
    num_backgrounds=64,
    cameras=CameraConfig(
        distance_m=(0.3, 1.5),
        field_of_view_deg=(35.0, 80.0),
        frames_wh=((640, 480), (1280, 720), (1920, 1080), (1024, 1024)),
        aim_jitter=0.4,
        principal_sigma=0.02,
        aspect_sigma=0.005,
        roll_deg=(-180.0, 180.0),
    ),
    crop=CropConfig(expand_ratio=1.5, center_jitter=0.05, scale_jitter=0.06),
    body=BodyConfig(
        shape_sigma=1.0,
        world_offset_m=(-1.0, 1.0),
        forearm_length_m=(0.10, 0.22),
        forearm_bend_deg=(-40.0, 40.0),
        forearm_taper=(1.05, 1.5),
        sleeve_probability=0.4,
    ),
    occluders=OccluderConfig(
        held_probability=0.35,
        blocker_probability=0.25,
        blocker_gap_m=(0.05, 0.16),
        blocker_offset_sigma_m=0.035,
        stray_probability=0.5,
        half_size_m=(0.012, 0.045),
        held_half_size_m=(0.009, 0.032),
    ),
    light=LightConfig(num_lights=(1, 3), intensity=(0.25, 1.1), ambient=(0.12, 0.55), tint=0.2),
    sensor=SensorConfig(
        gain=(0.65, 1.6),
        gamma=(0.36, 0.56),
        white_balance=0.15,
        blur_px=(0.0, 1.3),
        motion_probability=0.15,
        motion_px=(2, 7),
        noise=(0.0, 9.0),
        jpeg_probability=0.8,
        jpeg_quality=(35, 95),
    ),
)

"""`poem retarget`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from poem_jax.cli.options import File, Flag, OptionalFile


@dataclass(frozen=True)
class Retarget:
    """Let a robot hand follow a reconstructed one: its joint angles in every frame, by dex-retargeting.

    Needs the extra `retarget`. OUT holds `angles (F,D)` in radians, NaN where there is no hand, `joint_names
    (D,)`, `frames (F,)` and `time_s (F,)`.
    """

    prediction: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PREDICTION")]
    """prediction.npz of `poem reconstruct` or `poem fit`."""
    out: File
    """npz for the angles; it is replaced."""
    robot: Literal["allegro"] = "allegro"
    """Which: the right Allegro hand."""
    hand: int | None = None
    """Number of the hand in PREDICTION; without it the only one of the robot's side."""
    urdf: OptionalFile = None
    """Description of the robot; without it that of the package example-robot-data."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the angles and say how many frames have them."""
        import numpy as np

        from poem_jax.capture.robot_hand import ALLEGRO, follow, packaged_urdf
        from poem_jax.io.atomic import whole_file
        from poem_jax.io.npz_file import read_npz
        from poem_jax.io.writable import check_inputs_stay

        if self.out.suffix != ".npz":
            raise ValueError(f"--out must end in .npz; got {self.out}")
        check_inputs_stay([self.out], (self.prediction, self.urdf))
        needed = ["joints_world", "valid", "hand_side", "frames"]
        arrays = read_npz(self.prediction, required=needed)
        hand = self._hand(arrays["hand_side"].tolist(), ALLEGRO.side)
        valid = arrays["valid"][:, hand]
        if not valid.any():
            raise ValueError(f"{self.prediction}: hand {hand} was not reconstructed in any frame")
        urdf = self.urdf or packaged_urdf(ALLEGRO)
        motion = follow(ALLEGRO, urdf, arrays["joints_world"][:, hand], valid)
        times = arrays.get("time_s", np.full(len(valid), np.nan))
        with whole_file(self.out) as temporary:
            named = {"joint_names": np.array(motion.joint_names), "frames": arrays["frames"]}
            np.savez(temporary, angles=motion.angles, time_s=times, **named)
        print(f"{self.out}: {len(motion.joint_names)} joints in {valid.sum()} of {len(valid)} frames")

    def _hand(self, sides: list[str], side: str) -> int:
        """Return which hand is meant."""
        of_side = [index for index, each in enumerate(sides) if each == side]
        if self.hand is None and len(of_side) == 1:
            return of_side[0]
        if self.hand in of_side:
            return self.hand
        raise ValueError(
            f"--hand must be the number of a {side} hand, as the robot is one; {self.prediction} holds "
            f"{', '.join(f'{index}: {each}' for index, each in enumerate(sides))}; got {self.hand}"
        )

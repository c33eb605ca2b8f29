"""Where data and weights are looked for; the one place that names these folders."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Places:
    """Two folders; `--data-root` and `--checkpoints` move them."""

    data: Path = Path("data")
    checkpoints: Path = Path("checkpoints")
    """A folder for each model, as `poem train --export` and `poem import-torch` write them."""
    runs: Path = Path("runs")
    """A folder for each training run."""
    own_capture: Path | None = None
    """The labelled capture of the table of real recordings; None = `real_world` below `data`."""

    @property
    def tars(self) -> Path:
        """Of the authors' packed sets, as the release has them."""
        return self.data / "dataset_tars"

    @property
    def raw(self) -> Path:
        """Of the sets as they are unpacked."""
        return self.data / "raw"

    @property
    def mano(self) -> Path:
        """The user's right hand."""
        return self.data / "mano" / "MANO_RIGHT.pkl"

    @property
    def capture(self) -> Path:
        """Of a real recording with labels."""
        return self.data / "real_world" if self.own_capture is None else self.own_capture

    def keypoints(self, name: str) -> Path:
        """Return where key points of a set are looked for; those of one's own capture lie within it."""
        return self.data / name if self.own_capture is None else self.own_capture / "keypoints.npz"

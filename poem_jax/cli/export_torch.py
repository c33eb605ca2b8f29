"""`poem export-torch`."""

from dataclasses import dataclass

from poem_jax.cli.messages import tells_what_is_left
from poem_jax.cli.options import File, Flag, PositionalFolder


@dataclass(frozen=True)
class ExportTorch:
    """Turn a model folder back into a PyTorch state dict that the released code loads."""

    model: PositionalFolder
    """Folder of a released model, such as import-torch writes."""
    out: File
    """The .pth.tar to write."""
    overwrite: Flag = False
    """Replace the file at --out."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the file and print how to open it."""
        from poem_jax.io.writable import check_file_is_writable
        from poem_jax.weights.release_files import export_release

        check_file_is_writable(self.out)
        with tells_what_is_left(self.out):
            count = export_release(self.model, self.out, overwrite=self.overwrite)
        print(f"{count} arrays written to {self.out}; open it with")
        print(f"torch.load({str(self.out)!r}, weights_only=True)")

"""The authors' release as files: checkpoint, constants and MANO's hand in, one model folder out, and back.

`torch_import.py` converts the arrays; here their files are found, checked and written.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from poem_jax.hand import mano_file
from poem_jax.hand.model import HandModel
from poem_jax.io.npz_file import read_npy
from poem_jax.io.torch_file import load_state_dict, save_state_dict
from poem_jax.models.config import Config, ModelConfig
from poem_jax.models.presets import released
from poem_jax.typing import Float, Int
from poem_jax.weights import store
from poem_jax.weights.torch_import import check_anchors, convert, export_state_dict, names_of

BASIS_FILE, ANCHOR_FILE, INDEX_FILE = "bps.npy", "anchor.npy", "anchor_idx.npy"
_READ_OF_A_HAND = set(HandModel._fields) - {"faces", "is_left"}


class Assets(NamedTuple):
    """The constants of the released models that stand beside their checkpoints."""

    basis_points: Float[np.ndarray, "basis 3"]
    """Metres about the root."""
    anchor_points: Float[np.ndarray, "anchor 3"]
    """Basis radii about the root."""
    anchor_indices: Int[np.ndarray, " anchor"]


class Imported(NamedTuple):
    """What `import_release` found."""

    model: str
    """The variant, and of those that were released for several data sets which, and for how many views if
    its layers are made for a number."""
    num_read: int
    """Arrays of the checkpoint that went into the model."""
    num_ignored: int
    """Arrays on which no output depends."""
    num_parameters: int
    """Numbers that training moves."""


def import_release(
    checkpoint: str | Path,
    variant: str,
    *,
    mano: str | Path,
    out: str | Path,
    assets: str | Path | None = None,
    dataset: str | None = None,
    num_views: int | None = None,
    accept_anchors: bool = False,
    overwrite: bool = False,
) -> Imported:
    """Write a released model as a folder that `poem_jax.load` opens with nothing else.

    Args:
        checkpoint: the `.pth.tar`; nothing in it is run.
        variant: one of `torch_import.VARIANTS`.
        mano: `MANO_RIGHT.pkl`, or an `.npz` with MANO's names.
        out: folder to make; on failure nothing is left there, and what stood there stays.
        assets: folder with `bps.npy`, `anchor.npy`, `anchor_idx.npy`; POEM v2 alone, and needed there.
        dataset: as in `convert`, None = DexYCB; must be None for POEM v2.
        num_views: as in `convert`; must be None for all but MvP.
        accept_anchors: take anchors that do not lie on the template of `mano` and of the checkpoint.
        overwrite: replace the model folder at `out`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: files that are damaged, hostile or do not belong together, or `out` exists.
    """
    name = dataset or "dexycb"
    out, config = Path(out), released(variant, dataset=name, num_views=num_views)
    _check_options(variant, config, dataset, num_views)
    _check_folder(out, overwrite)
    hand, constants = mano_file.load(mano), _assets(assets, config, variant)
    state = load_state_dict(checkpoint)
    _, params = convert(state, variant, mano=hand, **constants, dataset=name, num_views=num_views)
    if isinstance(config, Config) and not accept_anchors:
        check_anchors(config, params, hand)
    store.save(out, config, params, overwrite=overwrite)
    num_read = _num_read(state, config)
    num_parameters = sum(leaf.size for leaf in jax.tree.leaves(params["trainable"]))
    return Imported(_described(variant, config, name), num_read, len(state) - num_read, num_parameters)


def export_release(model: str | Path, out: str | Path, *, overwrite: bool = False) -> int:
    """Write a model as a PyTorch state dict that the released code loads.

    Args:
        model: folder of one of the released models, such as `import_release` writes.
        out: the file to make, whole or not at all.
        overwrite: replace the file at `out`.

    Returns: how many arrays were written.

    Raises:
        FileNotFoundError: there is no such model.
        ValueError: it is damaged or none of the released models, or `out` exists.
    """
    out = Path(out)
    if out.is_dir():
        raise ValueError(
            f"`out` must name a file; got the folder {out}. Give a name in it, like model.pth.tar"
        )
    if out.exists() and not overwrite:
        raise ValueError(f"{out} exists already; give another name, or --overwrite to replace it")
    state = export_state_dict(*store.load(model))
    save_state_dict(out, state)
    return len(state)


def _check_options(variant: str, config: ModelConfig, dataset: str | None, num_views: int | None) -> None:
    """Refuse what was said for nothing: it was meant for another variant."""
    if isinstance(config, Config) and dataset is not None:
        raise ValueError(f"{variant} was released for all data sets at once; leave out --dataset")
    if num_views is not None and not _takes_one_view_count(config):
        raise ValueError(f"{variant} takes any number of views; leave out --num-views")


def _takes_one_view_count(config: ModelConfig) -> bool:
    least, most = config.view_range
    return least == most


def _described(variant: str, config: ModelConfig, dataset: str) -> str:
    if isinstance(config, Config):
        return variant
    views = f" for {config.views_in_words} views" if _takes_one_view_count(config) else ""
    return f"{variant} of {dataset}{views}"


def _assets(folder: str | Path | None, config: ModelConfig, variant: str) -> dict[str, np.ndarray]:
    """Return the constants that `convert` needs beside a checkpoint of this model."""
    if isinstance(config, Config) == (folder is None):
        wanted = (
            "needs the folder `assets` of the authors' repository" if folder is None else "has no `assets`"
        )
        raise ValueError(f"{variant} {wanted}; {'give' if folder is None else 'leave out'} --assets")
    return {} if folder is None or not isinstance(config, Config) else read_assets(folder, config)._asdict()


def read_assets(folder: str | Path, config: Config) -> Assets:
    """Read the constants of the released models.

    Raises:
        FileNotFoundError: one of the files is missing.
        ValueError: one of them is damaged, of another type or of another shape.
    """
    folder, anchors = Path(folder), config.decoder.num_neighbours
    return Assets(
        _read(folder / BASIS_FILE, (config.basis.num_points, 3), np.floating),
        _read(folder / ANCHOR_FILE, (anchors, 3), np.floating),
        _read(folder / INDEX_FILE, (anchors,), np.integer),
    )


def _read(path: Path, shape: tuple[int, ...], kind: type[np.number]) -> np.ndarray:
    """Read an array of numbers, and nothing else; a leading axis of one goes."""
    if not path.is_file():
        raise FileNotFoundError(
            f"no {path.name} in {path.parent}; give the folder `assets` of the authors' repository, with "
            f"{BASIS_FILE}, {ANCHOR_FILE} and {INDEX_FILE}"
        )
    try:
        array = read_npy(path)
    except ValueError as error:
        raise ValueError(f"{error}. Is it cut short or a Git LFS pointer? Fetch it again") from error
    if array.shape not in (shape, (1, *shape)) or not np.issubdtype(array.dtype, kind):
        raise ValueError(
            f"{path} must hold {kind.__name__} numbers of shape {shape} or {(1, *shape)}; got {array.dtype} "
            f"of shape {array.shape}. Is it the release's own? Fetch it again"
        )
    return array.reshape(shape)


def _check_folder(out: Path, overwrite: bool) -> None:
    """Refuse, before anything long is read, what cannot or should not be replaced."""
    if not out.exists():
        return
    if not out.is_dir():
        raise ValueError(f"`out` must name a folder; got the file {out}. Give another name")
    if not overwrite:
        raise ValueError(f"{out} exists already; give another folder, or --overwrite to replace it")
    parts = (store.CONFIG_FILE, store.ARRAYS_FOLDER)
    if any(out.iterdir()) and not all((out / part).exists() for part in parts):
        raise ValueError(
            f"{out} is not replaced, for it is no model folder: expected {' and '.join(parts)} in it. "
            "Give another folder"
        )


def _num_read(found: Iterable[str], config: ModelConfig) -> int:
    """Count the names of a state dict whose arrays `convert` uses."""
    names = names_of(config)
    used = {row.source for row in names.rows}
    hands = [prefix for prefix, is_used in names.hands.items() if is_used]
    used |= {f"{prefix}th_{field}" for prefix in hands for field in _READ_OF_A_HAND}
    return sum(name.removeprefix("module.") in used for name in found)

"""Weights on disk: `config.json`, `ckpt/` (an Orbax checkpoint) and `seal.json` (the checksums of its files).

The config travels with the weights, so that a checkpoint loads without its experiment file. Writing goes to a
temporary folder beside the target, which is renamed when it is whole.
"""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from poem_jax.io.checksums import check_checksums, write_checksums
from poem_jax.io.json_file import read_json
from poem_jax.models.config import ModelConfig
from poem_jax.models.network import StaticArray, describe, leaves_with_names, with_static_indices
from poem_jax.typing import Array, Params, PyTree
from poem_jax.weights.config_json import from_values, to_json

CONFIG_FILE = "config.json"
ARRAYS_FOLDER = "ckpt"
CHECKSUMS_FILE = "seal.json"
SHIPPED = Path(__file__).parent / "tiny"
"""The weights that come with the package."""


def save(
    path: str | os.PathLike,
    config: ModelConfig,
    params: Params,
    *,
    dtype: Any = None,
    overwrite: bool = False,
) -> None:
    """Write a model: its config as JSON and its parameters as an Orbax checkpoint.

    Args:
        path: folder to make; on failure nothing is left there, and what stood there stays.
        config: the model.
        params: its parameters; must fit `config`.
        dtype: storage type of weights and statistics (for example `jnp.float16`, to ship half the bytes);
            constants and integers keep theirs. None = as they are.
        overwrite: replace what stands at `path`.

    Raises:
        ValueError: `params` do not fit `config` or the storage type or hold NaN or infinity, or `path`
            exists and is a file, or `overwrite` is False.
    """
    path = Path(path).resolve()
    if path.exists() and not path.is_dir():
        raise ValueError(f"`path` must name a folder; got the file {path}. Give another name")
    if path.exists() and not overwrite:
        raise ValueError(f"`path` must not exist yet; got {path}. Pass overwrite=True to replace it")
    leaves = flatten(params)
    check_leaves(leaves, expected_leaves(config), f"parameters to save at {path}")
    _check_finite(leaves, f"parameters to save at {path}")
    stored = {name: _narrowed(name, np.asarray(leaf), dtype) for name, leaf in leaves.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        (temporary / CONFIG_FILE).write_text(to_json(config) + "\n", encoding="utf-8")
        ocp.save(str((temporary / ARRAYS_FOLDER).resolve()), stored)
        _forget_where_it_was_written(temporary / ARRAYS_FOLDER)
        write_checksums(temporary / CHECKSUMS_FILE, temporary / ARRAYS_FOLDER)
        temporary.chmod(0o755)
        _put_in_place(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _forget_where_it_was_written(arrays: Path) -> None:
    """Take the absolute path out of Orbax's mark of success, which names a temporary folder of this machine.

    What counts is that there is such a file.
    """
    mark = arrays / "commit_success.txt"
    if mark.exists():
        mark.write_text(f"Checkpoint commit was successful to {arrays.name}", encoding="utf-8")


def _put_in_place(new: Path, path: Path) -> None:
    """Rename `new` to `path`; what stood there goes only when the new one stands."""
    if not path.exists():
        os.replace(new, path)
        return
    old = new.with_name(new.name + ".old")
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        os.replace(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)


def load(path: str | os.PathLike, *, expected: ModelConfig | None = None) -> tuple[ModelConfig, Params]:
    """Read a model that `save` wrote.

    Args:
        path: its folder.
        expected: the config that the caller needs; None = any.

    Returns:
        The config, and the parameters as float32 (integers and masks as stored).

    Raises:
        FileNotFoundError: no such folder, or it misses its config or its arrays.
        ValueError: unreadable or truncated files, arrays that do not fit the config or hold NaN or infinity,
            or another config than `expected`.
    """
    path = Path(path)
    config = read_config(path)
    if expected is not None and expected != config:
        raise ValueError(
            f"checkpoint of another config at {path}: {_config_difference(expected, config)}. "
            "Build the model from the config that `load` returns, or load the checkpoint of this config"
        )
    stored = _read_arrays(path)
    template = expected_leaves(config)
    check_leaves(stored, template, f"checkpoint at {path}")
    _check_finite(stored, f"checkpoint at {path}")
    leaves = {name: jnp.asarray(stored[name], template[name].dtype) for name in template}
    return config, with_static_indices(unflatten(leaves, describe(config)))


def shipped() -> tuple[ModelConfig, Params]:
    """Load the weights that come with the package (preset `tiny`, trained on synthetic captures)."""
    return load(SHIPPED)


def flatten(tree: PyTree) -> dict[str, Array]:
    """List the leaves of a pytree by dotted path."""
    leaves = leaves_with_names(tree)
    return {
        name: np.asarray(leaf) if isinstance(leaf, StaticArray) else leaf for name, leaf in leaves.items()
    }


def checksum_of_leaves(leaves: Mapping[str, Array]) -> str:
    """Return what tells named leaves from others: of their names, types, shapes and numbers, in any order."""
    digest = hashlib.sha256()
    for name, leaf in sorted(leaves.items()):
        array = np.asarray(leaf)
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def unflatten(leaves: dict[str, Array], like: PyTree) -> PyTree:
    """Put leaves back into a pytree of the structure of `like`; what is static there is static."""
    filled = [
        np.asarray(leaves[name]).view(StaticArray) if isinstance(leaf, StaticArray) else leaves[name]
        for name, leaf in leaves_with_names(like).items()
    ]
    structure = jax.tree.structure(like, is_leaf=lambda leaf: isinstance(leaf, StaticArray))
    return jax.tree.unflatten(structure, filled)


def expected_leaves(config: ModelConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """Return shape and dtype of every parameter of a model, without computing any."""
    return flatten(describe(config))


def check_leaves(stored: dict[str, Any], template: dict[str, Any], what: str) -> None:
    """Compare names, shapes and kinds of numbers (not their widths), and report all differences at once.

    Raises:
        ValueError: something is missing, unknown, of another shape or of another kind.
    """
    problems = [
        f"{name}: missing, expected {template[name].shape}" for name in template.keys() - stored.keys()
    ]
    problems += [f"{name}: unknown, got {np.shape(stored[name])}" for name in stored.keys() - template.keys()]
    problems += [
        f"{name}: expected {template[name].shape}, got {np.shape(stored[name])}"
        for name in template.keys() & stored.keys()
        if tuple(template[name].shape) != tuple(np.shape(stored[name]))
    ]
    problems += [
        f"{name}: expected {_kind(template[name])} numbers, got {_kind(stored[name])}"
        for name in template.keys() & stored.keys()
        if _kind(template[name]) != _kind(stored[name])
    ]
    if problems:
        shown = "; ".join(sorted(problems)[:8])
        raise ValueError(
            f"{what}: {len(problems)} arrays do not fit the config: {shown}. "
            "Use the config that the parameters were made with"
        )


def _kind(leaf: Any) -> str:
    dtype = leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype
    kinds = {"floating": jnp.floating, "integer": jnp.integer, "bool": jnp.bool_}
    return next((name for name, kind in kinds.items() if jnp.issubdtype(dtype, kind)), str(dtype))


def _check_finite(leaves: dict[str, Any], what: str) -> None:
    broken = sorted(
        name
        for name, leaf in leaves.items()
        if _kind(leaf) == "floating" and not np.isfinite(np.asarray(leaf)).all()
    )
    if broken:
        raise ValueError(
            f"{what}: {len(broken)} arrays hold NaN or infinity: {', '.join(broken[:8])}. "
            "All weights must be finite; take those from before the training failed"
        )


def _narrowed(name: str, leaf: np.ndarray, dtype: Any) -> np.ndarray:
    narrow = dtype is not None and leaf.dtype == np.float32 and not name.startswith("constants")
    if not narrow:
        return leaf
    limit = float(jnp.finfo(dtype).max)
    if np.any(np.abs(leaf) > limit):
        raise ValueError(
            f"{name}: values up to {np.abs(leaf).max():.3g} do not fit into {jnp.dtype(dtype).name} "
            f"(largest {limit:.3g}). Store as bfloat16 or float32"
        )
    return leaf.astype(dtype)


def read_config(path: str | os.PathLike) -> ModelConfig:
    """Read the config of a model that `save` wrote, and none of its weights.

    Raises:
        FileNotFoundError: no such folder, or it misses its config or its arrays.
        ValueError: not a config.
    """
    path = Path(path)
    file = path / CONFIG_FILE
    for needed in (path, file, path / ARRAYS_FOLDER):
        if not needed.exists():
            raise FileNotFoundError(
                f"no checkpoint at {path}: {needed} does not exist. "
                "Expected a folder that poem_jax.save wrote, with config.json and ckpt/"
            )
    try:
        return from_values(read_json(file, what="model config"))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(
            f"{file} is not a model config: {error}. Expected the JSON that poem_jax.save wrote"
        ) from error


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    folder = path / ARRAYS_FOLDER
    try:
        check_checksums(path / CHECKSUMS_FILE, folder)
        return cast(dict[str, np.ndarray], ocp.load(str(folder.resolve())))
    except Exception as error:
        # Orbax and TensorStore raise many kinds; each means that the arrays cannot be read.
        raise ValueError(
            f"{folder} is truncated or not an Orbax checkpoint ({type(error).__name__}: {str(error)[:300]}). "
            "Copy the whole folder again, or save it anew"
        ) from error


def _config_difference(expected: ModelConfig, got: ModelConfig) -> str:
    if type(expected) is not type(got):
        return f"expected a {type(expected).__name__}, got a {type(got).__name__}"
    return "; ".join(_differences(json.loads(to_json(expected)), json.loads(to_json(got)), ""))


def _differences(expected: Any, got: Any, path: str) -> Iterator[str]:
    """List by dotted name where two configs in their JSON form differ; of a part that is of another class,
    only that it is."""
    if expected == got:
        return
    are_objects = isinstance(expected, dict) and isinstance(got, dict)
    if not are_objects or expected.get("kind") != got.get("kind"):
        yield f"`{path}` expected {_named(expected)}, got {_named(got)}"
        return
    for key in expected:
        yield from _differences(expected[key], got[key], f"{path}.{key}" if path else key)


def _named(value: Any) -> Any:
    return f"a {value['kind']}" if isinstance(value, dict) else value

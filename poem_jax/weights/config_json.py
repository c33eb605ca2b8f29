"""The JSON form of a model's configuration, saved beside every checkpoint.

A whole config carries the class name of its system as `kind`; without one it is POEM v2's. Unknown keys,
missing kinds and values of another type fail; an absent key takes its default.
"""

import dataclasses
import enum
import json
import types
import typing
from typing import Any, TypeVar

from poem_jax.io.json_file import parse_json
from poem_jax.models.config import Config, ModelConfig, require
from poem_jax.models.systems import MODULES

_T = TypeVar("_T")
_KIND = "kind"
_SYNTHETIC_CROP = 1.5
"""Crop ratio of our own models, which files of earlier versions do not say."""
_MOVED = {
    "feature_stride": ("features", "stride"),
    "similarity": ("aggregation", "similarity"),
    "decoder.query_start": ("decoder", "first_queries"),
}
"""Keys of files of earlier versions, and the part and the name that they have now."""
_ONE_BY_ONE = {
    "branch_bias": ("features", False, True),
    "root.pooling": ("root", 1, 2),
    "root.cell_offset": ("root", 0.5, 0.0),
    "root.sum_epsilon": ("root", 0.0, 1e-6),
    "root.unit_rows": ("root", True, False),
    "features.fusion": ("features", "top_down", "bottom_up"),
    "features.position_code": ("features", "projected_point", "view_row_column"),
    "basis.behind_camera": ("features", "zeros", "mirrored"),
    "aggregation.layout": ("aggregation", "by_name", "row_major"),
    "aggregation.single_view": ("aggregation", "pass", "residual"),
    "aggregation.narrow_phi": ("aggregation", False, True),
    "decoder.query_order": ("decoder", "vertices_first", "joints_first"),
    "decoder.first_attention": ("decoder", "queries", "basis"),
    "decoder.vector_form": ("decoder", "basis", "queries_then_basis"),
    "decoder.first_neighbours": ("decoder", "nearest", "anchors"),
    "decoder.coordinate_update": ("decoder", "feed_forward", "branch_before"),
    "decoder.shared_embedding": ("decoder", False, True),
    "decoder.layer_norm_epsilon": ("decoder", 1e-5, 1e-12),
    "decoder.pooling": ("decoder", "by_name", "row_major"),
}
"""What files of earlier versions say one by one: the part that names its design now, and what the key said in
the paper's and in the release's."""


def to_json(config: ModelConfig) -> str:
    """Write a config as JSON text; dataclasses that are one of several carry their class name as `kind`, but
    for POEM v2's whole config."""
    kind = type(config)
    said = {} if kind is Config else {_KIND: kind.__name__}
    return json.dumps({**said, **_encode(config, kind)}, indent=2)


def from_json(text: str) -> ModelConfig:
    """Read a config from JSON text.

    Raises:
        ValueError: unknown key, missing or unknown `kind`, a value of the wrong type, or one that breaks a
            rule of its dataclass.
    """
    return from_values(parse_json(text, "the config"))


def from_values(values: Any) -> ModelConfig:
    """Read a config from the values of its JSON form; errors as in `from_json`."""
    if not isinstance(values, dict) or _KIND not in values:
        return _decode(_of_today(values) if isinstance(values, dict) else values, Config, "config")
    return _decode_one_of(values, tuple(MODULES), "config")


def _of_today(values: dict[str, Any]) -> dict[str, Any]:
    """Bring what a file of an earlier version says into today's form."""
    kept = {key: dict(value) if isinstance(value, dict) else value for key, value in values.items()}
    for key, (part, name) in _MOVED.items():
        for value in _taken(kept, key):
            _put(kept, part, name, value)
    said: dict[str, dict[str, int]] = {}
    for key, (part, *forms) in _ONE_BY_ONE.items():
        for value in _taken(kept, key):
            require(value in forms, f"`config.{key}` must be one of {forms}; got {_short(value)}")
            said.setdefault(part, {})[key] = forms.index(value)
    for part, choices in said.items():
        require(
            len(set(choices.values())) == 1,
            f"`config.{part}` must follow the paper or the release; got some of both, (0 = paper): {choices}",
        )
        design = ("paper", "release")[next(iter(choices.values()))]
        _put(kept, part, "layer" if part == "decoder" else "design", design)
    if "crop" not in kept and not _is_released(kept):
        kept["crop"] = {"ratio": _SYNTHETIC_CROP}
    return kept


def _taken(values: dict[str, Any], key: str) -> list[Any]:
    """Remove a key, `name` or `part.name`; return what it said, or nothing."""
    part, _, name = key.rpartition(".")
    owner = values.get(part) if part else values
    return [owner.pop(name)] if isinstance(owner, dict) and name in owner else []


def _put(values: dict[str, Any], part: str, name: str, value: Any) -> None:
    """Set a key of a part; what is no object is left for the decoder to refuse."""
    owner = values.setdefault(part, {})
    if isinstance(owner, dict):
        owner[name] = value


def _is_released(values: dict[str, Any]) -> bool:
    """Tell a released model by its decoder; all others, when folders did not tell their crops, had been
    trained on synthetic captures."""
    decoder = values.get("decoder")
    return isinstance(decoder, dict) and decoder.get("layer") == "release"


def _encode(value: Any, declared: Any) -> Any:
    if dataclasses.is_dataclass(value):
        hints = typing.get_type_hints(type(value))
        entries = {f.name: _encode(getattr(value, f.name), hints[f.name]) for f in dataclasses.fields(value)}
        return {_KIND: type(value).__name__, **entries} if _is_choice(declared) else entries
    return list(value) if isinstance(value, tuple) else value


def _decode(value: Any, declared: Any, path: str) -> Any:
    if _is_union(declared):
        return _decode_union(value, declared, path)
    if dataclasses.is_dataclass(declared):
        return _decode_dataclass(value, typing.cast(type, declared), path)
    if typing.get_origin(declared) is tuple:
        return _decode_tuple(value, typing.get_args(declared), path)
    if issubclass(declared, enum.Enum):
        known = [member.value for member in declared]
        require(value in known, f"`{path}` must be one of {known}; got {_short(value)}")
        return declared(value)
    # A bool is an int to Python; a whole number is a good float.
    accepted = (int, float) if declared is float else (declared,)
    require(type(value) in accepted, f"`{path}` must be of type {declared.__name__}; got {_short(value)}")
    return declared(value)


def _decode_tuple(value: Any, entries: tuple[Any, ...], path: str) -> tuple[Any, ...]:
    require(isinstance(value, list), f"`{path}` must be a list; got {_short(value)}")
    if entries[-1] is Ellipsis:
        entries = entries[:1] * len(value)
    require(len(value) == len(entries), f"`{path}` must have {len(entries)} entries; got {_short(value)}")
    return tuple(
        _decode(v, declared, f"{path}.{i}")
        for i, (v, declared) in enumerate(zip(value, entries, strict=True))
    )


def _decode_union(value: Any, declared: Any, path: str) -> Any:
    options = typing.get_args(declared)
    if value is None and types.NoneType in options:
        return None
    dataclass_options = tuple(option for option in options if dataclasses.is_dataclass(option))
    if len(dataclass_options) == len(options):
        return _decode_one_of(value, options, path)
    (declared,) = (option for option in options if option is not types.NoneType)
    return _decode(value, declared, path)


def _decode_one_of(value: Any, classes: tuple[type, ...], path: str) -> Any:
    require(isinstance(value, dict), f"`{path}` must be an object; got {_short(value)}")
    options = {option.__name__: option for option in classes}
    kind = value.get(_KIND)
    if not isinstance(kind, str) or kind not in options:
        raise ValueError(f"`{path}.{_KIND}` must be one of {sorted(options)}; got {_short(kind)}")
    return _decode_dataclass({k: v for k, v in value.items() if k != _KIND}, options[kind], path)


def _decode_dataclass(value: Any, declared: type[_T], path: str) -> _T:
    require(isinstance(value, dict), f"`{path}` must be an object; got {_short(value)}")
    hints = typing.get_type_hints(declared)
    unknown = sorted(set(value) - set(hints))
    if unknown:
        raise ValueError(f"`{path}` has unknown keys {_short(unknown)}; known are {sorted(hints)}")
    return declared(**{key: _decode(entry, hints[key], f"{path}.{key}") for key, entry in value.items()})


def _is_choice(declared: Any) -> bool:
    """Whether a value may be of one of several dataclasses."""
    return _is_union(declared) and types.NoneType not in typing.get_args(declared)


def _is_union(declared: Any) -> bool:
    return isinstance(declared, types.UnionType)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else text[:97] + "..."

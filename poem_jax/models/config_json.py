"""The JSON form of a model's configuration, saved beside every checkpoint.

Unknown keys, missing kinds and values of another type fail; an absent key takes its default.
"""

import dataclasses
import enum
import json
import types
import typing
from typing import Any, TypeVar

from poem_jax.io.json_file import parse_json
from poem_jax.models.config import Config, require

_T = TypeVar("_T")
_KIND = "kind"
_MOVED = {"feature_stride": ("features", "stride"), "similarity": ("aggregation", "similarity")}
"""Keys of the whole model that belong to one of its parts now; checkpoints of earlier versions have them."""


def to_json(config: Config) -> str:
    """Write a config as JSON text; dataclasses that are one of several carry their class name as `kind`."""
    return json.dumps(_encode(config, Config), indent=2)


def from_json(text: str) -> Config:
    """Read a config from JSON text.

    Raises:
        ValueError: unknown key, missing or unknown `kind`, a value of the wrong type, or one that breaks a
            rule of its dataclass.
    """
    return from_values(parse_json(text, "the config"))


def from_values(values: Any) -> Config:
    """Read a config from the values of its JSON form; errors as in `from_json`."""
    return _decode(_at_their_new_place(values), Config, "config")


def _at_their_new_place(values: Any) -> Any:
    if not isinstance(values, dict):
        return values
    kept = {key: value for key, value in values.items() if key not in _MOVED}
    for key, (part, name) in _MOVED.items():
        if key in values:
            kept[part] = {**kept.get(part, {}), name: values[key]}
    return kept


def _encode(value: Any, declared: Any) -> Any:
    if dataclasses.is_dataclass(value):
        hints = typing.get_type_hints(type(value))
        entries = {f.name: _encode(getattr(value, f.name), hints[f.name]) for f in dataclasses.fields(value)}
        return {_KIND: type(value).__name__, **entries} if _is_union(declared) else entries
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
    require(isinstance(value, dict), f"`{path}` must be an object; got {_short(value)}")
    options = {option.__name__: option for option in typing.get_args(declared)}
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


def _is_union(declared: Any) -> bool:
    return isinstance(declared, types.UnionType)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else text[:97] + "..."

"""OpenCV's FileStorage, YAML and XML, as plain values: maps, lists, text, numbers; a matrix is an array.

`cv2.FileStorage` gives only nodes that are asked for by name and type, and prints what it cannot read; here a
file from elsewhere is looked at as a whole.
"""

import re
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from poem_jax.calibration.camera_values import short
from poem_jax.io.yaml_file import parse_yaml
from poem_jax.typing import Array

MAX_ENTRIES = 10_000
"""Of a matrix; those of cameras have up to 16."""
_MAX_DEPTH = 64


class _Loader(yaml.SafeLoader):
    """YAML's safe schema and OpenCV's matrices."""


def _matrix_node(loader: Any, node: Any) -> Array:
    return _matrix(loader.construct_mapping(node, deep=True))


for _tag in ("tag:yaml.org,2002:opencv-matrix", "tag:yaml.org,2002:opencv-nd-matrix", "!opencv-matrix"):
    _Loader.add_constructor(_tag, _matrix_node)


def parse_opencv_yaml(text: str, source: str) -> dict[str, Any]:
    """Parse a YAML file of `cv2.FileStorage`.

    Raises: ValueError: it is broken, or holds no map.
    """
    # OpenCV's first line is no directive of YAML; and it may write numbers as `1.` or `.5e+1`.
    body = re.sub(r"\A\ufeff?%YAML[^\n]*\n(---[^\n]*\n)?", "", text)
    return _as_map(parse_yaml(body.encode(), source, _Loader), source)


def parse_opencv_xml(text: str, source: str) -> dict[str, Any]:
    """Parse an XML file of `cv2.FileStorage`.

    Raises: ValueError: it is broken, declares entities, or is not of OpenCV.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError(f"{source} declares XML entities, which no calibration needs and which are refused")
    try:
        root = ElementTree.fromstring(text.lstrip("\ufeff").encode())
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(f"{source} cannot be read as XML: {error}") from error
    if root.tag != "opencv_storage":
        raise ValueError(
            f"{source} is XML of another kind than OpenCV's: `<opencv_storage>`, got <{root.tag}>"
        )
    return _as_map({child.tag: _element(child, 0, source) for child in root}, source)


def _element(element: ElementTree.Element, depth: int, source: str) -> Any:
    if depth > _MAX_DEPTH:
        raise ValueError(f"{source} nests too deeply: over {_MAX_DEPTH} elements within each other")
    text = (element.text or "").strip()
    children = list(element)
    if (element.get("type_id") or "").startswith("opencv-"):
        fields = {child.tag: (child.text or "").strip() for child in children}
        try:
            return _matrix({**fields, "data": fields.get("data", "").split()})
        except ValueError as error:
            raise ValueError(f"{source}: <{element.tag}>: {error}") from error
    if children and all(child.tag == "_" for child in children):
        return [_element(child, depth + 1, source) for child in children]
    if children:
        return {child.tag: _element(child, depth + 1, source) for child in children}
    words = text.split()
    values = [_number(word) for word in words]
    if not words or any(value is None for value in values):
        return text.strip('"')
    return values[0] if len(values) == 1 else values


def as_lists(value: Any) -> Any:
    """Return a matrix as nested lists, anything else as it is."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def _matrix(fields: Mapping[str, Any]) -> Array:
    """Return a matrix from rows, cols and data.

    Raises: ValueError: these do not belong together.
    """
    try:
        rows, cols = int(fields["rows"]), int(fields["cols"])
        data = [float(number) for number in fields["data"]]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise ValueError(f"a matrix must have rows, cols and data; got {short(dict(fields))}") from None
    if not (0 <= rows * cols <= MAX_ENTRIES and rows >= 0 and len(data) == rows * cols):
        raise ValueError(f"a matrix of {rows} x {cols} must hold {rows * cols} numbers; got {len(data)}")
    return np.array(data).reshape(rows, cols)


def _number(word: str) -> int | float | None:
    try:
        return int(word)
    except ValueError:
        pass
    try:
        return float(word)
    except ValueError:
        return None


def _as_map(content: Any, source: str) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"{source} must hold OpenCV's named values; got {short(content)}")
    return {str(key): value for key, value in content.items()}

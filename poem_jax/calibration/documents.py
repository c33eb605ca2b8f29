"""Calibration files as text: which syntax one is in, which keys it holds, and its content as plain values.

Keys are found by looking at the text, without parsing it, so that a file that is cut off, or broken
elsewhere, still tells what it was meant to be.
"""

import enum
import math
import os
import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from poem_jax.calibration.opencv_storage import parse_opencv_xml, parse_opencv_yaml
from poem_jax.io.json_file import parse_json
from poem_jax.io.yaml_file import parse_yaml

MAX_BYTES = 2**26
"""64 MiB: images.txt of COLMAP holds every point of every image."""
_MAX_TEXT_BYTES = 2**23
"""8 MiB for formats that hold cameras alone; these have kilobytes."""


class Syntax(enum.Enum):
    """How a file is written."""

    JSON = "JSON"
    TOML = "TOML"
    YAML = "YAML"
    OPENCV_YAML = "OpenCV's YAML"
    XML = "XML"
    LINES = "lines of text"


class Document(NamedTuple):
    """A text file."""

    path: Path
    syntax: Syntax
    text: str
    keys: frozenset[str]
    """Names of entries, at any depth; of XML those of elements and attributes; of lines the words of those
    lines that are comments or end with a colon."""

    def content(self) -> Any:
        """Parse the file.

        Raises: ValueError: it is broken; the message names the file and the place.
        """
        source = str(self.path)
        if self.syntax is Syntax.JSON:
            return parse_json(self.text, source, allow_nan=True)
        if self.syntax is Syntax.TOML:
            return _parse_toml(self.text, source)
        if self.syntax is Syntax.YAML:
            return parse_yaml(self.text.encode(), source)
        if self.syntax is Syntax.OPENCV_YAML:
            return parse_opencv_yaml(self.text, source)
        if self.syntax is Syntax.XML:
            return parse_opencv_xml(self.text, source)
        return self.text


_KEYS = {
    Syntax.JSON: re.compile(r'"([^"\\\n]{1,60})"\s*:'),
    Syntax.TOML: re.compile(r"^\s*(?:\[+\s*)?\"?([\w.\- ]{1,60}?)\"?\s*(?:=|\]+\s*(?:#.*)?$)", re.MULTILINE),
    Syntax.YAML: re.compile(r"(?:^[ \t-]*|[{,]\s*)[\"']?([\w .\-/]{1,60}?)[\"']?\s*:(?=\s|$)", re.MULTILINE),
    Syntax.XML: re.compile(r"<([A-Za-z_][\w.\-]{0,60})|\s([A-Za-z_][\w.\-]{0,60})="),
    Syntax.LINES: re.compile(r"^\s*#\s*([^\n]{1,60})|^\s*(\w{1,30}):", re.MULTILINE),
}
_MATRIX_TAG = "opencv-matrix"
_COLMAP_LINE = re.compile(r"\s*\d+ [A-Z_]+ \d+ \d+ |\s*\d+( -?[\d.]+(e[-+]?\d+)?){7} \d+ \S", re.IGNORECASE)


def read_document(path: str | os.PathLike) -> Document:
    """Read a text file and tell its syntax.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is empty, too large, or no text.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no calibration at {path}")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path} is no calibration: it has {size} bytes, of at most {MAX_BYTES}")
    data = path.read_bytes()
    if not data.strip():
        raise ValueError(f"{path} is empty: expected a calibration of cameras")
    text = _decode(data)
    if text is None or "\0" in text:
        raise ValueError(f"{path} is no calibration: it is not text{_binary_kind(data)}")
    syntax = _syntax(text)
    if syntax is not Syntax.LINES and size > (_MAX_TEXT_BYTES if syntax is not Syntax.JSON else MAX_BYTES):
        raise ValueError(f"{path} is no calibration: it has {size} bytes, of at most {_MAX_TEXT_BYTES}")
    pattern = _KEYS[Syntax.YAML if syntax is Syntax.OPENCV_YAML else syntax]
    groups = (match.groups() for match in pattern.finditer(text[:_MAX_TEXT_BYTES]))
    return Document(path, syntax, text, frozenset(key.strip() for group in groups for key in group if key))


def _decode(data: bytes) -> str | None:
    marks = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
    encoding = next((name for mark, name in marks.items() if data.startswith(mark)), "utf-8")
    try:
        return data.decode(encoding)
    except UnicodeDecodeError:
        return None


def _binary_kind(data: bytes) -> str:
    """Say what a binary file is, for those that lie beside calibrations."""
    kinds = {
        b"PK\x03\x04": " but an archive or .npz",
        b"\x93NUMPY": " but a NumPy array: give the cameras as rig.json",
        b"\xff\xd8\xff": " but a JPEG image",
        b"\x89PNG": " but a PNG image",
        b"\x80\x04": " but a pickle, which is not read: it may run any program",
        b"\x80\x03": " but a pickle, which is not read: it may run any program",
    }
    binary = next((words for start, words in kinds.items() if data.startswith(start)), "")
    if not binary and data[4:8] == b"ftyp":
        binary = " but a video"
    return binary or "; COLMAP's binary files are made text by `colmap model_converter --output_type TXT`"


def _syntax(text: str) -> Syntax:
    start = text.lstrip("\ufeff \t\r\n")
    if start.startswith("<"):
        return Syntax.XML
    if start.startswith("%YAML") or _MATRIX_TAG in text:
        return Syntax.OPENCV_YAML
    if start.startswith("{") or re.match(r"\[\s*[{\[\"\d\-]", start):
        return Syntax.JSON
    lines = [line for line in start.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines or _COLMAP_LINE.match(lines[0]):
        return Syntax.LINES
    if any(re.match(r"\s*(\[+[\w .\"\-]+\]+|[\w.\"\-]+\s*=)", line) for line in lines[:3]):
        return Syntax.TOML
    if re.match(r"\s*\w+:\s*$", lines[0]) and len(lines) > 1 and re.match(r"\s*-?[\d.]+[\s\d]", lines[1]):
        return Syntax.LINES
    if any(re.match(r"[\s\-]*[\w .\"'/\-]+:(\s|$)", line) for line in lines[:3]):
        return Syntax.YAML
    return Syntax.LINES


def _parse_toml(text: str, source: str) -> dict[str, Any]:
    try:
        content = tomllib.loads(text.replace("\r\n", "\n"))
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise ValueError(f"{source} cannot be read as TOML: {str(error)[:300]}") from error
    return content


def is_number(word: str) -> bool:
    """Tell whether a word is a finite number."""
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False

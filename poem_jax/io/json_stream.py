"""Walk through JSON files of any size with the memory of one value at a time.

Public annotation files reach gigabytes, which `json.load` would turn into ten times as much memory. Here a
file is read in chunks; the containers on the way to the wanted values are walked through by hand, and only
the values are handed to Python's own decoder. What is wrong with a file ends in a `ValueError` that names it
and the place.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

_CHUNK = 2**20
MAX_VALUE = 2**26
"""Characters of one value: a bound on what a damaged file makes us hold."""
_SPACE = " \t\n\r"
_SHOWN = 40


def stream_entries(path: str | Path, depth: int) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the values that lie `depth` objects deep, each with its `depth` keys, in the file's order.

    Args:
        path: A file that holds objects of objects, such as {"capture": {"frame": value}} for depth 2.
        depth: Number of keys from the top to a value, at least 1.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is no JSON, is cut short, has something else than an object where one is expected, a
            number that is not finite, or a value of more than 64 million characters.
    """
    with _opened(path) as stream:
        walk = _Walk(stream, str(path), MAX_VALUE)
        yield from _entries(walk, depth, ())
        walk.end()


def stream_list(
    path: str | Path, key: str | None = None, *, max_value: int = MAX_VALUE, allow_nan: bool = False
) -> Iterator[Any]:
    """Yield the elements of a list.

    Args:
        path: A file that holds a list, or an object with one.
        key: The list is what the top object has under this key, and is read no further than its end. None:
            the file is the list.
        max_value: Characters that an element may take; several times as many may be held.
        allow_nan: Read `NaN` and `Infinity`, which Python writes though JSON has no such numbers; only for
            readers that check every number themselves.

    Raises:
        FileNotFoundError, ValueError: As `stream_entries`, or there is no such key.
    """
    with _opened(path) as stream:
        walk = _Walk(stream, str(path), max_value, allow_nan=allow_nan)
        if key is None:
            yield from walk.elements()
            walk.end()
            return
        for name in walk.object_keys():
            if name == key:
                yield from walk.elements()
                return
            walk.skip()
    raise ValueError(f"{path} must have the key `{key}` with a list; it has none")


def _opened(path: str | Path) -> TextIO:
    if not Path(path).is_file():
        raise FileNotFoundError(f"no JSON file at {path}")
    return Path(path).open(encoding="utf-8")


def _entries(walk: "_Walk", depth: int, above: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key in walk.object_keys():
        keys = (*above, key)
        if len(keys) == depth:
            yield keys, walk.value()
        else:
            yield from _entries(walk, depth, keys)


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is no number of JSON")


class _Walk:
    """A place in a JSON text, and a window of characters from there on."""

    def __init__(self, stream: TextIO, source: str, max_value: int, *, allow_nan: bool = False):
        self._stream, self._source, self._max_value = stream, source, max_value
        self._text, self._at, self._before, self._ended = "", 0, 0, False
        self._decoder = json.JSONDecoder(parse_constant=None if allow_nan else _refuse_constant)

    def object_keys(self) -> Iterator[str]:
        """Go into an object; at each key the caller takes or skips the value."""
        self._expect("{", "an object")
        if self._take("}"):
            return
        while True:
            key = self.value()
            if not isinstance(key, str):
                raise self._problem("a key must be text")
            self._expect(":", "`:` after a key")
            yield key
            if self._take("}"):
                return
            self._expect(",", "`,` or the end of an object")

    def elements(self) -> Iterator[Any]:
        """Go through a list."""
        self._expect("[", "a list")
        if self._take("]"):
            return
        while True:
            yield self.value()
            if self._take("]"):
                return
            self._expect(",", "`,` or the end of a list")

    def value(self) -> Any:
        """Read one value as a whole."""
        self._next()
        while True:
            try:
                value, end = self._decoder.raw_decode(self._text, self._at)
            except json.JSONDecodeError as error:
                if self._ended:
                    raise self._problem(f"cut short, or no JSON ({error.msg})") from None
            except (ValueError, RecursionError) as error:
                raise self._problem(str(error)) from None
            else:
                # A number may go on in the next chunk.
                if end < len(self._text) or self._ended:
                    self._at = end
                    return value
            if len(self._text) - self._at > self._max_value:
                raise self._problem(f"one value takes more than {self._max_value} characters, or is no JSON")
            self._more(max(_CHUNK, len(self._text) - self._at))

    def skip(self) -> None:
        """Leave a value out; lists one element at a time."""
        if self._next() == "[":
            for _ in self.elements():
                pass
        else:
            self.value()

    def end(self) -> None:
        """Insist that nothing follows."""
        if self._next():
            raise self._problem("something follows the end of the JSON")

    def _next(self) -> str:
        """Go to the next character that is no space and return it; "" at the end."""
        while True:
            while self._at < len(self._text):
                if self._text[self._at] not in _SPACE:
                    return self._text[self._at]
                self._at += 1
            if self._ended:
                return ""
            self._more(_CHUNK)

    def _take(self, character: str) -> bool:
        if self._next() != character:
            return False
        self._at += 1
        return True

    def _expect(self, character: str, what: str) -> None:
        if not self._take(character):
            raise self._problem(f"expected {what}")

    def _more(self, count: int) -> None:
        """Drop what was read, and read on."""
        try:
            read = self._stream.read(count)
        except UnicodeDecodeError as error:
            raise self._problem(f"not UTF-8 ({error.reason})") from None
        self._before += self._at
        self._text, self._at, self._ended = self._text[self._at :] + read, 0, not read

    def _problem(self, what: str) -> ValueError:
        here = self._text[self._at : self._at + _SHOWN]
        found = f"found {here!r}" if here else "the file ends there"
        return ValueError(
            f"{self._source} cannot be read as JSON: {what} at character {self._before + self._at}; {found}. "
            "Is it cut short? Fetch it again."
        )

"""Damage in the coded pixels of a JPEG that shows without decoding them.

Between the segments of a JPEG lie scans, runs of Huffman codes in which a byte 0xFF must be followed by 0x00
(ITU T.81, section B.1.1.5). Any other byte makes a marker of the two, and few markers may stand there. So a
wrong bit shows where it makes or breaks such a pair; wherever else it falls, it is another picture.
"""

import re

_MARKER = re.compile(rb"\xff[^\x00]")
_END, _SCAN, _FILLING = 0xD9, 0xDA, 0xFF
_RESTARTS = range(0xD0, 0xD8)
_RESTART_INTERVAL = 0xDD
_BEFORE_A_SCAN = {0xC4, 0xCC, _SCAN, 0xDB, 0xDC, _RESTART_INTERVAL, *range(0xE0, 0xF0), 0xFE}
"""Segments that may follow a scan: tables, the next scan's header, comments."""


def check_scans(data: bytes, position: int, restarts: bool) -> None:
    """Walk from the first scan's header over all that follows, to the end mark.

    What lies behind the end mark, as the second picture of some phones, does not count.

    Args:
        data: The whole file.
        position: Of the marker of the first scan's header.
        restarts: Whether a restart interval was given before.

    Raises:
        ValueError: A marker that cannot stand where it does, or no end.
        IndexError: A segment reaches beyond the end.
    """
    while True:
        lead, marker = data[position], data[position + 1]
        if lead != 0xFF or (marker not in _BEFORE_A_SCAN and marker not in (_FILLING, _END)):
            raise ValueError(
                f"bytes {lead:02x} {marker:02x} at {position} are no marker that may stand there"
            )
        if marker == _END:
            return
        if marker == _FILLING:
            position += 1
            continue
        length = int.from_bytes(data[position + 2 : position + 4])
        if marker == _RESTART_INTERVAL:
            restarts = data[position + 4 : position + 6] != b"\0\0"
        position += 2 + length
        if marker == _SCAN:
            position = _end_of_scan(data, position, restarts)


def _end_of_scan(data: bytes, position: int, restarts: bool) -> int:
    """Return where the marker stands that ends a scan."""
    count = 0
    while (match := _MARKER.search(data, position)) is not None:
        place, marker = match.start(), data[match.start() + 1]
        if marker == _FILLING:
            position = place + 1
            continue
        if marker not in _RESTARTS:
            return place
        if not restarts or marker != _RESTARTS[count % 8]:
            raise ValueError(f"the restart marker {marker:02x} at {place} is out of its order")
        count, position = count + 1, place + 2
    raise ValueError("it breaks off")

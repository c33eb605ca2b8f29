"""The files that a run was begun with: `data_files.json` in its folder, compared when the run goes on."""

import json
from collections.abc import Mapping
from pathlib import Path

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json

Fingerprints = Mapping[str, Mapping[str, str]]
"""Part -> file -> what identifies its content."""
_MOST = 10


def check_files(file: Path, now: Fingerprints, *, allow_change: bool, begun: bool) -> None:
    """Store the fingerprints of a run's data, or insist that they are those that are stored.

    Args:
        file: `data_files.json` of the run.
        now: fingerprints of the parts, by name.
        allow_change: take the new ones instead.
        begun: the run has a checkpoint already.

    Raises:
        ValueError: files have changed, come or gone since the run began; names them. Or the run has begun
            and nobody knows with which files.
    """
    if begun and not allow_change and not file.is_file():
        raise ValueError(
            f"the run of {file.parent} has checkpoints, but {file.name} is gone, which says what data it "
            "began with. Bring it back, choose another --train.out, or pass --train.allow-config-change to "
            "go on with the data there are now"
        )
    if file.is_file():
        changed = _changes(_stored(file), now)
        if changed and not allow_change:
            more = f" and {len(changed) - _MOST} more" if len(changed) > _MOST else ""
            raise ValueError(
                f"the data are not those that the run of {file.parent} began with: "
                f"{'; '.join(changed[:_MOST])}{more}. Bring them back, choose another --train.out, or pass "
                "--train.allow-config-change to go on with these"
            )
        if not changed:
            return
    with whole_file(file) as temporary:
        temporary.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _stored(file: Path) -> Fingerprints:
    stored = read_json(file, what="list of a run's data files")
    if not isinstance(stored, dict) or not all(isinstance(files, dict) for files in stored.values()):
        raise ValueError(f"{file} must hold the files of every source; remove it to take those there are now")
    return stored


def _changes(then: Fingerprints, now: Fingerprints) -> list[str]:
    """Name what differs, one entry a file."""
    lines = []
    for part in sorted(then.keys() | now.keys()):
        if part not in now or part not in then:
            lines.append(f"{part} is {'gone' if part in then else 'new'}")
            continue
        old, new = then[part], now[part]
        for name in sorted(old.keys() | new.keys()):
            if old.get(name) != new.get(name):
                lines.append(f"{part}: {name}: {old.get(name, 'absent')} -> {new.get(name, 'absent')}")
    return lines

"""Every fault of a shard of the released kind: by path and key in the error, the log and the run's report."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from poem_jax.data.augmentation_recipes import NONE
from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources.released_tars import ReleasedTars
from poem_jax.data.view_sampling import AllViews
from poem_jax.miniatures import faults
from poem_jax.miniatures.names import WRITERS
from poem_jax.mixture.report import DataReport
from poem_jax.mixture.samples import FrameSamples, Mixture

KEY, OTHER = "000000000", "000000001"
IMAGE, LABEL = f"{KEY}.image_3.jpg", f"{KEY}.label.pyd"


class Fault(NamedTuple):
    do: Callable[[Path], object]
    words: str
    when_opened: bool = False
    """Else when the sample is drawn."""
    key: str = KEY


def make_marker(jpeg: bytes) -> bytes:
    """One wrong bit among the pixels, which makes 0xFF 0x00 a marker."""
    place = jpeg.index(b"\xff\x00", jpeg.rindex(b"\xff\xda")) + 1
    return jpeg[:place] + b"\x20" + jpeg[place + 1 :]


FAULTS = {
    "a wrong bit in a picture's header": Fault(
        lambda path: faults.change_member(path, IMAGE, faults.flip_header_bit), f"{IMAGE} cannot be read"
    ),
    "a wrong bit that makes a marker": Fault(
        lambda path: faults.change_member(path, IMAGE, make_marker), f"{IMAGE} cannot be read"
    ),
    "a picture that breaks off": Fault(
        lambda path: faults.change_member(path, IMAGE, lambda data: data[: len(data) // 2]),
        f"{IMAGE} cannot be read",
    ),
    "a picture that asks to be turned": Fault(
        lambda path: faults.change_member(path, IMAGE, lambda data: faults.exif_turned(data, 3)),
        f"{IMAGE} has EXIF orientation 3",
    ),
    "a missing picture": Fault(lambda path: faults.drop_member(path, IMAGE), "images must be numbered"),
    "a label without vertices": Fault(
        lambda path: faults.drop_field(path, KEY, "verts_3d"), "label.pyd lacks `verts_3d`"
    ),
    "a joint that is NaN": Fault(
        lambda path: faults.spoil_field(path, KEY, "joints_3d", view=2), "`joints_3d` is not finite in view 2"
    ),
    "a hand 3 m wide": Fault(lambda path: faults.blow_up_hand(path, KEY), "is a hand of"),
    "a stretched extrinsic": Fault(lambda path: faults.skew_extrinsic(path, KEY), "is not rigid"),
    "a hostile pickle": Fault(
        lambda path: faults.poison_label(path, KEY, path.with_name("marker")), "label.pyd"
    ),
    "a truncated shard": Fault(faults.truncate, "breaks off", when_opened=True, key="-"),
    "an empty shard": Fault(faults.empty_archive, "the shard is empty", when_opened=True, key="-"),
    "a missing label": Fault(
        lambda path: faults.drop_member(path, LABEL), "it has no label.pyd", when_opened=True
    ),
    "a key that comes twice": Fault(
        lambda path: faults.repeat_key(path, KEY),
        "come twice in this sample, or two samples have its key",
        when_opened=True,
    ),
}


@pytest.fixture(scope="module")
def tars(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("tars")
    WRITERS["tars-dexycb"](root, samples=2)
    return root / "DexYCB_mv"


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_and_the_other_sample_drawn(tars, tmp_path, monkeypatch, caplog, name):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    fault = FAULTS[name]
    broken = Path(shutil.copy(tars / "DexYCB_mv_train-000000.tar", tmp_path))
    shutil.copy(tars / "DexYCB_mv_train-000001.tar", tmp_path)
    fault.do(broken)

    source = ReleasedTars(tmp_path)
    mixture = Mixture([FrameSamples(source, AllViews(), NONE, (32, 32), pose=True)], (1.0,), seed=0)
    report = DataReport(tmp_path / "data_report.json", mixture.names, max_corrupt_share=0.01)
    report.note_left_out(0, mixture.parts[0].left_out())
    drawn = [mixture.draw(position, 8) for position in range(2)]
    report.note(drawn)
    report.write()
    (entry,) = json.loads(report.file.read_text())
    told = entry["sources"][source.name]

    if fault.when_opened:
        problem = "".join(map(str, source.faults))
        assert told["left_out"] == [problem]
    else:
        with pytest.raises(CorruptSampleError) as caught:
            mixture.parts[0].sample(0, 8, np.random.default_rng(0))
        problem = str(caught.value)
        assert list(told["corrupt_samples"].values()) == [problem]
        assert {sample.sample.views.shape for sample in drawn} == {(8, 32, 32, 3)}
    assert f"{broken}" in problem
    assert f"sample {fault.key}: " in problem.replace(f"{broken.stem}/", "")
    assert fault.words in problem
    assert caplog.text.count(problem) == 1
    assert not (tmp_path / "marker").exists()


def test_a_wrong_bit_that_leaves_a_picture_is_not_seen(tars, tmp_path, monkeypatch):
    """What docs/data.md says: checksums of packed shards see it, no reader does."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    broken = Path(shutil.copy(tars / "DexYCB_mv_train-000000.tar", tmp_path))
    faults.change_member(broken, IMAGE, faults.flip_scan_bit)
    part = FrameSamples(ReleasedTars(broken), AllViews(), NONE, (32, 32), pose=True)
    whole = FrameSamples(ReleasedTars(tars / broken.name), AllViews(), NONE, (32, 32), pose=True)
    views = [of.sample(0, 8, np.random.default_rng(0)).views for of in (part, whole)]
    assert [i for i in range(8) if (views[0][i] != views[1][i]).any()] in ([], [3])

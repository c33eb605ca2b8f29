"""`poem import-torch` and `poem export-torch`: files of the release in, a model folder out, and back.

Most tests run on a shrunken release: its names and its steps, a few channels wide. One runs on the whole
`v2-small`. No weights of the authors are needed, and no torch; where that is installed it joins.
"""

import re
import shlex
import shutil
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple, get_args, get_type_hints

import jax
import numpy as np
import pytest

import poem_jax
from poem_jax.cli import USAGE_ERROR, main
from poem_jax.cli.export_torch import ExportTorch
from poem_jax.cli.import_torch import ImportTorch
from poem_jax.cli.run import parse
from poem_jax.geometry.neighbours import farthest_points
from poem_jax.hand.model import HandModel, mirror, template_queries
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.io.torch_file import load_state_dict, save_state_dict
from poem_jax.models import presets
from poem_jax.models.apply import init
from poem_jax.models.config import Config, HRNetConfig
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.frustum_config import CUBOIDS
from poem_jax.models.mesh_transformer_config import pe_meshtr_release
from poem_jax.models.presets import PRESETS
from poem_jax.training.config import flatten_config
from poem_jax.typing import Params
from poem_jax.weights.release_files import read_assets
from poem_jax.weights.release_keys import hand_prefixes, unused_shapes, used_rows
from poem_jax.weights.store import SHIPPED, expected_leaves, flatten
from poem_jax.weights.torch_import import VARIANTS, convert, export_state_dict
from tests.torch_pickles import call, dict_of, legacy_bytes, name, ordered, plain, storage, tensor, zip_bytes

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "weights.md"
ASSETS = ("bps.npy", "anchor.npy", "anchor_idx.npy")
STORAGES = {np.dtype(np.float32): "FloatStorage", np.dtype(np.int64): "LongStorage"}


def shrunken(config: Config, width: int = 16) -> Config:
    return replace(
        config,
        width=width,
        backbone=HRNetConfig(width=2, stem_channels=4, stem_blocks=2, modules=(1, 1, 1), blocks=1),
        basis=replace(config.basis, num_points=NUM_QUERIES),
        decoder=replace(config.decoder, num_neighbours=4),
    )


SHRUNKEN = {
    "v2-small-release": shrunken(PRESETS["v2-small-release"]),
    "v2-medium-release": shrunken(PRESETS["v2-medium-release"], width=32),
    "v2-medium-mano-release": shrunken(PRESETS["v2-medium-mano-release"], width=32),
}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Whatever the command sets for its process ends with the test."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")


@pytest.fixture
def small_presets(monkeypatch):
    for preset_name, config in SHRUNKEN.items():
        monkeypatch.setitem(PRESETS, preset_name, config)


# The release's files.


def released_state(config: Config) -> dict[str, np.ndarray]:
    """Names and shapes of a released state dict: random where an output depends on it, else zeros.

    The zeros take no memory, nor any space in the files that `write_wrapped` makes.
    """
    rng, leaves = np.random.default_rng(0), expected_leaves(config)
    state: dict[str, np.ndarray] = {}
    for entry in used_rows(config):
        ours = np.broadcast_to(False, leaves[entry.path].shape[len(entry.index) :])
        numbers = rng.standard_normal(entry.axes.to_foreign(ours).shape, np.float32)
        state[entry.source] = np.abs(numbers) if entry.source.endswith("running_var") else numbers
    for source, shape in unused_shapes(config).items():
        is_count = source.endswith("num_batches_tracked")
        state[source] = np.broadcast_to(np.int64(0) if is_count else np.float32(0), shape)
    hand = default_hand()
    buffers = {field: getattr(hand, field) for field in ("shapedirs", "posedirs", "J_regressor", "weights")}
    buffers |= {"v_template": hand.v_template[None], "faces": hand.faces.astype(np.int64)}
    buffers |= {"betas": np.zeros((1, 10), np.float32), "hands_mean": np.zeros((1, 45), np.float32)}
    for prefix in hand_prefixes(config):
        state |= {f"{prefix}th_{field}": array for field, array in buffers.items()}
    return {f"module.{source}": array for source, array in state.items()}


def write_wrapped(form: str, path: Path, state: dict[str, np.ndarray]) -> None:
    """Write {"epoch": 3, "state_dict": ...} in one of torch's forms."""
    tensors, storages = {}, {}
    for i, (key, array) in enumerate(state.items()):
        numbers = array if any(array.strides) else array.flat[:1]
        strides = tuple(stride // array.itemsize for stride in array.strides)
        stored = storage(form, str(i), numbers.size, name("torch", STORAGES[array.dtype]))
        tensors[key], storages[str(i)] = tensor(stored, array.shape, strides), numbers
    operations = dict_of({"epoch": plain(3), "state_dict": ordered(tensors)})
    path.write_bytes((zip_bytes if form == "zip" else legacy_bytes)(operations, storages))


def write_by_torch(form: str, path: Path, state: dict[str, np.ndarray]) -> None:
    torch = pytest.importorskip("torch")
    tensors = OrderedDict((key, torch.from_numpy(array.copy())) for key, array in state.items())
    content = {"epoch": 3, "state_dict": tensors}
    torch.save(content, path, _use_new_zipfile_serialization=form == "zip")


WRITERS: dict[str, Callable[[Path, dict[str, np.ndarray]], None]] = {
    "zip of ours": save_state_dict,
    "zip": lambda path, state: write_wrapped("zip", path, state),
    "legacy": lambda path, state: write_wrapped("legacy", path, state),
    "zip of torch": lambda path, state: write_by_torch("zip", path, state),
    "legacy of torch": lambda path, state: write_by_torch("legacy", path, state),
}


def write_hand(path: Path, hand: HandModel) -> None:
    fields = hand._asdict()
    np.savez(path, f=fields.pop("faces"), **{key: fields[key] for key in fields if key != "is_left"})


def write_assets(folder: Path, config: Config) -> None:
    """Random basis points, and anchors that spread over the template of the shipped hand."""
    template = template_queries(default_hand(), config.decoder.query_order)
    index = farthest_points(template, config.decoder.num_neighbours)
    points = np.random.default_rng(1).uniform(-0.05, 0.05, (config.basis.num_points, 3))
    anchors = template[index] / config.basis.radius
    folder.mkdir()
    for file, array in zip(ASSETS, (points.astype(np.float32), anchors, index.astype(np.int64)), strict=True):
        np.save(folder / file, array[None])


class Release(NamedTuple):
    folder: Path
    state: dict[str, np.ndarray]

    def command(self, out: Path, variant: str = "v2-small") -> list[str]:
        files = ["--mano", str(self.folder / "MANO_RIGHT.npz"), "--assets", str(self.folder / "assets")]
        checkpoint = str(self.folder / "model.pth.tar")
        return ["import-torch", checkpoint, "--variant", variant, *files, "--out", str(out)]

    def converted(self, config: Config, variant: str) -> Params:
        assets = read_assets(self.folder / "assets", config)
        return convert(self.state, variant, mano=default_hand(), **assets._asdict())[1]


def write_release(folder: Path, config: Config, write=WRITERS["zip"]) -> Release:
    release = Release(folder, released_state(config))
    write_hand(folder / "MANO_RIGHT.npz", default_hand())
    write_assets(folder / "assets", config)
    write(folder / "model.pth.tar", release.state)
    return release


@pytest.fixture(scope="module")
def small_release(tmp_path_factory) -> Release:
    return write_release(tmp_path_factory.mktemp("release"), SHRUNKEN["v2-small-release"])


@pytest.fixture
def release(small_release, tmp_path, small_presets) -> Release:
    """A copy that a test may damage."""
    shutil.copytree(small_release.folder, tmp_path / "release")
    return small_release._replace(folder=tmp_path / "release")


def assert_same_bits(got: Params, expected: Params) -> None:
    leaves, wanted = flatten(got), flatten(expected)
    assert leaves.keys() == wanted.keys()
    for path in leaves:
        a, b = np.asarray(leaves[path]), np.asarray(wanted[path])
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# What is written.


@pytest.mark.parametrize("form", WRITERS)
def test_every_form_gives_the_model_that_convert_makes(tmp_path, capsys, release, form: str):
    WRITERS[form](release.folder / "model.pth.tar", release.state)
    out = tmp_path / "models" / "small"
    assert main(release.command(out)) == 0
    config, params = poem_jax.load(out)
    assert config == SHRUNKEN["v2-small-release"]
    assert_same_bits(params, release.converted(config, "v2-small"))
    assert [path.name for path in out.parent.iterdir()] == ["small"]
    printed = capsys.readouterr().out
    trained = sum(np.size(leaf) for path, leaf in flatten(params).items() if path.startswith("trainable."))
    assert f"v2-small: {trained:,} parameters" in printed
    read, ignored = map(int, re.findall(r"(\d+) arrays read, (\d+) ignored", printed)[0])
    assert read == len(list(used_rows(config))) + 5
    assert read + ignored == len(release.state)
    assert f"poem reconstruct CAPTURE --out out/ --checkpoint {out}" in printed


def test_the_parametric_model_is_imported(tmp_path, small_presets):
    config = SHRUNKEN["v2-medium-mano-release"]
    release = write_release(tmp_path, config)
    assert main(release.command(tmp_path / "out", "v2-medium-mano")) == 0
    assert_same_bits(poem_jax.load(tmp_path / "out")[1], release.converted(config, "v2-medium-mano"))


def test_a_baseline_is_imported_with_its_data_set(tmp_path, capsys, monkeypatch):
    whole = pe_meshtr_release("ho3d")
    trunk = replace(whole.backbone, blocks=(1, 1), channels=(8, 16), stem_channels=8)
    config = replace(whole, width=16, backbone=trunk, decoder=DetrConfig(1, 2, 16))
    monkeypatch.setitem(
        presets.RELEASED,
        "pe-meshtr",
        lambda dataset, num_views: replace(config, cuboid=CUBOIDS[dataset]),
    )
    params = init(config, key=jax.random.key(0))
    # What no output depends on is constant; so it takes no space in the file.
    state = {
        f"module.{name}": np.broadcast_to(array.flat[0], array.shape) if not array.any() else array
        for name, array in export_state_dict(config, params).items()
    }
    write_wrapped("zip", tmp_path / "model.pth.tar", state)
    write_hand(tmp_path / "MANO_RIGHT.npz", default_hand())
    files = [str(tmp_path / "model.pth.tar"), "--mano", str(tmp_path / "MANO_RIGHT.npz")]
    out = tmp_path / "out"
    command = ["import-torch", *files, "--variant", "pe-meshtr", "--dataset", "ho3d", "--out", str(out)]
    assert main(command) == 0
    loaded, found = poem_jax.load(out)
    assert loaded == config
    assert loaded.cuboid == CUBOIDS["ho3d"]
    assert_same_bits(found["trainable"], params["trainable"])
    assert "pe-meshtr of ho3d: " in capsys.readouterr().out


@pytest.mark.slow
def test_a_whole_model_is_imported(tmp_path, capsys):
    config = PRESETS["v2-small-release"]
    release = write_release(tmp_path, config)
    try:
        assert main(release.command(tmp_path / "out")) == 0
        loaded, params = poem_jax.load(tmp_path / "out")
        assert loaded == config
        assert_same_bits(params, release.converted(config, "v2-small"))
        assert "v2-small: 48,828,126 parameters" in capsys.readouterr().out
    finally:
        # pytest keeps the folders of three runs; these files are large.
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        (tmp_path / "model.pth.tar").unlink()


def test_anchors_off_the_template_can_be_accepted(tmp_path, release):
    anchors = np.load(release.folder / "assets" / "anchor.npy") + np.float32(0.05)
    np.save(release.folder / "assets" / "anchor.npy", anchors)
    assert main(release.command(tmp_path / "out")) == USAGE_ERROR
    assert main([*release.command(tmp_path / "out"), "--accept-anchors"]) == 0
    _, params = poem_jax.load(tmp_path / "out")
    np.testing.assert_array_equal(params["constants"]["anchors"]["positions"], anchors[0])


def test_an_older_model_goes_only_when_asked(tmp_path, capsys, release):
    out = tmp_path / "out"
    assert main(release.command(out)) == 0
    before = contents(out)
    np.save(release.folder / "assets" / "bps.npy", np.zeros((NUM_QUERIES, 3), np.float32))
    assert main(release.command(out)) == USAGE_ERROR
    assert "out exists already; give another folder, or --overwrite" in capsys.readouterr().err
    assert contents(out) == before
    assert main([*release.command(out), "--overwrite"]) == 0
    assert not np.any(poem_jax.load(out)[1]["constants"]["basis_points"])


def test_nothing_but_a_model_is_replaced(tmp_path, capsys, release):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "hand.jpg").write_text("mine")
    assert main([*release.command(tmp_path / "photos"), "--overwrite"]) == USAGE_ERROR
    assert "photos is not replaced, for it is no model folder" in capsys.readouterr().err
    file = tmp_path / "photos" / "hand.jpg"
    assert main([*release.command(file), "--overwrite"]) == USAGE_ERROR
    assert "the results go to a folder" in capsys.readouterr().err
    assert file.read_text() == "mine"
    (tmp_path / "empty").mkdir()
    assert main([*release.command(tmp_path / "empty"), "--overwrite"]) == 0


# What is refused.


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _make_hostile(path: Path) -> None:
    run = call(name("os", "system"), plain(f"touch {path.parent / 'ran'}"))
    path.write_bytes(zip_bytes(dict_of({"state_dict": run}), {}))


FAILURES: dict[str, tuple[Callable[[Path], object], list[str], str]] = {
    "variant": (lambda folder: None, ["--variant", "v2-medium"], r"looks like v2-small: pass that variant"),
    "no checkpoint": (
        lambda folder: (folder / "model.pth.tar").unlink(),
        [],
        r"no file at .*model\.pth\.tar",
    ),
    "cut checkpoint": (
        lambda folder: _cut(folder / "model.pth.tar"),
        [],
        r"model\.pth\.tar .*Fetch it again",
    ),
    "hostile checkpoint": (
        lambda folder: _make_hostile(folder / "model.pth.tar"),
        [],
        r"asks for os\.system, which .* is refused",
    ),
    "no hand": (lambda folder: (folder / "MANO_RIGHT.npz").unlink(), [], r"no hand model at .*MANO_RIGHT"),
    "left hand": (
        lambda folder: write_hand(folder / "MANO_LEFT.npz", mirror(default_hand())),
        ["--mano", "MANO_LEFT.npz"],
        r"must be a right hand.* got a left one",
    ),
    "another hand": (
        lambda folder: write_hand(
            folder / "MANO_RIGHT.npz", default_hand()._replace(v_template=1.1 * default_hand().v_template)
        ),
        [],
        r"anchors must lie on the template of the hand; .*accept other anchors with --accept-anchors",
    ),
    "no assets": (
        lambda folder: shutil.rmtree(folder / "assets"),
        [],
        r"no bps\.npy in .*assets; give the folder `assets` of the authors' repository",
    ),
    "no anchors": (lambda folder: (folder / "assets/anchor.npy").unlink(), [], r"no anchor\.npy in .*assets"),
    "LFS pointer": (
        lambda folder: (folder / "assets/bps.npy").write_text("version https://git-lfs.github.com/spec/v1"),
        [],
        r"bps\.npy must be an npy of plain numbers; .*magic string .*Fetch it again",
    ),
    "cut assets": (
        lambda folder: _cut(folder / "assets/anchor.npy"),
        [],
        r"anchor\.npy must be an npy of plain numbers; .*Is it cut short",
    ),
    "objects": (
        lambda folder: np.save(folder / "assets/anchor_idx.npy", np.array([None]), allow_pickle=True),
        [],
        r"anchor_idx\.npy must be an npy of plain numbers; .*Python objects",
    ),
    "shape": (
        lambda folder: np.save(folder / "assets/bps.npy", np.zeros((2, 64, 3))),
        [],
        r"bps\.npy must hold floating numbers of shape \(799, 3\) or \(1, 799, 3\); got .*\(2, 64, 3\)",
    ),
    "type": (
        lambda folder: np.save(folder / "assets/anchor_idx.npy", np.zeros(4)),
        [],
        r"anchor_idx\.npy must hold integer numbers of shape \(4,\) .*got float64",
    ),
    "index": (
        lambda folder: np.save(folder / "assets/anchor_idx.npy", np.full(4, 799)),
        [],
        r"`anchor_indices` must be whole numbers from 0 to 798",
    ),
    "anchors": (
        lambda folder: np.save(folder / "assets/anchor.npy", np.full((4, 3), 0.5)),
        [],
        r"the anchors must lie on the template of the hand; 4 of 4 are up to",
    ),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("failure", FAILURES)
def test_what_is_wrong_is_one_line_and_leaves_nothing(tmp_path, capsys, monkeypatch, release, failure: str):
    damage, options, message = FAILURES[failure]
    damage(release.folder)
    monkeypatch.chdir(release.folder)
    results = tmp_path / "results"
    (results / "older" / "ckpt").mkdir(parents=True)
    (results / "older" / "config.json").write_text("older")
    before = contents(results)
    for out in (["new"], ["older", "--overwrite"]):
        assert main([*release.command(results / out[0]), *out[1:], *options]) == USAGE_ERROR
        error = capsys.readouterr().err
        assert error.startswith("poem: error: ")
        assert error.count("\n") == 1
        assert re.search(message, error), error
    assert [path.name for path in results.iterdir()] == ["older"]
    assert contents(results) == before
    assert not (release.folder / "ran").exists()


def test_unknown_variants_are_usage_errors(tmp_path, capsys, small_release):
    with pytest.raises(SystemExit) as stop:
        main(small_release.command(tmp_path / "out", "v2-huge"))
    assert stop.value.code == USAGE_ERROR
    assert "v2-medium-mano" in capsys.readouterr().err
    assert get_args(get_type_hints(ImportTorch)["variant"]) == VARIANTS


# Export.


def test_what_is_exported_comes_back(tmp_path, capsys, release):
    first, second, file = tmp_path / "first", tmp_path / "second", release.folder / "model.pth.tar"
    assert main(release.command(first)) == 0
    assert main(["export-torch", str(first), "--out", str(file), "--overwrite"]) == 0
    assert f"{len(release.state)} arrays written to {file}" in capsys.readouterr().out
    exported = load_state_dict(file)
    assert {f"module.{key}" for key in exported} == release.state.keys()
    for entry in used_rows(SHRUNKEN["v2-small-release"]):
        np.testing.assert_array_equal(exported[entry.source], release.state[f"module.{entry.source}"])
    assert main(release.command(second)) == 0
    assert_same_bits(poem_jax.load(second)[1], poem_jax.load(first)[1])


def test_torch_reads_what_is_exported(tmp_path, release):
    torch = pytest.importorskip("torch")
    assert main(release.command(tmp_path / "model")) == 0
    assert main(["export-torch", str(tmp_path / "model"), "--out", str(tmp_path / "new" / "a.pth.tar")]) == 0
    tensors = torch.load(tmp_path / "new" / "a.pth.tar", weights_only=True)
    expected = export_state_dict(*poem_jax.load(tmp_path / "model"))
    assert list(tensors) == list(expected)
    for key, array in expected.items():
        assert tensors[key].numpy().dtype == array.dtype
        np.testing.assert_array_equal(tensors[key].numpy(), array)


def test_what_cannot_be_exported_is_one_line_and_leaves_nothing(tmp_path, capsys):
    shutil.copytree(SHIPPED, tmp_path / "tiny")
    (tmp_path / "mine.pth").write_text("mine")
    for model, out, options, message in (
        ("tiny", "new/a.pth", [], "only the released models can be exported"),
        ("tiny", "mine.pth", ["--overwrite"], "only the released models can be exported"),
        ("tiny", "mine.pth", [], "mine.pth exists already; give another name, or --overwrite"),
        ("tiny", "tiny", ["--overwrite"], "it is a folder; give another --out"),
        ("none", "new/a.pth", [], "no checkpoint at"),
    ):
        assert main(["export-torch", str(tmp_path / model), "--out", str(tmp_path / out), *options]) == 2
        error = capsys.readouterr().err
        assert error.startswith("poem: error: ")
        assert error.count("\n") == 1
        assert message in error
    assert {path.name for path in tmp_path.iterdir()} - {"cache"} == {"tiny", "mine.pth"}
    assert (tmp_path / "mine.pth").read_text() == "mine"


# The document.


def test_the_commands_of_the_document_are_understood():
    blocks = re.findall(r"```\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    commands = [parse(shlex.split(line, comments=True)[1:]) for line in lines if line.startswith("poem ")]
    assert {ImportTorch, ExportTorch} <= {type(command) for command in commands}


def test_the_document_names_all_fields_that_differ_and_their_values():
    rows = re.findall(r"^\| `([a-z_.]+)` \| ([^|]+) \| ([^|]+) \|", DOCUMENT.read_text(), re.MULTILINE)
    ours, theirs = (flatten_config(PRESETS[name]) for name in ("v2-base", "v2-medium-release"))
    assert {field for field, *_ in rows} == {name for name in ours if ours[name] != theirs[name]}
    for field, paper, release in rows:
        for written, preset_name in ((paper, "v2-base"), (release, "v2-medium-release")):
            value = PRESETS[preset_name]
            for part in field.split("."):
                assert part in {f.name for f in fields(value)}
                value = getattr(value, part)
            assert written.strip() == f"`{value}`", field

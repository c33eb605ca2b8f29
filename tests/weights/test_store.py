"""Weights on disk: what goes in comes out, and what is wrong is named."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import poem_jax
from poem_jax.models.apply import init
from poem_jax.models.mesh_transformer_config import FTL_MESHTR, PE_MESHTR, pe_meshtr_release
from poem_jax.models.mvp_config import MvpConfig
from poem_jax.models.presets import preset
from poem_jax.weights import store
from poem_jax.weights.config_json import to_json
from tests.micro import MICRO


@pytest.fixture(scope="module")
def params():
    return init(MICRO, key=jax.random.key(0))


@pytest.fixture
def saved(params, tmp_path):
    poem_jax.save(tmp_path / "model", MICRO, params)
    return tmp_path / "model"


def test_round_trip_is_exact(saved, params):
    config, loaded = poem_jax.load(saved)
    assert config == MICRO
    jax.tree.map(np.testing.assert_array_equal, loaded, params)
    jax.tree.map(lambda a, b: a.dtype == b.dtype or pytest.fail(f"{a.dtype} {b.dtype}"), loaded, params)
    assert json.loads((saved / "config.json").read_text())["width"] == 16
    assert store.load(saved, expected=MICRO)[0] == MICRO


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_narrow_storage_comes_back_as_float32(params, tmp_path, dtype):
    store.save(tmp_path / "model", MICRO, params, dtype=dtype)
    _, loaded = store.load(tmp_path / "model")
    for group in ("trainable", "statistics"):
        jax.tree.map(
            lambda a, b: np.testing.assert_array_equal(a, b.astype(dtype).astype(np.float32)),
            loaded[group],
            params[group],
        )
    jax.tree.map(np.testing.assert_array_equal, loaded["constants"], params["constants"])

    def size(folder):
        return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())

    store.save(tmp_path / "wide", MICRO, params)
    assert size(tmp_path / "model") < size(tmp_path / "wide")


def test_values_beyond_the_storage_type_are_refused(params, tmp_path):
    huge = jax.tree.map(lambda leaf: leaf, params)
    huge["trainable"] = jax.tree.map(lambda leaf: leaf + 1e6, params["trainable"])
    with pytest.raises(ValueError, match=r"do not fit into float16.*bfloat16"):
        store.save(tmp_path / "model", MICRO, huge, dtype=jnp.float16)
    assert not (tmp_path / "model").exists()


def test_nothing_is_overwritten_unasked(saved, params):
    with pytest.raises(ValueError, match=r"`path` must not exist yet; got .*overwrite=True"):
        store.save(saved, MICRO, params)
    store.save(saved, MICRO, params, overwrite=True)
    store.load(saved)
    assert [entry.name for entry in saved.parent.iterdir()] == ["model"]


def test_a_failed_save_leaves_the_old_model(saved, params, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(store.ocp, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        store.save(saved, MICRO, params, overwrite=True)
    store.load(saved)
    assert [entry.name for entry in saved.parent.iterdir()] == ["model"]


def test_a_failed_rename_leaves_the_old_model(saved, params, monkeypatch):
    """The new folder is written, but cannot take the place of the old one."""
    replace_path = os.replace

    def fail(source, target):
        if Path(target) == saved and not str(source).endswith(".old"):
            raise OSError("no such luck")
        replace_path(source, target)

    monkeypatch.setattr(store.os, "replace", fail)
    changed = jax.tree.map(jnp.zeros_like, params)
    with pytest.raises(OSError, match="no such luck"):
        store.save(saved, MICRO, changed, overwrite=True)
    jax.tree.map(np.testing.assert_array_equal, store.load(saved)[1], params)
    assert [entry.name for entry in saved.parent.iterdir()] == ["model"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_file_is_no_place_for_a_model(params, tmp_path, overwrite):
    (tmp_path / "model").write_text("notes")
    with pytest.raises(ValueError, match=r"`path` must name a folder; got the file .*model"):
        store.save(tmp_path / "model", MICRO, params, overwrite=overwrite)
    assert (tmp_path / "model").read_text() == "notes"


def with_leaf(params, change):
    """Change the first trainable leaf, and return its name with the parameters."""
    name = next(iter(store.flatten(params["trainable"])))
    leaves = store.flatten(params)
    leaves[f"trainable.{name}"] = change(leaves[f"trainable.{name}"])
    return f"trainable.{name}", store.unflatten(leaves, params)


@pytest.mark.parametrize("dtype", [None, jnp.float16, jnp.bfloat16])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_not_finite_are_refused(params, tmp_path, dtype, value):
    name, broken = with_leaf(params, lambda leaf: leaf.at[(0,) * leaf.ndim].set(value))
    with pytest.raises(ValueError, match=rf"1 arrays hold NaN or infinity: {name}\."):
        store.save(tmp_path / "model", MICRO, broken, dtype=dtype)
    assert not (tmp_path / "model").exists()


def test_stored_weights_that_are_not_finite_are_refused(params, tmp_path, monkeypatch):
    name, broken = with_leaf(params, lambda leaf: leaf.at[(0,) * leaf.ndim].set(np.nan))
    with monkeypatch.context() as unchecked:
        unchecked.setattr(store, "_check_finite", lambda *_: None)
        store.save(tmp_path / "model", MICRO, broken)
    with pytest.raises(ValueError, match=rf"checkpoint at .*NaN or infinity: {name}\."):
        store.load(tmp_path / "model")


def test_numbers_of_another_kind_are_refused(params, tmp_path, monkeypatch):
    name, broken = with_leaf(params, lambda leaf: leaf.astype(jnp.int32))
    message = rf"{name}: expected floating numbers, got integer"
    with pytest.raises(ValueError, match=message):
        store.save(tmp_path / "model", MICRO, broken)
    with monkeypatch.context() as unchecked:
        unchecked.setattr(store, "check_leaves", lambda *_: None)
        store.save(tmp_path / "model", MICRO, broken)
    with pytest.raises(ValueError, match=message):
        store.load(tmp_path / "model")


def test_params_of_another_config_are_not_saved(params, tmp_path):
    with pytest.raises(ValueError, match=r"arrays do not fit the config: .*expected \(.*got \("):
        store.save(tmp_path / "model", replace(MICRO, width=32), params)
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize("missing", ["", "config.json", "ckpt"])
def test_missing_parts_are_file_not_found(saved, missing):
    path = saved / "elsewhere" if not missing else saved
    if missing:
        (saved / missing).rename(saved / "gone")
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .* does not exist. Expected a folder"):
        store.load(path)


def test_truncated_arrays_are_a_value_error(saved):
    for file in (saved / "ckpt").rglob("*"):
        if file.is_file() and file.stat().st_size > 300:
            file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(
        ValueError, match=r"is truncated or not an Orbax .*bytes, got 200.*Copy the whole folder"
    ):
        store.load(saved)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"image_hw": [32, 32], "colour": 1}'])
def test_a_damaged_config_is_a_value_error(saved, text):
    (saved / "config.json").write_text(text)
    with pytest.raises(ValueError, match=r"config.json is not a model config"):
        store.load(saved)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ('{"basis": {"num_points": 1000000000000}}', "`num_points` must be at most 65536; got 1000000000000"),
        ('{"decoder": {"num_layers": 10000000}}', "`num_layers` must be at most 256"),
        ('{"width": 16, "width": 32}', "the key `width` comes more than once"),
        ('{"image_mean": NaN}', "`image_mean` must be finite"),
        ("[" * 10**5, "nests too deeply"),
        ('{"width": 1e999}', "`width` must be finite"),
        ('{"width": ' + "9" * 400 + "}", "`width` is a whole number beyond 64 bits"),
        ('{"features": 5, "feature_stride": 8}', "is not a model config"),
    ],
)
def test_a_hostile_config_is_refused_before_anything_is_built(saved, text, cause):
    (saved / "config.json").write_text(text)
    with pytest.raises(ValueError, match=rf"config\.json is not a model config: .*{cause}|{cause}"):
        store.load(saved)


def test_a_config_with_a_byte_order_mark_is_read(saved):
    text = (saved / "config.json").read_bytes()
    (saved / "config.json").write_bytes(b"\xef\xbb\xbf" + text)
    assert store.load(saved)[0] == MICRO


def test_unsealed_weights_are_never_read_in_silence(saved, caplog):
    store.load(saved)
    assert caplog.messages == []
    (saved / "seal.json").unlink()
    store.load(saved)
    assert "is read unchecked: seal.json is missing" in caplog.text


def test_a_config_that_is_not_the_arrays_own_is_a_value_error(saved):
    (saved / "config.json").write_text(to_json(replace(MICRO, width=32)))
    with pytest.raises(ValueError, match=r"arrays do not fit the config: .*Use the config"):
        store.load(saved)


def test_an_unexpected_config_is_a_value_error(saved):
    with pytest.raises(ValueError, match=r"checkpoint of another config at .*`width` expected 32, got 16"):
        store.load(saved, expected=replace(MICRO, width=32))


@pytest.mark.parametrize(
    ("expected", "got", "differing"),
    [
        (
            pe_meshtr_release(),
            pe_meshtr_release("oakink"),
            "`fusion.frustum.start` expected 0.2, got 0.0; `fusion.frustum.end` expected 2.0, got 1.5; "
            "`cuboid.low` expected [-1.2, -1.2, 0.2], got [-1.0, -1.0, 0.0]; "
            "`cuboid.high` expected [1.2, 1.2, 2.0], got [1.0, 1.0, 1.5]",
        ),
        (PE_MESHTR, FTL_MESHTR, "`fusion` expected a PositionEmbeddedFusion, got a CanonicalFusion"),
        (MvpConfig(), MvpConfig(num_views=5), "`num_views` expected 8, got 5"),
        (preset("tiny"), replace(preset("tiny"), joint_decoder=None), "a JointDecoderConfig, got None"),
        (PE_MESHTR, MvpConfig(), "expected a MeshTransformerConfig, got a MvpConfig"),
    ],
    ids=["another data set", "another fusion", "another number of views", "without a part", "another system"],
)
def test_another_config_is_told_by_the_fields_that_differ(tmp_path, expected, got, differing):
    (tmp_path / "ckpt").mkdir()
    (tmp_path / "config.json").write_text(to_json(got))
    with pytest.raises(ValueError, match=re.escape(f"{differing}. Build")):
        store.load(tmp_path, expected=expected)


def test_a_model_does_not_tell_where_it_was_written(tmp_path, params):
    store.save(tmp_path / "model", MICRO, params)
    files = [file for file in (tmp_path / "model").rglob("*") if file.is_file()]
    assert files
    assert not [file.name for file in files if str(tmp_path).encode() in file.read_bytes()]
    store.load(tmp_path / "model")


def test_shipped_weights_are_small_and_load():
    config, params = store.shipped()
    assert config.image_hw == (128, 128)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params["trainable"]))
    size = sum(file.stat().st_size for file in store.SHIPPED.rglob("*") if file.is_file())
    assert size <= 25e6

import pytest

from poem_jax.capture.outputs.formats import Format, formats_of


def test_a_list_with_commas():
    assert formats_of("glb, BVH,csv,") == {Format.GLB, Format.BVH, Format.CSV}


@pytest.mark.parametrize("text", ["", ",", "fbx", "glb,fbx"])
def test_what_is_none_of_them(text):
    with pytest.raises(ValueError, match=r"--formats must be a list of glb, bvh, csv, trc, mano, video, png"):
        formats_of(text)

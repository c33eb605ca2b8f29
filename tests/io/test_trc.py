import numpy as np

from poem_jax.io.trc import write_trc


def test_the_layout_that_opensim_reads(tmp_path):
    points = np.array([[[1.0, 2, 3], [np.nan] * 3], [[4, 5, 6.25], [7, 8, 9]]])
    write_trc(tmp_path / "hands.trc", ["a", "b"], np.array([0.0, 0.02]), points, 50.0)
    rows = [line.split("\t") for line in (tmp_path / "hands.trc").read_text().splitlines()]
    assert rows[0] == ["PathFileType", "4", "(X/Y/Z)", "hands.trc"]
    assert dict(zip(rows[1], rows[2], strict=True)) == {
        "DataRate": "50",
        "CameraRate": "50",
        "NumFrames": "2",
        "NumMarkers": "2",
        "Units": "mm",
        "OrigDataRate": "50",
        "OrigDataStartFrame": "1",
        "OrigNumFrames": "2",
    }
    assert rows[3] == ["Frame#", "Time", "a", "", "", "b", "", ""]
    assert rows[4] == ["", "", "X1", "Y1", "Z1", "X2", "Y2", "Z2"]
    assert rows[5] == [""]
    assert rows[6] == ["1", "0.000000", "1.0000", "2.0000", "3.0000", "", "", ""]
    assert rows[7] == ["2", "0.020000", "4.0000", "5.0000", "6.2500", "7.0000", "8.0000", "9.0000"]

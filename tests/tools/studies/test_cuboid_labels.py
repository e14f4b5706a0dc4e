"""The accuracy page and the codec's benchmark, from the command line, on a small made-up scene."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import shapely

from tools.benchmarks import codec as benchmark_codec
from tools.studies import cuboid_labels as label_accuracy

CALIBRATION = {"vp1": [790.0, -320.0], "vp2": [21000.0, -150.0], "pp": [960.0, 540.0], "scale": 0.025}


@pytest.fixture
def tree(tmp_path):
    """Two recordings in the layout of the real ones: one straight road seen by one camera."""
    mask = np.zeros((1080, 1920), np.uint8)
    cv2.fillPoly(mask, [np.array([[250, 1079], [1500, 1079], [1080, 130], [800, 130]])], 255)
    for name in ("session8_left", "session9_left"):
        (tmp_path / "brnocompspeed" / "dataset" / name).mkdir(parents=True)
        (tmp_path / "brnocompspeed" / "results" / name).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "brnocompspeed" / "dataset" / name / "video_mask.png"), mask)
        path = tmp_path / "brnocompspeed" / "results" / name / "system_optimal_calibration.json"
        path.write_text(json.dumps({"camera_calibration": CALIBRATION, "cars": []}), encoding="utf-8")
    return tmp_path


def test_masks_cover_what_the_polygon_covers():
    rng = np.random.default_rng(0)
    for _ in range(50):
        vertices = rng.uniform(20, 120, (8, 2))
        mask, (x, y) = label_accuracy.rasterise(vertices)
        hull = shapely.MultiPoint(vertices.astype(np.float32)).convex_hull
        rows, columns = np.indices(mask.shape)
        inside = shapely.contains_xy(hull, columns.ravel() + x + 0.5, rows.ravel() + y + 0.5).reshape(mask.shape)
        np.testing.assert_array_equal(mask, inside)
        assert mask.sum() == pytest.approx(hull.area, rel=0.03)


@pytest.mark.slow
def test_the_page_is_written_and_says_the_same_twice(tree, tmp_path, capsys):
    out = tmp_path / "docs" / "accuracy.md"
    command = ["--real", str(tree), "--count", "40", "--out", str(out)]
    assert label_accuracy.main(command) == 0
    text = out.read_text(encoding="utf-8")
    assert text.count("| session8_left |") == text.count("| session9_left |") == 4  # two pairs, two methods
    assert "15 of 15" not in text
    assert text.count("2 of 2") >= 4  # the hull keeps its bounds by both rules in both pairs
    assert label_accuracy.main(command[:4]) == 0
    assert capsys.readouterr().out == text


@pytest.mark.parametrize("where", [None, "nowhere"])
def test_without_scenes_it_says_what_to_set(where, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("LABELGEN_REAL_DATA", raising=False)
    arguments = [] if where is None else ["--real", str(tmp_path / where)]
    assert label_accuracy.main(arguments) == 2
    message = capsys.readouterr().err
    assert "LABELGEN_REAL_DATA" in message
    assert message.count("\n") == 1


def test_the_codec_benchmark_runs(capsys):
    assert benchmark_codec.main(["--count", "1000", "--repeat", "1"]) == 0
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == ["decode", "encode"]

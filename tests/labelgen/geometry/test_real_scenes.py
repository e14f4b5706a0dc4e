"""The real recordings: rectifications, the codec, and labels from masks of solid boxes."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from labelgen.geometry import Pair, Rectification, Rule, decode_boxes, encode_boxes, reorder_vertices, road_cuboids
from tools.studies.cuboid_labels import MEDIAN_BOUND, P99_BOUND, Scene, load_scenes, measure_scenes

REAL = os.environ.get("LABELGEN_REAL_DATA")
pytestmark = pytest.mark.skipif(not REAL, reason="LABELGEN_REAL_DATA is not set: the folder with the real recordings")

SIZES = {
    Pair.VP2_VP3: [(480, 270), (640, 360), (960, 540)],
    Pair.VP1_VP2: [(270, 480), (360, 640), (540, 960)],
}
EVERY_WAY = [(pair, size) for pair, sizes in SIZES.items() for size in sizes]


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    found = load_scenes(REAL or "")
    assert len(found) == 15
    return found


@pytest.mark.parametrize(("pair", "size"), EVERY_WAY, ids=str)
def test_every_scene_is_rectified(scenes, pair, size):
    for scene in scenes:
        rect = Rectification.from_road_mask(scene.camera, scene.road, pair, size)
        assert rect.frame_coverage >= 0.8, scene.name
        assert rect.frame_coverage == pytest.approx(rect.warp_mask(np.ones((1080, 1920), bool)).mean(), abs=0.003)
        if pair is Pair.VP1_VP2:  # VP3, below the picture, but for session5_left, where it lies 27 px inside of 640
            assert rect.vpu[1] > size[1] * (0.95 if scene.name == "session5_left" else 1.0), scene.name
        else:
            assert rect.vpu[1] < 0, scene.name
        centre = rect.points_back(np.array(size) / 2)
        # Lines along the road and up the vehicles (or across the road) run along the picture's columns and rows.
        for number, axis in ((2, 1), (pair.vertical, 0)):
            towards = scene.camera.vanishing_point(number) - centre
            ends = rect.points(centre + np.array([[-20], [20]]) * towards / np.linalg.norm(towards))
            assert abs(ends[1, axis] - ends[0, axis]) < 1e-6
        right, down = (rect.points(centre + d) - rect.points(centre) for d in ([1, 0], [0, 1]))
        assert right[0] * down[1] - right[1] * down[0] > 0
        assert down[1] > 0
        # What drives towards VP1, up the frame in all these scenes, drives up the picture.
        away = scene.camera.vp1 - centre
        assert (rect.points(centre + 5 * away / np.linalg.norm(away)) - rect.points(centre))[1] < 0


def test_rectifications_agree_with_the_public_implementation(scenes):
    # real/expected/rectifications.json; it takes hull corners at pixel indices, not at pixel borders.
    rows = json.loads((Path(REAL or "") / "expected" / "rectifications.json").read_text(encoding="utf-8"))["rows"]
    by_name = {scene.name: scene for scene in scenes}
    uncropped = 0
    for row in rows:
        scene, pair = by_name[row["recording"]], Pair.parse(row["pair"])
        rect = Rectification.from_road_mask(scene.camera, scene.road, pair, tuple(row["size"]))
        assert scene.camera.focal == pytest.approx(row["focal"], rel=1e-9)
        np.testing.assert_allclose(scene.camera.vp3, row["vp3"], rtol=1e-9)
        assert rect.crop_steps == row["crop_steps"]
        assert rect.frame_coverage == pytest.approx(row["frame_coverage"], abs=0.005)
        assert rect.road_area == pytest.approx(row["road_area"], abs=0.01)
        if row["crop_steps"] == 0:
            uncropped += 1
            np.testing.assert_allclose(rect.points(row["frame_px"]), row["rectified_px"], atol=1.5)
            np.testing.assert_allclose(rect.vpu, row["vpu"], atol=1.5)
    assert len(rows) == 30
    assert uncropped == 28


def test_boxes_go_round_the_codec(scenes):
    rng = np.random.default_rng(0)
    total, worst = 0, 0.0
    sides: dict[Pair, set[str]] = {pair: set() for pair in Pair}
    for scene in scenes:
        rows, columns = np.nonzero(scene.road.pixels)
        for pair in Pair:
            rect = Rectification.from_road_mask(scene.camera, scene.road, pair, SIZES[pair][1])
            pick = rng.integers(0, len(rows), 5000)
            near = scene.camera.road_points(np.stack([columns[pick], rows[pick]], axis=1) + 0.5, invalid="nan")
            cuboids = road_cuboids(near, rng.uniform([3.5, 1.6, 1.3], [16.5, 2.6, 4.0], (len(near), 3)))
            vertices = rect.points(scene.camera.project(cuboids))
            vertices = vertices[np.isfinite(vertices).all(axis=(1, 2))]
            encoded = encode_boxes(vertices, rect.vpu)
            boxes = encoded.boxes_xyxy
            decoded, valid = decode_boxes(boxes, encoded.cc, rect.vpu)
            outside = (rect.vpu[1] < boxes[:, 1]) | (rect.vpu[1] > boxes[:, 3])
            np.testing.assert_array_equal(valid, outside)  # no label if and only if VPU lies between top and bottom
            again = reorder_vertices(decoded, encoded.mirrored, encoded.reversed)
            worst = max(worst, float(np.abs(again - vertices).max(axis=(1, 2))[valid].max(initial=0)))
            total += int(valid.sum())
            sides[pair] |= {
                name
                for name, there in {
                    "left": rect.vpu[0] < boxes[:, 0],
                    "right": rect.vpu[0] > boxes[:, 2],
                    "within": (rect.vpu[0] > boxes[:, 0]) & (rect.vpu[0] < boxes[:, 2]),
                }.items()
                if there[valid].sum() > 100
            }
    assert total > 100_000
    assert worst < 1e-6
    assert sides == {pair: {"left", "right", "within"} for pair in Pair}


@pytest.mark.slow
def test_masks_of_solid_boxes_give_their_labels(scenes):
    rows = list(measure_scenes(scenes, count=200))
    assert len(rows) == 30
    for row in rows:
        where = f"{row.scene} {row.pair}"
        for rule, accuracy in row.accuracy.items():
            assert len(accuracy.cc) == 200, where
            assert np.median(accuracy.cc) <= MEDIAN_BOUND, f"{where} {rule}"
            assert np.median(accuracy.box_px) <= 1.5, where
        assert np.percentile(row.accuracy[Rule.CONDITIONED].cc, 99) <= P99_BOUND, where
        assert row.boxes.unlabelled == 0 or row.scene == "session5_left"

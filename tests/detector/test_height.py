"""c_c from a vehicle's height, against the geometry it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from random_cameras import random_camera

from detector.augment import AxisMap
from detector.height import VEHICLE_M, heights_from_cc, merge_cc, scene_vector
from detector.model import CcHead, ModelConfig, build_model
from detector.presets import PRESETS
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Pair, Rectification, encode_boxes, road_cuboids

SIZE = (480, 270)


def views(pair: Pair, count: int = 12) -> list[tuple[Camera, Rectification]]:
    rng, found = np.random.default_rng(5), []
    while len(found) < count:
        camera = random_camera(rng, roll_deg=2.0)
        try:
            rectification = Rectification.from_window(camera, [400, 500, 1500, 1080], pair, SIZE)
        except LabelgenError:
            continue
        found.append((camera, rectification))
    return found


@pytest.mark.parametrize("pair", list(Pair))
def test_c_c_is_what_the_height_says(pair: Pair) -> None:
    """Whatever the vehicle's length, width and place, before and after an augmentation."""
    rng, checked = np.random.default_rng(1), 0
    for camera, rectification in views(pair):
        high = camera.height_m
        near = np.stack([rng.uniform(2, 6, 40), rng.uniform(-1.5, 1.5, 40)], axis=1) * high
        sizes = rng.uniform(0.1, 0.3, (40, 3)) * high
        vertices = rectification.points(camera.project(road_cuboids(near, sizes)))
        keep = np.isfinite(vertices).all(axis=(1, 2))
        encoded = encode_boxes(vertices[keep], rectification.vpu)
        # What VP3 lies above is seen from behind itself; a front of less than 1 px is none.
        rows = encoded.boxes_xyxy[:, 3]
        front = (1 - encoded.cc) * (rows - encoded.boxes_xyxy[:, 1])
        fine = ((rows > rectification.vpu[1]) == (pair is Pair.VP2_VP3)) & (front > 1)
        tall = sizes[keep][fine, 2]
        share = tall / high if pair is Pair.VP2_VP3 else tall / (high - tall)
        scene = torch.from_numpy(scene_vector(rectification.vpu, camera))
        move = AxisMap((-1.7, 0.6), (500.0, 40.0))
        moved = torch.tensor([move.points([0.0, float(scene[0])])[1], float(scene[1])], dtype=torch.float64)
        cc, boxes = torch.from_numpy(encoded.cc[fine]), encoded.boxes_xyxy[fine]
        heights = torch.from_numpy(np.log(share * high / VEHICLE_M))
        told = heights_from_cc(cc, torch.from_numpy(boxes), scene)
        near_rows = np.abs(boxes[:, 3] - rectification.vpu[1]) < 1
        np.testing.assert_allclose(told[~near_rows], heights[~near_rows], atol=1e-6)
        for where, at in ((boxes, scene), (move.boxes(boxes), moved)):
            again = merge_cc(torch.zeros_like(cc), heights, torch.from_numpy(where), at, 1.0)
            np.testing.assert_allclose(again[~near_rows], cc[~near_rows], atol=1e-6)
        checked += np.count_nonzero(~near_rows)
    assert checked > 150


@pytest.mark.parametrize(("weight", "wanted"), [(0.0, 0.4), (0.5, 0.4 + 0.5 * 0.2), (1.0, 0.6)])
def test_both_are_merged(weight: float, wanted: float) -> None:
    """A box 40 px high that stands 80 px from VPU: a vehicle of 1.5 m takes 0.2 * 80 of its 40 px."""
    values = torch.tensor([0.4]), torch.tensor([0.0]), torch.tensor([[10.0, 50.0, 50.0, 90.0]])
    assert merge_cc(*values, torch.tensor([10.0, 0.2]), weight).tolist() == pytest.approx([wanted])
    # Without the camera's height there is only what was seen.
    assert merge_cc(*values, torch.tensor([10.0, 0.0]), weight).tolist() == pytest.approx([0.4])


def test_the_scene_of_a_camera() -> None:
    ((camera, rectification),) = views(Pair.VP2_VP3, 1)
    row, ratio = scene_vector(rectification.vpu, camera)
    assert (row, ratio) == (rectification.vpu[1], pytest.approx(1.5 / camera.height_m))
    assert scene_vector(rectification.vpu, replace(camera, scale=None))[1] == 0


@pytest.mark.parametrize("known", [True, False])
def test_loss_of_heights(known: bool) -> None:
    """One anchor on a label with c_c 0.6: (1 - 0.6) * 40 px is what 1.5 m have there, so the height should be 0."""
    head = CcHead(8, 1, convs=1, cc_weight=3.0, beta=0.02, with_height=True)
    anchors = [torch.tensor([[10.0, 50.0, 50.0, 90.0], [200.0, 200.0, 240.0, 240.0]])]
    target = {
        "boxes": torch.tensor([[10.0, 50.0, 50.0, 90.0]]),
        "cc": torch.tensor([0.6]),
        "cc_known": torch.tensor([True]),
        "scene": torch.tensor([10.0, 0.2 if known else 0.0]),
    }
    heights = torch.tensor([[0.2, 0.9]], requires_grad=True)
    outputs = {
        "cls_logits": torch.zeros(1, 2, 1),
        "bbox_regression": torch.zeros(1, 2, 4),
        "cc": torch.tensor([[0.6, 0.1]]),
        "height": heights,
    }
    losses = head.compute_loss([target], outputs, anchors, [torch.tensor([0, -1])])
    assert losses["cc"].item() == pytest.approx(0, abs=1e-6)
    assert losses["height"].item() == pytest.approx(3 * (0.2 - 0.01) if known else 0, rel=1e-4)
    losses["height"].backward()
    assert heights.grad is not None
    assert heights.grad.tolist() == [[pytest.approx(3.0 if known else 0.0), 0.0]]


def test_only_some_models_say_the_height() -> None:
    assert {name for name, preset in PRESETS.items() if preset.model.height_weight} == {"small"}
    config = ModelConfig("mobilenet_v3_small", (4, 5), 32, 1, anchor_sizes=((32.0,), (64.0,)), anchor_ratios=(1.0,))
    for weight, names in (
        (0.0, {"boxes", "scores", "labels", "cc"}),
        (0.5, {"boxes", "scores", "labels", "cc", "height"}),
    ):
        model = build_model(replace(config, height_weight=weight), score_thresh=0.0).eval()
        with torch.no_grad():
            (found,) = model([torch.rand(3, 96, 160)])
        assert set(found) == names
        assert len({len(value) for value in found.values()}) == 1

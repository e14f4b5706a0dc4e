"""c_c from a vehicle's height, against the geometry it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from random_cameras import random_camera

from detector.augment import AxisMap
from detector.height import VEHICLE_M, scene_vector, shares_from_heights
from detector.model import CcHead
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
        # Seen from behind VP3 the front is the far side.
        encoded = encode_boxes(vertices[keep], rectification.vpu)
        keep[keep] = (encoded.boxes_xyxy[:, 3] > rectification.vpu[1]) == (pair is Pair.VP2_VP3)
        encoded = encode_boxes(vertices[keep], rectification.vpu)
        tall = sizes[keep, 2]
        share = tall / high if pair is Pair.VP2_VP3 else tall / (high - tall)
        heights = torch.from_numpy(np.log(share * high / VEHICLE_M))
        scene = torch.from_numpy(scene_vector(rectification.vpu, camera))
        boxes = torch.from_numpy(encoded.boxes_xyxy)
        told = shares_from_heights(heights.clamp(-4, 4), boxes, scene).numpy()
        near_enough = np.abs(heights.numpy()) < 4
        np.testing.assert_allclose(told[near_enough], encoded.cc[near_enough], atol=1e-6)
        move = AxisMap((-1.7, 0.6), (500.0, 40.0))
        moved = torch.tensor([move.points([0.0, float(scene[0])])[1], float(scene[1])], dtype=torch.float64)
        again = shares_from_heights(heights, torch.from_numpy(move.boxes(encoded.boxes_xyxy)), moved).numpy()
        np.testing.assert_allclose(again[near_enough], encoded.cc[near_enough], atol=1e-6)
        checked += np.count_nonzero(near_enough)
    assert checked > 150


def test_a_camera_without_a_scale_is_taken_for_a_common_one() -> None:
    ((camera, rectification),) = views(Pair.VP2_VP3, 1)
    row, ratio = scene_vector(rectification.vpu, replace(camera, scale=None))
    assert row == rectification.vpu[1]
    assert ratio == pytest.approx(1.5 / 8)


def test_loss_of_heights_is_the_loss_of_their_c_c() -> None:
    """One anchor on a label; its box is right, so c_c is 1 - exp(0.2) * 0.2 * |90 - 10| / 40."""
    head = CcHead(8, 1, convs=1, cc_weight=1.0, beta=0.02, cc_from_height=True)
    anchors = [torch.tensor([[10.0, 50.0, 50.0, 90.0], [200.0, 200.0, 240.0, 240.0]])]
    target = {
        "boxes": torch.tensor([[10.0, 50.0, 50.0, 90.0]]),
        "cc": torch.tensor([0.4]),
        "cc_known": torch.tensor([True]),
        "scene": torch.tensor([10.0, 0.2]),
    }
    heights = torch.tensor([[0.2, 0.9]], requires_grad=True)
    outputs = {
        "cls_logits": torch.zeros(1, 2, 1),
        "bbox_regression": torch.zeros(1, 2, 4, requires_grad=True),
        "cc": heights,
    }
    losses = head.compute_loss([target], outputs, anchors, [torch.tensor([0, -1])])
    found = 1 - np.exp(0.2) * 0.2 * 80 / 40
    assert losses["cc"].item() == pytest.approx(abs(found - 0.4) - 0.01, rel=1e-4)
    losses["cc"].backward()
    assert heights.grad is not None
    # Less height is more c_c; the anchor without a label learns nothing, nor does the box from c_c.
    assert heights.grad[0].tolist() == pytest.approx([-np.exp(0.2) * 0.4 * np.sign(found - 0.4), 0], rel=1e-4)
    assert outputs["bbox_regression"].grad is None


def test_the_published_presets_learn_c_c_itself() -> None:
    from detector.presets import PRESETS

    assert {name for name, preset in PRESETS.items() if preset.model.cc_from_height} == {"small"}

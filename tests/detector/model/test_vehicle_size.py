"""c_c from a vehicle's height and length, against the geometry it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from random_cameras import random_camera

from detector.data.augment import AxisAlignedAffine
from detector.model.retinanet import CcHead, ModelConfig, build_model
from detector.model.vehicle_size import (
    TYPICAL_HEIGHT_M,
    TYPICAL_LENGTH_M,
    merge_sizes,
    scene_vector,
    sizes_from_cc,
    transform_scene,
)
from detector.training.config import PRESETS
from labelgen.errors import LabelgenError
from labelgen.geometry import Camera, Pair, Rectification, encode_boxes, road_cuboids

SIZE = (480, 270)


def views(pair: Pair, count: int = 12) -> list[tuple[Camera, Rectification]]:
    rng, pairs = np.random.default_rng(5), []
    while len(pairs) < count:
        camera = random_camera(rng, roll_deg=2.0)
        try:
            rectification = Rectification.from_window(camera, [400, 500, 1500, 1080], pair, SIZE)
        except LabelgenError:
            continue
        pairs.append((camera, rectification))
    return pairs


def scene_of(camera: Camera, rectification: Rectification) -> torch.Tensor:
    return torch.from_numpy(scene_vector(rectification.matrix, rectification.vpu, rectification.pair, camera))


def labels_of(
    rng: np.random.Generator, camera: Camera, rectification: Rectification, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes and c_c of vehicles of these sizes (N, 3), in heights of the camera, and which of them are seen whole."""
    high = camera.height_m
    near = np.stack([rng.uniform(2, 6, len(sizes)), rng.uniform(-1.5, 1.5, len(sizes))], axis=1) * high
    vertices = rectification.points(camera.project(road_cuboids(near, sizes * high)))
    whole = np.isfinite(vertices).all(axis=(1, 2))
    vertices[~whole] = 0
    encoded = encode_boxes(vertices, rectification.vpu)
    rows = encoded.boxes_xyxy[:, 3]
    # What VP3 lies above is seen from behind itself; a front of less than 1 px is none.
    front = (1 - encoded.cc) * (rows - encoded.boxes_xyxy[:, 1])
    ahead = (rows > rectification.vpu[1]) == (rectification.pair is Pair.VP2_VP3)
    return encoded.boxes_xyxy, encoded.cc, whole & ahead & (front > 1) & (np.abs(rows - rectification.vpu[1]) > 1)


@pytest.mark.parametrize("pair", list(Pair))
def test_c_c_is_what_the_sizes_say(pair: Pair) -> None:
    """Whatever the vehicle's sizes and place, before and after an augmentation."""
    rng, checked = np.random.default_rng(1), 0
    for camera, rectification in views(pair):
        sizes = rng.uniform([0.2, 0.1, 0.1], [0.8, 0.3, 0.3], (40, 3))
        boxes, shares, fine = labels_of(rng, camera, rectification, sizes)
        boxes, cc, (long, _, tall) = boxes[fine], torch.from_numpy(shares[fine]), sizes[fine].T
        metres = np.stack([tall if pair is Pair.VP2_VP3 else tall / (1 - tall), long], axis=1) * camera.height_m
        expected = np.log(metres / [TYPICAL_HEIGHT_M, TYPICAL_LENGTH_M])
        scene = scene_of(camera, rectification)
        move = AxisAlignedAffine((-1.7, 0.6), (500.0, 40.0))
        moved = torch.from_numpy(transform_scene(scene, move.scale_xy[1], move.shift_xy[1]))
        np.testing.assert_allclose(sizes_from_cc(cc, torch.from_numpy(boxes), scene), expected, atol=1e-5)
        for where, at in ((boxes, scene), (move.boxes(boxes), moved)):
            again, same = merge_sizes(
                torch.zeros_like(cc), torch.from_numpy(where), torch.from_numpy(expected), at, weight=1.0, height_px=1e6
            )
            np.testing.assert_allclose(again, cc, atol=1e-6)
            np.testing.assert_allclose(same[:, 1:], where[:, 1:].clip(min=[0, -np.inf, -np.inf]), atol=1e-4)
        checked += len(cc)
    assert checked > 150


@pytest.mark.parametrize("pair", list(Pair))
def test_an_error_of_the_scale_hardly_matters(pair: Pair) -> None:
    rng, worst = np.random.default_rng(2), []
    sizes = np.tile([0.5, 0.2, 0.17], (40, 1))
    for camera, rectification in views(pair):
        boxes, shares, fine = labels_of(rng, camera, rectification, sizes)
        where, cc = torch.from_numpy(boxes[fine]), torch.from_numpy(shares[fine])
        predicted = sizes_from_cc(cc, where, scene_of(camera, rectification))
        assert camera.scale is not None
        wrong = scene_of(replace(camera, scale=1.1 * camera.scale), rectification)
        merged_cc, _ = merge_sizes(torch.zeros_like(cc), where, predicted, wrong, weight=1.0, height_px=1e6)
        worst.append((merged_cc - cc).abs().numpy())
    assert np.concatenate(worst).max() < 0.02


# A car of 1.5 x 4.5 m, its foot 50 px from VPU, 18 m before a camera of 6 m: k = 1 / 4, L / D = 1 / 4,
# m = 0.25 * 0.75 / 1.25 = 0.15, c_c = 0.15 / 0.4 and the box is 0.4 * 50 px high.
CAR = torch.tensor([[10.0, 36.0, 50.0, 60.0]])
SCENE = [10.0, 1 / 6, 150.0, -1.0]


def merged(scene: list[float], weight: float = 1.0, height_px: float = 270) -> tuple[float, list[float]]:
    """A predicted c_c of 0.775 and a predicted box 4 px too high, merged with the typical sizes."""
    cc, boxes = merge_sizes(
        torch.tensor([0.775]), CAR, torch.zeros(1, 2), torch.tensor(scene), weight=weight, height_px=height_px
    )
    return cc.item(), boxes[0].tolist()


@pytest.mark.parametrize(("weight", "expected"), [(0.0, 0.775), (0.5, 0.575), (1.0, 0.375)])
def test_both_are_merged(weight: float, expected: float) -> None:
    assert merged(SCENE, weight) == (pytest.approx(expected), [10.0, 38.0, 50.0, 60.0])


def test_c_c_in_the_other_pair() -> None:
    """One of 4.5 x 1.2 m from above, 18 m ahead: k = 1.2 / 4.8, m = 1 / 4 * 5 / 4, the box 56.25 of 100 px high."""
    cc, box = merged([160.0, 1 / 6, 100 / 3, 1.0])
    assert cc == pytest.approx(0.3125 / 0.5625)
    assert box == pytest.approx([10.0, (36 + 3.75) / 2, 50.0, 60.0])


@pytest.mark.parametrize(
    ("scene", "height_px"), [([10.0, 0.0, 0.0, -1.0], 270.0), (SCENE, 62.0)], ids=["camera not known", "box cut below"]
)
def test_the_prediction_stays_where_nothing_else_is_known(scene: list[float], height_px: float) -> None:
    assert merged(scene, height_px=height_px) == (pytest.approx(0.775), CAR[0].tolist())


def test_the_scene_of_a_camera() -> None:
    for pair, power in ((Pair.VP2_VP3, -1), (Pair.VP1_VP2, 1)):
        ((camera, rectification),) = views(pair, 1)
        row, ratio, s, sign = scene_of(camera, rectification).tolist()
        assert (row, ratio, sign) == (rectification.vpu[1], pytest.approx(1 / camera.height_m), power)
        # Where the road is D ahead, h / D is seen in the rows from there to VPU.
        far = np.array([[2.5 * camera.height_m, 1.0]])
        rows = abs(rectification.points(camera.project(far))[0, 1] - row)
        assert (rows / s if pair is Pair.VP2_VP3 else s / rows) == pytest.approx(1 / 2.5)
        assert scene_of(replace(camera, scale=None), rectification)[1] == 0


@pytest.mark.parametrize("known", [True, False])
def test_loss_of_sizes(known: bool) -> None:
    """One anchor on the car above, whose sizes are the typical ones: both should be 0."""
    head = CcHead(8, 1, convs=1, cc_weight=3.0, beta=0.02, with_sizes=True)
    box = [10.0, 40.0, 50.0, 60.0]
    target = {
        "boxes": torch.tensor([box]),
        "cc": torch.tensor([0.375]),
        "cc_known": torch.tensor([True]),
        "scene": torch.tensor(SCENE if known else [10.0, 0.0, 0.0, -1.0]),
    }
    sizes = torch.tensor([[[0.2, -0.1], [0.9, 0.9]]], requires_grad=True)
    outputs = {
        "cls_logits": torch.zeros(1, 2, 1),
        "bbox_regression": torch.zeros(1, 2, 4),
        "cc": torch.tensor([[0.375, 0.1]]),
        "sizes": sizes,
    }
    anchors = [torch.tensor([box, [200.0, 200.0, 240.0, 240.0]])]
    losses = head.compute_loss([target], outputs, anchors, [torch.tensor([0, -1])])
    assert losses["cc"].item() == pytest.approx(0, abs=1e-6)
    assert losses["sizes"].item() == pytest.approx(3 * (0.2 + 0.1 - 2 * 0.01) if known else 0, rel=1e-4)
    losses["sizes"].backward()
    assert sizes.grad is not None
    slope = 3.0 if known else 0.0
    assert sizes.grad.tolist() == [[[pytest.approx(slope), pytest.approx(-slope)], [0.0, 0.0]]]


def test_only_some_models_predict_sizes() -> None:
    assert {name for name, preset in PRESETS.items() if preset.model.size_weight} == {"small"}
    config = ModelConfig("mobilenet_v3_small", (4, 5), 32, 1, anchor_sizes=((32.0,), (64.0,)), anchor_ratios=(1.0,))
    for weight, names in (
        (0.0, {"boxes", "scores", "labels", "cc"}),
        (0.5, {"boxes", "scores", "labels", "cc", "sizes"}),
    ):
        model = build_model(replace(config, size_weight=weight), score_thresh=0.0).eval()
        with torch.no_grad():
            (output,) = model([torch.rand(3, 96, 160)])
        assert set(output) == names
        assert len({len(value) for value in output.values()}) == 1

"""The box codec: boxes worked out by hand, round trips in all six cases, validity, vertex orders."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_cameras import random_camera

from labelgen.errors import RectificationError
from labelgen.geometry import (
    Pair,
    Rectification,
    decode_boxes,
    encode_boxes,
    front_bottom_midpoints,
    reorder_vertices,
    road_cuboids,
)

# Worked out by hand; vertices in the order top 0-3, bottom 4-7.
GOLDEN = {
    # VPU (0, 0): s = 60 / 80 = 0.75; front face x from 90 / 0.75 = 120 to 200, y 80..120; rear face is it times 0.75.
    "above, left of": {
        "box": [90, 60, 200, 120],
        "cc": 1 / 3,
        "vpu": [0, 0],
        "vertices": [[200, 80], [120, 80], [90, 60], [150, 60], [200, 120], [120, 120], [90, 90], [150, 90]],
    },
    # VPU (150, 0): s = 0.75 again; front face 100..200 fills the box; rear face x from 150 - 37.5 to 150 + 37.5.
    # VPU is not left of the middle, so the right side counts as the seen one.
    "above, within": {
        "box": [100, 60, 200, 120],
        "cc": 1 / 3,
        "vpu": [150, 0],
        "vertices": [
            [100, 80],
            [200, 80],
            [187.5, 60],
            [112.5, 60],
            [100, 120],
            [200, 120],
            [187.5, 90],
            [112.5, 90],
        ],
    },
    # VPU (300, 400), right of and below: the roof is the whole rectangle. Distances up from VPU: bottom front edge
    # 400 - 300 = 100, top front edge 400 - 200 = 200, roof's rear edge 400 - 100 = 300; s = 100 / 200 = 0.5.
    # Distances left of VPU: the box's sides 240 and 60. Pulled by 0.5 the roof's right end must reach 60, so it lies
    # 120 left of VPU, at 180; its left end is the box's own, 60.
    "below, right of": {
        "box": [60, 100, 240, 300],
        "cc": 0.5,
        "vpu": [300, 400],
        "vertices": [
            [60, 200],
            [180, 200],
            [180, 100],
            [60, 100],
            [180, 300],
            [240, 300],
            [240, 250],
            [180, 250],
        ],
    },
}


@pytest.mark.parametrize("case", GOLDEN.values(), ids=GOLDEN)
def test_boxes_worked_out_by_hand(case):
    vertices, valid = decode_boxes([case["box"]], [case["cc"]], case["vpu"])
    assert valid.tolist() == [True]
    np.testing.assert_allclose(vertices[0], case["vertices"], atol=1e-12)
    encoded = encode_boxes([case["vertices"]], case["vpu"])
    np.testing.assert_allclose(encoded.boxes_xyxy[0], case["box"])
    assert encoded.cc[0] == pytest.approx(case["cc"])
    assert not encoded.mirrored[0]
    assert not encoded.reversed[0]
    np.testing.assert_allclose(
        front_bottom_midpoints(vertices)[0], np.mean([case["vertices"][4], case["vertices"][5]], axis=0)
    )


def aligned_boxes(rng: np.random.Generator, count: int, vpu: np.ndarray, size_wh: tuple[int, int]) -> np.ndarray:
    """(N, 8, 2) boxes aligned with the vanishing points, built from a rectangle and a depth, not by the decoder."""
    below = vpu[1] > size_wh[1] / 2
    x0 = rng.uniform(-0.3, 1.0, count) * size_wh[0]
    x1 = x0 + rng.uniform(0.01, 0.6, count) * size_wh[0]
    y0 = rng.uniform(0.0, 0.8, count) * size_wh[1]
    y1 = y0 + rng.uniform(0.01, 0.2, count) * size_wh[1]
    s = rng.uniform(0.3, 1.0, count)[:, None, None]
    rectangle = np.stack([np.stack(p, axis=-1) for p in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], axis=1)
    pulled = vpu + s * (rectangle - vpu)
    # VPU above: the rectangle is the front face. VPU below: it is the roof, drawn from its rear edge.
    left_top, right_top, right_bottom, left_bottom = range(4)
    if below:
        near, far = (left_bottom, right_bottom), (right_top, left_top)
        top, bottom = rectangle[:, [*near, *far]], pulled[:, [*near, *far]]
    else:
        top = np.stack([rectangle[:, left_top], rectangle[:, right_top], pulled[:, right_top], pulled[:, left_top]], 1)
        bottom = np.stack(
            [rectangle[:, left_bottom], rectangle[:, right_bottom], pulled[:, right_bottom], pulled[:, left_bottom]], 1
        )
    return np.concatenate([top, bottom], axis=1)


def _case(boxes: np.ndarray, vpu: np.ndarray) -> np.ndarray:
    """Which of the six cases each box is: 0-2 VPU above and left, within, right; 3-5 below."""
    side = (vpu[0] >= boxes[:, 0]).astype(int) + (vpu[0] > boxes[:, 2])
    return side + 3 * (vpu[1] > boxes[:, 3])


def _round_trip(vertices: np.ndarray, vpu: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Greatest error px of encode -> decode -> reorder, which are valid, and which case each is."""
    encoded = encode_boxes(vertices, vpu)
    decoded, valid = decode_boxes(encoded.boxes_xyxy, encoded.cc, vpu)
    again = reorder_vertices(decoded, encoded.mirrored, encoded.reversed)
    outside = (vpu[1] < encoded.boxes_xyxy[:, 1]) | (vpu[1] > encoded.boxes_xyxy[:, 3])
    return np.abs(again - vertices).max(axis=(1, 2))[outside], valid[outside], _case(encoded.boxes_xyxy, vpu)[outside]


def test_round_trip_in_all_six_cases():
    rng = np.random.default_rng(0)
    counts, total = np.zeros(6, int), 0
    for pair in Pair:
        size = (640, 360) if pair is Pair.VP2_VP3 else (360, 640)
        for _ in range(80):
            camera = random_camera(rng)
            window = (
                [0, 400, 1920, 1080]
                if pair is Pair.VP1_VP2
                else rng.uniform([0, 500, 1200, 900], [500, 700, 1900, 1080])
            )
            try:
                vpu = Rectification.from_window(camera, window, pair, size).vpu
            except RectificationError:
                continue
            vpu = vpu if np.abs(vpu).max() < 1e5 else rng.uniform([-300, -300], [900, -20])
            error, valid, case = _round_trip(aligned_boxes(rng, 1000, vpu, size), vpu)
            assert valid.all()
            assert error.max() < 1e-6
            counts += np.bincount(case, minlength=6)
            total += len(error)
    assert total > 100_000
    assert (counts > 500).all(), counts


@settings(deadline=None, max_examples=60, derandomize=True)
@given(
    u=st.floats(-3000, 3000),
    v=st.one_of(st.floats(-5000, -1), st.floats(700, 5000)),
    seed=st.integers(0, 2**32 - 1),
)
def test_round_trip_for_any_vpu(u, v, seed):
    vpu = np.array([u, v])
    error, valid, _ = _round_trip(aligned_boxes(np.random.default_rng(seed), 200, vpu, (360, 640)), vpu)
    assert valid.all()
    assert error.max(initial=0) < 1e-6


@pytest.mark.parametrize("pair", list(Pair), ids=str)
def test_projected_cuboids_are_such_boxes(pair):
    # From metres on a road through a camera and a rectification: nothing here knows about rectangles pulled to VPU.
    rng = np.random.default_rng(1)
    checked = 0
    while checked < 2000:
        camera = random_camera(rng)
        place = rng.uniform([30, -12], [70, 12], (100, 2))
        cuboids = camera.project(road_cuboids(place, rng.uniform([3.5, 1.6, 1.3], [12, 2.5, 4], (100, 3))))
        if not np.isfinite(cuboids).all():
            continue
        low, high = cuboids[:, 4:].min(axis=(0, 1)), cuboids[:, 4:].max(axis=(0, 1))
        try:
            rect = Rectification.from_window(camera, [*low, *high], pair, (640, 360))
        except RectificationError:
            continue
        rectified = rect.points(cuboids)
        seen = np.isfinite(rectified).all(axis=(1, 2)) & (np.abs(rectified).max(axis=(1, 2)) < 1e4)
        rectified = rectified[seen]
        if not len(rectified) or np.abs(rect.vpu).max() > 1e5:
            continue
        error, valid, _ = _round_trip(rectified, rect.vpu)
        assert valid.all()
        assert error.max(initial=0) < 1e-6
        checked += len(error)


@pytest.mark.parametrize("order", list(itertools.product([False, True], repeat=2)))
@pytest.mark.parametrize("vpu", [[-50.0, -80.0], [700.0, -80.0], [300.0, -80.0], [-50.0, 800.0], [700.0, 800.0]])
def test_other_vertex_orders_are_restored(order, vpu):
    mirrored, backwards = order
    boxes = aligned_boxes(np.random.default_rng(2), 300, np.array(vpu), (640, 360))
    encoded = encode_boxes(boxes, vpu)
    plain, _ = decode_boxes(encoded.boxes_xyxy, encoded.cc, vpu)  # in the codec's own order
    swap = {
        (False, False): range(4),
        (True, False): (1, 0, 3, 2),
        (False, True): (3, 2, 1, 0),
        (True, True): (2, 3, 0, 1),
    }
    permutation = [*swap[order], *(4 + i for i in swap[order])]
    other = plain[:, permutation]
    again = encode_boxes(other, vpu)
    np.testing.assert_allclose(again.cc, encoded.cc, atol=1e-12)
    flat = encoded.cc < 1e-6  # nothing to tell front from rear by
    assert (again.mirrored == mirrored).all()
    assert (again.reversed == backwards)[~flat].all()
    np.testing.assert_allclose(reorder_vertices(plain, again.mirrored, again.reversed), other, atol=1e-12)


@pytest.mark.parametrize(
    ("box", "cc", "vpu"),
    [
        ([100, 60, 200, 120], -0.01, [150, 0]),
        ([100, 60, 200, 120], 1.01, [150, 0]),
        ([100, 60, 200, 120], np.nan, [150, 0]),
        ([np.nan, 60, 200, 120], 0.3, [150, 0]),
        ([-np.inf, 60, 200, 120], 0.3, [150, 0]),
        ([100, 60, np.inf, 120], 0.3, [150, 0]),
        ([100, 60, 200, np.inf], 0.0, [150, 0]),
        ([100, 60, 200, 120], 0.3, [150, np.nan]),
        ([100, 60, 200, 120], 0.3, [np.nan, 0]),
        ([100, 60, 200, 120], 0.3, [150, -np.inf]),
        ([100, 60, 200, 120], 0.3, [150, 60]),  # VPU on the border, and inside
        ([100, 60, 200, 120], 0.3, [150, 80]),
        ([100, 60, 200, 120], 0.7, [150, 110]),
        ([100, 60, 200, 120], 0.0, [150, 70]),
        ([100, 60, 200, 120], 1.0, [150, 110]),
        ([100, 60, 200, 120], 0.3, [0, 90]),
        ([200, 60, 100, 120], 0.3, [150, 0]),  # the wrong way round
        ([100, 120, 200, 60], 0.0, [150, 0]),
        ([100, 120, 200, 60], 1.0, [150, 400]),
        ([100, 60, 100, 120], 0.3, [150, 0]),  # no width, no height
        ([100, 60, 200, 60], 0.3, [150, 0]),
        ([100, 50, 200, 150], 0.5, [0, 0]),  # s = 0.5: the front face would begin at 200, where the box ends
        ([100, 50, 199, 150], 0.5, [0, 0]),
        ([100, 50, 199, 150], 0.5, [299, 0]),
        ([100, 50, 199, 150], 0.5, [299, 200]),
    ],
)
def test_boxes_without_a_3d_box_are_flagged(box, cc, vpu):
    vertices, valid = decode_boxes([box, [90, 60, 200, 120]], [cc, 1 / 3], [vpu, [0, 0]])
    assert valid.tolist() == [False, True]  # and the good one beside it is untouched
    np.testing.assert_allclose(vertices[1, 2], [90, 60])


def test_valid_boxes_stay_inside_their_2d_boxes():
    rng = np.random.default_rng(3)
    for vpu in ([-80.0, -60.0], [700.0, -150.0], [300.0, -30.0], [-80.0, 500.0], [700.0, 600.0], [300.0, 450.0]):
        corners = np.sort(rng.uniform([0, 0], [640, 360], (20_000, 2, 2)), axis=1)
        boxes, cc = corners.reshape(-1, 4), rng.uniform(0, 1, 20_000)
        vertices, valid = decode_boxes(boxes, cc, vpu)
        assert 0.05 < valid.mean() < 1
        inside = (vertices >= boxes[:, None, :2] - 1e-6) & (vertices <= boxes[:, None, 2:] + 1e-6)
        assert inside.all(axis=(1, 2))[valid].all()
        tight = np.abs(encode_boxes(vertices[valid], vpu).boxes_xyxy - boxes[valid]).max(axis=1)
        assert tight.max() < 1e-6


def test_one_vpu_for_all_or_one_for_each():
    boxes, cc = [[90, 60, 200, 120], [100, 60, 200, 120]], [1 / 3, 1 / 3]
    together, valid = decode_boxes(boxes, cc, [[0, 0], [150, 0]])
    assert valid.all()
    for i, vpu in enumerate([[0, 0], [150, 0]]):
        np.testing.assert_array_equal(together[i], decode_boxes([boxes[i]], [cc[i]], vpu)[0][0])
    np.testing.assert_allclose(encode_boxes(together, [[0, 0], [150, 0]]).cc, cc)


def test_labels_in_single_precision_are_decoded_in_double():
    vertices, valid = decode_boxes(np.float32([[90, 60, 200, 120]]), np.float32([1 / 3]), np.float32([0, 0]))
    assert vertices.dtype == np.float64
    assert valid.all()
    np.testing.assert_allclose(vertices[0], GOLDEN["above, left of"]["vertices"], atol=1e-4)


def test_no_boxes_give_no_boxes():
    vertices, valid = decode_boxes(np.empty((0, 4)), np.empty(0), [0, 0])
    assert vertices.shape == (0, 8, 2)
    assert valid.shape == (0,)
    encoded = encode_boxes(np.empty((0, 8, 2)), [0, 0])
    assert encoded.boxes_xyxy.shape == (0, 4)
    assert encoded.cc.shape == encoded.mirrored.shape == encoded.reversed.shape == (0,)
    assert reorder_vertices(vertices, encoded.mirrored, encoded.reversed).shape == (0, 8, 2)
    assert front_bottom_midpoints(vertices).shape == (0, 2)

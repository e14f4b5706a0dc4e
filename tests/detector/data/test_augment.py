"""Augmentation: image, boxes, c_c and VPU stay consistent."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detector_shards import painted_sample
from hypothesis import given, settings
from hypothesis import strategies as st

from detector.data.augment import (
    AugmentationRanges,
    AxisAlignedAffine,
    TrainingTarget,
    clip_to_image,
    jitter_color,
    sample_affine,
)
from labelgen.geometry import Pair, decode_boxes, encode_boxes
from labelgen.labels import Flag, Labels

SIZE = (160, 96)


def target(boxes: list[list[float]], cc: list[float]) -> TrainingTarget:
    return TrainingTarget(np.array(boxes), np.array(cc), np.ones(len(cc), dtype=np.bool_))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    pair=st.sampled_from(list(Pair)),
    flip=st.booleans(),
    aspect=st.floats(1.0, 1.5),
)
def test_decoding_and_augmenting_commute(seed: int, pair: Pair, flip: bool, aspect: float) -> None:
    """The 3D box of the moved label under the moved VPU is the moved 3D box."""
    size = SIZE if pair is Pair.VP2_VP3 else SIZE[::-1]
    sample = painted_sample(seed % 50, size, pair)
    rng = np.random.default_rng(seed)
    move = sample_affine(rng, AugmentationRanges(0.3, (0.5, 2.0), aspect, float(flip)), size, size)
    labels, vpu = sample.labels, sample.rectification.vpu
    before, valid = decode_boxes(labels.boxes_xyxy, labels.cc, vpu)
    after, still_valid = decode_boxes(move.boxes(labels.boxes_xyxy), labels.cc, move.points(vpu))
    assert valid.all()
    assert still_valid.all()
    # A flip swaps the names of left and right corners: compare the sets.
    moved = move.points(before)
    for a, b in zip(moved, after, strict=True):
        gaps = np.linalg.norm(a[:, None] - b[None], axis=-1)
        assert gaps.min(axis=1).max() < 1e-6
        assert gaps.min(axis=0).max() < 1e-6
    again = encode_boxes(moved, move.points(vpu))
    np.testing.assert_allclose(again.cc, labels.cc, atol=1e-9)


@pytest.mark.parametrize("scale", [(0.4, 0.4), (1.0, 1.0), (1.7, 1.3), (-1.2, 1.0), (0.12, 0.1)])
def test_picture_and_boxes_move_together(scale: tuple[float, float]) -> None:
    image = np.zeros((96, 160, 3), np.uint8)
    image[30:70, 40:100] = 200
    shift = (100.0 if scale[0] > 0 else 150.0, 7.0) if abs(scale[0]) < 1 or scale[0] < 0 else (-20.0, -15.0)
    move = AxisAlignedAffine(scale, shift)
    bright = move.warp_image(image, SIZE)[:, :, 0] >= 100
    ys, xs = np.nonzero(bright)
    bright_box = [xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]
    expected = np.clip(move.boxes([[40, 30, 100, 70]])[0], 0, [160, 96, 160, 96])
    np.testing.assert_allclose(bright_box, expected, atol=1.01)


def test_a_flip_of_the_whole_picture_is_exact() -> None:
    image = np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8)
    move = AxisAlignedAffine((-1.0, 1.0), (160.0, 0.0))
    np.testing.assert_array_equal(move.warp_image(image, SIZE), image[:, ::-1])
    np.testing.assert_array_equal(move.boxes([[10, 20, 30, 40]]), [[130, 20, 150, 40]])


# A box with its c_c, and what is left of both when the picture's border cuts the box.
@pytest.mark.parametrize(
    ("box", "cc", "left", "cc_left", "known"),
    [
        ([10, 10, 50, 50], 0.4, [10, 10, 50, 50], 0.4, True),
        ([-10, 10, 30, 50], 0.4, [0, 10, 30, 50], 0.4, True),
        ([10, -20, 50, 60], 0.5, [10, 0, 50, 60], 20 / 60, True),
        ([10, 46, 50, 126], 0.5, [10, 46, 50, 96], 40 / 50, True),
        ([10, 56, 50, 136], 0.75, [10, 56, 50, 96], 0.0, False),
        ([10, -40, 50, 40], 0.25, [10, 0, 50, 40], 0.0, False),
    ],
)
def test_cutting_a_box(box: list[float], cc: float, left: list[float], cc_left: float, known: bool) -> None:
    cut = clip_to_image(target([box], [cc]), SIZE)
    assert cut.boxes_xyxy.tolist() == [left]
    assert cut.cc_known.tolist() == [known]
    assert cut.cc[0] == pytest.approx(cc_left)


@pytest.mark.parametrize("box", [[-90, 10, 10, 50], [200, 10, 240, 50], [10, 10, 13, 50], [10, 93, 60, 200]])
def test_boxes_with_too_little_left_are_left_out(box: list[float]) -> None:
    assert len(clip_to_image(target([box], [0.5]), SIZE).cc) == 0


def test_ignored_boxes_are_moved_and_clipped_with_the_labels() -> None:
    ignored = np.array([[10.0, 10, 50, 50], [90, 20, 150, 40], [120, 20, 150, 40]])
    both = replace(target([[10, 10, 50, 50]], [0.5]), ignored_xyxy=ignored)
    move = AxisAlignedAffine((-1.5, 0.8), (160.0, -10.0))
    moved = both.moved(move)
    np.testing.assert_allclose(moved.ignored_xyxy[0], moved.boxes_xyxy[0])
    np.testing.assert_allclose(moved.ignored_xyxy, move.boxes(both.ignored_xyxy))
    clipped = clip_to_image(moved, SIZE)
    assert clipped.ignored_xyxy.tolist() == [[85, 0, 145, 30], [0, 6, 25, 22]]  # the third is outside


@pytest.mark.parametrize(
    ("box", "ignored"),
    [
        ([-90, 10, 10, 50], [[0, 10, 10, 50]]),
        ([10, 93, 60, 200], [[10, 93, 60, 96]]),
        ([200, 10, 240, 50], []),
        ([10, 10, 50, 50], []),
    ],
)
def test_what_the_border_leaves_of_a_label_is_ignored(box: list[float], ignored: list[list[float]]) -> None:
    assert clip_to_image(target([box], [0.5]), SIZE).ignored_xyxy.tolist() == ignored


def test_cc_of_truncated_labels_is_not_learnt_from() -> None:
    labels = Labels([[0, 0, 10, 10], [20, 20, 40, 40]], [0.4, 0.6], flags=[Flag.TRUNCATED.value, 0])
    learnt = TrainingTarget.from_labels(labels)
    assert learnt.cc_known.tolist() == [False, True]
    assert learnt.cc.tolist() == [0.0, 0.6]


def test_crops_fill_the_picture_at_scale_one() -> None:
    move = sample_affine(np.random.default_rng(0), AugmentationRanges(), (80, 48), SIZE, fill=True)
    np.testing.assert_allclose(move.boxes([[0, 0, 80, 48]]), [[0, 0, 160, 96]])
    small = sample_affine(np.random.default_rng(0), AugmentationRanges(scale=(0.1, 0.1)), (80, 48), SIZE, fill=True)
    sides = np.diff(small.boxes([[0, 0, 80, 48]]).reshape(2, 2), axis=0)
    np.testing.assert_allclose(sides, [[16, 9.6]])


def test_light_keeps_black_black_and_shape() -> None:
    image = np.zeros((20, 30, 3), np.uint8)
    image[5:, 5:] = cv2.resize(np.random.default_rng(0).integers(1, 255, (5, 5, 3), np.uint8), (25, 15))
    changed = jitter_color(np.random.default_rng(1), image, 0.3)
    assert changed.shape == image.shape
    assert changed.dtype == np.uint8
    assert (changed[:5] == 0).all()
    assert (changed[5:, 5:] != image[5:, 5:]).any()
    np.testing.assert_array_equal(jitter_color(np.random.default_rng(1), image, 0.3), changed)

"""Labels and samples: what is refused, and that selecting and joining keep every field."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from labelgen.errors import DataError
from labelgen.geometry import Camera, Pair, Rectification, decode_boxes, encode_boxes
from labelgen.labels import Flag, IgnoredBoxes, IgnoreReason, Labels, Sample, Split, VehicleClass

BOX = [[10.0, 20.0, 50.0, 60.0]]


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"boxes_xyxy": [[10, 20, 50]]}, r"boxes_xyxy: expected shape \(1, 4\), got \(1, 3\)"),
        ({"boxes_xyxy": [10, 20, 50, 60]}, r"boxes_xyxy: expected shape"),
        ({"boxes_xyxy": 7}, r"boxes_xyxy: expected shape"),
        ({"boxes_xyxy": None}, r"boxes_xyxy: expected shape"),
        ({"boxes_xyxy": "box"}, r"boxes_xyxy: expected numbers"),
        ({"boxes_xyxy": [[1, 2, 3], [4]]}, r"boxes_xyxy: expected numbers"),
        ({"boxes_xyxy": [[50, 20, 10, 60]]}, "x0 < x1"),
        ({"boxes_xyxy": [[10, 60, 50, 20]]}, "y0 < y1"),
        ({"boxes_xyxy": [[10, 20, 10, 60]]}, "x0 < x1"),
        ({"boxes_xyxy": [[10, 20, np.nan, 60]]}, "finite"),
        ({"boxes_xyxy": [[10, 20, np.inf, 60]]}, "finite"),
        ({"cc": [0.5, 0.5]}, r"cc: expected shape \(1,\), got \(2,\)"),
        ({"cc": [-1e-9]}, r"cc: expected values in \[0, 1\]"),
        ({"cc": [1.5]}, r"cc: expected values in \[0, 1\]"),
        ({"cc": [np.nan]}, r"cc: expected values in \[0, 1\]"),
        ({"scores": [1.01]}, r"scores: expected values in \[0, 1\]"),
        ({"scores": [np.nan]}, r"scores: expected values in \[0, 1\]"),
        ({"scores": [[0.5]]}, r"scores: expected shape \(1,\), got \(1, 1\)"),
        ({"class_ids": [1, 2]}, r"class_ids: expected shape"),
        ({"class_ids": np.array([300])}, r"class_ids: expected whole numbers from 0 to 255, got 300"),
        ({"class_ids": [-1]}, r"class_ids: expected whole numbers from 0 to 255, got -1"),
        ({"class_ids": [1.5]}, r"class_ids: expected whole numbers"),
        ({"class_ids": [np.nan]}, r"class_ids: expected whole numbers"),
        ({"flags": np.array([70000])}, r"flags: expected whole numbers from 0 to 65535, got 70000"),
        ({"candidates": [[0.1, 0.2, 0.3]]}, r"candidates: expected shape \(1, 2\), got \(1, 3\)"),
        ({"candidates": [[0.1, 7.0]]}, r"candidates: expected values in \[0, 1\] or NaN"),
        ({"candidates": [[0.1, np.inf]]}, r"candidates: expected values in \[0, 1\] or NaN"),
        ({"sigmas": [[1, 1, 1, 0.1]]}, r"sigmas: expected shape \(1, 5\), got \(1, 4\)"),
        ({"sigmas": [[1, 1, 1, 1, -0.1]]}, "sigmas: expected finite numbers from 0, or NaN"),
        ({"sigmas": [[1, 1, np.inf, 1, 0.1]]}, "sigmas: expected finite numbers from 0, or NaN"),
        ({"hidden": [1.2]}, r"hidden: expected values in \[0, 1\] or NaN"),
        ({"hidden": [[0.2]]}, r"hidden: expected shape \(1,\), got \(1, 1\)"),
    ],
)
def test_impossible_labels_are_refused(wrong, match):
    with pytest.raises(DataError, match=match):
        Labels(**{"boxes_xyxy": BOX, "cc": [0.5], **wrong})


def test_all_wrong_fields_are_named_at_once():
    with pytest.raises(DataError) as caught:
        Labels([[50, 20, 10, 60]], [2.0], scores=[-1], class_ids=[999])
    assert all(name in str(caught.value) for name in ("boxes_xyxy", "cc", "scores", "class_ids"))
    assert "\n" not in str(caught.value)


def test_fields_left_out_get_their_neutral_values():
    labels = Labels(BOX, [0.5])
    assert labels.class_ids.tolist() == [VehicleClass.VEHICLE]
    assert labels.scores.tolist() == [1.0]
    assert labels.flags.tolist() == [0]
    assert np.isnan(labels.candidates).all()
    assert labels.sigmas.shape == (1, 5)
    assert np.isnan(labels.sigmas).all()
    assert np.isnan(labels.hidden).all()
    assert {f.name: getattr(labels, f.name).dtype for f in fields(Labels)} == {
        "boxes_xyxy": np.float64,
        "cc": np.float64,
        "class_ids": np.uint8,
        "scores": np.float32,
        "flags": np.uint16,
        "candidates": np.float64,
        "sigmas": np.float32,
        "hidden": np.float32,
    }


def _three() -> Labels:
    return Labels(
        np.array([[0, 0, 10, 10], [5, 5, 20, 30], [-4, 2, 3, 9]]),
        np.array([0.0, 0.25, 1.0]),
        np.array([VehicleClass.CAR, VehicleClass.BUS, VehicleClass.TRUCK]),
        np.array([0.5, 0.75, 1.0]),
        np.array([Flag.TRUNCATED, Flag.MIRRORED | Flag.TOUCHING, 0]),
        np.array([[0.1, 0.2], [np.nan, np.nan], [1.0, 0.0]]),
        np.array([[1, 2, 3, 4, 0.5], [np.nan] * 5, [0, 0, 0, np.nan, 0]]),
        np.array([0.5, np.nan, 1.0]),
    )


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (slice(1, None), [0.25, 1.0]),
        (np.array([True, False, True]), [0.0, 1.0]),
        (np.array([2, 0, 0]), [1.0, 0.0, 0.0]),
        (np.array([], dtype=int), []),
    ],
)
def test_selecting_keeps_rows_together(index, expected):
    some = _three()[index]
    assert some.cc.tolist() == expected
    assert len(some) == len(expected)
    for row, cc in enumerate(some.cc):
        source = _three().cc.tolist().index(cc)
        for name in (f.name for f in fields(Labels)):
            np.testing.assert_array_equal(getattr(some, name)[row], getattr(_three(), name)[source])


def test_concatenating_the_parts_gives_the_whole():
    whole = _three()
    for parts in ([whole[:1], whole[1:]], [whole, Labels.empty()], [Labels.empty(), whole]):
        joined = Labels.concatenate(parts)
        for name in (f.name for f in fields(Labels)):
            np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))
    assert len(Labels.concatenate([])) == len(Labels.empty()) == 0


def test_flags_are_read_one_by_one():
    labels = _three()
    assert labels.has(Flag.TRUNCATED).tolist() == [True, False, False]
    assert labels.has(Flag.MIRRORED).tolist() == [False, True, False]
    assert labels.has(Flag.TOUCHING).tolist() == [False, True, False]
    assert labels.has(Flag.MISALIGNED).tolist() == [False, False, False]


def test_values_stored_in_shards_do_not_change():
    assert {c.name: c.value for c in VehicleClass} == {"VEHICLE": 0, "CAR": 1, "MOTORCYCLE": 2, "BUS": 3, "TRUCK": 4}
    assert {s.name: s.value for s in Split} == {"NONE": 0, "TRAIN": 1, "VALIDATION": 2, "TEST": 3}
    assert {f.name: f.value for f in Flag} == {
        "TRUNCATED": 1,
        "MIRRORED": 2,
        "REVERSED": 4,
        "MISALIGNED": 8,
        "CANDIDATES_DISAGREE": 16,
        "TOUCHING": 32,
        "FLAT": 64,
        "OCCLUDED": 128,
    }
    assert {r.name: r.value for r in IgnoreReason} == {
        "OTHER": 0,
        "OFF_ROAD": 1,
        "TOO_SMALL": 2,
        "IMPLAUSIBLE_SIZE": 3,
        "NO_3D_BOX": 4,
        "CUT": 5,
    }


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"boxes_xyxy": [[10, 20, 50]]}, r"boxes_xyxy: expected shape \(1, 4\), got \(1, 3\)"),
        ({"boxes_xyxy": "box"}, "boxes_xyxy: expected numbers"),
        ({"boxes_xyxy": 7}, "boxes_xyxy: expected shape"),
        ({"boxes_xyxy": [[50, 20, 50, 60]]}, "x0 < x1"),
        ({"boxes_xyxy": [[10, 20, np.inf, 60]]}, "finite"),
        ({"reasons": [0, 0]}, r"reasons: expected shape \(1,\), got \(2,\)"),
        ({"reasons": [6]}, "reasons: expected values of IgnoreReason, got 6"),
        ({"reasons": [-1]}, "reasons: expected values of IgnoreReason, got -1"),
        ({"reasons": [0.5]}, "reasons: expected values of IgnoreReason, got 0.5"),
        ({"reasons": [np.nan]}, "reasons: expected values of IgnoreReason"),
    ],
)
def test_impossible_ignored_boxes_are_refused(wrong, match):
    with pytest.raises(DataError, match=f"ignored boxes: .*{match}"):
        IgnoredBoxes(**{"boxes_xyxy": BOX, **wrong})


def test_ignored_boxes_are_selected_and_joined_row_by_row():
    boxes = np.array([[0, 0, 10, 10], [5, 5, 20, 30], [-4, 2, 3, 9]])
    whole = IgnoredBoxes(boxes, [IgnoreReason.CUT, IgnoreReason.OTHER, IgnoreReason.TOO_SMALL])
    assert IgnoredBoxes(boxes).reasons.tolist() == [0, 0, 0]
    some = whole[np.array([2, 0])]
    assert some.boxes_xyxy.tolist() == boxes[[2, 0]].tolist()
    assert some.reasons.tolist() == [IgnoreReason.TOO_SMALL, IgnoreReason.CUT]
    joined = IgnoredBoxes.concatenate([whole[:1], IgnoredBoxes.empty(), whole[1:]])
    assert joined.boxes_xyxy.tolist() == boxes.tolist()
    assert joined.reasons.tolist() == whole.reasons.tolist()
    assert len(IgnoredBoxes.concatenate([])) == len(IgnoredBoxes.empty()) == 0


def test_reasons_of_rejects_become_reasons_to_ignore():
    for reason in IgnoreReason:
        assert IgnoreReason.of_reject(reason.text) is reason
    assert IgnoreReason.of_reject("inside a better mask") is IgnoreReason.OTHER


@pytest.mark.parametrize("flags", [0, Flag.MIRRORED, Flag.REVERSED, Flag.MIRRORED | Flag.REVERSED])
def test_a_sample_gives_its_boxes_back_in_the_frame_and_in_the_sources_order(flags):
    camera = Camera([269.2, -43.6], [12914.9, -43.6], [320, 180], image_wh=(640, 360))
    rectification = Rectification.from_window(camera, [100, 100, 540, 340], Pair.VP2_VP3, (320, 180))
    labels = Labels([[100, 40, 180, 110]], [0.3], flags=[flags])
    sample = Sample(np.zeros((180, 320, 3), np.uint8), labels, rectification, camera)
    vertices, valid = sample.vertices_px()
    assert vertices.shape == (1, 8, 2)
    assert valid.all()
    encoded = encode_boxes(rectification.points(vertices), rectification.vpu)
    assert bool(encoded.mirrored[0]) == bool(flags & Flag.MIRRORED)
    assert bool(encoded.reversed[0]) == bool(flags & Flag.REVERSED)
    np.testing.assert_allclose(encoded.boxes_xyxy, labels.boxes_xyxy, atol=1e-9)
    np.testing.assert_allclose(encoded.cc, labels.cc, atol=1e-9)
    plain, _ = decode_boxes(labels.boxes_xyxy, labels.cc, rectification.vpu)
    assert {tuple(p) for p in plain[0].round(6)} == {
        tuple(p) for p in labels.vertices(rectification.vpu)[0][0].round(6)
    }


def test_a_sample_without_labels_has_no_boxes():
    camera = Camera([269.2, -43.6], [12914.9, -43.6], [320, 180], image_wh=(640, 360))
    rectification = Rectification.from_window(camera, [100, 100, 540, 340], Pair.VP2_VP3, (320, 180))
    vertices, valid = Sample(np.zeros((180, 320, 3), np.uint8), Labels.empty(), rectification, camera).vertices_px()
    assert vertices.shape == (0, 8, 2)
    assert valid.shape == (0,)

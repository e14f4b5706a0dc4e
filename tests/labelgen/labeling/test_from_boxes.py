"""Labels from 3D boxes: exact boxes give their label, others are flagged or rejected with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from clips import CAMERA, SIZE, vehicle_boxes

from labelgen.geometry import Pair, Rectification
from labelgen.labeling import BoxLimits, label_boxes
from labelgen.labels import Flag, Labels

RECTIFICATION = Rectification.from_window(CAMERA, [0, 0, *SIZE], Pair.VP2_VP3, (640, 360))


def _label(vertices: np.ndarray, limits: BoxLimits | None = None) -> Labels | tuple[str, str]:
    [label] = label_boxes(vertices[None], RECTIFICATION.vpu[None], RECTIFICATION.size_wh, limits or BoxLimits())
    return label


@pytest.fixture
def vertices() -> np.ndarray:
    """(8, 2) rectified px, an exact box."""
    return RECTIFICATION.points(vehicle_boxes(0)[0])


def test_an_exact_box_is_restored_from_its_label(vertices: np.ndarray) -> None:
    label = _label(vertices)
    assert isinstance(label, Labels)
    assert label.flags.tolist() == [0]
    decoded, valid = label.vertices(RECTIFICATION.vpu)
    assert valid.all()
    np.testing.assert_allclose(decoded[0], vertices, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda v: np.where(np.arange(8)[:, None] == 3, np.nan, v), "box beyond the horizon"),
        (
            lambda v: v + 0.5 * np.ptp(v, axis=0).max() * (np.arange(8)[:, None] == 6),
            "box against the vanishing points",
        ),
        (lambda v: np.zeros((8, 2)), "no valid 3D box"),
    ],
)
def test_unusable_boxes_are_rejected_with_a_reason(vertices: np.ndarray, change, reason: str) -> None:
    label = _label(change(vertices))
    assert isinstance(label, tuple)
    assert label[0] == reason


def test_boxes_outside_the_image_are_rejected(vertices: np.ndarray) -> None:
    small = (int(vertices[:, 0].min()) + 5, 360)
    [label] = label_boxes(vertices[None], RECTIFICATION.vpu[None], small)
    assert isinstance(label, tuple)
    assert label[0] == "outside the picture"


def test_limits_decide_what_is_flagged_and_what_is_rejected(vertices: np.ndarray) -> None:
    size = (vertices.max(axis=0) - vertices.min(axis=0)).max()
    vertices[6] += [0.05 * size, 0.0]
    label = _label(vertices)
    assert isinstance(label, Labels)
    assert label.has(Flag.MISALIGNED).all()
    assert isinstance(_label(vertices, BoxLimits(max_error=0.03)), tuple)
    strict = _label(vertices, BoxLimits(max_aligned_error=0.2))
    assert isinstance(strict, Labels)
    assert not strict.has(Flag.MISALIGNED).any()

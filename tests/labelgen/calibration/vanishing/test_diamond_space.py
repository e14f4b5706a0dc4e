"""Diamond space: the whole projective plane in one accumulator, infinity included."""

import numpy as np
import pytest

from labelgen.calibration.vanishing.diamond_space import accumulate, peak


@pytest.mark.parametrize(
    "point",
    [(0.3, -0.5, 1.0), (0.0, 0.0, 1.0), (-4.0, -0.3, 1.0), (60.0, -1.0, 1.0), (1.0, 0.05, 0.0), (0.1, 9.0, 1.0)],
    ids=["in the picture", "middle", "beside it", "far away", "at infinity", "below"],
)
def test_the_peak_is_where_the_lines_meet(point):
    rng = np.random.default_rng(2)
    p = np.array(point)
    meeting = np.cross(p, rng.normal(size=(300, 3)))
    stray = rng.normal(size=(100, 3))
    meeting_point, votes = peak(accumulate(np.concatenate([meeting, stray])))
    angle = np.degrees(np.arccos(np.clip(abs(meeting_point @ p) / np.linalg.norm(p), 0, 1)))
    assert angle < 1.0
    assert votes > 0.15 * len(meeting)


def test_a_line_votes_once_per_cell_it_passes():
    votes = accumulate(np.array([[0.3, -0.8, 0.2]]), resolution=40)
    assert votes.max() == 1.0
    # A polyline through two or three of the four triangles, from border to border.
    assert 40 < votes.sum() < 160


def test_the_peak_is_where_the_heavier_lines_meet():
    near, far = np.array([0.2, -0.2, 1.0]), np.array([5.0, -0.5, 1.0])
    rng = np.random.default_rng(0)
    lines = np.concatenate([np.cross(p, rng.normal(size=(100, 3))) for p in (near, far)])
    weights = np.repeat([1.0, 2.0], 100)
    votes = accumulate(lines, weights)
    assert abs(peak(votes)[0] @ far) / np.linalg.norm(far) > 0.999

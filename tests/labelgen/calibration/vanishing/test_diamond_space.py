"""Diamond space: the whole projective plane in one accumulator, infinity included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from labelgen.calibration.vanishing.diamond_space import accumulate, diamond_points, peak, plane_points

_coordinate = st.floats(-50, 50, allow_nan=False)


@given(st.tuples(_coordinate, _coordinate, _coordinate).filter(lambda p: np.abs(p).sum() > 1e-3))
@settings(deadline=None, max_examples=60)
def test_points_come_back_from_the_diamond(point):
    p = np.array(point)
    uv = diamond_points(p)
    assert np.abs(uv).sum() <= 1 + 1e-12
    assert np.abs(np.cross(plane_points(uv), p / np.linalg.norm(p))).max() < 1e-9


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
    found, votes = peak(accumulate(np.concatenate([meeting, stray])))
    angle = np.degrees(np.arccos(np.clip(abs(found @ p) / np.linalg.norm(p), 0, 1)))
    assert angle < 1.0
    assert votes > 0.15 * len(meeting)


def test_a_line_votes_once_per_cell_it_passes():
    votes = accumulate(np.array([[0.3, -0.8, 0.2]]), resolution=40)
    assert votes.max() == 1.0
    # A polyline through two or three of the four triangles, from border to border.
    assert 40 < votes.sum() < 160


def test_weights_and_allowed_cells_decide():
    near, far = np.array([0.2, -0.2, 1.0]), np.array([5.0, -0.5, 1.0])
    rng = np.random.default_rng(0)
    lines = np.concatenate([np.cross(p, rng.normal(size=(100, 3))) for p in (near, far)])
    weights = np.repeat([1.0, 2.0], 100)
    votes = accumulate(lines, weights)
    assert abs(peak(votes)[0] @ far) / np.linalg.norm(far) > 0.999
    inside = np.zeros(votes.shape, dtype=bool)
    row, column = np.round((diamond_points(near)[::-1] + 1) * (votes.shape[0] // 2)).astype(int)
    inside[row - 5 : row + 6, column - 5 : column + 6] = True
    assert abs(peak(votes, inside)[0] @ near) / np.linalg.norm(near) > 0.999

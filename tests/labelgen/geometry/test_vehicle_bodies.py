"""The kept forms of common vehicles are those of the renderer."""

from __future__ import annotations

import numpy as np
import pytest

from labelgen.geometry.vehicle_bodies import COMMON_KINDS, common_bodies
from labelgen.synth.vehicle.body_mesh import body_mesh
from labelgen.synth.vehicle.body_types import BODY_TYPES, mean_shape
from tools.studies.common_bodies import corners


@pytest.mark.parametrize("kind", COMMON_KINDS)
def test_the_file_holds_the_renderers_bodies(kind: str) -> None:
    """If this fails, run `python -m tools.studies.common_bodies`."""
    kept = next(body for body in common_bodies() if body.kind == kind)
    np.testing.assert_allclose(kept.points, corners(kind), atol=0.0006)
    total = sum(BODY_TYPES[k].share for k in COMMON_KINDS)
    assert kept.share == pytest.approx(BODY_TYPES[kind].share / total)


@pytest.mark.parametrize("kind", COMMON_KINDS)
def test_few_corners_reach_as_far_as_the_whole_body(kind: str) -> None:
    kept = next(body.points for body in common_bodies() if body.kind == kind)
    directions = np.random.default_rng(0).normal(size=(3, 500))
    directions /= np.linalg.norm(directions, axis=0)
    whole = (body_mesh(mean_shape(kind)).vertices @ directions).max(axis=0)
    beyond = (kept @ directions).max(axis=0) - whole
    assert beyond.min() > -0.02
    # Wing mirrors reach farther, to the sides alone.
    assert (beyond <= 0.02 + 0.15 * np.abs(directions[1])).all()
    assert np.ptp(kept[:, 1]) - np.ptp(body_mesh(mean_shape(kind)).vertices[:, 1]) == pytest.approx(0.10, abs=0.003)
    assert len(kept) < 150


def test_shares_sum_to_one() -> None:
    assert sum(body.share for body in common_bodies()) == pytest.approx(1)

"""How far bodies and outlines are apart, and how that changes with the bodies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.body_forms import MODES, BodyForms
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array
from labelgen.labeling.fitted.hypotheses import SHARED, BodyFit
from labelgen.labeling.fitted.outlines import Outlines
from labelgen.labeling.fitted.settings import BodyFitSettings, MaskErrors

__all__ = ["Residuals", "compare"]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of R sightings in M directions.

    Args:
        miss: (R, M) measured minus predicted reach, in standard deviations.
        weights: (R, M) of the robust sum of squares.
        by_own: (R, M, 3) derivatives of the prediction by place and heading, in the same.
        by_shared: (R, M, SHARED) by the shared parameters.
        costs: (R,) half the robust sum of squares.
        error_px: (R,) the standard deviation.
    """

    miss: Array
    weights: Array
    by_own: Array
    by_shared: Array
    costs: Array
    error_px: Array


def compare(
    fit: BodyFit, outlines: Outlines, camera: Camera, forms: BodyForms, errors: MaskErrors, settings: BodyFitSettings
) -> Residuals:
    """Return how far bodies and outlines are apart.

    Args:
        fit: P hypotheses with R sightings.
        outlines: all outlines.
        camera: with a scale.
        forms: the families.
        errors: of the masks.
        settings: of the fit.
    """
    p, rows = fit.hypothesis, fit.outline
    shared, normals = fit.shared[p], outlines.normals[rows]
    size = np.exp(shared[:, :3])
    cos, sin = np.cos(fit.heading) * fit.sign[p], np.sin(fit.heading) * fit.sign[p]
    ahead = cos[:, None] * normals[..., 0] + sin[:, None] * normals[..., 1]
    left = cos[:, None] * normals[..., 1] - sin[:, None] * normals[..., 0]
    own = np.stack([ahead, left, normals[..., 2]], axis=-1)
    reach, points, modes = forms.support(fit.family[p], own * size[:, None], shared[:, 3 : 3 + MODES])
    points *= size[:, None]
    by_size = own * points
    mirror, mirror_points = _mirrors(fit, forms, size, own)
    farther = mirror > reach
    reach = np.where(farther, mirror, reach)
    points = np.where(farther[..., None], mirror_points, points)
    protruding = mirror_points[..., 1] - np.sign(left) * size[:, None, 1] / 2
    by_size = np.where(farther[..., None], own * np.stack(
        [mirror_points[..., 0], mirror_points[..., 1] - protruding, mirror_points[..., 2]], -1), by_size)  # fmt: skip
    by_mirror = np.where(farther, np.abs(left), 0.0)
    modes = np.where(farther[..., None], 0.0, modes)

    from_camera = np.concatenate([fit.place, np.full((len(p), 1), -camera.height_m)], axis=1)
    gap = reach + (normals * from_camera[:, None]).sum(axis=-1)  # metres between the plane and the body
    depth = np.maximum(from_camera @ camera.axes[:, 2], 1.0)
    px_per_m = camera.focal / depth
    by_heading = left * points[..., 0] - ahead * points[..., 1]
    by_own = np.concatenate([normals[..., :2], by_heading[..., None]], axis=-1)
    down = np.maximum(settings.direction_vectors[:, 1], 0) ** settings.shadow_power
    sizes_px = outlines.sizes_px[rows]
    swollen_px = errors.swelling[1] + errors.swelling[2] * sizes_px
    beyond_px = errors.swelling[0] + (shared[:, -2] * swollen_px)[:, None]
    beyond_px = beyond_px + shared[:, -1, None] * sizes_px[:, None] * down
    miss_px = -gap * px_per_m[:, None] - beyond_px

    counts = np.bincount(p, minlength=len(fit.vehicle))[p].astype(np.float64)
    form_error = np.array([form.error_m for form in forms.forms])[fit.family[p]] * px_per_m
    mask_error = errors.outline_px**2 + (errors.outline_share * sizes_px) ** 2
    error = np.sqrt(mask_error + form_error**2)
    # All sightings together say less than independent ones, but what lies far off is as far off in each.
    share = error**2 / (mask_error + form_error**2 * counts**settings.shared_error_power)
    miss = miss_px / error[:, None]
    weights = settings.direction_weight / (1 + (miss / errors.robust) ** 2)
    cost = settings.direction_weight * errors.robust**2 / 2 * np.log1p((miss / errors.robust) ** 2)
    # A body may reach beyond what the picture's border cuts.
    short = miss < 0
    free = outlines.open[rows] & short
    # A single sighting cannot tell a hidden side from another form.
    price = settings.hidden_cost * (1 + 1 / counts)
    hidden = _hidden_side(np.where(short & ~free, cost, 0.0), price, settings)
    free |= hidden & short
    weights = share[:, None] * np.where(free, 0.0, weights)
    costs = np.where(free, 0.0, cost).sum(axis=-1) + price * hidden.any(axis=1)
    by_shared = np.zeros((*miss.shape, SHARED))
    by_shared[..., :3] = by_size
    by_shared[..., 3 : 3 + MODES] = modes
    by_shared[..., 3 + MODES] = by_mirror
    by_shared *= px_per_m[:, None, None]
    by_shared[..., -2] = swollen_px[:, None]
    by_shared[..., -1] = sizes_px[:, None] * down
    return Residuals(
        miss,
        weights,
        by_own * (px_per_m / error)[:, None, None],
        by_shared / error[:, None, None],
        share * costs,
        error,
    )


def _hidden_side(costs: Array, price: Array, settings: BodyFitSettings) -> NDArray[np.bool_]:
    """Return the directions (R, M) in which each sighting is hidden: those of the side where masks lack most.

    Args:
        costs: (R, M) of the directions in which the mask is shorter than the body.
        price: (R,) what must be saved by it.
        settings: of the fit.
    """
    sides = settings.sides
    saved = costs @ sides.T
    best = saved.argmax(axis=1)
    return np.asarray(sides[best] & (saved[np.arange(len(best)), best] > price)[:, None])


def _mirrors(fit: BodyFit, forms: BodyForms, size: Array, own: Array) -> tuple[Array, Array]:
    """Return how far the wing mirrors reach, (R, M), and the points (R, M, 3) that do, metres."""
    p = fit.hypothesis
    at = np.array([form.mirror_place for form in forms.forms])[fit.family[p]]
    out = size[:, 1] / 2 + fit.shared[p, 3 + MODES]
    points = np.empty_like(own)
    points[..., 0] = (at[:, 0] * size[:, 0])[:, None]
    points[..., 1] = np.where(own[..., 1] < 0, -1.0, 1.0) * out[:, None]
    points[..., 2] = (at[:, 1] * size[:, 2])[:, None]
    return (own * points).sum(axis=-1), points

"""The fit: Gauss-Newton on all hypotheses at once, with places and headings eliminated from the normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.body_forms import MODES, BodyForms, load_body_forms
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array
from labelgen.labeling.fitted.hypotheses import BodyFit, Priors, start_fit
from labelgen.labeling.fitted.outlines import Outlines
from labelgen.labeling.fitted.path import back_to_path, expected_path
from labelgen.labeling.fitted.residuals import Residuals, compare
from labelgen.labeling.fitted.settings import BodyFitSettings, MaskErrors

__all__ = ["FittedBodies", "fit_bodies"]

_LOST_COST = 1e6
_MAX_MODE_STEP = 1.5
_MAX_OTHER_STEP = np.array([0.1, 2.0, 0.05])


@dataclass(frozen=True, eq=False)
class FittedBodies:
    """The best body for each of R outlines.

    Args:
        family: (R,) number of the family of bodies.
        sign: (R,) +1 away from the camera, -1 towards it.
        size_lwh: (R, 3) metres.
        place: (R, 2) metres on the road, of the body's middle.
        heading: (R,) radians.
        covariance: (R, 6, 6) of place, heading and the logarithm of the size.
        reach_px: (R, M) how far the body reaches in the image in each direction.
        strain: (R,) how unusual the vehicle's size is: its distance from the family's mean in standard deviations.
        cost: (R,) half the robust sum of squares of the sighting.
        found: (R,) bool; False where no body could be placed.
    """

    family: NDArray[np.int64]
    sign: Array
    size_lwh: Array
    place: Array
    heading: Array
    covariance: Array
    reach_px: Array
    strain: Array
    cost: Array
    found: NDArray[np.bool_]

    @property
    def near_xy(self) -> Array:
        """(R, 2) metres on the road, middle of the near bottom edge: the contact point."""
        return self.place - np.stack([self.size_lwh[:, 0] / 2, np.zeros(len(self.place))], axis=1)

    @classmethod
    def scattered(cls, parts: Sequence[tuple[NDArray[np.int64], FittedBodies]], count: int) -> FittedBodies:
        """Return the bodies of `count` outlines from those of parts of them, each with its outlines' numbers."""
        arrays = {}
        for f in fields(cls):
            first = getattr(parts[0][1], f.name)
            arrays[f.name] = np.zeros((count, *first.shape[1:]), dtype=first.dtype)
            for rows, part in parts:
                arrays[f.name][rows] = getattr(part, f.name)
        return cls(**arrays)


@dataclass(frozen=True, eq=False)
class _Problem:
    """What does not change during the fit."""

    outlines: Outlines
    times_s: Array
    camera: Camera
    forms: BodyForms
    errors: MaskErrors
    settings: BodyFitSettings

    def residuals(self, fit: BodyFit) -> Residuals:
        return compare(fit, self.outlines, self.camera, self.forms, self.errors, self.settings)


def fit_bodies(
    outlines: Outlines,
    vehicles: NDArray[np.int64],
    times_s: Array,
    camera: Camera,
    errors: MaskErrors,
    *,
    signs: Sequence[int | None],
    classes: Sequence[frozenset[int]],
    settings: BodyFitSettings,
    forms: BodyForms | None = None,
    fitted: NDArray[np.bool_] | None = None,
) -> FittedBodies:
    """Lay a body over all outlines of each vehicle.

    Args:
        outlines: R of them.
        vehicles: (R,) number of each one's vehicle, 0 to V - 1.
        times_s: (R,) seconds.
        camera: with a scale.
        errors: of the masks.
        signs: V directions of travel, +1 away from the camera; None where both are possible.
        classes: V sets of the `VehicleClass` numbers that are possible; empty where all are.
        settings: of the fit.
        forms: families of bodies; those of the package where left out.
        fitted: (R,) the outlines that the vehicles' sizes and forms are found from, at least one of each vehicle; to
            the others the body is laid as it is then. All where left out.
    """
    forms = forms or load_body_forms()
    everything = _Problem(outlines, times_s, camera, forms, errors, settings)
    problem, all_vehicles = everything, vehicles
    if fitted is not None:
        rows = np.flatnonzero(fitted)
        outlines, vehicles, times_s = outlines.select(rows), vehicles[rows], times_s[rows]
        problem = replace(everything, outlines=outlines, times_s=times_s)
    hypotheses, shares = [], []
    for v, (sign, possible) in enumerate(zip(signs, classes, strict=True)):
        families = [k for k, form in enumerate(forms.forms) if not possible or form.vehicle_class in possible]
        total = sum(forms.forms[k].share for k in families)
        for k in families:
            for s in (1, -1) if sign is None else (sign,):
                hypotheses.append((v, k, s))
                shares.append(np.log(forms.forms[k].share / total))
    fit = start_fit(outlines, vehicles, hypotheses, camera, forms, errors)
    priors = Priors.of(fit, forms, errors, np.array(shares))
    # A hypothesis of which a sighting lies beyond the horizon cannot be placed.
    on_road = fit.sum_rows(np.where(np.isnan(fit.place).any(axis=1), 1.0, 0.0)) == 0
    fit, priors = fit.select(on_road), priors.select(on_road)
    fit = _steps(fit, priors, problem, settings.first_steps)
    cost = _costs(fit, priors, problem)
    keep = cost <= _best(fit.vehicle, cost, len(signs))[fit.vehicle] + settings.margin
    fit, priors = fit.select(keep), priors.select(keep)
    fit = back_to_path(fit, times_s, settings)
    fit = _steps(fit, priors, problem, settings.last_steps)
    cost = _costs(fit, priors, problem)
    order = np.lexsort((cost, fit.vehicle))
    best = np.zeros(len(cost), dtype=np.bool_)
    best[order[np.unique(fit.vehicle[order], return_index=True)[1]]] = True
    fit, priors = fit.select(best), priors.select(best)
    if fitted is not None:
        fit = _with_all(replace(fit, outline=rows[fit.outline]), all_vehicles, everything.times_s)
        fit = _steps(fit, priors, everything, settings.place_steps, keep_shared=True)
    return _results(fit, priors, everything)


def _with_all(fit: BodyFit, vehicles: NDArray[np.int64], times_s: Array) -> BodyFit:
    """Return the best hypotheses with all sightings of their vehicles; new ones stand between their neighbours."""
    order = np.lexsort((times_s, vehicles))
    number = np.full(int(vehicles.max()) + 1, -1)
    number[fit.vehicle] = np.arange(len(fit.vehicle))
    outline = order[number[vehicles[order]] >= 0]
    hypothesis = number[vehicles[outline]]
    place, heading = np.empty((len(outline), 2)), np.empty(len(outline))
    for p in range(len(fit.vehicle)):
        new, old = hypothesis == p, np.flatnonzero(fit.hypothesis == p)
        old = old[np.argsort(times_s[fit.outline[old]])]
        at, known = times_s[outline[new]], times_s[fit.outline[old]]
        for k in range(2):
            place[new, k] = np.interp(at, known, fit.place[old, k])
        heading[new] = np.interp(at, known, fit.heading[old])
    order = np.argsort(hypothesis, kind="stable")
    return replace(
        fit, outline=outline[order], hypothesis=hypothesis[order], place=place[order], heading=heading[order]
    )


def _best(vehicle: NDArray[np.int64], cost: Array, count: int) -> Array:
    lowest = np.full(count, np.inf)
    np.minimum.at(lowest, vehicle, cost)
    return lowest


def _steps(fit: BodyFit, priors: Priors, problem: _Problem, steps: int, *, keep_shared: bool = False) -> BodyFit:
    settings = problem.settings
    limits = np.concatenate([np.full(3, settings.max_log_step), np.full(MODES, _MAX_MODE_STEP), _MAX_OTHER_STEP])
    moves = np.array([settings.max_move_m, settings.max_move_m, settings.max_turn])
    for _ in range(steps):
        path = expected_path(fit, problem.times_s, settings)
        normal = _normal_equations(fit, priors, problem.residuals(fit), path)
        change = np.clip(np.linalg.solve(normal.matrix, normal.pull[..., None])[..., 0], -limits, limits)
        if keep_shared:
            change[:] = 0
        own = normal.own_pull - (normal.back @ change[fit.hypothesis][..., None])[..., 0]
        own = np.clip(own, -moves, moves)
        fit = replace(fit, shared=fit.shared + change, place=fit.place + own[:, :2], heading=fit.heading + own[:, 2])
    return fit


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations with the sightings' own parameters eliminated.

    Args:
        matrix: (P, SHARED, SHARED).
        pull: (P, SHARED).
        own_inverse: (R, 3, 3) inverse of each sighting's own normal matrix.
        own_pull: (R, 3) its change, the shared parameters being kept.
        back: (R, 3, SHARED) how that changes with them.
    """

    matrix: Array
    pull: Array
    own_inverse: Array
    own_pull: Array
    back: Array


def _normal_equations(fit: BodyFit, priors: Priors, r: Residuals, path: tuple[Array, Array]) -> _Normal:
    weighted_own = np.swapaxes(r.by_own * r.weights[..., None], -1, -2)
    weighted = np.swapaxes(r.by_shared * r.weights[..., None], -1, -2)
    expected, precision = path
    own = weighted_own @ r.by_own
    own[:, range(3), range(3)] += precision
    pull = (weighted_own @ r.miss[..., None])[..., 0]
    pull += precision * (expected - np.concatenate([fit.place, fit.heading[:, None]], axis=1))
    inverse = np.asarray(np.linalg.inv(own), dtype=np.float64)
    cross = weighted_own @ r.by_shared
    back, own_pull = inverse @ cross, (inverse @ pull[..., None])[..., 0]
    across = np.swapaxes(cross, -1, -2)
    matrix = fit.sum_rows(weighted @ r.by_shared - across @ back) + priors.precision
    total = fit.sum_rows((weighted @ r.miss[..., None] - across @ own_pull[..., None])[..., 0])
    total += (priors.precision @ (priors.mean - fit.shared)[..., None])[..., 0]
    return _Normal(matrix, total, inverse, own_pull, back)


def _costs(fit: BodyFit, priors: Priors, problem: _Problem) -> Array:
    """Return minus the logarithm of each hypothesis's evidence (P,), up to a constant (Laplace's approximation)."""
    r = problem.residuals(fit)
    path = expected_path(fit, problem.times_s, problem.settings)
    normal = _normal_equations(fit, priors, r, path)
    off = fit.shared - priors.mean
    prior = (off[:, None] @ priors.precision @ off[..., None])[:, 0, 0] / 2
    own = np.concatenate([fit.place, fit.heading[:, None]], axis=1)
    strayed = (path[1] * (own - path[0]) ** 2).sum(axis=1) / 2
    certain = np.linalg.slogdet(normal.matrix)[1] / 2
    cost = fit.sum_rows(r.costs + strayed) + prior + priors.cost + certain
    return np.where(np.isfinite(cost), cost, _LOST_COST)


def _results(fit: BodyFit, priors: Priors, problem: _Problem) -> FittedBodies:
    r = problem.residuals(fit)
    path = expected_path(fit, problem.times_s, problem.settings)
    normal = _normal_equations(fit, priors, r, path)
    p = fit.hypothesis
    shared = np.linalg.inv(normal.matrix)[p]
    moved = normal.back @ shared
    covariance = np.zeros((len(p), 6, 6))
    covariance[:, :3, :3] = normal.own_inverse + moved @ np.swapaxes(normal.back, -1, -2)
    covariance[:, :3, 3:] = -moved[..., :3]
    covariance[:, 3:, :3] = np.swapaxes(covariance[:, :3, 3:], -1, -2)
    covariance[:, 3:, 3:] = shared[:, :3, :3]
    off = (fit.shared - priors.mean)[:, :3]
    strain = np.sqrt((off[:, None] @ priors.precision[:, :3, :3] @ off[..., None])[:, 0, 0])
    count = len(problem.outlines)
    found = np.zeros(count, dtype=np.bool_)
    found[fit.outline] = True

    def spread(values: Array, fill: float = np.nan) -> Array:
        out = np.full((count, *values.shape[1:]), fill)
        out[fit.outline] = values
        return out

    return FittedBodies(
        spread(fit.family[p].astype(np.float64), 0).astype(np.int64),
        spread(fit.sign[p], 1),
        spread(fit.size_lwh[p]),
        spread(fit.place),
        spread(fit.heading),
        spread(covariance),
        spread(problem.outlines.reach_px[fit.outline] - r.miss * r.error_px[:, None]),
        spread(strain[p]),
        spread(r.costs),
        found,
    )

"""VP1, tilt and focal length once more, from vehicles that keep their size while they drive.

Features slide over a vehicle's body while it turns in view: VP1 from tracks alone is mostly too low, by less where
those at the vehicles' sides are taken (`travel.outer_tracks`). Silhouettes of one vehicle at several distances do not
share that error: the camera must make them one rigid body on the road. So models are laid over them (`model_fit`), each
vehicle with one size, and the camera is moved to where the outlines fit best, together with what tracks and edges say:
a bundle adjustment whose points are vehicles. What silhouettes say about the focal length and the tilt by themselves is
biased by forms that no model has, so little of it is believed; on both, the edges decide, whose answer moves with VP1.

Source: this project's. The constants are from rendered sessions, see docs/calibration.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labelgen.calibration.observation.association import choose_sightings, vehicle_of_blobs
from labelgen.calibration.observation.collect import Observations
from labelgen.calibration.observation.silhouettes import Blob
from labelgen.calibration.scale.estimate import unit_camera
from labelgen.calibration.vanishing.orientation import Basis, Orientation, road_camera
from labelgen.calibration.vanishing.vp2 import find_across
from labelgen.calibration.vehicle_fit import (
    Fit,
    Hypotheses,
    Silhouettes,
    eliminate,
    first_fit,
    improve,
    measure,
    prior_costs,
    reach_by,
    residuals,
    with_priors,
)
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import common_bodies

__all__ = ["refine_orientation"]

_SMALLEST, _MOST = 0.02, 300
_FEWEST_VEHICLES = 5
# Standard deviation of VP1 from tracks, in units (nearly rad), whatever its spread over resamples says.
_TRACKS_SD = 10 / 2304
# What silhouettes say is worth this share, for errors of neighbouring ones are alike, and no better than this: VP1's x
# and y in units, the focal length's logarithm, the tilt in rad. Seen obliquely, models err on the focal length by so
# much per tangent of the angle between the road and the camera's axis.
_TEMPER = 0.25
_SILHOUETTES_SD = np.array([10 / 2304, 8 / 2304, 0.025, 0.018])
_OBLIQUE_FOCAL_SD = 0.1
# What edges say is no better than this either: the focal length's logarithm, the tilt in rad.
_EDGES_SD = np.array([0.02, 0.0017])
# A silhouette that misses its model by this much is not of one vehicle, or not whole.
_HOPELESS = 6.0
_LEAST_SHARE = 0.02
_SIZES = np.linspace(-1.6, 0.8, 601)
_ITERATIONS = 8
_EDGES = 4000
_DIFFERENCES = np.array([1.3e-3, 1.3e-3, 5e-3, 3e-3])
_LONGEST = np.array([0.017, 0.017, 0.1, 0.02])


@dataclass(frozen=True, eq=False)
class _Belief:
    """A Gaussian over the camera (x, y, log focal, tilt): normal matrix (4, 4), and its product with the mean (4,)."""

    normal: Array
    pull: Array


def refine_orientation(seen: Observations, found: Orientation, blobs: Sequence[Blob]) -> Orientation:
    """A camera that vehicles keep their size in.

    Args:
        seen: what the pass over the video gave.
        found: what tracks and edges say.
        blobs: silhouettes from the same pass.

    Returns:
        the same with another camera and other spreads; as it was where fewer than 5 vehicles are seen several times.
    """
    basis = found.basis
    vehicles = vehicle_of_blobs(blobs, [seen.tracks[k] for k in basis.tracks.tolist()], basis.vehicles)
    chosen = choose_sightings(blobs, vehicles, least_px=_SMALLEST * seen.size_wh[0], most=_MOST)
    start = _vector(found.camera, basis.unit)
    unit = unit_camera(found.camera)
    sightings, _ = measure(unit, [blobs[i] for i in chosen.tolist()], vehicles[chosen])
    if len(np.unique(sightings.vehicles)) < _FEWEST_VEHICLES:
        return found
    hypotheses = Hypotheses.of(common_bodies())
    fit, shares = _identify(unit, sightings, hypotheses)
    if shares.sum() < _FEWEST_VEHICLES:
        return found
    tracks = np.diag([_TRACKS_SD**-2, _TRACKS_SD**-2, 0, 0])
    edges, at = _edges_say(start, basis), start
    for step in range(_ITERATIONS):
        fit = improve(unit, sightings, hypotheses, fit, 2 if step else 1)
        outlines = _outlines_say(at, found.camera, basis, sightings, hypotheses, fit, shares)
        normal = tracks + edges.normal + outlines.normal
        change = np.linalg.solve(normal, tracks @ start + edges.pull + outlines.pull) - at
        at = at + np.clip(change, -_LONGEST, _LONGEST)
        unit = unit_camera(_camera(at, found.camera, basis.unit))
        if step == _ITERATIONS // 2:
            edges = _edges_say(at, basis)
        elif (np.abs(change) < 0.02 * np.diag(np.linalg.inv(normal)) ** 0.5).all():
            break
    spread = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return replace(
        found,
        camera=_camera(at, found.camera, basis.unit),
        evidence=replace(
            found.evidence,
            vp1_deg=_ray_spread_deg(at, spread),
            focal=float(np.sqrt(spread[2, 2])),
            tilt_deg=float(np.degrees(np.sqrt(spread[3, 3]))),
            seen_again=round(float(shares.sum())),
        ),
    )


def _vector(camera: Camera, unit: float) -> Array:
    """(4,) x and y of VP1 in units from the principal point, log of the focal length in units, tilt."""
    way = camera.vp2 - camera.vp1
    return np.array([*(camera.vp1 - camera.pp) / unit, np.log(camera.focal / unit), np.arctan(way[1] / way[0])])


def _camera(at: Array, like: Camera, unit: float) -> Camera:
    assert like.image_wh is not None
    vp1 = np.array([at[0], at[1], 1.0])
    return replace(road_camera(vp1, at[3], np.exp(at[2]), like.pp, unit, like.image_wh), name=like.name)


def _identify(unit: Camera, seen: Silhouettes, hypotheses: Hypotheses) -> tuple[Fit, Array]:
    """What each vehicle may be: pairs that may be right (P,) with their probabilities (P,), which sum to at most V."""
    fit = improve(unit, seen, hypotheses, first_fit(seen, hypotheses), 4)
    cost = residuals(unit, seen, hypotheses, fit).costs()
    total = fit.over_pairs(np.minimum(cost, _HOPELESS)) + prior_costs(fit)
    starts = np.searchsorted(fit.vehicle, np.arange(fit.vehicle[-1] + 1))
    fit = fit.only(total < np.minimum.reduceat(total, starts)[fit.vehicle] + _HOPELESS)
    fit = improve(unit, seen, hypotheses, fit, 4)
    cost = residuals(unit, seen, hypotheses, fit).costs()
    fit = improve(unit, seen, hypotheses, replace(fit, worth=(cost < _HOPELESS).astype(np.float64)), 4)
    found = residuals(unit, seen, hypotheses, fit)
    normal, _ = with_priors(fit, *eliminate(fit, found, found.slopes[..., 2:])[:2])
    variance = np.linalg.inv(normal)[:, 0, 0]
    cost = fit.over_pairs(np.minimum(found.costs(), _HOPELESS)) + prior_costs(fit)
    score = hypotheses.log_prior[fit.hypothesis] - cost
    # All vehicles are seen through one camera: a type that needs another scale than the rest is the wrong one.
    starts = np.searchsorted(fit.vehicle, np.arange(fit.vehicle[-1] + 1))
    nothing = -_HOPELESS * np.bincount(seen.vehicles)
    sizes = seen.first_guess + _SIZES
    apart = (sizes - fit.shape[:, :1]) ** 2 / (2 * variance[:, None])
    evidence = np.logaddexp(np.logaddexp.reduceat(score[:, None] - apart, starts, axis=0), nothing[:, None])
    best = int(evidence.sum(axis=0).argmax())
    shares = np.exp(score - apart[:, best] - evidence[fit.vehicle, best])
    kept = (shares > _LEAST_SHARE) & (fit.over_pairs(fit.worth) > 1)
    return fit.only(kept), shares[kept]


def _outlines_say(
    at: Array, like: Camera, basis: Basis, seen: Silhouettes, hypotheses: Hypotheses, fit: Fit, shares: Array
) -> _Belief:
    """What silhouettes say about the camera, with sizes, proportions and places of the vehicles eliminated."""
    unit = unit_camera(_camera(at, like, basis.unit))
    found = residuals(unit, seen, hypotheses, fit)
    here = reach_by(unit, found.outline, fit)
    by_camera = []
    for k, step in enumerate(_DIFFERENCES):
        moved = unit_camera(_camera(at + step * (np.arange(4) == k), like, basis.unit))
        by_camera.append((reach_by(moved, found.outline, fit) - here) / step / found.error[:, None])
    slopes = np.concatenate([found.slopes[..., 2:], np.stack(by_camera, axis=-1)], axis=-1)
    normal, pull = with_priors(fit, *eliminate(fit, found, slopes)[:2])
    shape, camera = np.s_[:, :6], np.s_[:, 6:]
    cross = normal[shape][..., 6:]
    solved = np.linalg.solve(normal[shape][..., :6], np.concatenate([cross, pull[shape][..., None]], axis=-1))
    own = normal[camera][..., 6:] - np.swapaxes(cross, -1, -2) @ solved[..., :4]
    rest = pull[camera] - np.einsum("pij,pi->pj", cross, solved[..., 4])
    own, rest = (_TEMPER * np.tensordot(shares, part, axes=1) for part in (own, rest))
    # Errors of their own, beside what the outlines' scatter says.
    sd = _SILHOUETTES_SD.copy()
    sd[2] = np.hypot(sd[2], _OBLIQUE_FOCAL_SD * at[0] / np.exp(at[2]))
    weaker = np.linalg.inv(np.eye(4) + own @ np.diag(sd**2))
    own, rest = weaker @ own, weaker @ rest
    return _Belief(own, rest + own @ at)


def _edges_say(at: Array, basis: Basis) -> _Belief:
    """What edges say about the focal length and the tilt, and how that moves with VP1."""
    thin = np.arange(len(basis.edges))[:: max(1, len(basis.edges) // _EDGES)]
    edges, temper = basis.edges[thin], basis.temper * len(basis.edges) / max(len(thin), 1)

    def answer(x: float, y: float) -> Array:
        vp1 = np.array([x, y, 1.0])
        found = find_across(
            edges, vp1 / np.linalg.norm(vp1), basis.width, road=basis.road, temper=temper, around=basis.across
        )
        return np.array([np.log(found.focal), found.tilt])

    step = _TRACKS_SD
    here = answer(at[0], at[1])
    by_x = (answer(at[0] + step, at[1]) - answer(at[0] - step, at[1])) / (2 * step)
    by_y = (answer(at[0], at[1] + step) - answer(at[0], at[1] - step)) / (2 * step)
    miss = np.concatenate([-np.stack([by_x, by_y], axis=1), np.eye(2)], axis=1)
    sd = np.hypot([basis.across.focal_sd, basis.across.tilt_sd], _EDGES_SD)
    weighted = miss.T / sd**2
    return _Belief(weighted @ miss, weighted @ (here + miss[:, :2] @ at[:2]))


def _ray_spread_deg(at: Array, spread: Array) -> float:
    """Standard deviation of VP1's direction at the camera from the (4, 4) covariance, degrees."""
    ray = np.array([at[0], at[1], np.exp(at[2])])
    length = float(np.linalg.norm(ray))
    slopes = np.diag([1.0, 1.0, ray[2]]) / length
    slopes -= np.outer(ray / length, ray / length) @ slopes
    return float(np.degrees(np.sqrt(np.trace(slopes @ spread[:3, :3] @ slopes.T))))

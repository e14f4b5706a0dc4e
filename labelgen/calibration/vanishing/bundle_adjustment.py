"""Bundle adjustment: VP1, tilt and focal length from vehicles that keep their size while they drive.

Features slide over a vehicle's body while its aspect changes: VP1 from tracks alone is mostly too low, by less where
those at the vehicles' sides are taken (`vehicle_groups.outer_tracks`). Silhouettes of one vehicle at several distances
do not share that error: through the right camera they are one rigid body on the road. Bodies are therefore fitted to
them (`vehicle_fit`), each vehicle with one size, and the camera is moved to where the outlines, tracks and edges fit
best together. What silhouettes alone give for the focal length and the tilt is biased by shapes that no model has, and
has a low weight: on both, the edges decide, whose answer moves with VP1.

Source: this project's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from labelgen.calibration.observation.association import (
    AssociationSettings,
    associate_silhouettes,
    select_silhouettes,
)
from labelgen.calibration.observation.collect import Observations
from labelgen.calibration.observation.silhouettes import VehicleSilhouette
from labelgen.calibration.road_units import unit_camera
from labelgen.calibration.vanishing.orientation import Orientation, OrientationInputs, camera_from_angles
from labelgen.calibration.vanishing.vp2 import estimate_vp2
from labelgen.calibration.vehicle_fit.measurements import MeasuredSilhouettes, measure_silhouettes
from labelgen.calibration.vehicle_fit.model_fit import BodyHypotheses, ModelFit, initial_fit
from labelgen.calibration.vehicle_fit.optimize import (
    add_shape_priors,
    eliminate_positions,
    optimize_fit,
    shape_prior_costs,
    size_variance,
)
from labelgen.calibration.vehicle_fit.residuals import fit_residuals, project_support
from labelgen.calibration.vehicle_fit.settings import VehicleFitSettings
from labelgen.geometry import Camera
from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import common_bodies

__all__ = ["BundleAdjustmentSettings", "refine_orientation"]


@dataclass(frozen=True)
class BundleAdjustmentSettings:
    """How silhouettes, tracks and edges are weighed against each other.

    The standard deviations are errors of each kind of evidence beside its own scatter, measured against the true
    cameras of rendered sessions. Raising one gives the other kinds more weight. VP1's x and y are in normalised units,
    nearly rad; 1 px of a frame 1920 px wide is 1 / 2304 of a unit.
    """

    min_vehicles: int = 5
    """Fewest vehicles seen several times; with fewer the camera stays as it is."""
    tracks_sd: float = 10 / 2304
    """Standard deviation of VP1 from tracks, units, whatever its spread over resamples."""
    silhouette_weight: float = 0.25
    """Factor on the silhouettes' information: errors of neighbouring ones are alike."""
    silhouettes_vp1_x_sd: float = 10 / 2304
    """Standard deviation of VP1's x from silhouettes, units."""
    silhouettes_vp1_y_sd: float = 8 / 2304
    """Standard deviation of VP1's y from silhouettes, units."""
    silhouettes_focal_sd: float = 0.025
    """Standard deviation of the focal length's logarithm from silhouettes."""
    silhouettes_tilt_sd: float = 0.018
    """Standard deviation of the tilt from silhouettes, rad."""
    oblique_focal_sd: float = 0.1
    """Added to that of the focal length, per tangent of the angle between the road and the camera's axis: seen
    obliquely the bodies err more."""
    edges_focal_sd: float = 0.02
    """Standard deviation of the focal length's logarithm from edges, beside the posterior's."""
    edges_tilt_sd: float = 0.0017
    """Standard deviation of the tilt from edges, rad, beside the posterior's."""
    max_cost: float = 6.0
    """Cost, half a sum of squares, from which on a silhouette is not of one vehicle, or not whole; larger values let
    merged vehicles in."""
    min_probability: float = 0.02
    """Least probability of a vehicle's hypothesis that is still fitted; smaller values cost time."""
    min_log_size: float = -1.6
    """Smallest size tried, as the logarithm of its ratio to the first guess, which is rather too large."""
    max_log_size: float = 0.8
    """Largest size tried, likewise."""
    size_steps: int = 601
    """Sizes tried."""
    iterations: int = 8
    """Most steps of the camera."""
    convergence: float = 0.02
    """The steps end when none is longer than this share of the posterior's standard deviation."""
    identify_steps: int = 4
    """Steps of each fit while the vehicles' types are identified."""
    max_edges: int = 4000
    """About how many edges are used; more cost time."""
    difference_vp1: float = 1.3e-3
    """Step of the numerical derivative by VP1, units."""
    difference_focal: float = 5e-3
    """Step of the numerical derivative by the focal length's logarithm."""
    difference_tilt: float = 3e-3
    """Step of the numerical derivative by the tilt, rad."""
    max_step_vp1: float = 0.017
    """Largest change of VP1 per step, units."""
    max_step_focal: float = 0.1
    """Largest change of the focal length's logarithm per step."""
    max_step_tilt: float = 0.02
    """Largest change of the tilt per step, rad."""
    association: AssociationSettings = field(default_factory=AssociationSettings)
    """Of silhouettes with vehicles."""
    fit: VehicleFitSettings = field(default_factory=VehicleFitSettings)
    """Of bodies to silhouettes."""


@dataclass(frozen=True, eq=False)
class _Information:
    """A Gaussian over the camera (x, y, log focal, tilt) in information form.

    Args:
        normal: (4, 4) inverse covariance.
        pull: (4,) its product with the mean.
    """

    normal: Array
    pull: Array


def refine_orientation(
    observations: Observations,
    orientation: Orientation,
    silhouettes: Sequence[VehicleSilhouette],
    settings: BundleAdjustmentSettings | None = None,
) -> Orientation:
    """Adjust the camera so that vehicles keep their size.

    Args:
        observations: what the pass over the video gave.
        orientation: from tracks and edges.
        silhouettes: from the same pass.
        settings: thresholds.

    Returns:
        the same with another camera and other spreads; unchanged where too few vehicles are seen several times.
    """
    settings = settings or BundleAdjustmentSettings()
    inputs, like = orientation.inputs, orientation.camera
    unit = unit_camera(like)
    measured = _reobserved(unit, observations, inputs, silhouettes, settings)
    if len(np.unique(measured.vehicles)) < settings.min_vehicles:
        return orientation
    hypotheses = BodyHypotheses.from_bodies(common_bodies())
    fit, probabilities = _identify_types(unit, measured, hypotheses, settings)
    if probabilities.sum() < settings.min_vehicles:
        return orientation
    start = _camera_vector(like, inputs.unit)
    tracks = np.diag([settings.tracks_sd**-2, settings.tracks_sd**-2, 0, 0])
    edges, at = _edge_information(start, inputs, settings), start
    max_step = np.array([settings.max_step_vp1, settings.max_step_vp1, settings.max_step_focal, settings.max_step_tilt])
    for step in range(settings.iterations):
        fit = optimize_fit(unit, measured, hypotheses, fit, 2 if step else 1, settings.fit)
        outlines = _silhouette_information(at, like, inputs, measured, hypotheses, fit, probabilities, settings)
        normal = tracks + edges.normal + outlines.normal
        change = np.linalg.solve(normal, tracks @ start + edges.pull + outlines.pull) - at
        at = at + np.clip(change, -max_step, max_step)
        unit = unit_camera(_camera_at(at, like, inputs.unit))
        if step == settings.iterations // 2:
            edges = _edge_information(at, inputs, settings)
        elif (np.abs(change) < settings.convergence * np.diag(np.linalg.inv(normal)) ** 0.5).all():
            break
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    evidence = replace(
        orientation.evidence,
        vp1_sd_deg=_ray_sd_deg(at, covariance),
        focal_sd=float(np.sqrt(covariance[2, 2])),
        tilt_sd_deg=float(np.degrees(np.sqrt(covariance[3, 3]))),
        reobserved_vehicles=round(float(probabilities.sum())),
    )
    return replace(orientation, camera=_camera_at(at, like, inputs.unit), evidence=evidence)


def _reobserved(
    unit: Camera,
    observations: Observations,
    inputs: OrientationInputs,
    silhouettes: Sequence[VehicleSilhouette],
    settings: BundleAdjustmentSettings,
) -> MeasuredSilhouettes:
    """Return the silhouettes of vehicles that are seen several times."""
    tracks = [observations.tracks[k] for k in inputs.tracks.tolist()]
    vehicles = associate_silhouettes(silhouettes, tracks, inputs.vehicles, settings.association)
    selected = select_silhouettes(
        silhouettes,
        vehicles,
        min_size_px=settings.association.min_size_share * observations.size_wh[0],
        max_count=settings.association.max_count,
    )
    return measure_silhouettes(unit, [silhouettes[i] for i in selected.tolist()], vehicles[selected], settings.fit)[0]


def _camera_vector(camera: Camera, unit: float) -> Array:
    """(4,) x and y of VP1 in units from the principal point, log of the focal length in units, tilt in rad."""
    horizon = camera.vp2 - camera.vp1
    tilt = np.arctan(horizon[1] / horizon[0])
    return np.array([*(camera.vp1 - camera.pp) / unit, np.log(camera.focal / unit), tilt])


def _camera_at(at: Array, like: Camera, unit: float) -> Camera:
    """Return the camera of a vector (4,), otherwise like another one."""
    assert like.image_wh is not None
    vp1 = np.array([at[0], at[1], 1.0])
    return replace(camera_from_angles(vp1, at[3], np.exp(at[2]), like.pp, unit, like.image_wh), name=like.name)


def _identify_types(
    unit: Camera, measured: MeasuredSilhouettes, hypotheses: BodyHypotheses, settings: BundleAdjustmentSettings
) -> tuple[ModelFit, Array]:
    """Return the P plausible pairs of vehicle and hypothesis with their probabilities (P,), which sum to at most V."""
    max_cost, steps = settings.max_cost, settings.identify_steps
    fit = optimize_fit(unit, measured, hypotheses, initial_fit(measured, hypotheses, settings.fit), steps, settings.fit)
    cost = fit_residuals(unit, measured, hypotheses, fit, settings.fit).costs
    total = fit.sum_over_pairs(np.minimum(cost, max_cost)) + shape_prior_costs(fit, settings.fit)
    starts = np.searchsorted(fit.vehicle, np.arange(fit.vehicle[-1] + 1))
    fit = fit.select_pairs(total < np.minimum.reduceat(total, starts)[fit.vehicle] + max_cost)
    fit = optimize_fit(unit, measured, hypotheses, fit, steps, settings.fit)
    cost = fit_residuals(unit, measured, hypotheses, fit, settings.fit).costs
    fit = replace(fit, included=(cost < max_cost).astype(np.float64))
    fit = optimize_fit(unit, measured, hypotheses, fit, steps, settings.fit)
    residuals = fit_residuals(unit, measured, hypotheses, fit, settings.fit)
    variance = size_variance(fit, residuals, settings.fit)
    cost = fit.sum_over_pairs(np.minimum(residuals.costs, max_cost)) + shape_prior_costs(fit, settings.fit)
    score = hypotheses.log_prior[fit.hypothesis] - cost
    # All vehicles are seen through one camera: a type that needs another scale than the rest is the wrong one.
    starts = np.searchsorted(fit.vehicle, np.arange(fit.vehicle[-1] + 1))
    nothing = -max_cost * np.bincount(measured.vehicles)
    offsets = np.linspace(settings.min_log_size, settings.max_log_size, settings.size_steps)
    log_sizes = measured.guess_log_size(settings.fit) + offsets
    size_cost = (log_sizes - fit.shape[:, :1]) ** 2 / (2 * variance[:, None])
    evidence = np.logaddexp(np.logaddexp.reduceat(score[:, None] - size_cost, starts, axis=0), nothing[:, None])
    best = int(evidence.sum(axis=0).argmax())
    probabilities = np.exp(score - size_cost[:, best] - evidence[fit.vehicle, best])
    plausible = (probabilities > settings.min_probability) & (fit.sum_over_pairs(fit.included) > 1)
    return fit.select_pairs(plausible), probabilities[plausible]


def _silhouette_information(
    at: Array,
    like: Camera,
    inputs: OrientationInputs,
    measured: MeasuredSilhouettes,
    hypotheses: BodyHypotheses,
    fit: ModelFit,
    probabilities: Array,
    settings: BundleAdjustmentSettings,
) -> _Information:
    """Return the silhouettes' information, with sizes, proportions and positions of the vehicles eliminated."""
    unit = unit_camera(_camera_at(at, like, inputs.unit))
    residuals = fit_residuals(unit, measured, hypotheses, fit, settings.fit)
    here = project_support(unit, residuals.outline, fit, settings.fit)
    steps = (settings.difference_vp1, settings.difference_vp1, settings.difference_focal, settings.difference_tilt)
    by_camera = []
    for k, step in enumerate(steps):
        moved = unit_camera(_camera_at(at + step * (np.arange(4) == k), like, inputs.unit))
        change = project_support(moved, residuals.outline, fit, settings.fit) - here
        by_camera.append(change / step / residuals.error[:, None])
    slopes = np.concatenate([residuals.slopes[..., 2:], np.stack(by_camera, axis=-1)], axis=-1)
    normal, pull = add_shape_priors(fit, *eliminate_positions(fit, residuals, slopes)[:2], settings.fit)
    # The Schur complement of the shape leaves the camera.
    shape, camera = np.s_[:, :6], np.s_[:, 6:]
    cross = normal[shape][..., 6:]
    solved = np.linalg.solve(normal[shape][..., :6], np.concatenate([cross, pull[shape][..., None]], axis=-1))
    own = normal[camera][..., 6:] - np.swapaxes(cross, -1, -2) @ solved[..., :4]
    rest = pull[camera] - np.einsum("pij,pi->pj", cross, solved[..., 4])
    own, rest = (settings.silhouette_weight * np.tensordot(probabilities, part, axes=1) for part in (own, rest))
    # Errors that all silhouettes share add to the covariance.
    oblique = settings.oblique_focal_sd * at[0] / np.exp(at[2])
    sd = np.array(
        [
            settings.silhouettes_vp1_x_sd,
            settings.silhouettes_vp1_y_sd,
            np.hypot(settings.silhouettes_focal_sd, oblique),
            settings.silhouettes_tilt_sd,
        ]
    )
    weaker = np.linalg.inv(np.eye(4) + own @ np.diag(sd**2))
    own, rest = weaker @ own, weaker @ rest
    return _Information(own, rest + own @ at)


def _edge_information(at: Array, inputs: OrientationInputs, settings: BundleAdjustmentSettings) -> _Information:
    """Return the edges' information on focal length and tilt, which moves with VP1."""
    thin = np.arange(len(inputs.edges))[:: max(1, len(inputs.edges) // settings.max_edges)]
    edges, power = inputs.edges[thin], inputs.likelihood_power * len(inputs.edges) / max(len(thin), 1)

    def estimate(x: float, y: float) -> Array:
        vp1 = np.array([x, y, 1.0])
        vp2 = estimate_vp2(
            edges,
            vp1 / np.linalg.norm(vp1),
            inputs.width,
            road=inputs.road,
            likelihood_power=power,
            around=inputs.vp2,
            settings=inputs.vp2_settings,
        )
        return np.array([np.log(vp2.focal), vp2.tilt])

    step = settings.tracks_sd
    here = estimate(at[0], at[1])
    by_x = (estimate(at[0] + step, at[1]) - estimate(at[0] - step, at[1])) / (2 * step)
    by_y = (estimate(at[0], at[1] + step) - estimate(at[0], at[1] - step)) / (2 * step)
    slopes = np.concatenate([-np.stack([by_x, by_y], axis=1), np.eye(2)], axis=1)
    sd = np.hypot([inputs.vp2.focal_sd, inputs.vp2.tilt_sd], [settings.edges_focal_sd, settings.edges_tilt_sd])
    weighted = slopes.T / sd**2
    return _Information(weighted @ slopes, weighted @ (here + slopes[:, :2] @ at[:2]))


def _ray_sd_deg(at: Array, covariance: Array) -> float:
    """Return the standard deviation of VP1's direction at the camera, degrees, from a (4, 4) covariance."""
    ray = np.array([at[0], at[1], np.exp(at[2])])
    length = float(np.linalg.norm(ray))
    slopes = np.diag([1.0, 1.0, ray[2]]) / length
    slopes -= np.outer(ray / length, ray / length) @ slopes
    return float(np.degrees(np.sqrt(np.trace(slopes @ covariance[:3, :3] @ slopes.T))))

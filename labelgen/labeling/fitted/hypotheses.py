"""Hypotheses about vehicles, each a family of bodies and a direction of travel, and the state of their fit."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.body_forms import MODES, BodyForms
from labelgen.geometry.camera import Camera
from labelgen.geometry.homography import Array
from labelgen.labeling.fitted.outlines import Outlines
from labelgen.labeling.fitted.settings import MaskErrors

__all__ = ["SHARED", "BodyFit", "Priors", "start_fit"]

SHARED = 3 + MODES + 3
"""Parameters that a vehicle's sightings share: log length, width, height; form; mirrors, swelling, shadow. Swelling is
in standard deviations."""


@dataclass(frozen=True, eq=False)
class BodyFit:
    """P hypotheses about vehicles, and their R sightings in the hypotheses' order.

    Args:
        vehicle: (P,) number of the vehicle.
        family: (P,) number of the family of bodies.
        sign: (P,) +1 away from the camera, -1 towards it.
        shared: (P, SHARED) parameters of the vehicle.
        outline: (R,) number of the outline.
        hypothesis: (R,) of each sighting.
        place: (R, 2) metres on the road, of the body's middle.
        heading: (R,) radians between its axis and VP1's direction.
    """

    vehicle: NDArray[np.int64]
    family: NDArray[np.int64]
    sign: Array
    shared: Array
    outline: NDArray[np.int64]
    hypothesis: NDArray[np.int64]
    place: Array
    heading: Array

    def select(self, keep: NDArray[np.bool_]) -> BodyFit:
        """Return some of the hypotheses, keep (P,)."""
        rows = keep[self.hypothesis]
        number = np.cumsum(keep) - 1
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        of_rows = {"outline", "hypothesis", "place", "heading"}
        chosen = {name: part[rows if name in of_rows else keep] for name, part in parts.items()}
        return BodyFit(**chosen | {"hypothesis": number[self.hypothesis[rows]]})

    def sum_rows(self, values: Array) -> Array:
        """Return sums (P, ...) of values (R, ...) over each hypothesis's sightings."""
        starts = np.searchsorted(self.hypothesis, np.arange(len(self.vehicle)))
        return np.asarray(np.add.reduceat(values, starts, axis=0))

    def max_rows(self, values: Array) -> Array:
        """Return the largest of values (R,) of each hypothesis's sightings, (P,)."""
        starts = np.searchsorted(self.hypothesis, np.arange(len(self.vehicle)))
        return np.asarray(np.maximum.reduceat(values, starts))

    @property
    def size_lwh(self) -> Array:
        """(P, 3) length, width, height, metres."""
        return np.exp(self.shared[:, :3])


@dataclass(frozen=True, eq=False)
class Priors:
    """Gaussian priors of the shared parameters of P hypotheses, and what the hypotheses themselves cost.

    Args:
        mean: (P, SHARED).
        precision: (P, SHARED, SHARED).
        cost: (P,) minus the logarithm of the prior probability.
    """

    mean: Array
    precision: Array
    cost: Array

    @classmethod
    def of(cls, fit: BodyFit, forms: BodyForms, errors: MaskErrors, log_share: Array) -> Priors:
        """Return the priors of hypotheses.

        Args:
            fit: P hypotheses.
            forms: the families.
            errors: of the masks.
            log_share: (P,) logarithm of each hypothesis's share.
        """
        means, precisions = np.zeros((len(forms.forms), SHARED)), np.zeros((len(forms.forms), SHARED, SHARED))
        for k, form in enumerate(forms.forms):
            means[k, :3] = form.log_size
            means[k, 3 + MODES :] = form.mirror_m[0], 0.0, errors.shadow[0]
            precisions[k, :3, :3] = np.linalg.inv(form.log_size_covariance)
            spread = np.array([*np.ones(MODES), form.mirror_m[1], 1.0, errors.shadow[1]])
            precisions[k, range(3, SHARED), range(3, SHARED)] = 1 / spread**2
        # Families of narrow priors must not win by their narrowness alone being left out.
        widths = np.array([0.5 * np.linalg.slogdet(form.log_size_covariance)[1] for form in forms.forms])
        return cls(means[fit.family], precisions[fit.family], widths[fit.family] - log_share)

    def select(self, keep: NDArray[np.bool_]) -> Priors:
        """Return those of some hypotheses, keep (P,)."""
        return Priors(self.mean[keep], self.precision[keep], self.cost[keep])


def start_fit(
    outlines: Outlines,
    vehicles: NDArray[np.int64],
    hypotheses: list[tuple[int, int, int]],
    camera: Camera,
    forms: BodyForms,
    errors: MaskErrors,
) -> BodyFit:
    """Return hypotheses at their start: mean bodies that stand on the outlines' lower sides.

    Args:
        outlines: R of them.
        vehicles: (R,) number of each one's vehicle.
        hypotheses: vehicle, family and sign of each, in the order of the vehicles.
        camera: with a scale.
        forms: the families.
        errors: of the masks.
    """
    vehicle, family, sign = (np.array(column, dtype=np.int64) for column in zip(*hypotheses, strict=True))
    order = np.argsort(vehicles, kind="stable")
    first = np.searchsorted(vehicles[order], vehicle)
    count = np.searchsorted(vehicles[order], vehicle, side="right") - first
    hypothesis = np.repeat(np.arange(len(vehicle)), count)
    within = np.arange(len(hypothesis)) - np.repeat(np.cumsum(count) - count, count)
    outline = order[np.repeat(first, count) + within]
    shared = np.zeros((len(vehicle), SHARED))
    shared[:, :3] = np.array([form.log_size for form in forms.forms])[family]
    shared[:, -1] = errors.shadow[0]
    shared[:, 3 + MODES] = np.array([form.mirror_m[0] for form in forms.forms])[family]
    place = camera.road_points(outlines.bottoms_px[outline], invalid="nan")
    place[:, 0] += np.exp(shared[hypothesis, 0]) / 2
    return BodyFit(vehicle, family, sign.astype(np.float64), shared, outline, hypothesis, place, np.zeros(len(outline)))

"""Settings of the fit of vehicle bodies to silhouettes, and the arrays that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labelgen.geometry.homography import Array
from labelgen.geometry.vehicle_bodies import SIZE_SPREAD

__all__ = ["VehicleFitSettings"]


@dataclass(frozen=True)
class VehicleFitSettings:
    """How bodies are fitted to silhouettes.

    Shadow and swelling describe background masks; their means were measured on rendered sessions. A larger mean makes
    the fitted vehicles smaller in road units, and the scale larger; a larger standard deviation leaves more to each
    outline.
    """

    directions: int = 24
    """Directions, evenly spread in the image, in which outlines are compared; more cost time."""
    independent_directions: float = 10.0
    """Independent measurements that all directions together count as: errors of neighbouring ones are alike."""
    shadow_mean: float = 0.035
    """How far a silhouette reaches below the vehicle's lowest point, as a share of its size: the shadow beneath."""
    shadow_sd: float = 0.04
    """Standard deviation of the shadow's reach."""
    shadow_exponent: int = 20
    """Power of the downward component of a direction with which the shadow's reach falls off: none at the corners."""
    swelling_mean: float = 0.003
    """How far a silhouette reaches beyond the vehicle in all directions, as a share of its size."""
    swelling_sd: float = 0.01
    """Standard deviation of the swelling."""
    error_width_share: float = 1.6e-3
    """Standard deviation of an outline's reach, as a share of the frame's width: masks are made on small copies."""
    error_size_share: float = 0.02
    """The part of it that grows with the silhouette, as a share of its size: real bodies are not the models."""
    huber: float = 2.0
    """Residual, in standard deviations, from which on errors count linearly; smaller values ignore more of an outline
    that is partly wrong."""
    max_step: float = 0.2
    """Largest change of a shape parameter per step; larger ones overshoot from rough starts."""
    max_move_m: float = 4.0
    """Largest change of a position per step and axis, metres at the current size."""
    typical_width_m: float = 1.9
    """Width of the vehicle that the first guess of the size assumes, metres."""
    typical_half_length_m: float = 2.2
    """Half its length, metres: from its lower edge in the image to its middle."""
    size_precision: float = 1e-3
    """Precision (inverse variance) of the prior on the size's logarithm, weak: it keeps a vehicle without usable
    silhouettes where it is."""

    @property
    def direction_weight(self) -> float:
        """Weight of each direction."""
        return self.independent_directions / self.directions

    @cached_property
    def direction_vectors(self) -> Array:
        """(2, M) unit vectors x, y in the image, y down."""
        angles = 2 * np.pi * np.arange(self.directions) / self.directions
        return np.stack([np.cos(angles), np.sin(angles)])

    @cached_property
    def reach_beyond(self) -> Array:
        """(M, 2) how far shadow and swelling of 1 reach in each direction."""
        down = np.maximum(self.direction_vectors[1], 0) ** self.shadow_exponent
        return np.stack([down, np.ones(self.directions)], axis=1)

    @cached_property
    def shape_mean(self) -> Array:
        """(6,) prior mean of the shape: size (no prior), stretch along each axis, shadow, swelling."""
        return np.array([0, 0, 0, 0, self.shadow_mean, self.swelling_mean])

    @cached_property
    def shape_precision(self) -> Array:
        """(6,) inverse variances of the shape's prior; 0 for the size."""
        return np.array([0, *(1 / sd**2 for sd in (*SIZE_SPREAD, self.shadow_sd, self.swelling_sd))])

"""Settings of the fit of vehicle bodies to masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from labelgen.geometry.homography import Array
from labelgen.masks import InstanceMasks

__all__ = [
    "BODY_FIT_SETTINGS",
    "DRAWN_MASKS",
    "EXACT_MASKS",
    "NETWORK_MASKS",
    "SILHOUETTE_MASKS",
    "BodyFitSettings",
    "MaskErrors",
]


@dataclass(frozen=True)
class MaskErrors:
    """What masks of one kind add to vehicles or lack: mean and standard deviation.

    Args:
        outline_px: standard deviation of an outline's reach, px.
        outline_share: the part of it that grows with the mask, as a share of its size.
        swelling: how far masks of a vehicle reach beyond it in all directions: mean, px; standard deviation, px; and
            the part of that which grows with the mask, as a share of its size.
        shadow: how far they reach below, as a share of their size.
        robust: residual, in standard deviations, at which a direction has half its weight: less where parts of outlines
            are often quite wrong.
        border_share: how far masks end short of the frame's border, as a share of its width.
    """

    outline_px: float
    outline_share: float
    swelling: tuple[float, float, float]
    shadow: tuple[float, float]
    robust: float = 1.5
    border_share: float = 0.0

    def margin_px(self, frame_wh: tuple[int, int]) -> float:
        """Return how near to a frame's border an outline may be cut by it, px."""
        return max(1.5, self.border_share * frame_wh[0])

    @staticmethod
    def of(masks: Sequence[InstanceMasks], *, are_silhouettes: bool) -> MaskErrors:
        """Return the errors of masks of a video, by where they come from."""
        if are_silhouettes:
            return SILHOUETTE_MASKS
        return NETWORK_MASKS if any(m.are_predicted for m in masks if len(m)) else DRAWN_MASKS


EXACT_MASKS = MaskErrors(0.35, 0.0, (0.0, 0.25, 0.0), (0.0, 0.002), 2.5)
"""Rendered masks."""
DRAWN_MASKS = MaskErrors(0.5, 0.004, (0.0, 0.5, 0.003), (0.0, 0.003), 2.5)
"""Masks that are no predictions: drawn by hand, or rendered."""
NETWORK_MASKS = MaskErrors(0.7, 0.012, (0.0, 0.7, 0.012), (0.0, 0.01), border_share=0.01)
"""Masks of a segmentation network: coarse, without shadows."""
SILHOUETTE_MASKS = MaskErrors(0.7, 0.015, (0.3, 0.6, 0.008), (0.03, 0.035), border_share=0.004)
"""Masks of the background model: with some of the shadow beneath the vehicle."""


@dataclass(frozen=True)
class BodyFitSettings:
    """How bodies are fitted to outlines."""

    directions: int = 36
    """Directions, evenly spread in the image, in which outlines are compared; more cost time."""
    independent_directions: float = 14.0
    """Independent measurements that all directions together count as: errors of neighbouring ones are alike."""
    shared_error_power: float = 0.7
    """Errors of a body's form are alike in all sightings: their variance grows with this power of their number."""
    heading_sd: float = 0.01
    """Standard deviation of a vehicle's direction around VP1's, radians."""
    path_sd_m: tuple[float, float] = (0.5, 0.12)
    """Standard deviations of a sighting's place from the vehicle's steady path, along and across the road, metres."""
    path_acceleration_ms2: tuple[float, float] = (1.5, 0.3)
    """Accelerations along and across the road for which the path leaves room, m/s^2."""
    path_robust: float = 1.5
    """Distance from the path, in standard deviations, at which a sighting has half its weight in it."""
    shadow_power: int = 12
    """Power of the downward component of a direction with which a shadow's reach falls off."""
    hidden_cost: float = 8.0
    """What must be saved by taking a side of a vehicle for hidden in many sightings; twice as much in a single one."""
    side_angle: float = 0.8
    """Half the angle of directions that belong to a side, radians."""
    first_steps: int = 6
    """Steps of all hypotheses."""
    last_steps: int = 8
    """Steps of those that are left."""
    place_steps: int = 3
    """Steps of sightings that are laid to a body that others gave."""
    margin: float = 6.0
    """Hypotheses that cost so much more than the best after the first steps are dropped."""
    moved_m: float = 2.0
    """A passage that is shorter does not tell the direction of travel, metres."""
    max_cost: float = 40.0
    """Half the robust sum of squares of a sighting from which on no body explains the outline."""
    sigma_scale: float = 1.15
    """Factor of the stated standard deviations, by which they hold what they state on real cars' shapes."""
    max_log_step: float = 0.2
    """Largest change of a size's logarithm per step."""
    max_move_m: float = 4.0
    """Largest change of a place per step and axis, metres."""
    max_turn: float = 0.05
    """Largest change of a direction per step, radians."""

    @property
    def direction_weight(self) -> float:
        """Weight of each direction."""
        return self.independent_directions / self.directions

    @cached_property
    def sides(self) -> NDArray[np.bool_]:
        """(8, M) which directions belong to each of eight sides."""
        vectors = self.direction_vectors
        angles = np.pi / 4 * np.arange(8)
        middle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return np.asarray(middle @ vectors.T >= np.cos(self.side_angle))

    @cached_property
    def direction_vectors(self) -> Array:
        """(M, 2) unit vectors x, y in the image, y down."""
        angles = 2 * np.pi * np.arange(self.directions) / self.directions
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)


BODY_FIT_SETTINGS = BodyFitSettings()

"""Families of vehicle bodies: how far bodies of any size and form reach in any direction.

A family is a mean form and some modes of variation, each a support function: how far the body reaches in a direction.
Support functions add up: mean plus multiples of modes is again that of a body, and one of a body that is stretched is
the same function of a stretched direction. A plane through the camera's centre touches a body where the support
function says so, which makes outlines of bodies cheap to predict: no points are projected, nothing is searched.

`python -m tools.studies.body_forms` writes their file from the bodies of the synthetic renderer and published sizes.

Convention:
    Directions are (..., 3) float64: x ahead, y to the left, z up. Bodies stand on z = 0 with their middle at the
    origin. Unit bodies have length, width and height 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.geometry.homography import Array

__all__ = ["FORMS_FILE", "MODES", "BodyForm", "BodyForms", "cuboid_forms", "form_directions", "load_body_forms"]

FORMS_FILE = "body_forms.npz"
MODES = 8
"""Modes of variation of each family."""
_LATITUDES, _LONGITUDES = 37, 37
_NO_MIRROR_SD_M = 1e-3


@cache
def form_directions() -> Array:
    """Return the directions (D, 3) for which forms are stored.

    They lie on a grid of latitudes from below to above and longitudes from ahead to behind, on the left side alone:
    bodies are symmetric.
    """
    latitude = np.linspace(-np.pi / 2, np.pi / 2, _LATITUDES)[:, None]
    longitude = np.linspace(0, np.pi, _LONGITUDES)
    level = np.cos(latitude)
    grid = np.stack(
        [level * np.cos(longitude), level * np.sin(longitude), np.broadcast_to(np.sin(latitude), (37, 37))], -1
    )
    return grid.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class BodyForm:
    """One family.

    Args:
        name: of the family.
        vehicle_class: number of its `labelgen.labels.VehicleClass`.
        share: its share in traffic.
        log_size: (3,) mean logarithm of length, width and height, metres.
        log_size_covariance: (3, 3) of them.
        mirror_m: how far mirrors stand out beyond the width, mean and standard deviation, metres.
        mirror_place: where: ahead of the middle as a share of the length, above the road as one of the height.
        error_m: standard deviation of what mean and modes do not describe, metres.
    """

    name: str
    vehicle_class: int
    share: float
    log_size: Array
    log_size_covariance: Array
    mirror_m: tuple[float, float]
    mirror_place: tuple[float, float]
    error_m: float


@dataclass(frozen=True, eq=False)
class BodyForms:
    """All families.

    Args:
        forms: F of them.
        table: (F * D, 1 + K) support of mean and modes in the directions of `form_directions`.
    """

    forms: tuple[BodyForm, ...]
    table: NDArray[np.float32]

    def support(
        self, family: NDArray[np.int64], directions: ArrayLike, weights: ArrayLike
    ) -> tuple[Array, Array, Array]:
        """Return how far unit bodies reach.

        Args:
            family: (N,) number of the family.
            directions: (N, M, 3) of any length: the reach grows with it.
            weights: (N, K) multiples of the modes.

        Returns:
            reach (N, M); its derivatives (N, M, 3) by the direction, which are the points that reach farthest; and the
            modes' reach (N, M, K).
        """
        v = np.asarray(directions, dtype=np.float64)
        weights = np.asarray(weights, dtype=np.float64)
        x, y, z = v[..., 0], np.abs(v[..., 1]), v[..., 2]
        level = np.maximum(np.hypot(x, y), 1e-9)
        length = np.hypot(level, z)
        row = (np.arctan2(z, level) / np.pi + 0.5) * (_LATITUDES - 1)
        column = np.arctan2(y, x) / np.pi * (_LONGITUDES - 1)
        i = np.minimum(row.astype(np.int64), _LATITUDES - 2)
        j = np.minimum(column.astype(np.int64), _LONGITUDES - 2)
        down, right = row - i, column - j
        first = (family[:, None] * _LATITUDES + i) * _LONGITUDES + j
        corners = [self.table[first + step] for step in (0, 1, _LONGITUDES, _LONGITUDES + 1)]
        shares = ((1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right)
        modes = sum(corner[..., 1:] * share[..., None] for corner, share in zip(corners, shares, strict=True))
        # One number for each corner: mean and modes together.
        joined = [c[..., 0] + np.einsum("nmk,nk->nm", c[..., 1:], weights) for c in corners]
        unit = sum(value * share for value, share in zip(joined, shares, strict=True))
        by_row = (joined[2] - joined[0]) * (1 - right) + (joined[3] - joined[1]) * right
        by_column = (joined[1] - joined[0]) * (1 - down) + (joined[3] - joined[2]) * down
        by_latitude = by_row * ((_LATITUDES - 1) / np.pi)
        by_longitude = by_column * ((_LONGITUDES - 1) / np.pi)
        across = by_longitude * length / level**2
        up = by_latitude / (length * level)
        points = v * (unit / length)[..., None]
        points[..., 0] += -up * x * z - across * y
        points[..., 1] += (-up * y * z + across * x) * np.where(v[..., 1] < 0, -1.0, 1.0)
        points[..., 2] += up * level**2
        return unit * length, points, np.asarray(modes) * length[..., None]


@cache
def load_body_forms() -> BodyForms:
    """Return the families of the package."""
    forms, tables = [], []
    with np.load(Path(__file__).with_name(FORMS_FILE)) as file:
        for name in dict.fromkeys(key.split("/")[0] for key in file.files):
            log_size, mirrors, other = (file[f"{name}/{part}"] for part in ("log_size", "mirrors", "other"))
            tables.append(file[f"{name}/support"].astype(np.float32).T)
            forms.append(
                BodyForm(
                    name, int(other[0]), float(other[1]), log_size[0], log_size[1:],
                    (float(mirrors[0]), float(mirrors[1])), (float(mirrors[2]), float(mirrors[3])), float(other[2]),
                )
            )  # fmt: skip
    return BodyForms(tuple(forms), np.concatenate(tables))


@cache
def cuboid_forms() -> BodyForms:
    """Return the families of the package with solid cuboids in place of their bodies.

    For outlines that are of 3D boxes already: sizes and classes are those of the families, forms do not vary.
    """
    forms = tuple(
        replace(form, mirror_m=(0.0, _NO_MIRROR_SD_M), mirror_place=(0.0, 0.5), error_m=0.0)
        for form in load_body_forms().forms
    )
    directions = form_directions()
    table = np.zeros((len(forms), len(directions), 1 + MODES), dtype=np.float32)
    table[..., 0] = np.abs(directions[:, :2]).sum(axis=1) / 2 + np.maximum(directions[:, 2], 0)
    return BodyForms(forms, table.reshape(-1, 1 + MODES))

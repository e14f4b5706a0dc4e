"""The rectifying homography of a convex region, for many regions at once.

Convention:
    float64 px, x right, y down. Matrices (N, 3, 3) act on column vectors (x, y, 1) and map frame px to rectified px.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labelgen.choices import Pair
from labelgen.geometry.homography import Array, bounding_boxes

__all__ = ["rectify_windows"]


def rectify_windows(
    vps: ArrayLike, hulls: ArrayLike, pair: Pair, size_wh: tuple[int, int]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the rectifying homographies of N convex regions; every kind of rectification uses this formula.

    The tangents of a region through the two vanishing points become the borders of the rectified image. The side
    that is lower in the frame comes to the bottom, and nothing is reflected.

    Args:
        vps: (N, 3, 2) or (3, 2) px, VP1, VP2, VP3.
        hulls: (N, K, 2) px, points whose convex hulls are the regions.
        pair: the vanishing points whose directions become axis-parallel.
        size_wh: size of the rectified images, px.

    Returns:
        Matrices (N, 3, 3), and valid (N,) bool. A matrix is NaN and not valid where the line that joins the two
        vanishing points crosses the region, or where the region has no area.

    Source: Kocur & Ftacnik 2020, section 3.2.
    """
    hulls = np.asarray(hulls, dtype=np.float64)
    vps = np.broadcast_to(np.asarray(vps, dtype=np.float64), (len(hulls), 3, 2))
    # Work in coordinates of order one: vanishing points reach 1e5 px.
    boxes = bounding_boxes(hulls)
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    unit = np.maximum((boxes[:, 2:] - boxes[:, :2]).max(axis=1), 1e-9)
    points = np.concatenate([(hulls - centre[:, None]) / unit[:, None, None], np.ones((*hulls.shape[:2], 1))], -1)
    vps_h = np.concatenate([(vps - centre[:, None]) / unit[:, None, None], np.ones((*vps.shape[:2], 1))], -1)
    vps_h /= np.linalg.norm(vps_h, axis=-1, keepdims=True)

    inner = points.mean(axis=1)
    spread = (points - inner[:, None])[..., :2]
    # Sum of squares of a region one unit long: its determinant is the smaller, the thinner the region.
    with np.errstate(invalid="ignore"):
        without_area = np.linalg.det(np.swapaxes(spread, -1, -2) @ spread) < 1e-12
    horizontal, vertical = vps_h[:, 1], vps_h[:, pair.vertical - 1]
    basis = _basis(horizontal, vertical, inner)
    mapped = points @ np.swapaxes(basis, -1, -2)
    w = mapped[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = mapped[..., :2] / w[..., None]
    right, up = _orientation(basis, vertical, inner)
    basis[:, 0] *= right[:, None]
    basis[:, 1] *= up[:, None]
    flat = flat * np.stack([right, up], axis=1)[:, None]
    low, high = flat.min(axis=1), flat.max(axis=1)
    extent = high - low
    valid = ~without_area & (w > 1e-9).all(axis=1) & (extent > 1e-12).all(axis=1) & np.isfinite(extent).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.asarray(size_wh, dtype=np.float64) / extent
        to_target = np.zeros((len(points), 3, 3))
        to_target[:, 0, 0], to_target[:, 1, 1], to_target[:, 2, 2] = gain[:, 0], gain[:, 1], 1.0
        to_target[:, :2, 2] = -low * gain
        to_unit = np.zeros((len(points), 3, 3))
        to_unit[:, 0, 0] = to_unit[:, 1, 1] = 1 / unit
        to_unit[:, :2, 2] = -centre / unit[:, None]
        to_unit[:, 2, 2] = 1.0
        matrices = to_target @ basis @ to_unit
        matrices /= np.linalg.norm(matrices, axis=(-2, -1), keepdims=True)
    matrices[~valid] = np.nan
    return matrices, valid


def _basis(horizontal: Array, vertical: Array, inner: Array) -> Array:
    """Return homographies (N, 3, 3) that send two vanishing points to infinity, one along x and one along y.

    Args:
        horizontal, vertical: (N, 3) the homogeneous vanishing points.
        inner: (N, 3) homogeneous points that get a positive third coordinate.
    """
    to_infinity = np.cross(horizontal, vertical)
    basis = np.stack([np.cross(vertical, inner), np.cross(horizontal, inner), to_infinity], axis=1)
    norm = np.linalg.norm(basis, axis=-1, keepdims=True)
    basis /= np.where(norm > 0, norm, 1)
    basis *= np.sign(np.einsum("ni,ni->n", basis[:, 2], inner))[:, None, None]
    return basis


def _orientation(basis: Array, vertical: Array, inner: Array) -> tuple[Array, Array]:
    """Return the signs (N,) of x and y with which a basis keeps up and down and reflects nothing."""
    # No reflection is a positive determinant. What moves down the frame along lines through the vertical vanishing
    # point moves down the rectified image.
    along = vertical[:, :2] * inner[:, 2:] - inner[:, :2] * vertical[:, 2:]
    along *= np.where(along[:, 1:] < 0, -1.0, 1.0)
    up = np.where(np.einsum("ni,ni->n", basis[:, 1, :2], along) >= 0, 1.0, -1.0)
    with np.errstate(invalid="ignore"):
        right = up * np.where(np.linalg.det(basis) >= 0, 1.0, -1.0)
    return right, up

"""From a coded picture to the picture that is meant: square pixels, upright, not mirrored.

A container may state a sample aspect ratio (width : height of a pixel) and a display matrix (rotation, mirror, or any
other linear map). Both are applied, so that a camera model with square pixels fits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["GEOMETRY_RULES", "FrameGeometry", "GeometryRules"]

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class GeometryRules:
    """Which stated geometry is believed."""

    min_aspect_change: float = 0.005
    """Share of the width by which pixels must differ from squares; less comes from rounding of the frame's size."""
    max_aspect: float = 8.0
    """Largest ratio between the sides of a pixel; more is a damaged header."""
    right_angle_cos: float = 0.001
    """Entries of a display matrix below this are zero; such a matrix only turns and mirrors."""


GEOMETRY_RULES = GeometryRules()


@dataclass(frozen=True, eq=False)
class FrameGeometry:
    """The map from coded pictures of one size to the frames that are meant.

    Args:
        coded_wh: px, of the coded pictures.
        size_wh: px, of the frames.
        matrix: (2, 2) from coded px to frame px, without the shift; the identity where nothing is to be done.
        note: what is applied or ignored, in words; empty where nothing is.
    """

    coded_wh: tuple[int, int]
    size_wh: tuple[int, int]
    matrix: NDArray[np.float64]
    note: str = ""

    @classmethod
    def of(
        cls, coded_wh: tuple[int, int], aspect: Any, display: Any, rules: GeometryRules = GEOMETRY_RULES
    ) -> FrameGeometry:
        """Return the map that a container asks for.

        Args:
            coded_wh: px, of the coded pictures.
            aspect: width of a pixel by its height, a number; None or 0 where it is not stated.
            display: (3, 3) display matrix as FFmpeg has it: rows act on (x, y, 1) from the left; None for none.
            rules: thresholds.
        """
        notes = []
        wide = float(aspect or 1)
        if not 1 / rules.max_aspect <= wide <= rules.max_aspect:
            notes.append(f"its sample aspect ratio {aspect} cannot be; taken as 1")
            wide = 1.0
        if abs(wide - 1) < rules.min_aspect_change or round(coded_wh[0] * wide) == coded_wh[0]:
            wide = 1.0
        turn = np.eye(2) if display is None else _unit_axes(np.asarray(display, dtype=np.float64)[:2, :2].T)
        if turn is None:
            notes.append("its display matrix maps everything to a line; ignored")
            turn = np.eye(2)
        turn = np.where(np.abs(turn) < rules.right_angle_cos, 0.0, turn)
        matrix = turn @ np.diag([wide, 1.0])
        size_wh = _extent(matrix, coded_wh)
        if wide != 1:
            notes.append(f"its pixels are {wide:.4g} times as wide as high; frames are resampled to square pixels")
        if not np.array_equal(turn, np.eye(2)):
            notes.append(_words(turn))
        if size_wh != coded_wh and notes:
            notes[-1] += f", {size_wh[0]}x{size_wh[1]} px"
        return cls(coded_wh, size_wh, matrix, "; ".join(notes))

    @property
    def resamples(self) -> bool:
        """Whether pixels are computed anew, rather than kept or moved."""
        return not np.isin(np.abs(self.matrix), (0.0, 1.0)).all() or not _is_axis_parallel(self.matrix)

    def apply(self, picture: Picture) -> Picture:
        """Return the frame of a picture (H, W[, C]) uint8 of any size with the coded picture's proportions."""
        if np.array_equal(self.matrix, np.eye(2)):
            return picture
        height, width = picture.shape[:2]
        size_wh = _extent(self.matrix, (width, height))
        if not _is_axis_parallel(self.matrix):
            corners = self.matrix @ np.array([[0, width, 0, width], [0, 0, height, height]])
            # Pixels are areas: the middle of the first one lies at 0.5.
            shift = self.matrix @ [0.5, 0.5] - corners.min(axis=1) - 0.5
            affine = np.column_stack([self.matrix, shift])
            return np.asarray(cv2.warpAffine(picture, affine, size_wh, flags=cv2.INTER_LINEAR), dtype=np.uint8)
        turned = self.matrix[0, 0] == 0
        unturned_wh = size_wh[::-1] if turned else size_wh
        if unturned_wh != (width, height):
            shrinks = unturned_wh[0] < width
            way = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            picture = np.asarray(cv2.resize(picture, unturned_wh, interpolation=way), dtype=np.uint8)
        if turned:
            picture = picture.swapaxes(0, 1)
        signs = self.matrix.sum(axis=1)
        return np.ascontiguousarray(picture[:: -1 if signs[1] < 0 else 1, :: -1 if signs[0] < 0 else 1])


def _unit_axes(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the matrix with axes of length 1, as their lengths repeat the aspect ratio; None if it is singular."""
    lengths = np.hypot(*matrix)
    if not np.isfinite(lengths).all() or lengths.min() <= 0:
        return None
    unit = np.asarray(matrix / lengths)
    return unit if abs(np.linalg.det(unit)) > 0.1 else None


def _is_axis_parallel(matrix: NDArray[np.float64]) -> bool:
    return bool((matrix[0, 1] == matrix[1, 0] == 0) or (matrix[0, 0] == matrix[1, 1] == 0))


def _extent(matrix: NDArray[np.float64], size_wh: tuple[int, int]) -> tuple[int, int]:
    """Return the size of the box around a picture's image, px."""
    width, height = np.abs(matrix) @ np.array(size_wh)
    return max(1, round(float(width))), max(1, round(float(height)))


def _words(turn: NDArray[np.float64]) -> str:
    mirrored = np.linalg.det(turn) < 0
    # In the picture y points down, so a turn of the axes from x to -y is counter-clockwise.
    degrees = math.degrees(math.atan2(-turn[1, 0], turn[0, 0])) % 360
    if mirrored and round(degrees) in (0, 180):
        return f"frames are mirrored {'upside down' if round(degrees) == 0 else 'left to right'}, as the file asks"
    text = f"turned by {degrees:.4g} degrees" + (" and mirrored" if mirrored else "")
    return f"frames are {text}, as the file asks"

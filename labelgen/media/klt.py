"""Pyramidal Lucas-Kanade optical flow (KLT) with the settings that tracks and camera motion share.

Source: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["KltSettings", "optical_flow"]

Grey = NDArray[np.uint8]
Points = NDArray[np.float32]


@dataclass(frozen=True)
class KltSettings:
    """Settings of the optical flow."""

    window_px: int = 15
    """Side of the window that is matched; larger ones are steadier and blur neighbouring motions."""
    iterations: int = 15
    """Most iterations per pyramid level."""
    epsilon_px: float = 0.02
    """An iteration that moves the point by less is the last one."""
    min_eigenvalue: float = 1e-3
    """Least eigenvalue of a window's gradient matrix; points on flat areas fall below it and are lost."""
    levels: int = 4
    """Pyramid levels above the full size; each doubles the motion that can be followed."""


def optical_flow(
    previous: Grey, current: Grey, points: Points, guess: Points, settings: KltSettings, *, levels: int, flags: int = 0
) -> tuple[Any, Any]:
    """Follow points from one frame to another.

    Args:
        previous, current: (h, w) uint8.
        points: (N, 2) or (N, 1, 2) float32 px in the previous frame.
        guess: of the same shape, where they may be in the current frame; changed in place.
        settings: of the flow.
        levels: pyramid levels above the full size.
        flags: OpenCV's; `cv2.OPTFLOW_USE_INITIAL_FLOW` makes use of the guess.

    Returns:
        the points in the current frame, shaped like `points`; and (N, 1) uint8, 1 where a point was followed.
    """
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        points,
        guess,
        maxLevel=levels,
        flags=flags,
        winSize=(settings.window_px, settings.window_px),
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, settings.iterations, settings.epsilon_px),
        minEigThreshold=settings.min_eigenvalue,
    )
    return moved, status

"""Camera motion: corners all over the frame against those of some seconds before."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.media.klt import Grey, KltSettings, optical_flow

__all__ = ["CameraShake", "CameraShakeSettings"]


@dataclass(frozen=True)
class CameraShakeSettings:
    """How camera motion is measured, on the shrunken frames."""

    refresh: int = 8
    """Every so many frames the corners are taken anew; larger values see slower motion and lose more corners."""
    grid: int = 8
    """Fields per side of the frame, each with one corner, so that no textured part outvotes the rest."""
    min_corners: int = 12
    """With fewer corners nothing is measured: they may all be on vehicles."""
    min_followed_share: float = 0.3
    """With a smaller share of the corners followed, the frame counts as shifted without bounds."""
    shift_quantile: float = 0.25
    """Quantile of the corners' displacements that counts as the camera's; vehicles hold the larger ones."""
    min_contrast: float = 3.0
    """Least standard deviation of the grey levels of a field with a corner; flat fields give noise."""
    min_quality: float = 0.1
    """Least quality of a corner, as a share of the field's best."""
    spacing_px: int = 10
    """Least distance between corners."""
    block_px: int = 5
    """Side of the window in which a corner is judged."""
    flow: KltSettings = field(default_factory=KltSettings)
    """Of the optical flow."""


class CameraShake:
    """Measure how far a camera moves.

    Args:
        settings: thresholds.

    Attributes:
        shifts_px: displacement of the camera at each frame, px of the shrunken frames; infinite where the corners are
            gone.
        drift_px: greatest displacement since the beginning, px of the shrunken frames, without jumps.
    """

    def __init__(self, settings: CameraShakeSettings | None = None) -> None:
        self._settings = settings or CameraShakeSettings()
        self.shifts_px: list[float] = []
        self._drift = np.zeros(2)
        self.drift_px = 0.0
        self._reference: Grey | None = None
        self._corners = np.empty((0, 1, 2), dtype=np.float32)
        self._field_count = self._frames = 0

    def update(self, grey: Grey) -> None:
        """Take a frame, (h, w) uint8; call it a few times per second."""
        settings = self._settings
        refresh = self._frames % settings.refresh == 0
        if self._reference is not None and self._field_count >= settings.min_corners:
            moved_to, status = optical_flow(
                self._reference, grey, self._corners, self._corners.copy(), settings.flow, levels=settings.flow.levels
            )
            followed = status[:, 0] > 0
            displacements = (moved_to - self._corners)[followed].reshape(-1, 2)
            lost = followed.mean() < settings.min_followed_share
            # Corners on vehicles may be many; on a camera that moves even the slowest quarter moves.
            lengths = np.hypot(*displacements.T)
            self.shifts_px.append(np.inf if lost else float(np.quantile(lengths, settings.shift_quantile)))
            if refresh and not lost:
                self._drift += np.median(displacements[lengths <= np.median(lengths)], axis=0)
                self.drift_px = max(self.drift_px, float(np.hypot(*self._drift)))
        if refresh:
            corners = self._grid_corners(grey)
            self._reference, self._field_count = grey, len(corners)
            self._corners = np.concatenate([np.empty((0, 1, 2), dtype=np.float32), *corners])
        self._frames += 1

    def _grid_corners(self, grey: Grey) -> list[NDArray[np.float32]]:
        """Return the strongest corner (1, 1, 2) px of each field of the grid that has one."""
        settings = self._settings
        h, w = (n // settings.grid for n in grey.shape)
        out = []
        for row in range(settings.grid):
            for column in range(settings.grid):
                part = grey[row * h : (row + 1) * h, column * w : (column + 1) * w]
                corners = cv2.goodFeaturesToTrack(
                    part, 1, settings.min_quality, settings.spacing_px, blockSize=settings.block_px
                )
                if corners is not None and part.std() > settings.min_contrast:
                    out.append(np.asarray(corners + np.array([column * w, row * h]), dtype=np.float32))
        return out

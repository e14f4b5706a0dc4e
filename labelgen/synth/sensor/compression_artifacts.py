"""Block artifacts of old video codecs on and around moving vehicles: mosquito noise, blocking, lost chroma.

MPEG-4 part 2, MPEG-2 and H.263 quantise the discrete cosine transform of each 8x8 block and do not filter its edges.
The still road is refined from frame to frame until its artifacts vanish; those of moving parts remain.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["BLOCKY_CODECS", "add_block_artifacts"]

_MPEG = ("mpeg1video", "mpeg2video", "mpeg4", "msmpeg4v1", "msmpeg4v2", "msmpeg4v3")
BLOCKY_CODECS = frozenset([*_MPEG, "h263", "h263p", "flv1", "wmv1", "wmv2"])
"""FFmpeg's names of codecs of 8x8 blocks without a deblocking filter."""

_SIDE = 8
_K = np.arange(_SIDE)
_COSINES = np.where(_K[:, None] == 0, np.sqrt(1 / _SIDE), 0.5 * np.cos((2 * _K + 1) * _K[:, None] * np.pi / 16))
_CHROMA_FACTOR = 2.0
"""Factor on the quantisation step of chroma: JPEG's matrices are coarser there, and such sources have little chroma."""
# As in the default matrices of MPEG and JPEG, the highest frequencies have some six times the step of the mean.
_STEPS = 1 + 0.4 * (_K[:, None] + _K)


def add_block_artifacts(image: NDArray[np.uint8], moving: NDArray[np.bool_], step: float) -> NDArray[np.uint8]:
    """Return a frame whose moving blocks are quantised as by an old codec.

    Args:
        image: (H, W, 3) uint8 BGR.
        moving: (H, W) bool, where the frame differs from the background.
        step: quantisation step of a block's lowest frequency, grey levels.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    height, width = image.shape[:2]
    pad = (-height % (2 * _SIDE), -width % (2 * _SIDE))
    whole = cv2.copyMakeBorder(image, 0, pad[0], 0, pad[1], cv2.BORDER_REPLICATE)
    where = np.pad(moving, ((0, pad[0]), (0, pad[1])))
    planes: Any = cv2.cvtColor(whole, cv2.COLOR_BGR2YCrCb).astype(np.float32)
    planes[..., 0] = _quantized(planes[..., 0], where, step)
    for k in (1, 2):
        # Chroma has half the resolution, so that its blocks are twice as large.
        few = cv2.resize(planes[..., k], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        coarse = _quantized(few, where[::2, ::2] | where[1::2, 1::2], _CHROMA_FACTOR * step)
        planes[..., k] += cv2.resize(coarse - few, whole.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    out = cv2.cvtColor(planes.round().clip(0, 255).astype(np.uint8), cv2.COLOR_YCrCb2BGR)[:height, :width]
    # Elsewhere the conversion to YCrCb and back would cost a grey level.
    near = cv2.dilate(moving.astype(np.uint8), np.ones((4 * _SIDE, 4 * _SIDE), np.uint8)) > 0
    return np.where(near[..., None], out, image)


def _quantized(plane: NDArray[np.float32], moving: NDArray[np.bool_], step: float) -> NDArray[np.float32]:
    """Return the plane (H, W) with its moving blocks quantised."""
    rows, columns = plane.shape[0] // _SIDE, plane.shape[1] // _SIDE
    blocks = plane.reshape(rows, _SIDE, columns, _SIDE).transpose(0, 2, 1, 3).copy()
    picked = moving.reshape(rows, _SIDE, columns, _SIDE).any(axis=(1, 3))
    waves = _COSINES @ blocks[picked] @ _COSINES.T
    steps = step * _STEPS
    blocks[picked] = _COSINES.T @ (np.round(waves / steps) * steps) @ _COSINES
    return blocks.transpose(0, 2, 1, 3).reshape(plane.shape)

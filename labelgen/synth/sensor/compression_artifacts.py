"""What recorders that code a picture in blocks leave around and inside vehicles: dots, stripes, lost colours.

Old ones (MPEG-4 part 2, MPEG-2, H.263) round the cosine transform of each block and smooth no edges afterwards. The
road, which stands, is refined from frame to frame until nothing of it shows; what moves keeps it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["BLOCKY_CODECS", "add_block_artifacts"]

_MPEG = ("mpeg1video", "mpeg2video", "mpeg4", "msmpeg4v1", "msmpeg4v2", "msmpeg4v3")
BLOCKY_CODECS = frozenset([*_MPEG, "h263", "h263p", "flv1", "wmv1", "wmv2"])
"""FFmpeg's names of codecs of 8x8 blocks whose edges nothing smooths."""

_SIDE = 8
_K = np.arange(_SIDE)
_COSINES = np.where(_K[:, None] == 0, np.sqrt(1 / _SIDE), 0.5 * np.cos((2 * _K + 1) * _K[:, None] * np.pi / 16))
_COLOUR_COARSER = 2.0
"""Colours are rounded more coarsely, as by JPEG's matrices; and such recorders' sources had few of them."""
# As the default matrices of MPEG and JPEG: fine details are rounded some six times as coarsely as the mean.
_STEPS = 1 + 0.4 * (_K[:, None] + _K)


def add_block_artifacts(image: NDArray[np.uint8], moving: NDArray[np.bool_], step: float) -> NDArray[np.uint8]:
    """A frame with the blocks in which something moves coded coarsely.

    Args:
        image: (H, W, 3) BGR.
        moving: (H, W) where it shows something else than the road.
        step: grey levels, to multiples of which a block's coarsest waves are rounded.
    """
    height, width = image.shape[:2]
    pad = (-height % (2 * _SIDE), -width % (2 * _SIDE))
    whole = cv2.copyMakeBorder(image, 0, pad[0], 0, pad[1], cv2.BORDER_REPLICATE)
    where = np.pad(moving, ((0, pad[0]), (0, pad[1])))
    planes: Any = cv2.cvtColor(whole, cv2.COLOR_BGR2YCrCb).astype(np.float32)
    planes[..., 0] = _rounded(planes[..., 0], where, step)
    for k in (1, 2):
        # Colours come at half the resolution, so that their blocks are twice as large.
        few = cv2.resize(planes[..., k], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        coarse = _rounded(few, where[::2, ::2] | where[1::2, 1::2], _COLOUR_COARSER * step)
        planes[..., k] += cv2.resize(coarse - few, whole.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    out = cv2.cvtColor(planes.round().clip(0, 255).astype(np.uint8), cv2.COLOR_YCrCb2BGR)[:height, :width]
    # Elsewhere the way to brightness and colours and back would cost a grey level.
    near = cv2.dilate(moving.astype(np.uint8), np.ones((4 * _SIDE, 4 * _SIDE), np.uint8)) > 0
    return np.where(near[..., None], out, image)


def _rounded(plane: NDArray[np.float32], moving: NDArray[np.bool_], step: float) -> NDArray[np.float32]:
    """(H, W) with those blocks rounded that something moves in."""
    rows, columns = plane.shape[0] // _SIDE, plane.shape[1] // _SIDE
    blocks = plane.reshape(rows, _SIDE, columns, _SIDE).transpose(0, 2, 1, 3).copy()
    picked = moving.reshape(rows, _SIDE, columns, _SIDE).any(axis=(1, 3))
    waves = _COSINES @ blocks[picked] @ _COSINES.T
    steps = step * _STEPS
    blocks[picked] = _COSINES.T @ (np.round(waves / steps) * steps) @ _COSINES
    return blocks.transpose(0, 2, 1, 3).reshape(plane.shape)

"""The empty scene, learnt while the frames go by, and what differs from it.

The first looks are kept compressed until there are enough of them to learn from, and are then gone through once more,
so that nothing that was seen early is lost and memory stays bounded.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.masks.background_model import BackgroundModel

__all__ = ["Backdrop", "Look"]

Image = NDArray[np.uint8]
_WIDTH = 640
_LEARN_FROM = 40
_FEWEST = 8
_FOLLOW_EVERY = 4
_PICTURE_SAMPLES = 15
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]

Look = tuple[int, float, Image, NDArray[np.bool_] | None]
"""Frame number, time, full-size BGR image, and the mask of what differs from the empty scene."""


class Backdrop:
    """Empty scene of a fixed camera from a few looks per second, full-size BGR.

    Args:
        silhouettes: whether anybody wants to know what differs from it.
    """

    def __init__(self, *, silhouettes: bool = True) -> None:
        self._silhouettes = silhouettes
        self._waiting: list[tuple[int, float, Image]] = []
        self._samples: list[Image] = []
        self._model: BackgroundModel | None = None
        self._looks = 0

    def look(self, number: int, time_s: float, image: Image) -> Iterator[Look]:
        """Take a frame; yields what can be said by now: nothing at first, then the early frames, then each at once."""
        if self._samples and not self._silhouettes:
            return
        if self._model is not None:
            self._looks += 1
            small = _small(image)
            if self._looks % _FOLLOW_EVERY == 0:
                self._model.observe(small)
            yield number, time_s, image, self._moving(small, image)
            return
        self._waiting.append((number, time_s, _packed(image)))
        if len(self._waiting) >= _LEARN_FROM:
            yield from self.finish()

    def finish(self) -> Iterator[Look]:
        """At the end: the frames still waiting, with masks where there were enough to learn from."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        self._samples = [packed for _, _, packed in waiting]
        if not self._silhouettes:
            return
        if len(waiting) >= _FEWEST:
            self._model = BackgroundModel()
            self._model.prime(_small(_unpacked(packed)) for packed in self._samples)
        for number, time_s, packed in waiting:
            image = _unpacked(packed)
            yield number, time_s, image, None if self._model is None else self._moving(_small(image), image)

    def picture(self) -> Image | None:
        """(H, W, 3) BGR, the empty scene at full size: the median over the early looks; None without any."""
        count = len(self._samples)
        if not count:
            return None
        chosen = self._samples[:: max(1, -(-count // _PICTURE_SAMPLES))]
        stack = np.stack([_unpacked(packed) for packed in chosen])
        out = np.empty(stack.shape[1:], dtype=np.uint8)
        for row in range(0, len(out), 64):
            out[row : row + 64] = np.partition(stack[:, row : row + 64], len(chosen) // 2, axis=0)[len(chosen) // 2]
        return out

    def _moving(self, small: Image, image: Image) -> NDArray[np.bool_]:
        assert self._model is not None
        aligned, (dx, dy) = self._model.align(small)
        changed = self._model.changed(aligned).view(np.uint8)
        h, w = image.shape[:2]
        fx, fy = w / small.shape[1], h / small.shape[0]
        matrix = np.array([[fx, 0, (0.5 - dx) * fx - 0.5], [0, fy, (0.5 - dy) * fy - 0.5]])
        return np.asarray(cv2.warpAffine(changed, matrix, (w, h), flags=cv2.INTER_NEAREST) > 0)


def _small(image: Image) -> Image:
    h, w = image.shape[:2]
    if w <= _WIDTH:
        return image
    return np.asarray(cv2.resize(image, (_WIDTH, round(h * _WIDTH / w)), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _packed(image: Image) -> Image:
    return np.asarray(cv2.imencode(".jpg", image, _QUALITY)[1], dtype=np.uint8)


def _unpacked(packed: Image) -> Image:
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)

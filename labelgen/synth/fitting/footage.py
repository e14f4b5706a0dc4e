"""A few frames of somebody's own video, held still, and the empty road behind its traffic."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.media.frames import FrameSource
from labelgen.media.open_frames import open_frames

__all__ = ["CHANGED", "Footage", "codec_of", "read_footage", "usual_packet"]

CHANGED = 22
"""Grey levels of any colour from which on a pixel differs from the empty road."""

_LOOKS, _FEWEST, _BYTES = 72, 8, 450_000_000
_STILL_PX = 0.35
"""How far a fixed camera's picture may seem to move."""
_DENSEST = 0.4
"""Share of the looks that agree where the road is seen."""
_BAND, _LOOSE = 16, 30
_ALIKE, _NEAR, _WORTH = 12, 24, 0.6
"""Grey levels by which looks at one road differ, and by which it differs from place to place; how many looks of the
former kind one of the latter is worth."""
_COLOURED, _FEW = 20, 0.42
_RUN, _PACKETS = 48, 1500

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Footage:
    """What was taken from a video.

    Args:
        name: of the video.
        fps: frames per second.
        looks: (K, H, W, 3) uint8 BGR, frames spread over the video, moved so that the scene stands still.
        raw: (R, H, W, 3) uint8 BGR, frames that follow one another, as they came.
        empty: (H, W, 3) uint8 BGR, the empty road.
        shake_px: how far the picture moved, root of the mean square.
        packet_bytes: of a compressed frame that rests on others; None where that is not known.
        codec: FFmpeg's name of what it is compressed with; empty where that is not known.
    """

    name: str
    fps: float
    looks: Image
    raw: Image
    empty: Image
    shake_px: float
    packet_bytes: float | None
    codec: str = ""

    @cached_property
    def flat(self) -> NDArray[np.bool_]:
        """(H, W) where the empty road has no edges, so that a shift by a pixel changes nothing."""
        grey = cv2.GaussianBlur(cv2.cvtColor(self.empty, cv2.COLOR_BGR2GRAY), (0, 0), 1.0).astype(np.float32)
        steep = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
        return np.asarray(cv2.dilate((steep > 2.5).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)

    def changed(self, look: Image) -> NDArray[np.bool_]:
        """(H, W) where a look shows something else than the empty road, without specks and small holes."""
        change = cv2.absdiff(look, self.empty).max(axis=2) > CHANGED
        solid = cv2.morphologyEx(change.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        return np.asarray(cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0)


def read_footage(path: Path) -> Footage:
    """Look through a video of a fixed camera; one that sways a little is held still.

    Args:
        path: video file or folder of images.

    Raises:
        DataError: it cannot be read, or is too short to show the empty road.
    """
    source = open_frames(path)
    width, height = source.size_wh
    width, height = width - width % 2, height - height % 2  # as the encoder wants them
    looks, raw, count = _looks(source, (width, height))
    if count < _FEWEST or len(looks) < _FEWEST:
        raise DataError(f"{path}: {count} frames are too few to see the empty road; give a longer video")
    held, shake = _held_still(looks)
    size, codec = (usual_packet(path), codec_of(path)) if path.is_file() else (None, "")
    return Footage(source.name, source.fps or 25.0, held, raw, _densest(held), shake, size, codec)


def usual_packet(video: Path) -> float | None:
    """Mean bytes of the compressed frames of a video that rest on others; None where there are none."""
    import av

    sizes: list[int] = []
    try:
        with av.open(str(video)) as container:
            for packet in container.demux(video=0):
                if packet.size and not packet.is_keyframe:
                    sizes.append(packet.size)
                if len(sizes) == _PACKETS:
                    break
    except (OSError, ValueError):
        return None
    return float(np.mean(sizes)) if sizes else None


def codec_of(video: Path) -> str:
    """FFmpeg's name of a video's codec; empty where it cannot be told."""
    import av

    try:
        with av.open(str(video)) as container:
            return str(container.streams.video[0].codec_context.name)
    except (OSError, ValueError, IndexError):
        return ""


def _looks(source: FrameSource, size_wh: tuple[int, int]) -> tuple[Image, Image, int]:
    """Frames spread over a video, frames from its middle that follow one another, and how many there are."""
    width, height = size_wh
    most = int(np.clip(_BYTES // (3 * width * height), _FEWEST, _LOOKS))
    announced = source.frame_count or 0
    step = [max(1, announced // most)]
    first = max(0, (announced - _RUN) // 2)
    run = range(first, first + min(_RUN, max(2, most)))
    looks: list[Image] = []
    raw: list[Image] = []
    count = 0
    for frame in source.frames(lambda n: n % step[0] == 0 or n in run):
        image = frame.image[:height, :width]
        count = frame.number + 1
        if frame.number in run:
            raw.append(image)
        if frame.number % step[0] == 0:
            looks.append(image)
        if len(looks) > 2 * most:  # more came than was announced
            looks, step[0] = looks[::2], 2 * step[0]
    if not looks:
        raise DataError(f"{source.path}: no frame could be read; is it a video?")
    return np.stack(looks), np.stack(raw or looks[:2]), count


def _held_still(looks: Image) -> tuple[Image, float]:
    """The looks laid over their middle one, and how far they had moved."""
    grey = [np.asarray(cv2.cvtColor(look, cv2.COLOR_BGR2GRAY), dtype=np.uint8) for look in looks]
    middle = len(grey) // 2
    points = cv2.goodFeaturesToTrack(grey[middle], 400, 0.01, 8)
    if points is None or len(points) < 12:
        return looks, 0.0
    height, width = grey[0].shape
    moves: list[Any] = [np.eye(2, 3)] * len(grey)
    # From the middle outwards, so that each search begins where the last one ended.
    for order in (range(middle, len(grey)), range(middle, -1, -1)):
        for before, now in pairwise(order):
            start = (points[:, 0] @ moves[before][:, :2].T + moves[before][:, 2])[:, None].astype(np.float32)
            found, ok, _ = cv2.calcOpticalFlowPyrLK(
                grey[middle], grey[now], points, start, winSize=(15, 15), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
            )
            good = ok[:, 0] > 0
            move = None
            if np.count_nonzero(good) >= 12:
                move, _ = cv2.estimateAffinePartial2D(points[good], found[good], ransacReprojThreshold=0.7)
            moves[now] = moves[before] if move is None else move
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=np.float64)
    away = [corners @ move.T - corners[:, :2] for move in moves]
    shake = float(np.sqrt(np.mean([(a**2).sum(axis=1).mean() for a in away])))
    if shake < _STILL_PX:
        return looks, shake
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    held = [
        cv2.warpAffine(look, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        for look, move in zip(looks, moves, strict=True)
    ]
    return np.stack(held).astype(np.uint8), shake


def _densest(looks: Image) -> Image:
    """Per pixel the middle of the looks that agree most in brightness: the road, where vehicles differ.

    A median would need the road to be seen in half of the looks.
    """
    out = np.empty(looks.shape[1:], dtype=np.uint8)
    loose = np.zeros(looks.shape[1:3], dtype=np.bool_)
    share = max(3, round(_DENSEST * len(looks)))
    for row in range(0, len(out), _BAND):
        band = looks[:, row : row + _BAND]
        grey = (band @ np.array([29, 150, 77], dtype=np.uint16) >> 8).astype(np.int16)
        order = np.argsort(grey, axis=0, kind="stable")
        grey = np.take_along_axis(grey, order, axis=0)
        width = grey[share - 1 :] - grey[: len(grey) - share + 1]
        # Of equally dense stretches the middle one, so that an even scene gives its median.
        dense = width == width.min(axis=0)[None]
        loose[row : row + _BAND] = width.min(axis=0) > _LOOSE
        first = (dense.argmax(axis=0) + len(dense) - 1 - dense[::-1].argmax(axis=0)) // 2
        agreeing = np.take_along_axis(order, first[None] + np.arange(share)[:, None, None], axis=0)
        colours = np.take_along_axis(band, agreeing[..., None], axis=0)
        out[row : row + _BAND] = np.partition(colours, share // 2, axis=0)[share // 2]
    # Where something stood for most of the time the looks agree on nothing: an even blot is better than specks.
    out[loose] = cv2.medianBlur(out, 7)[loose]
    return _mended(out, looks)


def _mended(empty: Image, looks: Image) -> Image:
    """The empty road without specks of what stood on it for much of the time.

    Where less than half of the looks agree with a pixel, those are taken that look as the sure road around it does,
    if they are not much fewer: where there are markings, hardly any do.
    """
    votes = np.zeros(empty.shape[:2], dtype=np.int32)
    for look in looks:
        votes += cv2.absdiff(look, empty).max(axis=2) <= _ALIKE
    unsure = votes < 0.5 * len(looks)
    # The sure road around, from wide to narrow: its mean where there is any.
    sure = (~unsure).astype(np.float32)
    around = np.full(empty.shape, 0.0, dtype=np.float32)
    for width in (121, 61, 31):
        share = cv2.blur(sure, (width, width))
        mean = cv2.blur(empty * sure[..., None], (width, width)) / np.maximum(share, 1e-6)[..., None]
        around = np.where((share > 0.1)[..., None], mean, around)
    odd = unsure & (np.abs(empty - around).max(axis=2) > _ALIKE)
    rows, columns = np.nonzero(odd)
    out = empty.copy()
    seen = looks[:, rows, columns].astype(np.float32)
    near = np.abs(seen - around[rows, columns]).max(axis=2) <= _NEAR
    enough = near.sum(axis=0) > np.maximum(_WORTH * votes[rows, columns], 2)
    seen[~near] = np.nan
    out[rows[enough], columns[enough]] = np.nanmedian(seen[:, enough], axis=0)
    # What then is still seldom seen and of another colour than the road around are specks.
    speck = odd & (votes < _FEW * len(looks)) & (np.ptp(out.astype(np.float32) - around, axis=2) > _COLOURED)
    out[speck] = cv2.medianBlur(out, 9)[speck]
    return out

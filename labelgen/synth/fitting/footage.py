"""Frames sampled from a video, stabilised, and the background image behind its traffic."""

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
from labelgen.media.container.file_names import ffmpeg_name
from labelgen.media.frames import FrameSource
from labelgen.media.open_frames import open_frames

__all__ = ["FOOTAGE", "Footage", "FootageThresholds", "codec_of", "mean_packet_bytes", "read_footage"]

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class FootageThresholds:
    """Thresholds for sampling a video and estimating its background image.

    Args:
        changed_levels: grey levels of any channel from which a pixel differs from the background. Lower values find
            dark vehicles on dark asphalt, and noise.
        max_frames, min_frames: frames sampled over the video. More frames see the road where traffic is dense, and
            take memory.
        max_bytes: memory for the sampled frames, which lowers their number for large frames.
        still_px: motion of the picture, root mean square in px, below which the camera counts as fixed.
        dense_share: share of the frames that must agree for a pixel to show the road. A median would need 0.5;
            a lower share copes with dense traffic and is less certain.
        band_rows: rows treated together, which bounds memory.
        loose_levels: spread of the agreeing frames from which a pixel is smoothed, grey levels.
        same_levels: difference between two frames of the same road, grey levels.
        near_levels: difference between the road at neighbouring places, grey levels.
        neighbour_weight: how many frames of the pixel itself one frame that looks like its neighbourhood is worth.
        coloured_levels: difference in colour from which a rarely seen pixel is a speck, grey levels.
        rare_share: share of the frames below which a pixel's colour is rarely seen.
        consecutive_frames: frames in a row that are kept for measuring compression.
        max_packets: compressed frames whose size is read.
    """

    changed_levels: int = 22
    max_frames: int = 72
    min_frames: int = 8
    max_bytes: int = 450_000_000
    still_px: float = 0.35
    dense_share: float = 0.4
    band_rows: int = 16
    loose_levels: int = 30
    same_levels: int = 12
    near_levels: int = 24
    neighbour_weight: float = 0.6
    coloured_levels: int = 20
    rare_share: float = 0.42
    consecutive_frames: int = 48
    max_packets: int = 1500


FOOTAGE = FootageThresholds()


@dataclass(frozen=True, eq=False)
class Footage:
    """Frames of one video and its background image.

    Args:
        name: of the video.
        fps: frames per second.
        frames: (K, H, W, 3) uint8 BGR, sampled over the video and stabilised.
        consecutive: (R, H, W, 3) uint8 BGR, consecutive frames as they were decoded.
        background: (H, W, 3) uint8 BGR, the road without traffic.
        shake_px: motion of the picture before stabilisation, root mean square in px.
        packet_bytes: mean size of the compressed frames that are no key frames; None where it is not known.
        codec: FFmpeg's name of the codec; empty where it is not known.
        thresholds: of this stage.
    """

    name: str
    fps: float
    frames: Image
    consecutive: Image
    background: Image
    shake_px: float
    packet_bytes: float | None
    codec: str = ""
    thresholds: FootageThresholds = FOOTAGE

    @cached_property
    def flat(self) -> NDArray[np.bool_]:
        """(H, W) where the background has no edges, so that a shift by one pixel changes nothing."""
        grey = cv2.GaussianBlur(cv2.cvtColor(self.background, cv2.COLOR_BGR2GRAY), (0, 0), 1.0).astype(np.float32)
        steep = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
        return np.asarray(cv2.dilate((steep > 2.5).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)

    def foreground(self, frame: Image) -> NDArray[np.bool_]:
        """Return (H, W) where a stabilised frame differs from the background, without specks and small holes."""
        change = cv2.absdiff(frame, self.background).max(axis=2) > self.thresholds.changed_levels
        solid = cv2.morphologyEx(change.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        return np.asarray(cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0)


def read_footage(path: Path, thresholds: FootageThresholds = FOOTAGE, *, deinterlace: bool = False) -> Footage:
    """Sample a video of a fixed camera and estimate its background image; a slightly swaying picture is stabilised.

    Args:
        path: video file or folder of images.
        thresholds: of this stage.
        deinterlace: whether each frame of a video is deinterlaced.

    Returns:
        The footage; its width and height are even, as the encoder needs them.

    Raises:
        DataError: the video cannot be read, or is too short to show the road without traffic.
    """
    source = open_frames(path, deinterlace=deinterlace)
    width, height = source.size_wh
    width, height = width - width % 2, height - height % 2
    frames, consecutive, count = _sample(source, (width, height), thresholds)
    if count < thresholds.min_frames or len(frames) < thresholds.min_frames:
        raise DataError(f"{path}: {count} frames are too few to see the empty road; give a longer video")
    stabilised, shake = _stabilise(frames, thresholds.still_px)
    size, codec = (mean_packet_bytes(path, thresholds.max_packets), codec_of(path)) if path.is_file() else (None, "")
    background = _background(stabilised, thresholds)
    return Footage(source.name, source.fps or 25.0, stabilised, consecutive, background, shake, size, codec, thresholds)


def mean_packet_bytes(video: Path, max_packets: int = FOOTAGE.max_packets) -> float | None:
    """Return the mean size in bytes of the compressed frames that are no key frames; None where there are none.

    Args:
        video: video file.
        max_packets: how many frames are read.
    """
    import av

    sizes: list[int] = []
    try:
        with av.open(ffmpeg_name(video)) as container:
            for packet in container.demux(video=0):
                if packet.size and not packet.is_keyframe:
                    sizes.append(packet.size)
                if len(sizes) == max_packets:
                    break
    except (OSError, ValueError):
        return None
    return float(np.mean(sizes)) if sizes else None


def codec_of(video: Path) -> str:
    """Return FFmpeg's name of a video's codec; empty where it is not known."""
    import av

    try:
        with av.open(ffmpeg_name(video)) as container:
            return str(container.streams.video[0].codec_context.name)
    except (OSError, ValueError, IndexError):
        return ""


def _sample(source: FrameSource, size_wh: tuple[int, int], thresholds: FootageThresholds) -> tuple[Image, Image, int]:
    """Return frames spread over a video, consecutive frames from its middle, and the number of all frames."""
    width, height = size_wh
    at_most = int(np.clip(thresholds.max_bytes // (3 * width * height), thresholds.min_frames, thresholds.max_frames))
    announced = source.frame_count or 0
    step = [max(1, announced // at_most)]
    first = max(0, (announced - thresholds.consecutive_frames) // 2)
    run = range(first, first + min(thresholds.consecutive_frames, max(2, at_most)))
    frames: list[Image] = []
    consecutive: list[Image] = []
    count = 0
    for frame in source.frames(lambda n: n % step[0] == 0 or n in run):
        image = frame.image[:height, :width]
        count = frame.number + 1
        if frame.number in run:
            consecutive.append(image)
        if frame.number % step[0] == 0:
            frames.append(image)
        if len(frames) > 2 * at_most:  # the video is longer than its header says
            frames, step[0] = frames[::2], 2 * step[0]
    if not frames:
        raise DataError(f"{source.path}: no frame could be read; is it a video?")
    return np.stack(frames), np.stack(consecutive or frames[:2]), count


def _stabilise(frames: Image, still_px: float) -> tuple[Image, float]:
    """Register the frames to their middle one by optical flow; return them and how far they had moved."""
    grey = [np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), dtype=np.uint8) for frame in frames]
    middle = len(grey) // 2
    points = cv2.goodFeaturesToTrack(grey[middle], 400, 0.01, 8)
    if points is None or len(points) < 12:
        return frames, 0.0
    height, width = grey[0].shape
    moves: list[Any] = [np.eye(2, 3)] * len(grey)
    # From the middle outwards, so that each search begins where the last one ended.
    for order in (range(middle, len(grey)), range(middle, -1, -1)):
        for before, now in pairwise(order):
            start = (points[:, 0] @ moves[before][:, :2].T + moves[before][:, 2])[:, None].astype(np.float32)
            moved, ok, _ = cv2.calcOpticalFlowPyrLK(
                grey[middle], grey[now], points, start, winSize=(15, 15), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
            )
            tracked = ok[:, 0] > 0
            move = None
            if np.count_nonzero(tracked) >= 12:
                move, _ = cv2.estimateAffinePartial2D(points[tracked], moved[tracked], ransacReprojThreshold=0.7)
            moves[now] = moves[before] if move is None else move
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], dtype=np.float64)
    away = [corners @ move.T - corners[:, :2] for move in moves]
    shake = float(np.sqrt(np.mean([(a**2).sum(axis=1).mean() for a in away])))
    if shake < still_px:
        return frames, shake
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    stabilised = [
        cv2.warpAffine(frame, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        for frame, move in zip(frames, moves, strict=True)
    ]
    return np.stack(stabilised).astype(np.uint8), shake


def _background(frames: Image, thresholds: FootageThresholds) -> Image:
    """Return per pixel the middle of the frames that agree most in brightness: the road, where vehicles differ.

    A median would need the road to be visible in half of the frames.
    """
    out = np.empty(frames.shape[1:], dtype=np.uint8)
    loose = np.zeros(frames.shape[1:3], dtype=np.bool_)
    share = max(3, round(thresholds.dense_share * len(frames)))
    for row in range(0, len(out), thresholds.band_rows):
        band = frames[:, row : row + thresholds.band_rows]
        grey = (band @ np.array([29, 150, 77], dtype=np.uint16) >> 8).astype(np.int16)
        order = np.argsort(grey, axis=0, kind="stable")
        grey = np.take_along_axis(grey, order, axis=0)
        width = grey[share - 1 :] - grey[: len(grey) - share + 1]
        # Of equally dense stretches the middle one, so that an even scene gives its median.
        dense = width == width.min(axis=0)[None]
        loose[row : row + thresholds.band_rows] = width.min(axis=0) > thresholds.loose_levels
        first = (dense.argmax(axis=0) + len(dense) - 1 - dense[::-1].argmax(axis=0)) // 2
        agreeing = np.take_along_axis(order, first[None] + np.arange(share)[:, None, None], axis=0)
        colours = np.take_along_axis(band, agreeing[..., None], axis=0)
        out[row : row + thresholds.band_rows] = np.partition(colours, share // 2, axis=0)[share // 2]
    # Where the frames agree on nothing, a smooth patch is better than specks.
    out[loose] = cv2.medianBlur(out, 7)[loose]
    return _without_specks(out, frames, thresholds)


def _without_specks(background: Image, frames: Image, thresholds: FootageThresholds) -> Image:
    """Replace pixels that show what stood on the road for much of the time.

    Where less than half of the frames agree with a pixel, those frames are taken that look like the certain road
    around it, unless they are far fewer: near lane markings hardly any do.
    """
    votes = np.zeros(background.shape[:2], dtype=np.int32)
    for frame in frames:
        votes += cv2.absdiff(frame, background).max(axis=2) <= thresholds.same_levels
    uncertain = votes < 0.5 * len(frames)
    # The mean of the certain road around, in windows from wide to narrow.
    certain = (~uncertain).astype(np.float32)
    around = np.full(background.shape, 0.0, dtype=np.float32)
    for width in (121, 61, 31):
        share = cv2.blur(certain, (width, width))
        mean = cv2.blur(background * certain[..., None], (width, width)) / np.maximum(share, 1e-6)[..., None]
        around = np.where((share > 0.1)[..., None], mean, around)
    odd = uncertain & (np.abs(background - around).max(axis=2) > thresholds.same_levels)
    rows, columns = np.nonzero(odd)
    out = background.copy()
    values = frames[:, rows, columns].astype(np.float32)
    near = np.abs(values - around[rows, columns]).max(axis=2) <= thresholds.near_levels
    enough = near.sum(axis=0) > np.maximum(thresholds.neighbour_weight * votes[rows, columns], 2)
    values[~near] = np.nan
    out[rows[enough], columns[enough]] = np.nanmedian(values[:, enough], axis=0)
    # Rarely seen pixels of another colour than the road around them are specks.
    rare = votes < thresholds.rare_share * len(frames)
    speck = odd & rare & (np.ptp(out.astype(np.float32) - around, axis=2) > thresholds.coloured_levels)
    out[speck] = cv2.medianBlur(out, 9)[speck]
    return out

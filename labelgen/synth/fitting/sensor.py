"""A camera's faults, measured on its own video: noise, sharpness, halos, smeared colours, compression.

Edges are followed across: of the sharpest edges in the picture (paint on asphalt, rails against the sky) the median
step is taken, and the blur and the sharpening that make such a step of a perfect one are looked up. Noise is what
even, unchanged parts of the scene show in addition to the empty road.
"""

from __future__ import annotations

import tempfile
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.media.video_writer import VideoWriter
from labelgen.synth.fitting.footage import CHANGED, Footage, usual_packet
from labelgen.synth.sensor.compression_artifacts import BLOCKY_CODECS
from labelgen.synth.sensor.noise import NoiseModel
from labelgen.synth.sensor.sensor import HALO_PX, Sensor

__all__ = ["block_step_of", "edge_profile", "fit_edges", "fit_sensor", "measure_noise", "quality_of"]

_LEVELS = np.linspace(0, 255, 9)
_FEWEST_PX = 400
_LOCAL_PX = 6.0
_REACH_PX, _STEP_PX = 5.0, 0.25
_EDGES, _SHARPEST = 4000, 0.7
_LEAST_CONTRAST, _PLATEAU_PX = 36.0, 2.5
_BLURS, _SHARPENS = np.arange(0.3, 2.6, 0.1), np.arange(0.0, 2.3, 0.15)
_WIDEST_SMEAR_PX = 8.0
_USUAL_CRF, _CRFS = 20, (16, 23, 30)
_QUANTISERS = (2, 5, 12, 31)

Plane = NDArray[np.float32]


def fit_sensor(footage: Footage) -> Sensor:
    """The faults of the camera that took a video, for vehicles to be put into its picture.

    Args:
        footage: of it.
    """
    noise_model = measure_noise(footage.looks, footage.empty, footage.flat)
    greys = [np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.float32) for image in footage.raw[::8]]
    blur, sharpen = fit_edges(greys)
    smear = _smear(footage.raw[::8]) / footage.empty.shape[1]
    crf = _USUAL_CRF
    if footage.packet_bytes is not None:
        crf = quality_of(footage.raw[:32], footage.fps, footage.packet_bytes)
    step = 0.0
    if footage.packet_bytes is not None and footage.codec in BLOCKY_CODECS:
        step = block_step_of(footage.raw[:32], footage.fps, footage.packet_bytes)
    return Sensor(
        sharpen=sharpen,
        smear=smear,
        crf=crf,
        arms=0.006,
        noise_model=noise_model,
        blur_px=blur,
        in_picture=True,
        block_step=step,
    )


def measure_noise(looks: NDArray[np.uint8], empty: NDArray[np.uint8], flat: NDArray[np.bool_]) -> NoiseModel:
    """The temporal noise of a video by brightness.

    Args:
        looks: (K, H, W, 3) uint8 BGR frames of a scene that stands still.
        empty: (H, W, 3) the scene without what moves.
        flat: (H, W) where it is even.
    """
    base = cv2.cvtColor(empty, cv2.COLOR_BGR2YCrCb).astype(np.float32)
    samples: list[list[NDArray[np.float32]]] = [[] for _ in range(3)]
    levels: list[NDArray[np.float32]] = []
    together = np.zeros((3, 2))
    for look in looks[:: max(1, len(looks) // 24)]:
        quiet = cv2.erode(
            (cv2.absdiff(look, empty).max(axis=2) <= CHANGED).astype(np.uint8), np.ones((9, 9), np.uint8)
        ).astype(np.bool_)
        quiet &= flat
        if np.count_nonzero(quiet) < _FEWEST_PX:
            continue
        off = cv2.cvtColor(look, cv2.COLOR_BGR2YCrCb).astype(np.float32) - base
        # Light that changes slowly over the picture is no noise.
        share = cv2.GaussianBlur(quiet.astype(np.float32), (0, 0), _LOCAL_PX) + 1e-6
        pairs = quiet[:, 1:] & quiet[:, :-1]
        for k in range(3):
            plane = np.where(quiet, off[..., k], 0).astype(np.float32)
            noise = off[..., k] - cv2.GaussianBlur(plane, (0, 0), _LOCAL_PX) / share
            samples[k].append(noise[quiet])
            a, b = noise[:, 1:][pairs], noise[:, :-1][pairs]
            together[k] += float((a * b).sum()), float((a * a + b * b).sum() / 2)
        levels.append(base[..., 0][quiet])
    if not levels:
        return NoiseModel((0.0,) * len(_LEVELS), (0.0,) * len(_LEVELS), 0.0, 0.0)
    level = np.concatenate(levels)
    spreads = [_by_level(level, np.concatenate(s)) for s in samples]
    likeness = together[:, 0] / np.maximum(together[:, 1], 1e-9)
    colour = np.sqrt((np.square(spreads[1]) + np.square(spreads[2])) / 2)
    return NoiseModel(
        tuple(spreads[0]), tuple(colour.tolist()), _blur_of(float(likeness[0])), _blur_of(float(likeness[1:].mean()))
    )


def _by_level(level: Plane, noise: Plane) -> list[float]:
    """Standard deviation at each of `_LEVELS`; where a brightness is rare, that of the nearest one."""
    at = np.round(level / _LEVELS[1]).astype(int)
    out = np.full(len(_LEVELS), np.nan)
    for k in range(len(_LEVELS)):
        part = noise[at == k]
        if len(part) >= _FEWEST_PX:
            # Robust, but not blind to noise that is rounded away most of the time.
            inner = np.clip(part, *np.percentile(part, [1, 99]))
            out[k] = 1.05 * float(inner.std())
    known = np.flatnonzero(np.isfinite(out))
    if not len(known):
        return [0.0] * len(_LEVELS)
    filled: list[float] = np.interp(np.arange(len(_LEVELS)), known, out[known]).tolist()
    return filled


def _blur_of(likeness: float) -> float:
    """Sigma of the blur, px, that makes neighbours in white noise so much alike."""
    return 0.0 if likeness <= 0.02 else float(min(1 / (2 * np.sqrt(-np.log(min(likeness, 0.95)))), 2.2))


def edge_profile(plane: Plane, *, along_rows: bool = False) -> tuple[NDArray[np.float64], int]:
    """The median step across the sharpest edges of a picture, and on how many it rests.

    Args:
        plane: (H, W) float32, 0 to 255.
        along_rows: whether only edges that cross rows count.

    Returns:
        values from 0 to 1 (beyond them where there are halos), every quarter pixel, the step in the middle.
    """
    dx, dy = (cv2.Sobel(plane, cv2.CV_32F, a, b) / 8 for a, b in ((1, 0), (0, 1)))
    if along_rows:
        dy = np.zeros_like(dy)
    steep = np.hypot(dx, dy)
    margin = int(_REACH_PX) + 2
    inside = np.zeros(plane.shape, dtype=np.bool_)
    inside[margin:-margin, margin:-margin] = True
    ridge = (steep >= cv2.dilate(steep, np.ones((3, 3), np.uint8)) - 1e-6) & inside & (steep > 4)
    rows, columns = np.nonzero(ridge)
    strongest = np.argsort(-steep[rows, columns], kind="stable")[:_EDGES]
    rows, columns = rows[strongest], columns[strongest]
    across = np.arange(-_REACH_PX, _REACH_PX + 1e-6, _STEP_PX)
    ux, uy = (d[rows, columns] / np.maximum(steep[rows, columns], 1e-6) for d in (dx, dy))
    x = (columns[:, None] + ux[:, None] * across).astype(np.float32)
    y = (rows[:, None] + uy[:, None] * across).astype(np.float32)
    if not len(rows):
        return np.clip(across / _REACH_PX, 0, 1), 0
    profiles = cv2.remap(plane, x, y, cv2.INTER_CUBIC).astype(np.float64)
    end = round(_PLATEAU_PX / _STEP_PX)
    low, high = profiles[:, :end].mean(axis=1), profiles[:, -end:].mean(axis=1)
    even = np.maximum(profiles[:, :end].std(axis=1), profiles[:, -end:].std(axis=1))
    # Lines narrower than that, such as far lane markings, would look as if they had halos.
    good = (high - low > _LEAST_CONTRAST) & (even < 0.05 * (high - low))
    # Clipped to white or black, a step tells nothing of halos.
    good &= (profiles.max(axis=1) < 250) & (profiles.min(axis=1) > 4)
    if not good.any():
        return np.clip(across / _REACH_PX, 0, 1), 0
    steps = (profiles[good] - low[good, None]) / (high - low)[good, None]
    slope = np.gradient(steps, _STEP_PX, axis=1).max(axis=1)
    sharp = steps[slope >= np.quantile(slope, _SHARPEST)]
    return np.median(_centred(sharp, across), axis=0), len(sharp)


def _centred(steps: NDArray[np.float64], across: NDArray[np.float64]) -> NDArray[np.float64]:
    """Steps moved so that each passes one half in the middle."""
    out = np.empty_like(steps)
    for k, step in enumerate(steps):
        after = int(np.argmax((step >= 0.5) & (across > -1.5)))
        before = max(after - 1, 0)
        rise = max(step[after] - step[before], 1e-6)
        middle = across[before] + _STEP_PX * (0.5 - step[before]) / rise
        out[k] = np.interp(across + middle, across, step)
    return out


def fit_edges(greys: list[Plane]) -> tuple[float, float]:
    """Sigma of the lens's blur, px, and strength of the sharpening, as `Sensor` has them."""
    seen = [edge_profile(grey) for grey in greys]
    count = sum(n for _, n in seen)
    if count < 30:
        return 0.5, 0.0
    profile = np.sum([p * n for p, n in seen], axis=0) / count
    best = min(
        (float(((_step(blur, sharpen) - profile) ** 2).sum()), float(blur), float(sharpen))
        for blur in _BLURS
        for sharpen in _SHARPENS
    )
    return round(best[1], 2), round(best[2], 2)


def _step(blur: float, sharpen: float) -> NDArray[np.float64]:
    """What a camera makes of a perfect step that falls anywhere onto its pixels, as `edge_profile` gives it."""
    across = np.arange(-_REACH_PX, _REACH_PX + 1e-6, _STEP_PX)
    fine = 0.05
    x = np.arange(-12, 12, fine)
    step = (x > 0).astype(np.float64)

    def soft(values: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
        reach = np.arange(-4 * sigma, 4 * sigma + fine, fine)
        kernel = np.exp(-0.5 * (reach / max(sigma, 1e-3)) ** 2)
        padded = np.pad(values, len(kernel) // 2, mode="edge")
        return np.convolve(padded, kernel / kernel.sum(), mode="valid")[: len(values)]

    # A pixel is as wide as a blur of 0.29 px, and reading between pixels softens a little once more.
    lens = soft(step, float(np.hypot(blur, 0.35)))
    lens += sharpen * (lens - soft(lens, HALO_PX))
    at: NDArray[np.float64] = np.interp(across, x, lens)
    low = np.interp(np.arange(-_REACH_PX, -_REACH_PX + _PLATEAU_PX, fine), x, lens).mean()
    return np.asarray((at - low) / (1 - 2 * low))


def _smear(images: NDArray[np.uint8]) -> float:
    """Sigma of the colours' blur along rows, px; 0 when it is no more than halved planes of colour have."""
    slopes = []
    for image in images:
        planes = cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb).astype(np.float32)
        for k in (1, 2):
            # Colours differ less than brightness, so they are stretched.
            profile, count = edge_profile(128 + 2.2 * (planes[..., k] - 128), along_rows=True)
            if count >= 8:
                slopes.append(float(np.gradient(profile, _STEP_PX).max()))
    if not slopes:
        return 0.0
    sigma = 1 / (float(np.median(slopes)) * np.sqrt(2 * np.pi))
    return 0.0 if sigma < 1.8 else min(sigma, _WIDEST_SMEAR_PX)


def quality_of(frames: NDArray[np.uint8], fps: float, packet_bytes: float) -> int:
    """The encoder's quality at which it takes as many bytes for frames as the video they come from.

    Args:
        frames: (R, H, W, 3) uint8 BGR that follow one another.
        fps: frames per second.
        packet_bytes: of the video, see `Footage`.
    """
    sizes = []
    with tempfile.TemporaryDirectory() as folder:
        for crf in _CRFS:
            path = Path(folder) / f"{crf}.avi"
            # Video cameras and platforms encode with more care than a renderer in a hurry, so fewer bytes do as well.
            with VideoWriter(path, fps, (frames.shape[2], frames.shape[1]), crf, preset="medium") as writer:
                for frame in frames:
                    writer.write(frame)
            sizes.append(usual_packet(path) or 1.0)
    # Bytes fall evenly on a logarithmic scale.
    return round(float(np.interp(-np.log(packet_bytes), -np.log(sizes), _CRFS)))


def block_step_of(frames: NDArray[np.uint8], fps: float, packet_bytes: float) -> float:
    """The grey levels to whose multiples an old recorder rounded, from how many bytes a frame takes; see `quality_of`.

    MPEG-4's quantiser q rounds to multiples of 2 q.
    """
    import av

    sizes = []
    with tempfile.TemporaryDirectory() as folder:
        for quantiser in _QUANTISERS:
            path = Path(folder) / f"{quantiser}.avi"
            with av.open(str(path), "w", format="avi") as container:
                stream: Any = container.add_stream("mpeg4", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = frames.shape[1:3]
                stream.pix_fmt = "yuv420p"
                stream.codec_context.qmin = stream.codec_context.qmax = quantiser
                for frame in frames:
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
                container.mux(stream.encode(None))
            sizes.append(usual_packet(path) or 1.0)
    return round(2 * float(np.exp(np.interp(-np.log(packet_bytes), -np.log(sizes), np.log(_QUANTISERS)))), 1)

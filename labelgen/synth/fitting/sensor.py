"""Properties of a camera measured on its own video: noise, sharpness, halos, chroma blur, compression.

Edges are sampled across: of the sharpest edges in the picture (paint on asphalt, rails against the sky) the median
step is taken, and the blur and the sharpening that make such a step of a perfect one are looked up. Noise is the
difference of even, unchanged parts of the scene from the background image.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.media.container.file_names import ffmpeg_name
from labelgen.media.video_writer import VideoWriter
from labelgen.synth.fitting.footage import FOOTAGE, Footage, mean_packet_bytes
from labelgen.synth.sensor.compression_artifacts import BLOCKY_CODECS
from labelgen.synth.sensor.noise import NoiseModel
from labelgen.synth.sensor.sensor import HALO_PX, Sensor

__all__ = [
    "SENSOR",
    "SensorThresholds",
    "edge_profile",
    "estimate_block_step",
    "estimate_crf",
    "fit_edges",
    "fit_sensor",
    "measure_noise",
]

Plane = NDArray[np.float32]


@dataclass(frozen=True)
class SensorThresholds:
    """Thresholds for measuring a camera.

    Args:
        levels: number of brightnesses, spread evenly from 0 to 255, at which noise is measured.
        changed_levels: difference from the background from which a pixel is not still, grey levels.
        min_pixels: still pixels that a frame, and a brightness, must have.
        local_px: sigma of the window whose mean is taken off noise, px: light changes slowly over the picture.
        reach_px, step_px: extent of an edge's profile on either side, and its resolution.
        max_edges: strongest edge pixels of a picture that are sampled.
        sharpest_quantile: quantile of the edges' slope above which they count.
        min_contrast: contrast of an edge, grey levels.
        plateau_px: extent of the even part on either side of an edge. Narrower lines would look like halos.
        min_edges: edges below which blur and sharpening are those of `without_edges`.
        without_edges: lens blur in px and sharpening of a camera whose video shows no edges.
        blurs_px, sharpens: (from, to, step) of the values that are tried.
        min_chroma_edges: edges in a colour plane that count.
        min_smear_px, max_smear_px: sigma of the chroma blur: below the first it is that of halved colour planes.
        usual_crf: quality where the size of compressed frames is not known.
        crfs: qualities at which the frames are encoded for comparison.
        quantizers: MPEG-4 quantisers, likewise.
    """

    levels: int = 9
    changed_levels: int = FOOTAGE.changed_levels
    min_pixels: int = 400
    local_px: float = 6.0
    reach_px: float = 5.0
    step_px: float = 0.25
    max_edges: int = 4000
    sharpest_quantile: float = 0.7
    min_contrast: float = 36.0
    plateau_px: float = 2.5
    min_edges: int = 30
    without_edges: tuple[float, float] = (0.5, 0.0)
    blurs_px: tuple[float, float, float] = (0.3, 2.6, 0.1)
    sharpens: tuple[float, float, float] = (0.0, 2.3, 0.15)
    min_chroma_edges: int = 8
    min_smear_px: float = 1.8
    max_smear_px: float = 8.0
    usual_crf: int = 20
    crfs: tuple[int, ...] = (16, 23, 30)
    quantizers: tuple[int, ...] = (2, 5, 12, 31)


SENSOR = SensorThresholds()


def fit_sensor(footage: Footage, thresholds: SensorThresholds = SENSOR) -> Sensor:
    """Return the sensor of the camera that took a video, for vehicles to be rendered into its picture.

    Args:
        footage: of the video.
        thresholds: of this stage.
    """
    noise_model = measure_noise(footage.frames, footage.background, footage.flat, thresholds)
    images = footage.consecutive[::8]
    greys = [np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.float32) for image in images]
    blur, sharpen = fit_edges(greys, thresholds)
    smear = _chroma_blur(images, thresholds) / footage.background.shape[1]
    crf, step = thresholds.usual_crf, 0.0
    if footage.packet_bytes is not None:
        crf = estimate_crf(footage.consecutive[:32], footage.fps, footage.packet_bytes, thresholds)
        if footage.codec in BLOCKY_CODECS:
            step = estimate_block_step(footage.consecutive[:32], footage.fps, footage.packet_bytes, thresholds)
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


def measure_noise(
    frames: NDArray[np.uint8],
    background: NDArray[np.uint8],
    flat: NDArray[np.bool_],
    thresholds: SensorThresholds = SENSOR,
) -> NoiseModel:
    """Measure the temporal noise of a video by brightness.

    Args:
        frames: (K, H, W, 3) uint8 BGR, stabilised.
        background: (H, W, 3) uint8 BGR, the scene without what moves.
        flat: (H, W) where the background is even.
        thresholds: of this stage.

    Returns:
        The noise; zeros where no part of the scene stands still.
    """
    base = cv2.cvtColor(background, cv2.COLOR_BGR2YCrCb).astype(np.float32)
    samples: list[list[NDArray[np.float32]]] = [[] for _ in range(3)]
    levels: list[NDArray[np.float32]] = []
    together = np.zeros((3, 2))
    for frame in frames[:: max(1, len(frames) // 24)]:
        same = cv2.absdiff(frame, background).max(axis=2) <= thresholds.changed_levels
        still = cv2.erode(same.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(np.bool_)
        still &= flat
        if np.count_nonzero(still) < thresholds.min_pixels:
            continue
        off = cv2.cvtColor(frame, cv2.COLOR_BGR2YCrCb).astype(np.float32) - base
        # Differences that vary slowly over the picture are changes of light.
        share = cv2.GaussianBlur(still.astype(np.float32), (0, 0), thresholds.local_px) + 1e-6
        pairs = still[:, 1:] & still[:, :-1]
        for k in range(3):
            plane = np.where(still, off[..., k], 0).astype(np.float32)
            noise = off[..., k] - cv2.GaussianBlur(plane, (0, 0), thresholds.local_px) / share
            samples[k].append(noise[still])
            a, b = noise[:, 1:][pairs], noise[:, :-1][pairs]
            together[k] += float((a * b).sum()), float((a * a + b * b).sum() / 2)
        levels.append(base[..., 0][still])
    if not levels:
        return NoiseModel((0.0,) * thresholds.levels, (0.0,) * thresholds.levels, 0.0, 0.0)
    level = np.concatenate(levels)
    spreads = [_by_level(level, np.concatenate(s), thresholds) for s in samples]
    correlation = together[:, 0] / np.maximum(together[:, 1], 1e-9)
    colour = np.sqrt((np.square(spreads[1]) + np.square(spreads[2])) / 2)
    return NoiseModel(
        tuple(spreads[0]),
        tuple(colour.tolist()),
        _blur_of(float(correlation[0])),
        _blur_of(float(correlation[1:].mean())),
    )


def _by_level(level: Plane, noise: Plane, thresholds: SensorThresholds) -> list[float]:
    """Return the standard deviation at each brightness; where one is rare, that of the nearest one."""
    levels = np.linspace(0, 255, thresholds.levels)
    at = np.round(level / levels[1]).astype(int)
    out = np.full(len(levels), np.nan)
    for k in range(len(levels)):
        part = noise[at == k]
        if len(part) >= thresholds.min_pixels:
            # Robust, but not blind to noise that is rounded away most of the time.
            inner = np.clip(part, *np.percentile(part, [1, 99]))
            out[k] = 1.05 * float(inner.std())
    known = np.flatnonzero(np.isfinite(out))
    if not len(known):
        return [0.0] * len(levels)
    filled: list[float] = np.interp(np.arange(len(levels)), known, out[known]).tolist()
    return filled


def _blur_of(correlation: float) -> float:
    """Return the sigma of the blur, px, that gives neighbours in white noise this correlation."""
    return 0.0 if correlation <= 0.02 else float(min(1 / (2 * np.sqrt(-np.log(min(correlation, 0.95)))), 2.2))


def edge_profile(
    plane: Plane, *, along_rows: bool = False, thresholds: SensorThresholds = SENSOR
) -> tuple[NDArray[np.float64], int]:
    """Return the median step across the sharpest edges of a picture, and the number of these edges.

    Args:
        plane: (H, W) float32, 0 to 255.
        along_rows: whether only edges that cross rows count.
        thresholds: of this stage.

    Returns:
        (P,) values from 0 to 1, beyond them where there are halos, at steps of `step_px`, the edge in the middle; and
        the number of edges.
    """
    dx, dy = (cv2.Sobel(plane, cv2.CV_32F, a, b) / 8 for a, b in ((1, 0), (0, 1)))
    if along_rows:
        dy = np.zeros_like(dy)
    steep = np.hypot(dx, dy)
    margin = int(thresholds.reach_px) + 2
    inside = np.zeros(plane.shape, dtype=np.bool_)
    inside[margin:-margin, margin:-margin] = True
    ridge = (steep >= cv2.dilate(steep, np.ones((3, 3), np.uint8)) - 1e-6) & inside & (steep > 4)
    rows, columns = np.nonzero(ridge)
    strongest = np.argsort(-steep[rows, columns], kind="stable")[: thresholds.max_edges]
    rows, columns = rows[strongest], columns[strongest]
    across = np.arange(-thresholds.reach_px, thresholds.reach_px + 1e-6, thresholds.step_px)
    ux, uy = (d[rows, columns] / np.maximum(steep[rows, columns], 1e-6) for d in (dx, dy))
    x = (columns[:, None] + ux[:, None] * across).astype(np.float32)
    y = (rows[:, None] + uy[:, None] * across).astype(np.float32)
    if not len(rows):
        return np.clip(across / thresholds.reach_px, 0, 1), 0
    profiles = cv2.remap(plane, x, y, cv2.INTER_CUBIC).astype(np.float64)
    end = round(thresholds.plateau_px / thresholds.step_px)
    low, high = profiles[:, :end].mean(axis=1), profiles[:, -end:].mean(axis=1)
    even = np.maximum(profiles[:, :end].std(axis=1), profiles[:, -end:].std(axis=1))
    # Lines narrower than that, such as far lane markings, would look as if they had halos.
    good = (high - low > thresholds.min_contrast) & (even < 0.05 * (high - low))
    # A step that is clipped to white or black hides its halos.
    good &= (profiles.max(axis=1) < 250) & (profiles.min(axis=1) > 4)
    if not good.any():
        return np.clip(across / thresholds.reach_px, 0, 1), 0
    steps = (profiles[good] - low[good, None]) / (high - low)[good, None]
    slope = np.gradient(steps, thresholds.step_px, axis=1).max(axis=1)
    sharp = steps[slope >= np.quantile(slope, thresholds.sharpest_quantile)]
    return np.median(_centred(sharp, across, thresholds.step_px), axis=0), len(sharp)


def _centred(steps: NDArray[np.float64], across: NDArray[np.float64], step_px: float) -> NDArray[np.float64]:
    """Return the steps moved so that each passes one half in the middle."""
    out = np.empty_like(steps)
    for k, step in enumerate(steps):
        after = int(np.argmax((step >= 0.5) & (across > -1.5)))
        before = max(after - 1, 0)
        rise = max(step[after] - step[before], 1e-6)
        middle = across[before] + step_px * (0.5 - step[before]) / rise
        out[k] = np.interp(across + middle, across, step)
    return out


def fit_edges(greys: list[Plane], thresholds: SensorThresholds = SENSOR) -> tuple[float, float]:
    """Return the sigma of the lens blur, px, and the strength of the sharpening, as `Sensor` has them.

    Args:
        greys: (H, W) float32 pictures, 0 to 255.
        thresholds: of this stage.
    """
    profiles = [edge_profile(grey, thresholds=thresholds) for grey in greys]
    count = sum(n for _, n in profiles)
    if count < thresholds.min_edges:
        return thresholds.without_edges
    profile = np.sum([p * n for p, n in profiles], axis=0) / count
    best = min(
        (float(((_step(blur, sharpen, thresholds) - profile) ** 2).sum()), float(blur), float(sharpen))
        for blur in np.arange(*thresholds.blurs_px)
        for sharpen in np.arange(*thresholds.sharpens)
    )
    return round(best[1], 2), round(best[2], 2)


def _step(blur: float, sharpen: float, thresholds: SensorThresholds) -> NDArray[np.float64]:
    """Return the image of a perfect step at any position between pixels, as `edge_profile` gives it."""
    across = np.arange(-thresholds.reach_px, thresholds.reach_px + 1e-6, thresholds.step_px)
    fine = 0.05
    x = np.arange(-12, 12, fine)
    step = (x > 0).astype(np.float64)

    def soft(values: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
        reach = np.arange(-4 * sigma, 4 * sigma + fine, fine)
        kernel = np.exp(-0.5 * (reach / max(sigma, 1e-3)) ** 2)
        padded = np.pad(values, len(kernel) // 2, mode="edge")
        return np.convolve(padded, kernel / kernel.sum(), mode="valid")[: len(values)]

    # Integration over a pixel equals a blur of 0.29 px, and interpolation between pixels adds a little.
    lens = soft(step, float(np.hypot(blur, 0.35)))
    lens += sharpen * (lens - soft(lens, HALO_PX))
    at: NDArray[np.float64] = np.interp(across, x, lens)
    low = np.interp(np.arange(-thresholds.reach_px, -thresholds.reach_px + thresholds.plateau_px, fine), x, lens).mean()
    return np.asarray((at - low) / (1 - 2 * low))


def _chroma_blur(images: NDArray[np.uint8], thresholds: SensorThresholds) -> float:
    """Return the sigma of the chroma planes' blur along rows, px; 0 when it is that of halved chroma planes."""
    slopes = []
    for image in images:
        planes = cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb).astype(np.float32)
        for k in (1, 2):
            # Chroma has less contrast than brightness, so it is stretched.
            stretched = 128 + 2.2 * (planes[..., k] - 128)
            profile, count = edge_profile(stretched, along_rows=True, thresholds=thresholds)
            if count >= thresholds.min_chroma_edges:
                slopes.append(float(np.gradient(profile, thresholds.step_px).max()))
    if not slopes:
        return 0.0
    sigma = 1 / (float(np.median(slopes)) * np.sqrt(2 * np.pi))
    return 0.0 if sigma < thresholds.min_smear_px else min(sigma, thresholds.max_smear_px)


def estimate_crf(
    frames: NDArray[np.uint8], fps: float, packet_bytes: float, thresholds: SensorThresholds = SENSOR
) -> int:
    """Return the H.264 quality (crf) at which frames take as many bytes as in the video they come from.

    Args:
        frames: (R, H, W, 3) uint8 BGR, consecutive.
        fps: frames per second.
        packet_bytes: of the video, see `Footage`.
        thresholds: of this stage.
    """
    sizes = []
    with tempfile.TemporaryDirectory() as folder:
        for crf in thresholds.crfs:
            path = Path(folder) / f"{crf}.avi"
            # Cameras and video platforms encode more slowly than the renderer, so that fewer bytes give this quality.
            with VideoWriter(path, fps, (frames.shape[2], frames.shape[1]), crf, preset="medium") as writer:
                for frame in frames:
                    writer.write(frame)
            sizes.append(mean_packet_bytes(path) or 1.0)
    # Quality is about linear in the logarithm of the size.
    return round(float(np.interp(-np.log(packet_bytes), -np.log(sizes), thresholds.crfs)))


def estimate_block_step(
    frames: NDArray[np.uint8], fps: float, packet_bytes: float, thresholds: SensorThresholds = SENSOR
) -> float:
    """Return the step, grey levels, to whose multiples an MPEG-4 encoder rounded; arguments as for `estimate_crf`.

    MPEG-4 part 2 (ISO/IEC 14496-2) with quantiser q rounds to multiples of 2 q.
    """
    import av

    quantizers = thresholds.quantizers
    sizes = []
    with tempfile.TemporaryDirectory() as folder:
        for quantizer in quantizers:
            path = Path(folder) / f"{quantizer}.avi"
            with av.open(ffmpeg_name(path), "w", format="avi") as container:
                stream: Any = container.add_stream("mpeg4", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = frames.shape[1:3]
                stream.pix_fmt = "yuv420p"
                stream.codec_context.qmin = stream.codec_context.qmax = quantizer
                for frame in frames:
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
                container.mux(stream.encode(None))
            sizes.append(mean_packet_bytes(path) or 1.0)
    return round(2 * float(np.exp(np.interp(-np.log(packet_bytes), -np.log(sizes), np.log(quantizers)))), 1)

"""Effects of a camera and its recorder on a whole frame: resolution, chroma blur, sharpening, captions.

No effect moves anything, so the truth stays valid. Captions that the camera burns in lie over vehicles and are not
cut out of their masks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.synth.sensor.noise import NoiseModel

__all__ = ["HALO_PX", "PLAIN", "Sensor", "make_sensor"]

HALO_PX = 0.9
"""Sigma of the blur that unsharp masking subtracts, px."""

_INVERSE_STEPS = 12
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_PLAIN, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX_SMALL)


@dataclass(frozen=True)
class Caption:
    """A line of text that the camera burns into the picture.

    Args:
        text: `{clock}` stands for the time of day.
        corner: (x, y) of the text's left end, as shares of the frame's width and height.
        height: of the letters, as a share of the frame's height.
        font: OpenCV's number of the font.
        band: whether a dark band lies behind the text.
        rim: whether letters have a dark outline.
    """

    text: str
    corner: tuple[float, float]
    height: float
    font: int
    band: bool
    rim: bool


@dataclass(frozen=True)
class Sensor:
    """Imperfections of a camera.

    Args:
        lines: resolution of the sensor, as a share of the frame's lines and columns.
        smear: sigma of the chroma blur along lines, as a share of the frame's width; 0 for none.
        sharpen: strength of unsharp masking, which leaves halos; 0 for none.
        peaking: strength of sharpening along lines alone, as in analogue cameras; 0 for none.
        crf: constant rate factor of the H.264 stream; higher is worse.
        captions: text in the picture.
        start_s: time of day at the first frame, seconds.
        arms: length of the stars that the lens draws around reflections of the sun, as a share of the frame's width;
            0 for none.
        blur_px: sigma of the lens blur, px.
        noise_model: noise by brightness; None for the even noise of `Light`.
        in_picture: whether the background image comes from this camera, so that it has these effects already.
        block_step: quantisation step of an old codec, grey levels, see `add_block_artifacts`; 0 for none. It is used
            with `in_picture` only.
    """

    lines: float = 1.0
    smear: float = 0.0
    sharpen: float = 0.0
    peaking: float = 0.0
    crf: int = 21
    captions: tuple[Caption, ...] = ()
    start_s: float = 0.0
    arms: float = 0.006
    blur_px: float = 0.5
    noise_model: NoiseModel | None = None
    in_picture: bool = False
    block_step: float = 0.0

    def before_noise(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Apply the sensor's resolution, then the chroma blur, then sharpening of brightness alone.

        Args:
            image: (H, W, 3) uint8 BGR.

        Returns:
            (H, W, 3) uint8 BGR; `image` itself for a camera without these effects.
        """
        if self.lines >= 1 and not (self.smear or self.sharpen or self.peaking):
            return image
        size = (image.shape[1], image.shape[0])
        # Even, as halved chroma planes need it.
        few = (_even(size[0] * self.lines), _even(size[1] * self.lines))
        out: Any = image
        if few != size:
            # Between half and all lines, linear interpolation averages enough and takes a third of the time.
            out = cv2.resize(out, few, interpolation=cv2.INTER_AREA if self.lines < 0.5 else cv2.INTER_LINEAR)
        planes = cv2.cvtColor(out, cv2.COLOR_BGR2YUV_I420)
        if self.smear:
            # Chroma at fewer columns, as in analogue video.
            colours = planes[few[1] :].reshape(2, few[1] // 2, few[0] // 2)
            narrow = (max(2, round(1 / (2 * self.smear))), few[1] // 2)
            for plane in colours:
                plane[:] = cv2.resize(cv2.resize(plane, narrow, interpolation=cv2.INTER_AREA), plane.shape[::-1])
        bright = planes[: few[1]]
        if self.sharpen:
            soft = cv2.GaussianBlur(bright, (5, 5), HALO_PX)
            cv2.addWeighted(bright, 1 + self.sharpen, soft, -self.sharpen, 0, dst=bright)
        if self.peaking:
            cv2.addWeighted(bright, 1 + self.peaking, cv2.blur(bright, (3, 1)), -self.peaking, 0, dst=bright)
        out = cv2.cvtColor(planes, cv2.COLOR_YUV2BGR_I420)
        if few != size:
            out = cv2.resize(out, size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(out, dtype=np.uint8)

    def sharpened(self, planes: NDArray[np.float32], width_px: int) -> NDArray[np.float32]:
        """Apply sharpening and chroma blur, both of which are linear, to a picture or a difference of pictures.

        Args:
            planes: (H, W, 3) float32 BGR.
            width_px: of the whole frame.

        Returns:
            (H, W, 3) float32 BGR.
        """
        bright = planes @ np.array([0.114, 0.587, 0.299], dtype=np.float32)
        sharper = bright
        if self.sharpen:
            sharper = bright + self.sharpen * (bright - cv2.GaussianBlur(bright, (5, 5), HALO_PX))
        if self.smear:
            colour: Any = cv2.GaussianBlur(planes - bright[..., None], (0, 0), self.smear * width_px, sigmaY=0.3)
            return np.asarray(colour + sharper[..., None])
        return np.asarray(planes + (sharper - bright)[..., None])

    def unsharpened(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Invert `sharpened` approximately, by fixed-point iteration.

        Args:
            picture: (H, W, 3) uint8 BGR.

        Returns:
            (H, W, 3) uint8 BGR that `sharpened` turns into `picture`.
        """
        target = picture.astype(np.float32)
        if not self.sharpen:
            return picture
        plain = replace(self, smear=0.0)
        out = target.copy()
        for _ in range(_INVERSE_STEPS):
            out += (target - plain.sharpened(out, picture.shape[1])) / (1 + self.sharpen)
        return np.asarray(out.round().clip(0, 255).astype(np.uint8))

    def write(self, image: NDArray[np.uint8], time_s: float) -> None:
        """Burn the captions into a frame, in place.

        Args:
            image: (H, W, 3) uint8 BGR.
            time_s: time since the first frame.
        """
        height, width = image.shape[:2]
        clock = self.start_s + time_s
        hms = f"{int(clock // 3600) % 24:02d}:{int(clock // 60) % 60:02d}:{int(clock) % 60:02d}"
        for caption in self.captions:
            text = caption.text.format(clock=hms)
            scale = cv2.getFontScaleFromHeight(caption.font, max(6, round(caption.height * height)))
            (wide, tall), base = cv2.getTextSize(text, caption.font, scale, 1)
            x, y = round(caption.corner[0] * width), round(caption.corner[1] * height)
            x, y = max(0, min(x, width - wide - 2)), max(tall + 2, min(y, height - base - 2))
            if caption.band:
                image[y - tall - 2 : y + base + 2, x : x + wide] //= 4
            if caption.rim:
                for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                    cv2.putText(image, text, (x + dx, y + dy), caption.font, scale, (10, 10, 10), 1, cv2.LINE_AA)
            cv2.putText(image, text, (x, y), caption.font, scale, (245, 245, 245), 1, cv2.LINE_AA)


def _even(value: float) -> int:
    return max(4, 2 * round(value / 2))


PLAIN = Sensor()
"""A camera without imperfections."""


def make_sensor(rng: np.random.Generator) -> Sensor:
    """Sample a traffic camera: most are good, some sharpened, some old and coarse; half of them burn in captions."""
    style = rng.random()
    captions = _captions(rng) if rng.random() < 0.5 else ()
    start = rng.uniform(6, 20) * 3600
    arms = rng.uniform(0.003, 0.013) if rng.random() < 0.6 else 0.0
    if style < 0.35:
        sharp = rng.uniform(0.0, 0.6) if rng.random() < 0.6 else 0.0
        return Sensor(sharpen=sharp, arms=arms, crf=int(rng.integers(18, 25)), captions=captions, start_s=start)
    if style < 0.8:
        sharp = rng.uniform(0.4, 1.6)
        return Sensor(rng.uniform(0.7, 1.0), 0.0, sharp, 0.0, int(rng.integers(20, 30)), captions, start, arms)
    coarse, smear = min(1.0, rng.uniform(0.3, 1.1)), rng.uniform(0.002, 0.008)
    sharp, peaking = rng.uniform(0.0, 2.4), rng.uniform(0.3, 1.6)
    return Sensor(coarse, smear, sharp, peaking, int(rng.integers(20, 32)), captions, start, arms)


def _captions(rng: np.random.Generator) -> tuple[Caption, ...]:
    day = f"{rng.integers(2004, 2027)}-{rng.integers(1, 13):02d}-{rng.integers(1, 29):02d}"
    if rng.random() < 0.4:
        day = day.replace("-", "/")
    names = ("Camera-1", "CAM 04", "A7 km 112.4", "CH1", "Bridge North", "IPCAM", "D1-023 LEFT")
    font, height = _FONTS[int(rng.integers(len(_FONTS)))], rng.uniform(0.018, 0.045)
    band, rim = bool(rng.random() < 0.3), bool(rng.random() < 0.6)
    out = []
    if rng.random() < 0.85:
        corner = ((0.01, 0.05), (0.62, 0.05), (0.62, 0.97), (0.01, 0.97))[int(rng.integers(4))]
        out.append(Caption(f"{day} {{clock}}", corner, height, font, band, rim))
    if rng.random() < 0.6:
        corner = ((0.01, 0.10), (0.75, 0.90))[int(rng.integers(2))]
        out.append(Caption(str(rng.choice(names)), corner, height, font, band, rim))
    return tuple(out)

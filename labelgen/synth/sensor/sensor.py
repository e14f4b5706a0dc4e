"""What a camera and its recorder do to a whole frame: fewer lines, smeared colours, sharpening, writing.

Nothing here moves anything: truth stays what it is. Writing that the camera burns in lies over vehicles without
being cut out of their masks.
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
"""Sigma of the blur that sharpening takes away, px."""

_INVERSE_STEPS = 12
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_PLAIN, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX_SMALL)


@dataclass(frozen=True)
class Caption:
    """A line of burnt-in text.

    Args:
        text: with `{clock}` where the time of day goes.
        corner: (x, y) share of the frame, of the text's left end.
        height: share of the frame's height.
        font: OpenCV's number.
        band: whether a dark band lies behind it.
        rim: whether letters have a dark rim.
    """

    text: str
    corner: tuple[float, float]
    height: float
    font: int
    band: bool
    rim: bool


@dataclass(frozen=True)
class Sensor:
    """A camera's faults.

    Args:
        lines: share of the frame's lines and columns that the sensor has; 1 for all.
        smear: sigma of the colours' blur along lines, share of the frame's width; 0 for none.
        sharpen: strength of the halos that sharpening leaves; 0 for none.
        peaking: strength of the halos along lines alone, as analogue cameras make them.
        crf: quality of the H.264 stream; higher is worse.
        captions: text in the picture.
        start_s: time of day at the first frame.
        arms: length of the stars that the lens draws around glints of the sun, share of the frame's width; 0 for none.
        blur_px: sigma of the lens's blur.
        noise_model: noise by brightness; None for the even noise of `Light`.
        in_picture: whether the picture of the empty road comes from this camera and has its faults already.
        block_step: how coarsely an old recorder rounds the blocks that vehicles drive through, see
            `add_block_artifacts`; 0 for not at all. Only with `in_picture`.
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
        """A frame (H, W, 3) BGR with the sensor's resolution, its colour smear and the sharpening after it.

        Brightness alone is sharpened; a camera without faults gives the frame back as it is.
        """
        if self.lines >= 1 and not (self.smear or self.sharpen or self.peaking):
            return image
        size = (image.shape[1], image.shape[0])
        # Even, as brightness and the halved planes of colour need it.
        few = (_even(size[0] * self.lines), _even(size[1] * self.lines))
        out: Any = image
        if few != size:
            # Between half and all lines, linear interpolation averages enough and takes a third of the time.
            out = cv2.resize(out, few, interpolation=cv2.INTER_AREA if self.lines < 0.5 else cv2.INTER_LINEAR)
        planes = cv2.cvtColor(out, cv2.COLOR_BGR2YUV_I420)
        if self.smear:
            # Colour at fewer columns, as analogue video carries it.
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
        """Any difference of pictures (H, W, 3) BGR after sharpening and smearing, both of which are linear.

        Args:
            planes: a picture, or what one has more than another.
            width_px: of the whole frame.
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
        """What `sharpened` turns into this picture (H, W, 3) BGR, nearly: the road before the camera's electronics."""
        wanted = picture.astype(np.float32)
        if not self.sharpen:
            return picture
        plain = replace(self, smear=0.0)
        out = wanted.copy()
        for _ in range(_INVERSE_STEPS):
            out += (wanted - plain.sharpened(out, picture.shape[1])) / (1 + self.sharpen)
        return np.asarray(out.round().clip(0, 255).astype(np.uint8))

    def write(self, image: NDArray[np.uint8], time_s: float) -> None:
        """Burn the captions into a frame, in place."""
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
"""A camera without faults."""


def make_sensor(rng: np.random.Generator) -> Sensor:
    """A camera as traffic is filmed with: mostly good ones, some sharpened, some old and coarse; half of them write."""
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

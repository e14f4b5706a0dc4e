"""Which masks move along the road: textured patches on a textured road, moved by known amounts."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from clips import CAMERA, SIZE

from labelgen.geometry import Camera
from labelgen.masks import InstanceMasks, create_mask_source, labelled_frames
from labelgen.masks.background.motion import MOTION, find_moving, working_grey
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.image_folder import ImageFolder

WIDTH_M = 2.0
FOOT_M = (32.0, -12.0)
UNSCALED = replace(CAMERA, scale=None)


def texture(seed: int, shape: tuple[int, int], low: int, high: int) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(low, high, (shape[0] // 5 + 2, shape[1] // 5 + 2), dtype=np.uint8)
    big = cv2.resize(coarse, None, fx=5, fy=5, interpolation=cv2.INTER_CUBIC)
    return np.repeat(big[: shape[0], : shape[1], None], 3, axis=2)


ROAD_PICTURE = texture(1, (SIZE[1] + 40, SIZE[0] + 40), 90, 130)


def picture(
    along_m: float = 0.0, across_m: float = 0.0, *, sway_px: tuple[int, int] = (0, 0), there: bool = True
) -> tuple[np.ndarray, tuple[int, int, int, int]]:
    """A frame with one vehicle moved from its place, and the vehicle's box."""
    dx, dy = sway_px
    image = ROAD_PICTURE[20 - dy : 20 - dy + SIZE[1], 20 - dx : 20 - dx + SIZE[0]].copy()
    x, y = CAMERA.project([[FOOT_M[0] + along_m, FOOT_M[1] + across_m]])[0] + np.array(sway_px)
    half = np.ptp(CAMERA.project([FOOT_M, (FOOT_M[0], FOOT_M[1] + WIDTH_M)])[:, 0]) / 2
    box = (round(x - half), round(y - 2 * half), round(x + half), round(y))
    if there:
        patch = texture(2, (box[3] - box[1], box[2] - box[0]), 0, 255)
        image[box[1] : box[3], box[0] : box[2]] = patch
    return image, box


def moves(others: list[tuple[float, np.ndarray]], camera: Camera = CAMERA, *, if_unknown: bool = False) -> bool:
    image, (x0, y0, x1, y1) = picture()
    masks = InstanceMasks.from_crops(SIZE, [((x0, y0), np.ones((y1 - y0, x1 - x0), dtype=bool))], [0], [1.0])
    greys = [(looks, working_grey(other)) for looks, other in others]
    return bool(find_moving(masks, working_grey(image), greys, camera, if_unknown=if_unknown)[0])


@pytest.mark.parametrize("camera", [CAMERA, UNSCALED], ids=["metres", "no scale"])
@pytest.mark.parametrize(
    ("what", "others", "expected"),
    [
        ("drives away", [(0.08, picture(1.1)[0])], True),
        ("comes closer", [(0.08, picture(-1.1)[0])], True),
        ("drives, camera sways", [(0.08, picture(1.1, sway_px=(4, -3))[0])], True),
        ("stands", [(0.08, picture()[0]), (1.0, picture()[0])], False),
        ("stands, camera sways", [(0.08, picture(sway_px=(4, -3))[0]), (1, picture(sway_px=(-6, 5))[0])], False),
        ("crawls, seen after a second", [(0.08, picture(0.1)[0]), (1.0, picture(2.0)[0])], True),
        ("moves less than a metre in a second", [(0.08, picture(0.03)[0]), (1.0, picture(0.4)[0])], False),
        ("slides across the road", [(0.08, picture(0.0, 1.0)[0])], False),
        ("flickers", [(0.08, picture(there=False)[0]), (1.0, picture(there=False)[0])], False),
        ("nothing to compare with", [], False),
    ],
)  # fmt: skip
def test_what_moves(what: str, others: list[tuple[float, np.ndarray]], expected: bool, camera: Camera) -> None:
    assert moves(others, camera) is expected, what


def test_what_cannot_be_followed_counts_as_asked() -> None:
    """Between the pictures of a slow sequence vehicles are lost; what is seen to stand is not."""
    assert moves([(1.0, picture(there=False)[0])], if_unknown=True)
    assert not moves([(1.0, picture()[0])], if_unknown=True)


@pytest.mark.parametrize(
    ("fps", "offsets"),
    [(25.0, (-2, 2, -1, 1, -25)), (50.0, (-5, 5, -1, 1, -50)), (2.0, (-1, 1, -2)), (0.5, (-1, 1)), (None, (-1, 1))],
)
def test_frames_that_are_compared(fps: float | None, offsets: tuple[int, ...]) -> None:
    assert MOTION.offsets(fps) == offsets
    assert MOTION.can_follow(fps) is (fps is not None and fps > 2)


def test_the_answer_does_not_depend_on_what_else_is_asked(tmp_path) -> None:
    """A resumed job asks for the later frames only."""
    for number in range(40):
        image, _ = picture((20 - number) * 0.2, there=number >= 4)
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), image)
    answers = []
    for every, first in ((4, 0), (4, 20), (20, 20)):
        source = create_mask_source("background")
        source.prime(picture(there=False)[0] for _ in range(5))
        choice = FrameChoice(every=every, wanted=lambda number, first=first: number >= first)
        told = {
            f.number: masks for f, masks in labelled_frames(ImageFolder(tmp_path, fps=10.0), source, CAMERA, choice)
        }
        assert sorted(told) == list(range(first, 40, every))
        answers.append(told[20].moving.tolist())
    assert answers == [[True]] * 3

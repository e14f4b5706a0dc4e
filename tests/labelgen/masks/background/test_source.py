"""Background masks on drawn traffic with known silhouettes, and on real videos."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from labelgen.errors import DataError
from labelgen.labels import VehicleClass
from labelgen.masks import InstanceMasks, MaskSource, create_mask_source
from labelgen.media.open_frames import open_frames

WH = (640, 360)
REAL = os.environ.get("LABELGEN_REAL_DATA")
Box = tuple[int, int, int, int]


def road(size_wh: tuple[int, int] = WH) -> np.ndarray:
    """Grey asphalt with grain, grass beside it, and white lines."""
    w, h = size_wh
    rng = np.random.default_rng(5)
    image = np.full((h, w, 3), 110, dtype=np.uint8)
    image[:, : w // 8] = (60, 120, 70)
    for x in (w // 3, 2 * w // 3):
        image[:, x - 2 : x + 3] = 215
    grain = cv2.GaussianBlur(rng.normal(0, 14, (h, w, 1)).astype(np.float32), (5, 5), 0)
    return np.clip(image + grain[..., None] * [1, 1, 1], 0, 255).astype(np.uint8)


def drive(scene: np.ndarray, box: Box, colour: tuple[int, int, int], *, shadow: bool = False) -> np.ndarray:
    """The scene with a vehicle: a body with windows and lights, and a shadow to its right if asked for."""
    image = scene.copy()
    x0, y0, x1, y1 = box
    w, h = x1 - x0, y1 - y0
    if shadow:
        dark = image[y0 + h // 2 : y1, x1 : x1 + w // 2]
        dark[:] = (dark * 0.5).astype(np.uint8)
    image[y0:y1, x0:x1] = colour
    image[y0 + h // 6 : y0 + h // 2, x0 + w // 8 : x1 - w // 8] = (70, 60, 50)
    image[y1 - h // 4 : y1 - h // 8, x0 + 2 : x0 + w // 5] = (40, 40, 200)
    image[y1 - h // 4 : y1 - h // 8, x1 - w // 5 : x1 - 2] = (40, 40, 200)
    return image


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 3, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def traffic(scene: np.ndarray, count: int = 40) -> Iterator[np.ndarray]:
    """A car that passes and leaves."""
    for i in range(count):
        y = 10 + 12 * i
        yield noisy(drive(scene, (260, y, 310, y + 40), (30, 30, 180)) if y < 310 else scene, i)


def iou(masks: InstanceMasks, box: Box) -> list[float]:
    whole = np.zeros((masks.frame_wh[1], masks.frame_wh[0]), dtype=bool)
    whole[box[1] : box[3], box[0] : box[2]] = True
    return [float((masks.full(i) & whole).sum() / (masks.full(i) | whole).sum()) for i in range(len(masks))]


def primed(**options: object) -> MaskSource:
    source = create_mask_source("background", **options)  # type: ignore[arg-type]
    source.prime(traffic(road()))
    return source


@pytest.fixture(scope="module")
def primed_source() -> MaskSource:
    """A source primed with the road; for tests that only ask it for masks, which leaves its state as it is."""
    return primed()


def masks_of(source: MaskSource, image: np.ndarray) -> InstanceMasks:
    return source.masks([image], [0], [""])[0]


@pytest.mark.parametrize("colour", [(30, 30, 190), (230, 230, 230), (35, 35, 35), (150, 90, 40)])
@pytest.mark.parametrize("box", [(300, 100, 340, 132), (240, 180, 330, 260), (120, 20, 145, 40)])
def test_finds_a_vehicle_and_its_outline(primed_source: MaskSource, colour: tuple[int, int, int], box: Box) -> None:
    masks = masks_of(primed_source, noisy(drive(road(), box, colour), 900))
    # A pixel more or less all around is 0.84 of the smallest box.
    assert max(iou(masks, box), default=0) > (0.8 if box[2] - box[0] > 30 else 0.7)
    assert len(masks) == 1
    assert masks.class_ids.tolist() == [VehicleClass.VEHICLE]
    assert 0.5 <= masks.scores[0] <= 1


def test_empty_road_gives_nothing(primed_source: MaskSource) -> None:
    for seed in range(5):
        assert len(masks_of(primed_source, noisy(road(), 500 + seed))) == 0


def test_another_scene_is_no_traffic(primed_source: MaskSource) -> None:
    rng = np.random.default_rng(3)
    patches = cv2.resize(rng.integers(0, 256, (9, 16, 3), dtype=np.uint8), WH, interpolation=cv2.INTER_NEAREST)
    for scene in (rng.integers(0, 256, (WH[1], WH[0], 3), dtype=np.uint8), np.asarray(patches)):
        assert len(masks_of(primed_source, scene)) == 0


def test_cast_shadow_is_left_out(primed_source: MaskSource) -> None:
    box = (300, 150, 380, 220)
    masks = masks_of(primed_source, noisy(drive(road(), box, (40, 160, 220), shadow=True), 1))
    assert len(masks) == 1
    assert iou(masks, box)[0] > 0.8
    assert masks.boxes_xyxy[0, 2] < box[2] + 12


@pytest.mark.parametrize("colour", [(230, 230, 230), (150, 90, 40), (45, 45, 45), (140, 140, 140)])
def test_shade_under_a_grey_sky_is_left_out(primed_source: MaskSource, colour: tuple[int, int, int]) -> None:
    x0, y0, x1, y1 = box = (290, 150, 370, 220)
    # What the vehicle hides of the sky makes the road around its foot darker, the less the farther away.
    away = np.ones((WH[1], WH[0]), dtype=np.uint8)
    away[(y0 + y1) // 2 : y1, x0:x1] = 0
    distance = cv2.distanceTransform(away, cv2.DIST_L2, 5)
    shaded = (road() * (1 - 0.6 * np.exp(-distance / 16))[..., None]).astype(np.uint8)
    masks = masks_of(primed_source, noisy(drive(shaded, box, colour), 7))
    assert max(iou(masks, box), default=0) > 0.85
    assert len(masks) == 1
    assert masks.boxes_xyxy[0] == pytest.approx(box, abs=6)


def test_two_vehicles_side_by_side_stay_two(primed_source: MaskSource) -> None:
    one, two = (250, 150, 310, 200), (318, 150, 378, 200)
    masks = masks_of(primed_source, noisy(drive(drive(road(), one, (200, 60, 40)), two, (230, 230, 230)), 2))
    assert len(masks) == 2
    assert max(iou(masks, one)) > 0.75
    assert max(iou(masks, two)) > 0.75


def test_two_that_touch_at_a_corner_are_cut(primed_source: MaskSource) -> None:
    one, two = (250, 100, 310, 150), (305, 146, 365, 200)
    masks = masks_of(primed_source, noisy(drive(drive(road(), one, (200, 60, 40)), two, (230, 230, 230)), 3))
    assert len(masks) == 2
    assert max(iou(masks, one)) > 0.7
    assert max(iou(masks, two)) > 0.7


@pytest.mark.slow
def test_vehicles_must_stand_on_the_road() -> None:
    mask = np.zeros((WH[1], WH[0]), dtype=np.uint8)
    mask[:, 320:] = 255
    source = primed(road_mask=mask)
    on, off = (400, 100, 460, 150), (150, 100, 210, 150)
    masks = masks_of(source, noisy(drive(drive(road(), on, (30, 30, 190)), off, (30, 30, 190)), 4))
    assert len(masks) == 1
    assert iou(masks, on)[0] > 0.8


def test_road_mask_of_another_size_is_refused() -> None:
    source = create_mask_source("background", road_mask=np.full((100, 100), 255, dtype=np.uint8))
    with pytest.raises(DataError, match="it is 100x100 px, but the frames are 640x360"):
        source.observe(road())


@pytest.mark.slow
def test_masks_change_nothing_and_repeat() -> None:
    frames = list(traffic(road(), 20))
    results = []
    for asked in (False, True):
        source = primed()
        for frame in frames:
            source.observe(frame)
            if asked:
                masks_of(source, frame)
        results.append(masks_of(source, frames[12]))
    assert results[0].origins.tolist() == results[1].origins.tolist()
    for one, two in zip(results[0].crops, results[1].crops, strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.slow
def test_follows_the_light() -> None:
    source = primed()
    box = (300, 150, 380, 220)
    for step in range(40):
        darker = np.clip(road() * (1 - 0.01 * step), 0, 255)
        source.observe(noisy(darker, step))
    scene = np.clip(road() * 0.6, 0, 255).astype(np.uint8)
    assert len(masks_of(source, noisy(scene, 77))) == 0
    assert max(iou(masks_of(source, noisy(drive(scene, box, (30, 30, 190)), 78)), box), default=0) > 0.75


@pytest.mark.slow
def test_ghost_of_a_vehicle_that_left_is_no_mask_and_is_forgotten() -> None:
    box = (300, 150, 380, 220)
    parked = drive(road(), box, (30, 30, 190))
    source = create_mask_source("background")
    source.prime(noisy(parked, i) for i in range(20))
    assert len(masks_of(source, noisy(road(), 50))) == 0
    for i in range(30):
        source.observe(noisy(road(), 60 + i))
    back = masks_of(source, noisy(parked, 99))
    assert max(iou(back, box), default=0) > 0.75


@pytest.mark.slow
def test_swaying_camera() -> None:
    box = (300, 150, 380, 220)
    scene = cv2.copyMakeBorder(road(), 8, 8, 8, 8, cv2.BORDER_REFLECT)

    def moved(image: np.ndarray, dx: int, dy: int) -> np.ndarray:
        return image[8 + dy : 368 + dy, 8 + dx : 648 + dx]

    source = create_mask_source("background")
    source.prime(noisy(moved(scene, i % 5 - 2, i % 3 - 1), i) for i in range(30))
    assert len(masks_of(source, noisy(moved(scene, 5, -4), 40))) == 0
    image = drive(moved(scene, 5, -4), box, (30, 30, 190))
    masks = masks_of(source, noisy(image, 41))
    assert len(masks) == 1
    assert iou(masks, box)[0] > 0.8


@pytest.mark.slow
def test_sway_is_undone_frame_after_frame() -> None:
    scene = cv2.copyMakeBorder(road(), 8, 8, 8, 8, cv2.BORDER_REFLECT)
    box = (240, 120, 400, 240)  # it hides the middle, which only what lies around can make up for

    def frame_at(i: int, vehicle: bool = False) -> np.ndarray:
        dx, dy = (3, -4) if i % 2 else (-5, 2)
        image = scene[8 + dy : 368 + dy, 8 + dx : 648 + dx]
        return noisy(drive(image, box, (30, 30, 190)) if vehicle else image, i)

    source = create_mask_source("background")
    source.prime(frame_at(i) for i in range(20))
    shares = [iou(masks_of(source, frame_at(i, vehicle=True)), box) for i in range(40)]
    assert [len(share) for share in shares] == [1] * 40
    assert min(share[0] for share in shares) > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("size_wh", [(640, 1), (1, 640), (641, 7), (3, 5), (48, 48)])
def test_slivers_and_thumbnails_do_no_harm(size_wh: tuple[int, int]) -> None:
    w, h = size_wh
    rng = np.random.default_rng(1)
    scene = rng.integers(60, 200, (h, w, 3), dtype=np.uint8)
    source = create_mask_source("background")
    source.prime(noisy(scene, i) for i in range(6))
    for i in range(6):
        image = noisy(scene, 10 + i)
        image[h // 4 : h // 4 + max(1, h // 3), i % w : i % w + max(1, w // 3)] = rng.integers(0, 255, 3)
        source.observe(image)
        masks = masks_of(source, image)
        assert masks.frame_wh == size_wh
        assert all(masks.full(j).shape == (h, w) for j in range(len(masks)))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_works_at_any_size(factor: float) -> None:
    def sized(image: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))

    box = (300, 200, 380, 360)  # cut off by the frame's lower border
    source = create_mask_source("background")
    source.prime(sized(frame) for frame in traffic(road(), 20))
    masks = masks_of(source, sized(noisy(drive(road(), box, (30, 30, 190)), 9)))
    scaled = tuple(int(v * factor) for v in box)
    assert masks.frame_wh == (int(640 * factor), int(360 * factor))
    assert max(iou(masks, scaled), default=0) > 0.8  # type: ignore[arg-type]
    assert masks.boxes_xyxy[0, 3] == masks.frame_wh[1]


def test_unprimed_source_gives_nothing_then_learns() -> None:
    source = create_mask_source("background")
    assert len(masks_of(source, road())) == 0
    source.prime(iter(()))
    for i in range(3):
        source.observe(noisy(road(), i))
    box = (300, 150, 380, 220)
    assert max(iou(masks_of(source, noisy(drive(road(), box, (30, 30, 190)), 9)), box), default=0) > 0.8


# Vehicles as a person draws their boxes by eye, to a pixel or two: frame number -> x0, y0, x1, y1.
CITY: dict[int, list[Box]] = {
    161: [(179, 220, 270, 325), (390, 134, 447, 183)],
    469: [(207, 120, 258, 167), (322, 168, 397, 255), (277, 76, 312, 107)],
    520: [(180, 125, 226, 172), (316, 148, 370, 203), (438, 215, 534, 303)],
    623: [(410, 196, 507, 283), (302, 62, 329, 88)],
    675: [(154, 215, 235, 314), (248, 111, 289, 156), (440, 121, 549, 250), (352, 95, 397, 129)],
    983: [(257, 75, 287, 106), (233, 113, 275, 161)],
}
FREEWAY: dict[int, list[Box]] = {
    92: [(188, 70, 213, 92), (156, 7, 172, 20)],
    113: [(49, 66, 80, 91), (100, 121, 143, 162), (8, 157, 55, 196), (206, 16, 222, 29)],
    156: [(191, 55, 212, 72), (0, 184, 44, 225)],
    263: [(70, 166, 126, 222), (161, 37, 184, 57), (202, 20, 220, 36)],
    285: [(28, 142, 73, 176), (158, 40, 184, 63)],
    370: [(8, 87, 53, 121), (26, 142, 67, 175), (162, 139, 197, 172)],
    392: [(163, 117, 197, 153)],
}


@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="LABELGEN_REAL_DATA is not set")
@pytest.mark.parametrize(("name", "drawn"), [("city_road_640x360.mp4", CITY), ("freeway_320x240.avi", FREEWAY)])
def test_real_vehicles(name: str, drawn: dict[int, list[Box]]) -> None:
    assert REAL is not None
    path = Path(REAL) / "videos" / name
    mask = cv2.imread(str(path.with_name(path.stem + ".mask.png")), cv2.IMREAD_GRAYSCALE)
    source = create_mask_source("background", road_mask=mask)
    video = open_frames(path)
    source.prime(f.image for f in video.frames(lambda i: i % 10 == 0))
    best: list[float] = []
    for frame in video.frames(lambda i: i % source.every_frame == 0 or i in drawn):
        if frame.number % source.every_frame == 0:
            source.observe(frame.image)
        if frame.number in drawn:
            boxes = masks_of(source, frame.image).boxes_xyxy.astype(float)
            best += [max((box_iou(box, other) for other in boxes.tolist()), default=0) for box in drawn[frame.number]]
    assert np.mean(np.array(best) > 0.6) >= 0.9
    assert np.median(best) > 0.75


def box_iou(one: Box, two: list[float]) -> float:
    w = min(one[2], two[2]) - max(one[0], two[0])
    h = min(one[3], two[3]) - max(one[1], two[1])
    shared = max(w, 0) * max(h, 0)
    return shared / ((one[2] - one[0]) * (one[3] - one[1]) + (two[2] - two[0]) * (two[3] - two[1]) - shared)

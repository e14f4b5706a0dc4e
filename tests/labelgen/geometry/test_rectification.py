"""Rectification: coverage, orientation, axis-parallel directions, warping both ways, and what is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import shapely
from random_cameras import FRAME_WH, random_camera

from labelgen.errors import LabelgenError, RectificationError
from labelgen.geometry import Camera, Pair, Rectification, RoadMask, parse_size, rectify_windows

SIZES = {Pair.VP2_VP3: (320, 180), Pair.VP1_VP2: (180, 320)}


def _band(top: int, bottom: int, left: int = 100, right: int = 540) -> np.ndarray:
    mask = np.zeros((360, 640), np.uint8)
    mask[top:bottom, left:right] = 255
    return mask


# -- what is refused ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vps", "mask", "pair", "options", "match"),
    [
        (None, np.zeros((360, 640), np.uint8), Pair.VP2_VP3, {}, "it is empty"),
        (None, np.full((360, 640), 127, np.uint8), Pair.VP2_VP3, {}, "it is empty"),
        (None, np.zeros((0, 640), np.uint8), Pair.VP2_VP3, {}, "it is empty"),
        (None, np.full((180, 320), 255, np.uint8), Pair.VP2_VP3, {}, "320x180 px, but the frame is 640x360"),
        (None, np.full((2, 3, 4, 5), 255, np.uint8), Pair.VP2_VP3, {}, "expected an image"),
        (None, np.full((360, 640), 255.0), Pair.VP2_VP3, {}, "from 0 to 1"),
        # VP1 in the picture, and road right up to it.
        ((300, 60), _band(20, 300), Pair.VP1_VP2, {}, "VP1 at .* lies inside the road mask's hull"),
        ((300, 60), _band(20, 300), Pair.VP2_VP3, {}, "the horizon.* crosses the road mask"),
        ((300, 60), _band(40, 300, 400, 600), Pair.VP1_VP2, {}, "the horizon.* crosses the road mask"),
        # Two components, one on either side of the horizon: their hull crosses it.
        ((300, 60), _band(10, 30) | _band(200, 300), Pair.VP2_VP3, {}, "the horizon.* crosses"),
        # Looking down so steeply that VP3 is in the picture.
        ("down", _band(150, 350), Pair.VP2_VP3, {}, "VP3 at .* lies inside the road mask's hull"),
        ("down", _band(200, 350, 0, 200), Pair.VP2_VP3, {"min_coverage": 1.01}, "the line joining VP2 and VP3 crosses"),
        (None, _band(100, 300), Pair.VP2_VP3, {"min_coverage": 1.01}, "cropped away before 101%"),
        (None, _band(100, 300), Pair.VP2_VP3, {"cover": "mask", "min_coverage": 0.999}, "lay inside the mask"),
        (None, _band(100, 300), Pair.VP2_VP3, {"crop_step": 0}, "crop_step"),
        (None, _band(100, 300), Pair.VP2_VP3, {"crop_step": -5}, "crop_step"),
        (None, _band(100, 300), Pair.VP2_VP3, {"size_wh": (0, 180)}, "size"),
        (None, _band(100, 300), Pair.VP2_VP3, {"size_wh": (-320, 180)}, "size"),
    ],
)
@pytest.mark.timeout(60)
def test_impossible_regions_are_refused(vps, mask, pair, options, match):
    if vps == "down":  # 60 degrees down
        camera = _looking_down(np.radians(60))
    elif vps is None:
        camera = Camera([269.2, -43.6], [12914.9, -43.6], [320, 180], image_wh=(640, 360))
    else:
        camera = Camera(vps, [12914.9, 60.0], [320, 180], image_wh=(640, 360))
    options = {"size_wh": SIZES[pair], **options}
    with pytest.raises(RectificationError, match=match) as caught:
        Rectification.from_road_mask(camera, mask, pair, options.pop("size_wh"), **options)
    assert "\n" not in str(caught.value)


def _looking_down(pitch: float, focal: float = 150.0) -> Camera:
    def vanishing_point(azimuth: float) -> list[float]:
        x, y, z = np.sin(azimuth), -np.sin(pitch) * np.cos(azimuth), np.cos(pitch) * np.cos(azimuth)
        return [320 + focal * x / z, 180 + focal * y / z]

    return Camera(vanishing_point(0.02), vanishing_point(0.02 + np.pi / 2), [320, 180], image_wh=(640, 360))


@pytest.mark.parametrize(
    ("window", "match"),
    [
        ([0, -100, 640, 360], "VP1 at .* lies inside the window's hull"),
        ([400, -100, 640, 360], "crosses the window"),
        ([100, 100, 100, 300], "without area"),
        ([100, 100, 100, 100], "without area"),
        ([300, 100, 100, 300], "x0 < x1"),
        ([100, 100, np.nan, 300], "finite"),
    ],
)
def test_impossible_windows_are_refused(camera, window, match):
    with pytest.raises(RectificationError, match=match):
        Rectification.from_window(camera, window, Pair.VP1_VP2, (180, 320))


@pytest.mark.parametrize(
    "fields",
    [
        {"matrix": np.full((3, 3), np.nan)},
        {"matrix": np.zeros((3, 3))},
        {"matrix": np.eye(4)},
        {"vpu": [np.inf, 0]},
        {"vpu": [1, 2, 3]},
        {"size_wh": (0, 180)},
    ],
)
def test_impossible_rectifications_are_refused(fields):
    with pytest.raises(RectificationError, match="rectification"):
        Rectification(**{"pair": Pair.VP2_VP3, "size_wh": (320, 180), "matrix": np.eye(3), "vpu": [160, -50], **fields})


@pytest.mark.parametrize("text", ["", "640", "640x", "x360", "640x360x3", "0x360", "15x360", "9000x360", "-640x360"])
def test_unknown_sizes_are_refused(text):
    with pytest.raises(LabelgenError, match=r"write WIDTHxHEIGHT"):
        parse_size(text)


def test_names_are_read_in_any_case():
    assert parse_size(" 640X360 ") == parse_size("640×360") == (640, 360)
    assert Pair.parse("vp1-vp2 ") is Pair.VP1_VP2
    with pytest.raises(LabelgenError, match=r"VP1-VP3.*use one of VP2-VP3, VP1-VP2"):
        Pair.parse("VP1-VP3")


# -- masks -------------------------------------------------------------------------------------------


def test_masks_of_any_type_mean_the_same(camera, road):
    expected = Rectification.from_road_mask(camera, road, Pair.VP2_VP3, (320, 180)).matrix
    noisy = np.where(road > 0, road - 40, 90).astype(np.uint8)
    for same in (
        road > 0,
        noisy,
        road.astype(np.uint16) * 257,
        road.astype(np.float32) / 255,
        np.dstack([road] * 3),
        np.dstack([road] * 3 + [np.full_like(road, 255)]),  # with an opaque alpha channel
        np.dstack([road, np.full_like(road, 255)]),  # grey and alpha
        np.asfortranarray(road),
    ):
        np.testing.assert_array_equal(
            Rectification.from_road_mask(camera, same, Pair.VP2_VP3, (320, 180)).matrix, expected
        )


def test_the_hull_is_that_of_all_parts_and_of_pixel_areas():
    mask = np.zeros((50, 80), np.uint8)
    mask[0, 0] = mask[49, 79] = mask[0, 79] = 255  # three single pixels in corners of the picture
    hull = RoadMask(mask).hull()
    assert {tuple(p) for p in hull} == {(0, 0), (0, 1), (80, 0), (80, 50), (79, 50)}
    assert {tuple(p) for p in RoadMask(mask).hull(rows_below=49)} == {(0, 0), (0, 1), (80, 0), (80, 1)}
    assert RoadMask(mask).bottom == 50
    with pytest.raises(RectificationError, match="cropped away"):
        RoadMask(mask).hull(rows_below=0)


def test_road_fills_the_picture_from_edge_to_edge(rectification, road):
    hull = rectification.points(RoadMask(road).hull())
    if rectification.crop_steps == 0:
        np.testing.assert_allclose(hull.min(axis=0), 0, atol=1e-6)
        np.testing.assert_allclose(hull.max(axis=0), rectification.size_wh, atol=1e-6)


# -- what every rectification must do ------------------------------------------------------------------


def _random_rectifications(count: int, seed: int):
    rng = np.random.default_rng(seed)
    made = 0
    while made < count:
        camera = random_camera(rng)
        near, far = np.sort(rng.uniform(10, 120, 2))
        side = rng.uniform(-15, 15)
        strip = camera.project([[near, side - 8], [near, side + 8], [far, side + 8], [far, side - 8]])
        mask = np.zeros(FRAME_WH[::-1], np.uint8)
        if not np.isfinite(strip).all() or np.abs(strip).max() > 1e4:
            continue
        cv2.fillConvexPoly(mask, strip.astype(np.int32), 255)
        pair = list(Pair)[made % 2]
        try:
            yield camera, mask, Rectification.from_road_mask(camera, mask, pair, SIZES[pair])
        except RectificationError:
            continue
        made += 1


@pytest.mark.slow
def test_directions_orientation_and_coverage_of_random_scenes():
    for camera, mask, rect in _random_rectifications(120, seed=5):
        assert rect.frame_coverage >= 0.8
        assert rect.frame_coverage == pytest.approx(rect.warp_mask(np.ones_like(mask, bool)).mean(), abs=0.01)
        assert rect.road_area == pytest.approx(rect.warp_mask(mask > 0).mean(), abs=1e-9)
        centre = rect.points_back(np.array(rect.size_wh) / 2)
        for number, axis in ((2, 1), (rect.pair.vertical, 0)):
            step = _step(rect, centre, camera.vanishing_point(number))
            assert abs(step[axis]) <= 1e-6 * abs(step[1 - axis])  # the other coordinate alone changes
        right, down = (rect.points(centre + d) - rect.points(centre) for d in ([1e-3, 0], [0, 1e-3]))
        assert right[0] * down[1] - right[1] * down[0] > 0  # no mirror
        away = camera.vp1 - centre
        if abs(away[1]) > 0.3 * np.linalg.norm(away):  # traffic that drives up the frame drives up the picture
            assert np.sign(_step(rect, centre, camera.vp1)[1]) == np.sign(away[1])
        # Lines to the unused vanishing point meet in VPU.
        towards_vpu = _step(rect, centre, camera.vanishing_point(rect.pair.unused))
        reach = rect.vpu - rect.points(centre)
        cross = towards_vpu[0] * reach[1] - towards_vpu[1] * reach[0]
        assert abs(cross) <= 1e-6 * np.linalg.norm(towards_vpu) * np.linalg.norm(reach)


def _step(rect: Rectification, start: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """How the rectified point moves when the frame point moves by two hundredths of a px."""
    direction = (towards - start) / np.linalg.norm(towards - start)
    ends = rect.points(start + np.array([[-1e-2], [1e-2]]) * direction)
    return ends[1] - ends[0]


@pytest.mark.parametrize("distance", [1e5, 1e7, 1e9])
@pytest.mark.parametrize("side", [-1, 1])
def test_vp2_may_lie_far_away_on_either_side(distance, side, road):
    # VP1 and VP2 with no roll: any focal length belongs to one VP2 distance; only near 0 yaw is it far.
    vp2 = [320 + side * distance, -43.6]
    vp1 = [320 - side * (768.0**2 + 223.6**2) / distance * 0.94, -43.6]
    camera = Camera(vp1, vp2, [320, 180], image_wh=(640, 360))
    assert 600 < camera.focal < 800
    rect = Rectification.from_road_mask(camera, road, Pair.VP2_VP3, (320, 180))
    assert rect.frame_coverage >= 0.8
    row = rect.points([[200, 200], [440, 200]])
    assert row[0, 1] == pytest.approx(row[1, 1], abs=180 * 500 / distance)
    assert row[0, 0] < row[1, 0]


def test_a_corner_beyond_the_horizon_keeps_the_coverage_finite():
    # One corner of the output lies beyond the frame's line at infinity; 95 % of the output lies inside the frame.
    camera = Camera([300, 70], [5400, 210], [320, 180], image_wh=(640, 360))
    mask = np.zeros((360, 640), np.uint8)
    cv2.fillConvexPoly(mask, np.array([[440, 320], [270, 70], [200, 170]]), 255)
    rect = Rectification.from_road_mask(camera, mask, Pair.VP1_VP2, (180, 320))
    assert rect.crop_steps == 0
    assert np.isnan(rect.corners_px).any()
    columns, rows = np.meshgrid(np.arange(180) + 0.5, np.arange(320) + 0.5)
    places = rect.points_back(np.stack([columns, rows], axis=-1))
    inside = ((places >= 0) & (places <= [640, 360])).all(axis=-1)
    assert rect.frame_coverage == pytest.approx(inside.mean(), abs=0.005)
    assert rect.frame_coverage > 0.9


def test_the_coverage_rule_crops_from_the_bottom(camera):
    # Road wider than the picture at the bottom: the tangents' corners lie far outside the frame.
    mask = np.zeros((360, 640), np.uint8)
    cv2.fillPoly(mask, [np.array([[0, 359], [639, 359], [639, 250], [330, 20], [310, 20], [0, 250]])], 255)
    free = Rectification.from_road_mask(camera, mask, Pair.VP2_VP3, (320, 180), min_coverage=0.0)
    assert free.crop_steps == 0
    bar = free.frame_coverage + 0.02
    ruled = Rectification.from_road_mask(camera, mask, Pair.VP2_VP3, (320, 180), min_coverage=bar)
    assert ruled.crop_steps > 0
    assert ruled.frame_coverage >= bar
    by_hand = mask.copy()
    by_hand[360 - 5 * ruled.crop_steps :] = 0
    again = Rectification.from_road_mask(camera, by_hand, Pair.VP2_VP3, (320, 180), min_coverage=0.0)
    np.testing.assert_allclose(again.matrix, ruled.matrix, atol=1e-12)
    assert ruled.road_area > again.road_area  # of the uncropped mask


def test_covering_the_mask_itself_is_an_option(camera, road):
    rect = Rectification.from_road_mask(camera, road, Pair.VP1_VP2, (180, 320), cover="mask")
    assert rect.warp_mask(RoadMask(road).cropped(350 - 5 * rect.crop_steps)).mean() >= 0.8


def test_windows_fill_the_picture_and_agree_with_the_batch(camera):
    windows = np.array([[0, 0, 640, 360], [100, 80, 300, 200], [300, 100, 639, 359]], dtype=float)
    corners = windows[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2)
    for pair, size in SIZES.items():
        vps = np.stack([camera.vp1, camera.vp2, camera.vp3])
        matrices, valid = rectify_windows(vps, corners, pair, size)
        assert valid.all()
        for window, corner, matrix in zip(windows, corners, matrices, strict=True):
            rect = Rectification.from_window(camera, window, pair, size)
            np.testing.assert_allclose(rect.matrix, matrix, atol=1e-12)
            seen = rect.points(corner)
            np.testing.assert_allclose(seen.min(axis=0), 0, atol=1e-6)
            np.testing.assert_allclose(seen.max(axis=0), size, atol=1e-6)


def test_batches_flag_what_cannot_be_rectified(camera):
    vps = np.stack([camera.vp1, camera.vp2, camera.vp3])
    square = np.array([[100, 100], [300, 100], [300, 300], [100, 300.0]])
    bad = {
        "horizon crosses": square - [0, 200],
        "a point": np.full((4, 2), 200.0),
        "flat": np.array([[100, 100], [100, 300], [100, 200], [100, 250.0]]),
        "slanted and flat": np.array([[100, 100], [300, 300], [200, 200], [250, 250.0]]),
        "nan": np.full((4, 2), np.nan),
    }
    matrices, valid = rectify_windows(vps, [square, *bad.values()], Pair.VP1_VP2, (180, 320))
    assert dict(zip(["square", *bad], valid.tolist(), strict=True)) == {"square": True} | dict.fromkeys(bad, False)
    assert np.isfinite(matrices[0]).all()
    assert np.isnan(matrices[1:]).all()
    matrices, valid = rectify_windows(vps, np.empty((0, 4, 2)), Pair.VP1_VP2, (180, 320))
    assert matrices.shape == (0, 3, 3)
    assert valid.shape == (0,)


# -- warping ---------------------------------------------------------------------------------------


def test_points_go_both_ways(rectification):
    inside = np.random.default_rng(0).uniform([0, 0], rectification.size_wh, (5, 7, 2))
    np.testing.assert_allclose(rectification.points(rectification.points_back(inside)), inside, atol=1e-9)
    assert rectification.points(np.empty((0, 2))).shape == (0, 2)
    assert rectification.points([300.0, 200.0]).shape == (2,)


def test_points_beyond_the_line_at_infinity_are_nan(camera, road):
    rect = Rectification.from_road_mask(camera, road, Pair.VP1_VP2, (180, 320))
    assert np.isnan(rect.points([[300, -60], [300, 200]])).all(axis=1).tolist() == [True, False]


def test_the_sign_of_the_matrix_does_not_matter(rectification):
    flipped = Rectification(rectification.pair, rectification.size_wh, -3 * rectification.matrix, rectification.vpu)
    points = rectification.points_back(np.random.default_rng(0).uniform([0, 0], rectification.size_wh, (9, 2)))
    np.testing.assert_allclose(flipped.points(points), rectification.points(points), atol=1e-9)
    np.testing.assert_allclose(flipped.points_back(flipped.points(points)), points, atol=1e-9)


def test_boxes_warped_back_contain_the_original_ones(rectification):
    boxes = np.array([[250, 150, 330, 220], [300, 200, 301, 201]], dtype=float)
    rectified = rectification.boxes(boxes)
    inside = np.random.default_rng(0).uniform(boxes[0, :2], boxes[0, 2:], (500, 2))
    seen = rectification.points(inside)
    assert (seen >= rectified[0, :2]).all()
    assert (seen <= rectified[0, 2:]).all()
    back = rectification.boxes_back(rectified)
    assert (back[:, :2] <= boxes[:, :2]).all()
    assert (back[:, 2:] >= boxes[:, 2:]).all()
    assert rectification.boxes(np.empty((0, 4))).shape == (0, 4)


def test_images_land_where_points_do(rectification):
    def centroid(image):
        ys, xs = np.indices(image.shape)
        return np.array([(xs * image).sum(), (ys * image).sum()]) / image.sum() + 0.5  # pixels are areas

    rng = np.random.default_rng(0)
    for _ in range(10):
        middle = rectification.points_back(rng.uniform(0.35, 0.65, 2) * rectification.size_wh)
        column, row = middle.astype(int)
        frame = np.zeros((360, 640), np.float32)
        frame[row - 20 : row + 21, column - 20 : column + 21] = 1
        seen = rectification.warp_image(frame)
        assert seen.shape == rectification.size_wh[::-1]
        low, high = np.array([column - 20, row - 20]), np.array([column + 21, row + 21])
        corners = rectification.points([low, [high[0], low[1]], high, [low[0], high[1]]])
        exact = np.array(shapely.Polygon(corners).centroid.coords[0])
        np.testing.assert_allclose(centroid(seen), exact, atol=0.12)
        back = rectification.warp_image_back(seen)
        assert back.shape == frame.shape
        np.testing.assert_allclose(centroid(back), [column + 0.5, row + 0.5], atol=0.3)
    colour = np.zeros((360, 640, 3), np.uint8)
    assert rectification.warp_image(colour).shape == (*rectification.size_wh[::-1], 3)


def test_a_crop_is_warped_as_the_frame_it_was_cut_from(rectification):
    frame = np.random.default_rng(0).integers(0, 255, (360, 640, 3), dtype=np.uint8)
    frame = cv2.GaussianBlur(frame, (0, 0), 4)
    black = np.zeros_like(frame)
    black[120:260, 200:420] = frame[120:260, 200:420]
    seen = rectification.warp_image(frame[120:260, 200:420], origin_px=(200, 120))
    assert np.abs(seen.astype(int) - rectification.warp_image(black)).max() <= 1
    mask = frame[..., 0] > 127
    part = np.zeros_like(mask)
    part[120:260, 200:420] = mask[120:260, 200:420]
    np.testing.assert_array_equal(
        rectification.warp_mask(mask[120:260, 200:420], origin_px=(200, 120)), rectification.warp_mask(part)
    )


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("top", [1, 255])
def test_masks_of_any_type_are_warped_alike(rectification, road, dtype, top):
    mask = (road > 0).astype(dtype) * dtype(top)
    expected = rectification.warp_mask(road > 0)
    assert expected.mean() > 0.3
    np.testing.assert_array_equal(rectification.warp_mask(mask), expected)
    back = rectification.warp_mask_back(expected.astype(dtype) * dtype(top))
    np.testing.assert_array_equal(back, rectification.warp_mask_back(expected))
    inside = cv2.erode(road, np.ones((9, 9))) > 0
    inside[cv2.warpPerspective(np.ones(expected.shape, np.uint8), rectification.inverse, (640, 360)) == 0] = False
    assert back[inside].mean() > 0.98


def test_warping_back_needs_the_frames_size(rectification):
    bare = Rectification(rectification.pair, rectification.size_wh, rectification.matrix, rectification.vpu)
    image = np.zeros((*rectification.size_wh[::-1], 3), np.uint8)
    with pytest.raises(RectificationError, match="pass frame_wh"):
        bare.warp_image_back(image)
    assert bare.warp_image_back(image, (640, 360)).shape == (360, 640, 3)

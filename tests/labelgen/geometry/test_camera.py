"""Cameras: impossible inputs, the public distance convention, the road frame, projection."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
from random_cameras import random_camera

from labelgen.errors import CalibrationError
from labelgen.geometry import Camera, cuboid_sizes, road_cuboids

GOOD = {"vp1": [269.2, -43.6], "vp2": [12914.9, -43.6], "pp": [320.0, 180.0], "scale": 0.05}


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"vp2": [400.0, -43.6]}, "cannot be orthogonal"),
        ({"vp1": GOOD["vp2"], "vp2": GOOD["vp2"]}, "cannot be orthogonal"),
        ({"vp1": GOOD["pp"]}, "cannot be orthogonal"),
        ({"vp1": [269.2, 180.0], "vp2": [9000.0, 180.0]}, "lie on one line"),
        ({"vp1": [np.nan, 0]}, "vp1: expected two finite numbers"),
        ({"vp2": [np.inf, 0]}, "vp2: expected two finite numbers"),
        ({"vp1": [1e200, 3.0], "vp2": [-1e200, 5.0]}, "too far"),
        ({"pp": [1, 2, 3]}, "pp: expected two finite numbers"),
        ({"pp": None}, "pp: expected two finite numbers"),
        ({"vp1": "here"}, "vp1: expected two finite numbers"),
        ({"scale": 0}, "scale: expected a positive number, got 0"),
        ({"scale": -0.1}, "scale: expected a positive number"),
        ({"scale": np.nan}, "scale: expected a positive number"),
        ({"scale": np.inf}, "scale: expected a positive number"),
        ({"scale": "0.1"}, "scale: expected a number"),
        ({"scale": True}, "scale: expected a number"),
        ({"image_wh": (0, 360)}, "image_wh: expected two positive"),
        ({"image_wh": (640,)}, "image_wh: expected two positive"),
        ({"image_wh": (640.5, 360)}, "image_wh: expected two positive"),
        ({"image_wh": (640, np.nan)}, "image_wh: expected two positive"),
        ({"image_wh": 640}, "image_wh: expected two positive"),
    ],
)
def test_impossible_cameras_are_refused(changes, match):
    with pytest.raises(CalibrationError, match=match) as caught:
        Camera(**{**GOOD, "name": "east", **changes})
    assert "camera east" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_all_problems_are_named_at_once():
    with pytest.raises(CalibrationError) as caught:
        Camera([np.nan, 0], [1], [0, 0], -1, image_wh=(0, 0))
    assert all(name in str(caught.value) for name in ("vp1", "vp2", "scale", "image_wh"))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("\x00\xff", "not JSON"),
        ("[]", "no camera in it"),
        ("{}", "no camera in it; missing vp1, vp2, pp"),
        ('{"camera_calibration": null}', "no camera in it"),
        ('{"camera_calibration": {"vp1": [1, 2], "pp": [0, 0]}}', "missing vp2"),
        ('{"camera_calibration": {"vp1": [NaN, 2], "vp2": [1, 2], "pp": [0, 0]}}', "vp1: expected two finite"),
    ],
)
def test_files_without_a_camera_are_refused(tmp_path, text, match):
    path = tmp_path / "east.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(CalibrationError, match=match) as caught:
        Camera.load(path)
    assert "east.json" in str(caught.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(CalibrationError, match="no such file"):
        Camera.load(tmp_path / "east.json")
    with pytest.raises(CalibrationError, match=str(tmp_path)):
        Camera.load(tmp_path)


@pytest.mark.parametrize("scale", [0.05, None])
def test_written_and_read_again_it_is_the_same_camera(tmp_path, scale):
    camera = Camera(**{**GOOD, "scale": scale}, image_wh=[640, 360], name="east")
    path = tmp_path / "east.json"
    camera.save(path)
    again = Camera.load(path, image_wh=(640, 360))
    assert again == camera
    assert hash(again) == hash(camera)
    assert pickle.loads(pickle.dumps(camera)) == camera
    assert again != Camera(**{**GOOD, "scale": scale, "pp": [320.0, 181.0]}, image_wh=(640, 360), name="east")


def _published_distance(calibration: dict, a, b) -> float:
    """Distance of two road pixels as the public evaluation defines it, from its description alone."""
    vp1, vp2, pp = (np.array(calibration[k]) for k in ("vp1", "vp2", "pp"))
    focal = np.sqrt(-((vp1 - pp) @ (vp2 - pp)))
    direction_3 = np.cross(np.append(vp1 - pp, focal), np.append(vp2 - pp, focal))
    vp3 = direction_3[:2] / direction_3[2] * focal + pp
    normal = np.append(vp3 - pp, focal)
    normal /= np.linalg.norm(normal)
    centre = np.array([pp[0], pp[1], 0.0])

    def world(pixel):
        ray = np.append(np.array(pixel) - pp, focal)
        return centre - (normal @ centre + 10) / (normal @ ray) * ray

    return calibration["scale"] * float(np.linalg.norm(world(a) - world(b)))


def test_distances_are_those_of_the_public_convention():
    rng = np.random.default_rng(1)
    for _ in range(30):
        camera = random_camera(rng)
        pixels = camera.project(rng.uniform([5, -10], [80, 10], (8, 2)))
        metres = camera.road_points(pixels)
        for i, j in [(0, 1), (2, 3), (4, 5), (6, 7)]:
            expected = _published_distance(camera.to_dict()["camera_calibration"], pixels[i], pixels[j])
            assert np.linalg.norm(metres[i] - metres[j]) == pytest.approx(expected, rel=1e-9)


def test_road_points_and_projection_are_inverse():
    rng = np.random.default_rng(2)
    for _ in range(50):
        camera = random_camera(rng, roll_deg=20)
        metres = rng.uniform([2, -15], [150, 15], (40, 2))
        pixels = camera.project(metres)
        seen = np.isfinite(pixels).all(axis=1)
        assert seen.sum() > 20
        np.testing.assert_allclose(camera.road_points(pixels[seen]), metres[seen], rtol=1e-7, atol=1e-7)


def test_road_frame_axes():
    rng = np.random.default_rng(3)
    for _ in range(50):
        camera = random_camera(rng)
        np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(camera.axes) == pytest.approx(1)  # right-handed
        far = camera.project([[1e9, 0.0, 0.0]])[0]
        np.testing.assert_allclose(far, camera.vp1, rtol=1e-5)  # X runs towards VP1
        ground, above = camera.project([[60.0, 0.0, 0.0], [60.0, 0.0, 2.0]])
        assert above[1] < ground[1]  # Z is up: higher in the picture
        # On the vertical's line: the line through foot and top passes VP3.
        foot, top, vp3 = (np.append(p, 1) for p in (ground, above, camera.vp3))
        line = np.cross(foot, top)
        assert abs(line @ vp3) < 1e-6 * np.linalg.norm(line[:2]) * np.linalg.norm(vp3)
        # Y is to the left of somebody who looks towards VP1.
        left, right = camera.project([[60.0, 3.0, 0.0], [60.0, -3.0, 0.0]])
        assert np.cross(np.append(camera.vp1 - ground, 0), np.append(left - right, 0))[2] < 0


def test_known_camera():
    # By hand: (vp1 - pp).(vp2 - pp) = -20000 + 10000, so the focal length is 100; the cross product is
    # (0, 30000, 30000), so VP3 lies 100 px below pp: the camera looks down at 45 degrees, and the road seen at pp
    # is as far from the foot as the camera is high. Road axes: X = (-1, -1, 1) / sqrt 3, Y = (-2, 1, -1) / sqrt 6.
    camera = Camera([-100, 100], [200, 100], [0, 200], 0.1)
    assert camera.focal == pytest.approx(100)
    np.testing.assert_allclose(camera.vp3, [0, 300], atol=1e-9)
    assert camera.height_m == pytest.approx(0.1 * (200 / np.sqrt(2) + 10))
    expected = camera.height_m * np.array([np.sqrt(2 / 3), -np.sqrt(1 / 3)])
    np.testing.assert_allclose(camera.road_points([0, 200]), expected, rtol=1e-12)
    np.testing.assert_allclose(camera.project(expected), [0, 200], atol=1e-9)


def test_pixels_off_the_road(camera):
    above, on, below = [300.0, -80.0], [300.0, -43.6], [300.0, 200.0]
    for pixel in (above, on, [np.nan, 3.0]):
        with pytest.raises(CalibrationError, match="on or above the horizon"):
            camera.road_points([below, pixel])
    points = camera.road_points([above, on, below], invalid="nan")
    assert np.isnan(points).all(axis=1).tolist() == [True, True, False]


def test_points_behind_the_camera_have_no_pixel(camera):
    assert np.isnan(camera.project([[-50.0, 0.0, 0.0], [0.0, 0.0, camera.height_m]])).all()


def test_no_points_give_no_points(camera):
    assert camera.road_points(np.empty((0, 2))).shape == (0, 2)
    assert camera.project(np.empty((0, 3))).shape == (0, 2)


def test_without_a_scale_there_are_no_metres():
    camera = Camera(GOOD["vp1"], GOOD["vp2"], GOOD["pp"])
    with pytest.raises(CalibrationError, match="no scale"):
        camera.road_points([300, 200])
    with pytest.raises(CalibrationError, match="no scale"):
        camera.project([10.0, 0.0])


@pytest.mark.parametrize("factor", [0.5, 2.0, 1 / 3])
def test_a_resized_camera_measures_the_same_metres(camera, factor):
    small = camera.resized(factor)
    pixels = np.array([[300.0, 200.0], [500.0, 320.0], [10.0, 150.0]])
    np.testing.assert_allclose(small.road_points(pixels * factor), camera.road_points(pixels), rtol=1e-9)
    assert small.focal == pytest.approx(camera.focal * factor)
    assert small.image_wh == (round(640 * factor), round(360 * factor))


@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan, np.inf])
def test_impossible_resizing_is_refused(factor):
    camera = Camera(GOOD["vp1"], GOOD["vp2"], GOOD["pp"])
    with pytest.raises(CalibrationError, match="factor"):
        camera.resized(factor)


def test_cuboids_are_measured_exactly():
    rng = np.random.default_rng(4)
    for _ in range(20):
        camera = random_camera(rng)
        sizes = rng.uniform([3.5, 1.6, 1.3], [16, 2.6, 4], (10, 3))
        vertices = camera.project(road_cuboids(rng.uniform([40, -8], [90, 8], (10, 2)), sizes))
        # A top that reaches above the horizon is measured as well as any other.
        np.testing.assert_allclose(cuboid_sizes(vertices, camera), sizes, rtol=1e-6)


def test_cuboids_have_the_codecs_vertex_order():
    left, right = road_cuboids([[20.0, 4.0], [20.0, -4.0]], [[5.0, 2.0, 1.5]] * 2)
    for box, seen, hidden in ((left, 3.0, 5.0), (right, -3.0, -5.0)):  # the side facing Y = 0 is the seen one
        np.testing.assert_array_equal(box[:4, 0], [20, 20, 25, 25])
        np.testing.assert_array_equal(box[:4, 1], [hidden, seen, seen, hidden])
        np.testing.assert_array_equal(box[:4, 2], [1.5] * 4)
        np.testing.assert_array_equal(box[4:], box[:4] * [1, 1, 0])
    assert road_cuboids(np.empty((0, 2)), np.empty((0, 3))).shape == (0, 8, 3)


def test_cuboids_off_the_road_have_no_size(camera):
    vertices = camera.project(road_cuboids([[30.0, 2.0]], [[4.0, 1.8, 1.5]]))
    vertices[0, 6] = [300, -80]
    assert np.isnan(cuboid_sizes(vertices, camera)[0, 0])
    assert cuboid_sizes(np.empty((0, 8, 2)), camera).shape == (0, 3)


@pytest.mark.parametrize("scale", [0.05, None])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_byte_order_marks_and_other_encodings_are_read(tmp_path, scale, encoding):
    camera = Camera(**{**GOOD, "scale": scale}, image_wh=(640, 360), name="east")
    (tmp_path / "east.json").write_text(json.dumps(camera.to_dict()), encoding=encoding)
    assert Camera.load(tmp_path / "east.json") == camera


@pytest.mark.parametrize(("frame_wh", "factor"), [((1280, 720), 2.0), ((320, 180), 0.5), ((854, 480), 854 / 640)])
def test_a_calibration_of_another_size_is_scaled(tmp_path, frame_wh, factor):
    camera = Camera(**GOOD, image_wh=(640, 360), name="east")
    camera.save(tmp_path / "east.json")
    scaled = Camera.load(tmp_path / "east.json", image_wh=frame_wh)
    assert scaled.image_wh == frame_wh
    np.testing.assert_allclose(scaled.vp1, camera.vp1 * factor)
    points = np.array([[300.0, 300.0], [340.0, 250.0]])
    # Metres stay metres.
    np.testing.assert_allclose(scaled.road_points(points * factor), camera.road_points(points), rtol=1e-9)


@pytest.mark.parametrize("frame_wh", [(640, 480), (360, 640), (640, 352), (1920, 1088)])
def test_a_calibration_of_another_ratio_is_refused(tmp_path, frame_wh):
    Camera(**GOOD, image_wh=(640, 360)).save(tmp_path / "east.json")
    with pytest.raises(CalibrationError, match=f"of 640x360 px, but these are {frame_wh[0]}x{frame_wh[1]}"):
        Camera.load(tmp_path / "east.json", image_wh=frame_wh)


def test_a_size_that_is_none_is_refused(tmp_path):
    data = {**Camera(**GOOD).to_dict(), "image_wh": [640, "wide"]}
    (tmp_path / "east.json").write_text(json.dumps(data))
    with pytest.raises(CalibrationError, match="image_wh: expected two positive whole numbers"):
        Camera.load(tmp_path / "east.json")


@pytest.mark.parametrize(
    ("pp", "frame_wh", "own_wh"),
    [
        ((320, 180), (640, 360), None),  # of these frames
        ((320, 180), (320, 180), (640, 360)),
        ((160, 90), (640, 360), (320, 180)),
        ((480, 270), (1280, 720), (960, 540)),  # near the middle, but exactly that of another size
        ((960, 540), (1280, 720), (1920, 1080)),
        ((427, 240), (1920, 1080), (854, 480)),  # a ratio but for the rounding of one side
        ((310.3, 174.5), (640, 360), None),  # measured, and on the diagonal of the frame
        ((352, 240), (720, 480), None),
    ],
)
def test_a_principal_point_shows_the_size_of_a_calibration(
    pp: tuple[float, float], frame_wh: tuple[int, int], own_wh: tuple[int, int] | None
) -> None:
    camera = Camera(np.subtract(pp, (100.0, 200.0)), np.add(pp, (3000.0, -220.0)), np.array(pp), 0.06)
    fitted = camera.fitted_to(frame_wh)
    assert camera.own_wh(frame_wh) == own_wh
    assert fitted.image_wh == frame_wh
    assert fitted.size_doubt() is None
    factor = 1.0 if own_wh is None else frame_wh[0] / own_wh[0]
    # Points of the scene keep their places on the road: distances are those of the camera's own frames.
    points = np.array([pp, (pp[0] + 30.0, pp[1] + 40.0)])
    assert fitted.road_points(points * factor) == pytest.approx(camera.road_points(points), rel=1e-9)


@pytest.mark.parametrize("frame_wh", [(640, 240), (320, 240), (1280, 360)])
def test_a_principal_point_far_from_the_middle_is_refused_or_told(frame_wh: tuple[int, int]) -> None:
    camera = Camera(**GOOD)  # its principal point is that of 640x360
    with pytest.raises(CalibrationError, match=r"is far from the middle .* state their size in the file"):
        camera.fitted_to(frame_wh)
    stated = Camera(**GOOD, image_wh=frame_wh)
    assert stated.fitted_to(frame_wh).size_doubt().endswith("right only where the frames are cropped")

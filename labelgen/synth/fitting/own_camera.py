"""Somebody's own camera as a scene: its road, its light and its faults, all taken from its video."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from labelgen.calibration.complete_scene import complete_scene
from labelgen.calibration.observation.collect import observe
from labelgen.datasets.scene import find_scene
from labelgen.errors import DataError
from labelgen.geometry import Camera
from labelgen.media.open_frames import open_frames
from labelgen.synth.fitting.footage import Footage, read_footage
from labelgen.synth.fitting.lanes import find_lanes
from labelgen.synth.fitting.lighting import (
    Tones,
    fit_to_details,
    fit_to_road,
    fit_to_shadows,
    fit_to_tones,
    footage_parts,
    tones_of,
)
from labelgen.synth.fitting.panel_noise import fit_to_panels
from labelgen.synth.fitting.sensor import fit_sensor
from labelgen.synth.fitting.sun import Shadows, find_shadows
from labelgen.synth.renderer.renderer import Placed, Renderer, covered_by
from labelgen.synth.scene.scene import FARTHEST_M, Lane, Scene, line_through, visible_range
from labelgen.synth.scene.traffic import random_traffic
from labelgen.synth.sensor.sensor import Sensor
from labelgen.synth.shading.lighting import Light, Weather, make_light

__all__ = ["OwnCamera", "load_own_camera"]

_DEPTH_M = 60.0
_LEAST_SEEN_M = 8.0
_TRY_FRAMES, _TRY_EVERY_S, _TRY_SEED, _TRY_TRAFFIC = 40, 2.0, 4, 20.0
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class OwnCamera:
    """A camera's road and what was measured on its video.

    Args:
        scene: with its picture.
        light: of the video.
        sensor: its faults.
        fps: frames per second.
        measured: what was found, in words, for the user.
    """

    scene: Scene
    light: Light
    sensor: Sensor
    fps: float
    measured: dict[str, str]


def load_own_camera(
    video: Path,
    folder: Path,
    rng: np.random.Generator,
    *,
    calibration: Path | None = None,
    road_mask: Path | None = None,
    heading: int | None = None,
    weather: Weather | None = None,
    sun: tuple[float, float] | None = None,
    plates: str | None = None,
) -> OwnCamera:
    """Everything that putting traffic into somebody's own video takes.

    Args:
        video: of a fixed camera above a straight road, or a folder of images.
        folder: where a calibration and a road mask made on the way are kept, below it by the video's name.
        rng: decides on what the video does not tell.
        calibration, road_mask: use these rather than NAME.calibration.json and NAME.mask.png beside the video.
        heading: +1 traffic drives away, -1 it comes closer; as seen in the video when None.
        weather: kind of light; by the shadows when None.
        sun: degrees, its height above the horizon and how far right of straight ahead it stands; by the shadows when
            None.
        plates: family of number plates of the vehicles by which colours are fitted; any when None.

    Raises:
        DataError: the video, its calibration or its road mask is missing, damaged or of another size.
        CalibrationError: there is none, and the video cannot carry one.
    """
    files = find_scene(video, calibration=calibration, road_mask=road_mask, may_lack=True)
    parts = complete_scene(files, folder / files.name)
    footage = read_footage(video)
    height, width = footage.empty.shape[:2]
    camera = parts.camera((width, height))
    road = parts.road().pixels
    if abs(road.shape[0] - height) > 1 or abs(road.shape[1] - width) > 1:
        raise DataError(
            f"{parts.mask_path}: {road.shape[1]}x{road.shape[0]}, but the video has {width}x{height}; "
            "make the mask with labelgen road-mask"
        )
    road = road[:height, :width]
    lanes, borders = find_lanes(camera, road, footage.empty, observe(open_frames(video)).tracks, heading)
    scene = _scene(parts.name, camera, lanes, borders, road, footage.empty)
    shadows = find_shadows(footage, camera, road)
    if sun is not None:
        shadows = replace(shadows, sun=_direction(*sun))
    weather = weather or (Weather.DAY if shadows.sunny else Weather.OVERCAST)
    sensor = fit_sensor(footage)
    light = fit_to_shadows(fit_to_road(make_light(weather, rng), footage.empty, road), shadows)
    vehicles = list(footage_parts(footage, road, shadows))
    assert sensor.noise_model is not None
    sensor = replace(sensor, noise_model=fit_to_panels(sensor.noise_model, vehicles))
    real = tones_of(vehicles)
    if real is not None:
        light, sensor = _fit_to_vehicles(light, sensor, real, scene, shadows, footage, plates)
    return OwnCamera(scene, light, sensor, footage.fps, _words(footage, scene, light, sensor, shadows, real))


def _direction(height_deg: float, right_deg: float) -> NDArray[np.float64]:
    """(3,) towards the sun in the road frame."""
    up, aside = np.radians(height_deg), np.radians(right_deg)
    return np.array([np.cos(up) * np.cos(aside), -np.cos(up) * np.sin(aside), np.sin(up)])


def _scene(
    name: str, camera: Camera, lanes: tuple[Lane, ...], borders: NDArray[np.float64], road: NDArray[np.bool_],
    empty: NDArray[np.uint8],
) -> Scene:  # fmt: skip
    """The road with three lines across, as far as it is seen, the one crossed last first."""
    measured = [lane for lane in lanes if lane.index is not None]
    middle = float(borders.mean())
    seen = visible_range(camera, middle)
    if seen is None or seen[1] - max(seen[0], 2.0) < _LEAST_SEEN_M:
        raise DataError(f"{name}: the picture shows less than {_LEAST_SEEN_M:.0f} m of the road; check its calibration")
    near = max(seen[0], 2.0) + 1.5
    far = min(seen[1] - 1.5, near + _DEPTH_M)
    marks = np.linspace(near + 1, far - 1, 3)
    if measured[0].heading > 0:
        marks = marks[::-1]
    across = tuple(line_through(camera, (x, borders[0]), (x, borders[-1])) for x in marks)
    along = tuple(line_through(camera, (near, y), (far, y)) for y in borders)
    rows, columns = np.nonzero(road)
    pick = slice(None, None, max(1, len(rows) // 20000))
    x = camera.road_points(np.stack([columns[pick], rows[pick]], axis=1) + 0.5, invalid="nan")[:, 0]
    reach = float(min(np.nanmax(x) + 30.0, FARTHEST_M))
    return Scene(name, camera, lanes, along, across, road, empty, (-25.0, reach))


def _fit_to_vehicles(
    light: Light, sensor: Sensor, real: Tones, scene: Scene, shadows: Shadows, footage: Footage,
    plates: str | None,
) -> tuple[Light, Sensor]:  # fmt: skip
    """Light and sensor with which drawn vehicles have the tones and details of real ones."""
    measured = sensor
    traffic = _some_traffic(scene, light, plates)
    for _ in range(_ROUNDS):
        # Looked at as the video is, so that what is taken for a vehicle is the same.
        looks, known = _drawn_looks(scene, light, sensor, traffic)
        drawn = tones_of(list(footage_parts(replace(footage, looks=looks), scene.road_mask, shadows, known)))
        if drawn is None:
            break
        sensor = fit_to_details(sensor, measured, real, drawn)
        # Tones change how dark shadows come out, so these are looked at again.
        light = fit_to_shadows(fit_to_tones(light, real, drawn), shadows)
    return light, sensor


def _some_traffic(scene: Scene, light: Light, plates: str | None) -> list[list[Placed]]:
    """What drives in the scene at several times."""
    trips = random_traffic(scene, _TRY_FRAMES * _TRY_EVERY_S, _TRY_SEED, per_minute=_TRY_TRAFFIC)
    moments: list[list[Placed]] = [[] for _ in range(_TRY_FRAMES)]
    for trip in trips:
        first, last = trip.span_s((0.0, _DEPTH_M))
        times = [k for k in range(_TRY_FRAMES) if first <= k * _TRY_EVERY_S <= last]
        if times and trip.kind != "motorcycle":
            vehicle = trip.vehicle(lamps=light.lamps, plates=plates)
            for k in times:
                centre = trip.near_point(k * _TRY_EVERY_S) + np.array([trip.size_lwh[0] / 2, 0.0])
                speed = trip.speed_ms(k * _TRY_EVERY_S)
                moments[k].append(Placed(trip.track_id, vehicle, centre, trip.lane.heading, speed))
    return moments


def _drawn_looks(
    scene: Scene, light: Light, sensor: Sensor, traffic: list[list[Placed]]
) -> tuple[NDArray[np.uint8], list[NDArray[np.bool_]]]:
    """(K, H, W, 3) BGR, traffic drawn into the scene, and for each look (H, W) where vehicles are."""
    assert scene.background is not None
    renderer = Renderer(scene.camera, scene.background, light, seed=0, sensor=sensor)
    looks, known = [], []
    for number, placed in enumerate(traffic):
        look, drawn = renderer.frame(placed, number=number)
        looks.append(look)
        known.append(covered_by(drawn, look.shape[:2]))
    return np.stack(looks), known


def _words(
    footage: Footage, scene: Scene, light: Light, sensor: Sensor, shadows: Shadows, real: Tones | None
) -> dict[str, str]:
    ways = {1: "away", -1: "closer"}
    lanes = ", ".join(f"{lane.y0:.1f} m {ways[lane.heading]}" for lane in scene.lanes)
    shadow = "none stands out" if shadows.left is None else f"{shadows.left:.0%} of the road's brightness"
    sun = light.sun_direction
    height, aside = np.degrees(np.arcsin(sun[2])), np.degrees(np.arctan2(-sun[1], sun[0]))
    where = f"{height:.0f} degrees high, {aside:.0f} right of ahead" if shadows.sunny else "hidden"
    if shadows.sunny and shadows.sun is None:
        where += ", which is a guess: shadows do not tell; give --sun"
    assert sensor.noise_model is not None
    noise = sensor.noise_model.grey[len(sensor.noise_model.grey) // 2]
    return {
        "lanes": lanes,
        "picture moved": f"{footage.shake_px:.2f} px",
        "shadows": shadow,
        "sun": where,
        "noise": f"{noise:.1f} grey levels on middle grey",
        "lens": f"blur {sensor.blur_px:.1f} px, sharpening {sensor.sharpen:.1f}, colours smeared {sensor.smear:.4f}",
        "compression": f"as H.264 at crf {sensor.crf}",
        "vehicles looked at": "too few" if real is None else f"{real.vehicles} times",
    }

"""A synthetic data set in the layout of BoxCars116k.

dataset.pkl, json_data/dataset.json   cameras and samples, the same content
images/CAMERA/N/VEHICLE_INSTANCE.png  crops
atlas.pkl                             the same crops, JPEG-encoded: [vehicle][instance]
classification_splits.pkl             which vehicle serves for what
"""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import make_folder, write_atomic
from labelgen.errors import OutputError
from labelgen.geometry import Camera, road_cuboids
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.scene.road_image import draw_scene
from labelgen.synth.scene.scene import Scene, procedural_scene
from labelgen.synth.scene.static_layer import StaticLayer
from labelgen.synth.scene.traffic import Trip, random_traffic
from labelgen.synth.shading.lighting import Light, Weather, make_light, varied_light
from labelgen.synth.truth.session import place
from labelgen.synth.truth.writer import own_front_first

__all__ = ["CAMERAS", "write_boxcars_tree"]

CAMERAS = ("botanicka", "uvoz", "tesnohlidka", "prahaVinohradska", "svratka", "stefanikova", "videnska", "konecneho")
"""Camera names, in the order they are used; four of them are those the published training leaves out."""

_FRAME_WH = (1920, 1080)
_INSTANCES = 4
_MIN_HEIGHT = 40.0
_WINDOW_S = 60.0


@dataclass(frozen=True, eq=False)
class _View:
    """One vehicle at one time, as its camera sees it."""

    trip: Trip
    time_s: float
    vertices_px: NDArray[np.float64]


def write_boxcars_tree(
    out: Path, vehicles: int = 60, seed: int = 0, *, overwrite: bool = False, progress: bool = False
) -> dict[str, Any]:
    """Write a BoxCars116k tree.

    Args:
        out: folder.
        vehicles: number of samples (tracks), with up to four instances each.
        seed: everything comes from it.
        overwrite: whether an existing tree may be replaced.
        progress: show a bar.

    Returns:
        Summary: samples, instances, cameras, the root folder.

    Raises:
        OutputError: the tree exists.
    """
    from tqdm import tqdm

    if (out / "dataset.pkl").exists() and not overwrite:
        raise OutputError(f"{out}: a data set is there already; use --overwrite or another --out")
    shutil.rmtree(out / "images", ignore_errors=True)
    make_folder(out / "json_data")
    names = CAMERAS[: max(1, min(len(CAMERAS), vehicles // 2))]
    shares = [len(range(k, vehicles, len(names))) for k in range(len(names))]
    cameras: dict[str, Any] = {}
    samples: list[dict[str, Any]] = []
    atlas: list[list[NDArray[np.uint8]]] = []
    with tqdm(total=vehicles, unit="vehicle", disable=not progress, desc="boxcars") as bar:
        for number, (name, count) in enumerate(zip(names, shares, strict=True)):
            scene, light, static_layer = _camera_scene(name, seed, number)
            cameras[name] = _camera_entry(scene.camera)
            for sample, crops in _samples(
                scene, light, static_layer, count, seed, number, len(samples), out / "images"
            ):
                samples.append(sample)
                atlas.append(crops)
                bar.update()
    dataset = {"cameras": cameras, "samples": samples}
    for path, content in (
        (out / "dataset.pkl", dataset),
        (out / "atlas.pkl", atlas),
        (out / "classification_splits.pkl", _splits(samples, seed)),
    ):
        write_atomic(path, pickle.dumps(content, protocol=2))
    write_atomic(out / "json_data" / "dataset.json", json.dumps(dataset).encode())
    instances = sum(len(s["instances"]) for s in samples)
    return {"samples": len(samples), "instances": instances, "cameras": len(cameras), "root": str(out)}


def _camera_scene(name: str, seed: int, number: int) -> tuple[Scene, Light, StaticLayer | None]:
    rng = np.random.default_rng([seed, 21, number])
    scene = procedural_scene(rng, _FRAME_WH, name=name, both_ways=True)
    weather = (Weather.DAY, Weather.OVERCAST, Weather.OVERCAST, Weather.RAIN)[number % 4]
    light = varied_light(make_light(weather, rng), rng)
    background, static_layer = draw_scene(scene, light, rng)
    return replace(scene, background=background), light, static_layer


def _camera_entry(camera: Camera) -> dict[str, Any]:
    return {key: getattr(camera, key).tolist() for key in ("vp1", "vp2", "vp3", "pp")}


def _views(scene: Scene, trip: Trip) -> list[_View]:
    """Up to four times at which the whole vehicle is in the frame and large enough, evenly spread."""
    start, end = trip.span_s(scene.x_range)
    times = np.arange(max(start, 0.0), end, 0.08)
    if not len(times):
        return []
    near = np.stack([trip.near_point(t) for t in times])
    pixels = scene.camera.project(road_cuboids(near, np.tile(trip.size_lwh, (len(times), 1))))
    with np.errstate(invalid="ignore"):
        inside = ((pixels > 12) & (pixels < np.array(_FRAME_WH) - 12)).all(axis=(1, 2))
        inside &= np.ptp(pixels[..., 1], axis=1) > _MIN_HEIGHT
    good = np.flatnonzero(inside)
    if len(good) < 2:
        return []
    chosen = np.unique(good[np.linspace(0, len(good) - 1, min(_INSTANCES, len(good))).astype(int)])
    return [_View(trip, float(times[k]), pixels[k]) for k in chosen]


def _samples(
    scene: Scene,
    light: Light,
    static_layer: StaticLayer | None,
    count: int,
    seed: int,
    number: int,
    first: int,
    images: Path,
) -> Iterator[tuple[dict[str, Any], list[NDArray[np.uint8]]]]:
    """`count` vehicles of one camera, half of them driving away where there are such."""
    trips = random_traffic(scene, _WINDOW_S * max(1, count / 10), seed * 1009 + number, per_minute=14)
    rng = np.random.default_rng([seed, 22, number])
    candidates = [(trip, views) for trip in trips if (views := _views(scene, trip))]
    rng.shuffle(candidates)
    ways = [[c for c in candidates if c[0].lane.heading == h] for h in (-1, 1)]
    chosen = [way[k] for k in range(max(map(len, ways))) for way in ways if k < len(way)][:count]
    assert scene.background is not None
    renderer = Renderer(scene.camera, scene.background, light, seed=seed * 1009 + number, static_layer=static_layer)
    for index, (trip, views) in enumerate(chosen):
        vehicle_id = first + index
        instances, crops = [], []
        for instance, view in enumerate(views):
            image = _frame(scene, renderer, trips, view, light, vehicle_id * 10 + instance)
            entry, crop = _instance(scene, view, image, vehicle_id, instance, rng)
            path = images / entry["path"]
            make_folder(path.parent)
            write_atomic(path, bytes(cv2.imencode(".png", crop)[1]))
            crops.append(cv2.imencode(".jpg", crop, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].reshape(-1))
            instances.append(entry)
        sample = {
            "camera": scene.name,
            "to_camera": trip.lane.heading < 0,
            "annotation": f"synthetic {trip.kind}",
            "instances": instances,
        }
        yield sample, crops


def _frame(
    scene: Scene, renderer: Renderer, trips: list[Trip], view: _View, light: Light, number: int
) -> NDArray[np.uint8]:
    here = []
    for trip in trips:
        start, end = trip.span_s(scene.x_range)
        close = abs(trip.near_x(view.time_s) - view.trip.near_x(view.time_s)) < 25
        if start <= view.time_s <= end and close:
            here.append(place(trip, trip.vehicle(lamps=light.lamps), view.time_s))
    image, _ = renderer.frame(here, number=number)
    return image


def _instance(
    scene: Scene, view: _View, image: NDArray[np.uint8], vehicle_id: int, instance: int, rng: np.random.Generator
) -> tuple[dict[str, Any], NDArray[np.uint8]]:
    low, high = view.vertices_px.min(axis=0), view.vertices_px.max(axis=0)
    margin = rng.uniform(0.02, 0.10, 4) * np.tile(high - low, 2) + 3
    x0, y0 = np.maximum(np.floor(low - margin[:2]), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin[2:]), _FRAME_WH).astype(int)
    entry = {
        "2DBB": [float(v) for v in (*low, *(high - low))],
        "3DBB": own_front_first(view.vertices_px, view.trip.lane.heading).tolist(),
        "3DBB_offset": [float(x0), float(y0)],
        "instance_id": instance,
        "path": f"{scene.name}/1/{vehicle_id:06d}_{instance:03d}.png",
    }
    return entry, np.ascontiguousarray(image[y0:y1, x0:x1])


def _splits(samples: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """One split by body type: of every ten vehicles seven train, one validates, two test."""
    kinds = sorted({s["annotation"] for s in samples})
    order = np.random.default_rng([seed, 23]).permutation(len(samples)).tolist()
    parts: dict[str, Any] = {"train": [], "validation": [], "test": []}
    for rank, vehicle_id in enumerate(order):
        part = "train" if rank % 10 < 7 else "validation" if rank % 10 == 7 else "test"
        parts[part].append((vehicle_id, kinds.index(samples[vehicle_id]["annotation"])))
    return {"body": {**parts, "types_mapping": {kind: k for k, kind in enumerate(kinds)}}}

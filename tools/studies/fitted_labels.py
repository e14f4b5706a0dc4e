r"""How near labels from masks of real cars come to exact 3D boxes, by rule: surface meshes driven past real cameras.

    python -m tools.studies.fitted_labels --real DIR [--out docs/studies/fitted-labels.md] [--count 8] [--worse]

DIR holds brnocompspeed/dataset, brnocompspeed/results and vehicles/*.npz. Only numbers leave it. Each mesh drives along
a lane at one speed, away from the camera or towards it; its masks are exact. The true 3D box is the cuboid of the body,
its width taken below half its height: wing mirrors are no part of it. Labels are made by the functions of
`labelgen bcs-masks`, passages included: all vehicles of a scene drive in one video, one after the other.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from labelgen.choices import Rule
from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import Camera, Rectification, decode_boxes, encode_boxes, road_cuboids
from labelgen.geometry.boxes import iou_matrix
from labelgen.geometry.cuboid import cuboid_sizes
from labelgen.geometry.homography import Array
from labelgen.labeling import label_masks
from labelgen.labeling.fitted.label import SeenFrame, label_passages
from labelgen.labeling.fitted.settings import EXACT_MASKS, NETWORK_MASKS, SILHOUETTE_MASKS, MaskErrors
from labelgen.labels import Labels
from labelgen.masks import InstanceMasks
from tools.studies.cuboid_labels import SIZES, Scene, load_scenes
from tools.studies.worse_masks import WORSE

__all__ = ["CarMesh", "Look", "Result", "drive", "load_meshes", "main", "measure", "page"]

STEPS_S = {"every 0.08 s": 0.08, "every 0.5 s": 0.5, "single sightings": 0.0}
_KMH = (60.0, 110.0)
_FARTHEST_M = 120.0
_PAUSE_S = 30.0
"""Time between two vehicles of one video, seconds: none is joined with the next."""
_FEWEST = 4
_OVERSAMPLING = 4
_LOWER = 0.5


@dataclass(frozen=True, eq=False)
class CarMesh:
    """One car.

    Args:
        name: of the model.
        kind: type of the car as the data set names it.
        vertices: (V, 3) metres: x ahead, y to the left, z up, the middle of its cuboid at x = y = 0.
        faces: (F, 3) numbers of vertices.
        size_lwh: (3,) metres of its cuboid.
    """

    name: str
    kind: str
    vertices: Array
    faces: NDArray[np.int64]
    size_lwh: Array


@dataclass(frozen=True, eq=False)
class Look:
    """One car in one frame.

    Args:
        vehicle: number of the passage.
        mesh: number of the car.
        time_s: seconds.
        near_xy: (2,) metres, middle of the cuboid's near bottom edge.
        masks: its mask, as a frame's only one.
    """

    vehicle: int
    mesh: int
    time_s: float
    near_xy: Array
    masks: InstanceMasks


@dataclass
class Result:
    """Errors of labels; all lists have one entry per label.

    Args:
        iou: of the 2D boxes.
        cc: label minus exact.
        size: ratio of length, width and height to the exact ones, minus 1.
        contact_m: label minus exact, along and across the road.
        stated: errors of x0, y0, x1, y1, c_c in stated standard deviations.
        kind: type of the car.
        missing: looks that got no label.
        seconds: processor time.
    """

    iou: list[float] = field(default_factory=list)
    cc: list[float] = field(default_factory=list)
    size: list[Array] = field(default_factory=list)
    contact_m: list[Array] = field(default_factory=list)
    stated: list[Array] = field(default_factory=list)
    kind: list[str] = field(default_factory=list)
    missing: int = 0
    seconds: float = 0.0


def load_meshes(root: Path) -> list[CarMesh]:
    """Return the cars of `root`/vehicles.

    Raises:
        DataError: there are none.
    """
    meshes = []
    for path in sorted((root / "vehicles").glob("*.npz")):
        with np.load(path) as file:
            x, y, z = file["vertices"].astype(np.float64).T
            vertices, faces, kind = np.stack([z, -x, y], axis=1), file["faces"].astype(np.int64), str(file["car_type"])
        vertices[:, 2] -= vertices[:, 2].min()
        lower = vertices[vertices[:, 2] < _LOWER * vertices[:, 2].max(), 1]
        vertices[:, 1] -= (lower.min() + lower.max()) / 2
        vertices[:, 0] -= (vertices[:, 0].min() + vertices[:, 0].max()) / 2
        size = np.array([np.ptp(vertices[:, 0]), np.ptp(lower), vertices[:, 2].max()])
        meshes.append(CarMesh(path.stem, kind, vertices, faces, size))
    if not meshes:
        raise DataError(f"{root}: no vehicles/*.npz in it; give --real or set LABELGEN_REAL_DATA")
    return meshes


def rasterise(triangles_px: Array, frame_wh: tuple[int, int]) -> tuple[NDArray[np.bool_], tuple[int, int]] | None:
    """Return the pixels that triangles (F, 3, 2) cover by half or more, and where they begin; None for none."""
    low = np.maximum(np.floor(triangles_px.min(axis=(0, 1))).astype(int) - 1, 0)
    high = np.minimum(np.ceil(triangles_px.max(axis=(0, 1))).astype(int) + 1, frame_wh)
    if (high <= low).any():
        return None
    width, height = (high - low).tolist()
    k = _OVERSAMPLING
    canvas = np.zeros((height * k, width * k), dtype=np.uint8)
    fine = np.round(((triangles_px - low) * k - 0.5) * 16).astype(np.int32)
    for triangle in fine:
        cv2.fillConvexPoly(canvas, triangle, 255, lineType=8, shift=4)
    mask = canvas.reshape(height, k, width, k).mean(axis=(1, 3)) > 127
    return (mask, (int(low[0]), int(low[1]))) if mask.any() else None


def drive(scene: Scene, meshes: Sequence[CarMesh], count: int, seed: int, step_s: float = 0.08) -> list[Look]:
    """Return the looks at `count` cars that drive through a scene, one after the other.

    Args:
        scene: camera and road.
        meshes: of which cars are drawn.
        count: of passages.
        seed: of cars, lanes, directions and speeds.
        step_s: seconds between two looks.
    """
    camera = scene.camera
    assert camera.image_wh is not None
    rng = np.random.default_rng([seed, 5])
    rows, columns = np.nonzero(scene.road.pixels)
    pixels = np.stack([columns, rows], axis=1)[rng.integers(0, len(rows), 6000)] + 0.5
    ground = camera.road_points(pixels, invalid="nan")
    ground = ground[np.isfinite(ground).all(axis=1) & (ground[:, 0] < _FARTHEST_M)]
    looks: list[Look] = []
    passed = 0
    for _ in range(40 * count):
        number, heading, lane = (
            int(rng.integers(len(meshes))),
            int(rng.choice([-1, 1])),
            float(rng.choice(ground[:, 1])),
        )
        along = ground[np.abs(ground[:, 1] - lane) < 0.5, 0]
        step = rng.uniform(*_KMH) / 3.6 * step_s
        x = along.min() + rng.uniform(0, step) + np.arange(int(np.ptp(along) / step)) * step
        places = np.stack([x, np.full(len(x), lane)], axis=1)[::heading]
        seen = [_look(camera, meshes[number], heading, near) for near in places]
        start = (passed + 1) * _PAUSE_S
        found = [
            Look(passed, number, start + k * step_s, places[k], masks)
            for k, masks in enumerate(seen)
            if masks is not None
        ]
        if len(found) >= _FEWEST:
            looks += found
            passed += 1
        if passed == count:
            break
    return looks


def _look(camera: Camera, mesh: CarMesh, heading: int, near: Array) -> InstanceMasks | None:
    """Return the mask of a car; None where its cuboid does not lie wholly inside the frame."""
    assert camera.image_wh is not None
    corners = camera.project(road_cuboids(near[None], mesh.size_lwh[None]))
    with np.errstate(invalid="ignore"):
        if not ((corners > 2) & (corners < np.array(camera.image_wh) - 2)).all():
            return None
    points = mesh.vertices * [heading, heading, 1] + [near[0] + mesh.size_lwh[0] / 2, near[1], 0]
    drawn = rasterise(camera.project(points)[mesh.faces], camera.image_wh)
    if drawn is None:
        return None
    return InstanceMasks.from_crops(camera.image_wh, [(drawn[1], drawn[0])], [0], [1.0])


def measure(
    scene: Scene, meshes: Sequence[CarMesh], looks: Sequence[Look], rectification: Rectification, rule: Rule,
    step: str, errors: MaskErrors = EXACT_MASKS, worsen: Callable[[InstanceMasks, int], InstanceMasks] | None = None,
) -> Result:  # fmt: skip
    """Label looks and compare with the exact 3D boxes.

    Args:
        scene: of the looks.
        meshes: of the cars.
        looks: in the order of time.
        rectification: of the scene.
        rule: of the labels.
        step: one of `STEPS_S`.
        errors: of the masks, for the fitted rule.
        worsen: what is done to each mask before, with its number.
    """
    result = Result()
    road = np.ones(scene.road.pixels.shape, dtype=np.bool_)
    for group in _videos(looks, step):
        frames = []
        for number, look in enumerate(group):
            masks = look.masks if worsen is None else worsen(look.masks, round(look.time_s * 1000))
            frames.append(SeenFrame(number, look.time_s, masks))
        begin = process_time()
        if rule is Rule.FITTED:
            given = [g.labels for g in label_passages(frames, rectification, scene.camera, road, errors)]
        else:
            given = [label_masks(f.masks, rectification, scene.camera, road, rule).labels for f in frames]
        result.seconds += process_time() - begin
        for look, labels in zip(group, given, strict=True):
            _compare(result, labels, look, meshes[look.mesh], scene.camera, rectification)
    return result


def _videos(looks: Sequence[Look], step: str) -> Iterator[list[Look]]:
    """Yield the looks of a video at a step; each sighting as a video of its own for single ones."""
    if step == "single sightings":
        for look in _thinned(looks, 0.5):
            yield [look]
        return
    yield _thinned(looks, STEPS_S[step])


def _thinned(looks: Sequence[Look], step_s: float) -> list[Look]:
    kept: list[Look] = []
    for look in looks:
        if not kept or look.vehicle != kept[-1].vehicle or look.time_s - kept[-1].time_s > step_s - 0.04:
            kept.append(look)
    return kept


def _compare(
    result: Result, labels: Labels, look: Look, mesh: CarMesh, camera: Camera, rectification: Rectification
) -> None:
    vertices = camera.project(road_cuboids(look.near_xy[None], mesh.size_lwh[None]))
    inside = rectification.points(vertices)
    if not (np.isfinite(inside).all() and ((inside > 0) & (inside < rectification.size_wh)).all()):
        return
    exact = encode_boxes(inside, rectification.vpu)
    if not decode_boxes(exact.boxes_xyxy, exact.cc, rectification.vpu)[1][0]:
        return
    if not len(labels):
        result.missing += 1
        return
    result.iou.append(float(iou_matrix(labels.boxes_xyxy[:1], exact.boxes_xyxy)[0, 0]))
    result.cc.append(float(labels.cc[0] - exact.cc[0]))
    decoded = rectification.points_back(labels.vertices(rectification.vpu)[0][:1])
    result.size.append(cuboid_sizes(decoded, camera)[0] / mesh.size_lwh - 1)
    contact = camera.road_points(decoded[0, 4:6], invalid="nan").mean(axis=0)
    result.contact_m.append(contact - look.near_xy)
    error = np.append(labels.boxes_xyxy[0] - exact.boxes_xyxy[0], labels.cc[0] - exact.cc[0])
    result.stated.append(error / labels.sigmas[0])
    result.kind.append(mesh.kind)


# -- the page ---------------------------------------------------------------------------------------------


def _join(results: Sequence[Result]) -> Result:
    joined = Result()
    for result in results:
        for name, value in vars(result).items():
            setattr(joined, name, getattr(joined, name) + value)
    return joined


def _row(name: str, result: Result) -> str:
    cc = np.abs(result.cc)
    size = 100 * np.nanmedian(np.abs(result.size), axis=0)
    along = np.abs(np.array(result.contact_m)[:, 0])
    covered = np.mean(np.abs(result.stated) < 1.96)
    cells = [
        name, f"{len(cc)}", f"{result.missing}",
        f"{np.median(result.iou):.3f}", f"{np.percentile(result.iou, 5):.3f}",
        f"{np.median(cc):.4f}", f"{np.percentile(cc, 95):.4f}",
        " / ".join(f"{s:.1f}" for s in size),
        f"{np.nanmedian(along):.2f}", f"{np.nanpercentile(along, 95):.2f}",
        f"{100 * covered:.0f}" if np.isfinite(result.stated).all() else "-",
        f"{1000 * result.seconds / max(1, len(cc) + result.missing):.1f}",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


_HEADER = (
    "| {} | n | no label | IoU median | p5 | c_c median | p95 | length / width / height, % | along, m | p95 "
    "| within, % | ms |\n| --- |" + " ---: |" * 11
)


def page(tables: dict[str, dict[str, Result]], count: int, scenes: int) -> str:
    """Return the Markdown page of tables of rows."""
    parts = [
        "# Labels from masks of real cars\n",
        f"Surface meshes of 40 real cars, driven past {scenes} real cameras, {count} passages in each, away from the",
        "camera and towards it; exact masks; the true 3D box is the cuboid of the body without its mirrors.",
        "Made by `python -m tools.studies.fitted_labels`.\n",
        "- **IoU** is that of the 2D boxes, **c_c** the absolute error, **p5** and **p95** percentiles.",
        "- Sizes are medians of absolute errors; **along** is the error of the contact point along the road.",
        "- **within** is the share of box sides and c_c that lie within 1.96 stated standard deviations.",
        "- **ms** is the processor time of a sighting, all of the labelling.\n",
    ]
    for title, rows in tables.items():
        parts.append(f"## {title}\n")
        parts.append(_HEADER.format("rule, looks"))
        parts += [_row(name, result) for name, result in rows.items() if result.iou]
        parts.append("")
    return "\n".join(parts)


def _errors_of(kind: str) -> MaskErrors:
    return {"exact": EXACT_MASKS, "with a shadow": SILHOUETTE_MASKS}.get(kind, NETWORK_MASKS)


def main(
    out: Annotated[Path, typer.Option("--out", help="The page, Markdown.")] = Path("docs/studies/fitted-labels.md"),
    real: Annotated[Path | None, typer.Option("--real", help="Folder of the real data.")] = None,
    count: Annotated[int, typer.Option(min=1, help="Passages per scene.")] = 8,
    seed: Annotated[int, typer.Option(help="Of cars, lanes and speeds.")] = 0,
    worse: Annotated[bool, typer.Option("--worse", help="Also masks with errors.")] = False,
) -> None:
    """Measure labels of all rules on masks of real cars."""
    from tqdm import tqdm

    root = real or Path(os.environ.get("LABELGEN_REAL_DATA", "."))
    scenes, meshes = load_scenes(root), load_meshes(root)
    parts: dict[str, dict[str, list[Result]]] = {}
    for number, scene in enumerate(tqdm(scenes, unit="scene")):
        looks = drive(scene, meshes, count, seed * 100 + number)
        for pair, size in SIZES.items():
            rect = Rectification.from_road_mask(scene.camera, scene.road, pair, size)
            rows = parts.setdefault(f"{pair}, {size[0]}x{size[1]}", {})
            for rule in Rule:
                for step in STEPS_S if rule is Rule.FITTED else ("every 0.5 s",):
                    result = measure(scene, meshes, looks, rect, rule, step)
                    rows.setdefault(f"{rule}, {step}", []).append(result)
            if not worse:
                continue
            rows = parts.setdefault(f"{pair}, masks with errors, fitted, every 0.5 s", {})
            for kind, worsen in WORSE.items():
                result = measure(scene, meshes, looks, rect, Rule.FITTED, "every 0.5 s", _errors_of(kind), worsen)
                rows.setdefault(kind, []).append(result)
    tables = {title: {name: _join(results) for name, results in rows.items()} for title, rows in parts.items()}
    out.write_text(page(tables, count, len(scenes)), encoding="utf-8")


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None

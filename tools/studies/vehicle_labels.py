r"""How near labels from exact masks come to exact 3D boxes: rendered vehicles of every body type.

    python -m tools.studies.vehicle_labels --out docs/studies/synthetic-labels.md --pictures docs/pictures \
        [--real DIR] [--count 4]

Every vehicle stands alone and wholly inside the picture, so that what is measured is the method's own error: real
vehicles are not boxes. DIR holds brnocompspeed/dataset and brnocompspeed/results; only numbers leave it, pictures
are of made-up roads alone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from labelgen.drawing import crop_around, draw_box3d, draw_text, tile_pictures
from labelgen.errors import LabelgenError
from labelgen.geometry import (
    Pair,
    Rectification,
    RectifiedOutline,
    RoadMask,
    Rule,
    decode_boxes,
    encode_boxes,
    label_outlines,
    rectified_outline,
    road_cuboids,
)
from labelgen.synth.renderer.placed_vehicle import PlacedVehicle
from labelgen.synth.renderer.renderer import Renderer
from labelgen.synth.scene.road_image import draw_road
from labelgen.synth.scene.scene import RoadScene, procedural_scene
from labelgen.synth.shading.lighting import Weather, make_light
from labelgen.synth.vehicle.body_types import BODY_TYPES
from labelgen.synth.vehicle.vehicle import VehicleModel, make_vehicle
from tools.studies.cuboid_labels import TANGENT_RULES

__all__ = ["HEIGHTS", "PAIRS", "Case", "main", "measure_scene", "page"]

HEIGHTS = (20, 40, 80)
"""Heights of the exact 2D box, rectified px; each stands for what is nearest to it on a logarithmic scale."""
_TRIED = 1000
# Only few scenes show the road so far that these occur.
_MORE = {(Pair.VP1_VP2, 20): 6, (Pair.VP1_VP2, 40): 2, (Pair.VP2_VP3, 20): 2}
_FEWEST = 10
_LOOKS = 3
_FARTHEST_M = 400.0
_DEPTHS_M = (60.0, 130.0, 250.0, 400.0)
PAIRS = {Pair.VP2_VP3: (640, 360), Pair.VP1_VP2: (360, 640)}


@dataclass(frozen=True, eq=False)
class Case:
    """One vehicle in one rectified image.

    Args:
        scene: which scene.
        pair: which rectification.
        kind: body type.
        seed: of its looks.
        heading: +1 away from the camera, -1 towards it.
        near_xy: (2,) metres.
        height_px: of the exact 2D box.
        iou: of the mask's 2D box with the exact one.
        box_xyxy: (4,) the mask's 2D box.
        exact_cc: c_c of the exact 3D box.
        cc: by rule.
    """

    scene: int
    pair: Pair
    kind: str
    seed: int
    heading: int
    near_xy: NDArray[np.float64]
    height_px: float
    iou: float
    box_xyxy: NDArray[np.float64]
    exact_cc: float
    cc: dict[Rule, float]


def _iou(a: NDArray[Any], b: NDArray[Any]) -> float:
    wh = np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None)
    inner = float(wh.prod())
    return inner / float((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - inner)


def _rectifications(scene: RoadScene) -> dict[Pair, Rectification]:
    mask = RoadMask(scene.road_mask)
    return {pair: Rectification.from_road_mask(scene.camera, mask, pair, size) for pair, size in PAIRS.items()}


def _spots(scene: RoadScene, rng: np.random.Generator) -> NDArray[np.float64]:
    """(N, 2) metres on the road, spread evenly over the logarithm of the distance."""
    rows, columns = np.nonzero(scene.road_mask)
    pick = rng.integers(0, len(rows), 4000)
    ground = scene.camera.road_points(np.stack([columns[pick], rows[pick]], axis=1) + 0.5, invalid="nan")
    ground = ground[np.isfinite(ground).all(axis=1) & (ground[:, 0] < _FARTHEST_M)]
    # Pixels crowd near the camera as the inverse cube of the distance.
    weight = np.hypot(ground[:, 0], ground[:, 1])
    return np.asarray(ground[rng.choice(len(ground), _TRIED, p=weight / weight.sum())])


def measure_scene(scene: RoadScene, number: int, count: int, seed: int, kinds: list[str] | None = None) -> list[Case]:
    """Cases of one scene: `count` places per body type, rectification and box height, where there are so many.

    Args:
        scene: its picture is not needed.
        number: of the scene, to find it again.
        count: vehicles per body type, rectification and box height.
        seed: what they look like and where they stand.
        kinds: body types; all when None, and "box".
    """
    assert scene.camera.image_wh is not None
    size = scene.camera.image_wh
    light = make_light(Weather.OVERCAST, np.random.default_rng(0))
    renderer = Renderer(scene.camera, np.zeros((size[1], size[0], 3), np.uint8), light, seed=0)
    rects = _rectifications(scene)
    cases: list[Case] = []
    for place, kind in enumerate(kinds or [*BODY_TYPES, "box"]):
        rng = np.random.default_rng([seed, number, place])
        pool = rng.integers(1 << 30, size=_LOOKS * count)
        still = {(pair, height): count * _MORE.get((pair, height), 1) for pair in PAIRS for height in HEIGHTS}
        for near in _spots(scene, rng):
            looks, heading = int(rng.choice(pool)), int(rng.choice([-1, 1]))
            placed = _placed(kind, looks, heading, near)
            drawn = None
            for pair, rect in rects.items():
                exact = _exact(scene, rect, placed, near)
                height = None if exact is None else _nearest(float(exact[0][3] - exact[0][1]))
                if exact is None or height is None or not still[pair, height]:
                    continue
                drawn = drawn or renderer.truth([placed])
                case = _case(rect, drawn[0], exact, number, pair, kind, looks, heading, near)
                if case is not None:
                    still[pair, height] -= 1
                    cases.append(case)
            if not any(still.values()):
                break
    return cases


@lru_cache(maxsize=64)
def _vehicle(kind: str, looks: int) -> VehicleModel:
    return make_vehicle(kind, np.random.default_rng(looks))


def _placed(kind: str, looks: int, heading: int, near: NDArray[Any]) -> PlacedVehicle:
    vehicle = _vehicle(kind, looks)
    return PlacedVehicle(1, vehicle, near + np.array([vehicle.size_lwh[0] / 2, 0.0]), heading, 0.0)


def _exact(
    scene: RoadScene, rect: Rectification, placed: PlacedVehicle, near: NDArray[Any]
) -> tuple[NDArray[np.float64], float] | None:
    """2D box (4,) and c_c of the exact 3D box; None where it does not lie wholly inside both pictures."""
    vertices = scene.camera.project(road_cuboids(near[None], placed.vehicle.size_lwh[None]))
    if not (
        np.isfinite(vertices).all() and (vertices > 1).all() and (vertices < np.array(scene.camera.image_wh) - 1).all()
    ):
        return None
    inside = rect.points(vertices)
    if not (np.isfinite(inside).all() and (inside > 0).all() and (inside < rect.size_wh).all()):
        return None
    exact = encode_boxes(inside, rect.vpu)
    if not decode_boxes(exact.boxes_xyxy, exact.cc, rect.vpu)[1][0]:
        return None
    return exact.boxes_xyxy[0], float(exact.cc[0])


def _case(
    rect: Rectification, drawn: Any, exact: tuple[NDArray[np.float64], float], number: int, pair: Pair, kind: str,
    looks: int, heading: int, near: NDArray[Any],
) -> Case | None:  # fmt: skip
    """The label of a drawn vehicle beside its exact one; None where it gets none."""
    outline: RectifiedOutline | None = rectified_outline(rect, drawn.mask, drawn.origin_px)
    if outline is None:
        return None
    found = {rule: label_outlines([outline], rect.vpu, rule) for rule in TANGENT_RULES}
    if not all(label.valid[0] for label in found.values()):
        return None
    box, (wanted, cc) = found[Rule.WIDER].boxes_xyxy[0], exact
    return Case(
        number, pair, kind, looks, heading, near, float(wanted[3] - wanted[1]), _iou(box, wanted), box, cc,
        {rule: float(label.cc[0]) for rule, label in found.items()},
    )  # fmt: skip


# -- the page ---------------------------------------------------------------------------------------------


def _nearest(height_px: float) -> int | None:
    """The one of `HEIGHTS` that a box of this height stands for, if any."""
    nearest = min(HEIGHTS, key=lambda h: abs(np.log(height_px / h)))
    return nearest if abs(np.log(height_px / nearest)) <= np.log(2) / 2 else None


def _bin(case: Case) -> int | None:
    return _nearest(case.height_px)


def _row(cases: list[Case]) -> str:
    iou = np.percentile([c.iou for c in cases], [50, 5, 1])
    cells = [str(len(cases)), *(f"{v:.3f}" for v in iou)]
    for rule in TANGENT_RULES:
        error = np.array([c.cc[rule] - c.exact_cc for c in cases])
        cells += [f"{v:.3f}" for v in np.percentile(np.abs(error), [50, 95, 99])] + [f"{error.mean():+.3f}"]
    return " | ".join(cells)


_HEADER = (
    "n | IoU median | p5 | p1 | wider: median | p95 | p99 | bias | conditioned: median | p95 | p99 | bias |\n"
)  # fmt: skip


def _table(first: str, groups: dict[str, list[Case]]) -> str:
    lines = [f"| {first} | {_HEADER}| --- {'| ---: ' * 12}|"]
    lines += [f"| {name} | {_row(cases)} |" for name, cases in groups.items() if len(cases) >= _FEWEST]
    return "\n".join(lines)


def page(cases: list[Case], scenes: int, real: int) -> str:
    """The Markdown page."""
    kinds = [*BODY_TYPES, "box"]
    parts = [
        "# Labels from masks of drawn vehicles\n",
        "Rendered vehicles, each alone and wholly inside the picture,\n"
        f"in {scenes} made-up and {real} real camera geometries, towards and away from the camera. The mask is\n"
        "exact; its label is compared with the one encoded from the body's exact 3D box (without mirrors).\n"
        "Made by `python -m tools.studies.vehicle_labels`.\n",
        "- **IoU** is that of the 2D boxes, with its 5th and 1st percentiles (lower is worse).\n"
        "- Then |c_c error| with its 95th and 99th percentiles for both rules, and the mean error with its\n"
        "  sign (**bias**).\n"
        "- A height stands for boxes within a factor of the square root of 2.\n"
        "- **box** is a plain cuboid: what is left there is the raster's error alone.\n"
        f"- Rows of fewer than {_FEWEST} vehicles are left out.\n",
    ]
    vehicles = [c for c in cases if c.kind != "box"]
    for pair, size in PAIRS.items():
        here = [c for c in vehicles if c.pair is pair]
        parts.append(f"## {pair}, {size[0]}x{size[1]}\n")
        parts.append(_table("all vehicles", {f"{h} px": [c for c in here if _bin(c) == h] for h in HEIGHTS}) + "\n")
        for h in HEIGHTS:
            groups = {k: [c for c in cases if c.kind == k and c.pair is pair and _bin(c) == h] for k in kinds}
            parts.append(f"### Box height {h} px\n\n" + _table("body", groups) + "\n")
    return "\n".join(parts)


# -- the worst ------------------------------------------------------------------------------------------------


def _worst(cases: list[Case], pair: Pair, rule: Rule, count: int = 10) -> list[Case]:
    """The worst, at most one of each vehicle body in a scene so that they are not all the same."""
    seen, out = set(), []
    for case in sorted(cases, key=lambda c: -abs(c.cc[rule] - c.exact_cc)):
        if case.pair is pair and case.kind != "box" and _bin(case) in (40, 80) and (case.scene, case.kind) not in seen:
            seen.add((case.scene, case.kind))
            out.append(case)
    return out[:count]


def _picture(case: Case, scene: RoadScene, rule: Rule) -> NDArray[np.uint8]:
    rng = np.random.default_rng([case.scene, 3])
    light = make_light(Weather.DAY, rng)
    background = scene.background if scene.background is not None else draw_road(scene, light, rng)
    placed = _placed(case.kind, case.seed, case.heading, case.near_xy)
    image, _ = Renderer(scene.camera, background, light, seed=0).frame([placed])
    rect = _rectifications(scene)[case.pair]
    seen = rect.warp_image(image)
    exact = rect.points(scene.camera.project(road_cuboids(case.near_xy[None], placed.vehicle.size_lwh[None])))
    found, _ = decode_boxes(case.box_xyxy[None], [case.cc[rule]], rect.vpu)
    around = np.concatenate([exact[0].min(axis=0), exact[0].max(axis=0)])
    left, matrix = crop_around(seen, around, 0.15, 260)
    right = left.copy()
    for view, vertices in ((left, exact[0]), (right, found[0])):
        draw_box3d(view, vertices @ matrix[:2, :2].T + matrix[:2, 2])
    draw_text(left, f"exact c_c {case.exact_cc:.3f}", (6, 252))
    draw_text(right, f"{case.kind}, label {case.cc[rule]:.3f}", (6, 252))
    return np.concatenate([left, right], axis=1)


def _real_scenes(root: Path) -> list[RoadScene]:
    from labelgen.synth.truth.replay import load_scene

    folders = sorted((root / "brnocompspeed" / "dataset").glob("session*"))
    return [load_scene(f, Weather.OVERCAST, np.random.default_rng(0))[0] for f in folders]


def main(
    out: Annotated[Path, typer.Option("--out", help="The page, Markdown.")] = Path("docs/studies/synthetic-labels.md"),
    pictures: Annotated[Path | None, typer.Option("--pictures", help="Folder for pictures of the worst.")] = None,
    real: Annotated[Path | None, typer.Option("--real", help="Real data, for more camera geometries.")] = None,
    count: Annotated[int, typer.Option(min=1, help="Vehicles per scene, body type, pair and height.")] = 4,
    scenes: Annotated[int, typer.Option(min=1, help="Made-up scenes.")] = 20,
) -> None:
    """Measure labels from exact masks against exact 3D boxes."""
    from tqdm import tqdm

    root = real or (Path(os.environ["LABELGEN_REAL_DATA"]) if "LABELGEN_REAL_DATA" in os.environ else None)
    made_up = [
        procedural_scene(np.random.default_rng([k, 41]), (1920, 1080), depth_m=_DEPTHS_M[k % len(_DEPTHS_M)])
        for k in range(scenes)
    ]
    real_scenes = [] if root is None else _real_scenes(root)
    cases: list[Case] = []
    for number, scene in enumerate(tqdm([*made_up, *real_scenes], unit="scene")):
        try:
            cases += measure_scene(scene, number, count, 7)
        except LabelgenError as err:
            typer.echo(f"{scene.name}: left out: {err}", err=True)
    out.write_text(page(cases, len(made_up), len(real_scenes)), encoding="utf-8")
    if pictures is None:
        return
    pictures.mkdir(parents=True, exist_ok=True)
    drawable = [c for c in cases if c.scene < len(made_up)]
    for pair in PAIRS:
        worst = _worst(drawable, pair, Rule.WIDER)
        for number in {c.scene for c in worst}:
            if made_up[number].background is None:
                rng = np.random.default_rng([number, 3])
                light = make_light(Weather.DAY, rng)
                made_up[number] = replace(made_up[number], background=draw_road(made_up[number], light, rng))
        tiles = [_picture(case, made_up[case.scene], Rule.WIDER) for case in worst]
        name = f"synthetic-worst-{pair.value.lower()}.jpg"
        cv2.imwrite(str(pictures / name), tile_pictures(tiles, 2), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None

"""How near labels from masks come to exact ones: solid boxes projected into real scenes.

    python -m tools.studies.cuboid_labels --real DIR [--out docs/studies/label-accuracy.md] [--count 250]

DIR holds brnocompspeed/dataset/sessionN_*/video_mask.png and brnocompspeed/results/sessionN_*/. Only numbers leave it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError, LabelgenError
from labelgen.geometry import (
    Camera,
    Pair,
    Rectification,
    RectifiedOutline,
    RoadMask,
    Rule,
    decode_boxes,
    encode_boxes,
    label_outlines,
    mask_outline,
    rectified_outline,
    road_cuboids,
)

__all__ = [
    "SIZES",
    "TANGENT_RULES",
    "Accuracy",
    "Row",
    "Scene",
    "SolidBoxes",
    "load_scenes",
    "main",
    "measure",
    "measure_scenes",
    "page",
    "rasterise",
    "sample_boxes",
]

TANGENT_RULES = tuple(rule for rule in Rule if rule.is_of_tangents)
SIZES = {Pair.VP2_VP3: (640, 360), Pair.VP1_VP2: (360, 640)}
KINDS_LWH = np.array(
    [
        [(3.5, 1.6, 1.3), (5.0, 2.0, 1.9)],  # car
        [(4.8, 1.9, 1.9), (7.0, 2.2, 3.0)],  # van
        [(7.0, 2.3, 2.8), (16.5, 2.6, 4.0)],  # lorry, bus
    ]
)
"""Smallest and largest length, width and height, metres; each kind is equally likely."""
MEDIAN_BOUND, P99_BOUND = 0.008, 0.05
"""What must hold in every scene: the median by the published rule, the 99th percentile by the conditioned one."""


@dataclass(frozen=True)
class Scene:
    """One recording's name, calibration and road."""

    name: str
    camera: Camera
    road: RoadMask


@dataclass(frozen=True)
class SolidBoxes:
    """Boxes that lie wholly inside the frame and inside the rectified image, with their exact labels.

    Args:
        vertices_px: (N, 8, 2) frame px.
        boxes_xyxy: (N, 4) exact 2D boxes, rectified px.
        cc: (N,) exact c_c.
        unlabelled: how many more boxes inside the picture have no label, as VPU lies inside them.
    """

    vertices_px: NDArray[np.float64]
    boxes_xyxy: NDArray[np.float64]
    cc: NDArray[np.float64]
    unlabelled: int


@dataclass(frozen=True)
class Accuracy:
    """Errors of N labels: |c_c error|, and the greatest error of the box's four sides in px."""

    cc: NDArray[np.float64]
    box_px: NDArray[np.float64]
    undecided: int


def load_scenes(root: str | Path) -> list[Scene]:
    """All recordings under `root`/brnocompspeed, by name.

    Raises:
        DataError: there are none.
    """
    base = Path(root) / "brnocompspeed"
    scenes = []
    for mask in sorted(base.glob("dataset/*/video_mask.png")):
        image = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise DataError(f"{mask}: not a readable picture")
        camera = Camera.load(
            base / "results" / mask.parent.name / "system_optimal_calibration.json",
            image_wh=(image.shape[1], image.shape[0]),
        )
        scenes.append(Scene(mask.parent.name, camera, RoadMask(image)))
    if not scenes:
        raise DataError(f"{base}: no dataset/*/video_mask.png in it; give --real or set LABELGEN_REAL_DATA")
    return scenes


def sample_boxes(scene: Scene, rect: Rectification, count: int, seed: int = 0) -> SolidBoxes:
    """`count` random boxes on the road, spread evenly over its metres as traffic at one speed is.

    The middle of the near bottom edge lies in the road mask; sizes are even within `KINDS_LWH`.

    Raises:
        DataError: not enough of them fit into the picture.
    """
    rng = np.random.default_rng(seed)
    rows, columns = np.nonzero(scene.road.pixels)
    pixels = np.stack([columns, rows], axis=1) + 0.5
    # A pixel shows so much of the road: the cube of how far its ray goes until it has fallen by one.
    down = scene.camera.rays(pixels)[:, 2]
    share = np.where(down < 0, np.abs(down) ** -3.0, 0.0)
    share /= share.sum()
    vertices: list[NDArray[np.float64]] = []
    found, unlabelled = 0, 0
    for _ in range(400):
        near = scene.camera.road_points(pixels[rng.choice(len(pixels), 500, p=share)], invalid="nan")
        sizes = rng.uniform(*np.swapaxes(KINDS_LWH[rng.integers(0, len(KINDS_LWH), len(near))], 0, 1))
        boxes = scene.camera.project(road_cuboids(near, sizes))
        rectified = rect.points(boxes)
        with np.errstate(invalid="ignore"):
            seen = ((boxes >= 0) & (boxes <= scene.road.size_wh)).all(axis=(1, 2))
            seen &= ((rectified >= 0) & (rectified <= rect.size_wh)).all(axis=(1, 2))
        exact = encode_boxes(rectified[seen], rect.vpu)
        valid = decode_boxes(exact.boxes_xyxy, exact.cc, rect.vpu)[1]
        vertices.append(boxes[seen][valid])
        found, unlabelled = found + int(valid.sum()), unlabelled + int((~valid).sum())
        if found >= count:
            break
    else:
        raise DataError(f"{scene.name}: only {found} of {count} random boxes lie inside the {rect.pair} picture")
    kept = np.concatenate(vertices)[:count]
    exact = encode_boxes(rect.points(kept), rect.vpu)
    return SolidBoxes(kept, exact.boxes_xyxy, exact.cc, unlabelled)


def rasterise(vertices_px: NDArray[np.float64]) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """The mask (h, w) of one solid box (8, 2): pixels whose centre it covers, and the first pixel's place."""
    hull = cv2.convexHull(vertices_px.astype(np.float32))[:, 0].astype(np.float64)
    low, high = np.floor(hull.min(axis=0)).astype(int), np.ceil(hull.max(axis=0)).astype(int)
    y = np.arange(low[1], high[1]) + 0.5
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for start, end in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        top, bottom = (start, end) if start[1] <= end[1] else (end, start)
        crosses = (top[1] <= y) & (y < bottom[1])
        x = top[0] + (y[crosses] - top[1]) * (bottom[0] - top[0]) / (bottom[1] - top[1] or 1.0)
        left[crosses], right[crosses] = np.minimum(left[crosses], x), np.maximum(right[crosses], x)
    x = np.arange(low[0], high[0]) + 0.5
    return (x >= left[:, None]) & (x < right[:, None]), (int(low[0]), int(low[1]))


def published_outline(
    rect: Rectification, mask: NDArray[np.bool_], origin_px: tuple[int, int]
) -> RectifiedOutline | None:
    """Outline by the published method: the mask's pixels rectified, then outlined."""
    return mask_outline(rect.warp_mask(mask, origin_px=origin_px))


def measure(boxes: SolidBoxes, rect: Rectification, *, published: bool = False) -> dict[Rule, Accuracy]:
    """Errors of the labels from the boxes' masks by either rule; `published` rectifies pixels instead of hulls."""
    outline_of = published_outline if published else rectified_outline
    drawn = (rasterise(vertices) for vertices in boxes.vertices_px)
    outlines = [outline_of(rect, mask, origin) for mask, origin in drawn]
    there = np.array([outline is not None for outline in outlines])
    found = [outline for outline in outlines if outline is not None]
    out = {}
    for rule in TANGENT_RULES:
        labels = label_outlines(found, rect.vpu, rule)
        keep = np.flatnonzero(there)[labels.valid]
        out[rule] = Accuracy(
            np.abs(labels.cc[labels.valid] - boxes.cc[keep]),
            np.abs(labels.boxes_xyxy[labels.valid] - boxes.boxes_xyxy[keep]).max(axis=1),
            len(there) - len(keep),
        )
    return out


@dataclass(frozen=True)
class Row:
    """The measurement of one scene and pair."""

    scene: str
    pair: Pair
    boxes: SolidBoxes
    accuracy: dict[Rule, Accuracy]

    def keeps_bound(self, rule: Rule) -> bool:
        """Whether the rule's own bound holds here."""
        errors = self.accuracy[rule].cc
        if rule is Rule.WIDER:
            return bool(np.median(errors) <= MEDIAN_BOUND)
        return bool(np.percentile(errors, 99) <= P99_BOUND)


def measure_scenes(scenes: list[Scene], count: int, *, published: bool = False, seed: int = 0) -> Iterator[Row]:
    """`measure` for every pair and scene; a generator, as each takes a fraction of a second."""
    for pair, size in SIZES.items():
        for scene in scenes:
            rect = Rectification.from_road_mask(scene.camera, scene.road, pair, size)
            boxes = sample_boxes(scene, rect, count, seed)
            yield Row(scene.name, pair, boxes, measure(boxes, rect, published=published))


# -- the page ------------------------------------------------------------------------------------------

_LENGTHS = ", ".join(f"{low[0]:g}-{high[0]:g}" for low, high in KINDS_LWH)
_SIZES = " and ".join(f"{w}x{h} ({pair})" for pair, (w, h) in SIZES.items())
_INTRODUCTION = f"""# Labels from masks of solid boxes

Solid boxes have an exact label, so the error of the way from a mask to a label can be measured on
them. In the geometry of each recording (its calibration, its road mask) random boxes are put on the
road, spread evenly over its metres, one third each of the size of cars, vans and lorries
({_LENGTHS} m long), aligned with the direction of travel. Those wholly inside the
frame and the rectified picture are kept. Each is drawn as a mask in the frame (a pixel is set if the
box covers its centre), the mask is labelled as in real use, and the label is compared with the one
computed from the eight projected corners. Sizes: {_SIZES}.

- **c_c error** is |c_c from the mask - exact c_c|; c_c itself runs from 0 to 1.
- **box error** is the greatest error among a box's four sides, rectified px. Half a pixel of the frame
  is part of it: at the far end of a VP1-VP2 picture a frame pixel is more than a pixel high.
- **wider** is the published rule: of the two candidates the one that gives the wider box.
  **conditioned** weights the two by how little a shift of the tangent point moves them.
- **hull** (labelgen) rectifies the convex hull of the mask's pixels, so that nothing is rounded to the
  rectified grid; **pixels** (the published method) rectifies the mask itself.
- **no label** counts boxes that have no label: VPU lies between their top and bottom, so decoding calls
  them invalid. They are not part of n.
- **within its bound** asks for a median c_c error of at most {MEDIAN_BOUND} by `wider`, and a 99th
  percentile of at most {P99_BOUND} by `conditioned`.

Real vehicles are not boxes: [labels of drawn vehicles](synthetic-labels.md) and
[of real cars' shapes](../results.md#labels-from-masks-of-real-cars-shapes) are worse by far.
"""


def _stats(values: NDArray[np.float64], digits: int, *percentiles: float) -> list[str]:
    return [f"{np.percentile(values, q):.{digits}f}" for q in percentiles]


def _table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _scene_table(rows: list[Row]) -> str:
    header = ["scene", "n", "no label"]
    header += [f"{rule} {name}" for rule in TANGENT_RULES for name in ("median", "p95", "p99")]
    header += ["box median", "box p99"]
    body = []
    for row in rows:
        cells = [row.scene, str(len(row.boxes.cc)), str(row.boxes.unlabelled)]
        for rule in TANGENT_RULES:
            cells += _stats(row.accuracy[rule].cc, 4, 50, 95, 99)
        body.append(cells + _stats(row.accuracy[Rule.WIDER].box_px, 2, 50, 99))
    return _table(header, body)


def _summary_table(measured: dict[str, list[Row]]) -> str:
    body = []
    for pair in Pair:
        for method, rows in measured.items():
            of_pair = [row for row in rows if row.pair is pair]
            for rule in TANGENT_RULES:
                pooled = np.concatenate([row.accuracy[rule].cc for row in of_pair])
                worst = max(float(np.percentile(row.accuracy[rule].cc, 99)) for row in of_pair)
                kept = f"{sum(row.keeps_bound(rule) for row in of_pair)} of {len(of_pair)}"
                body.append([str(pair), method, str(rule), str(len(pooled)), *_stats(pooled, 4, 50, 95, 99)])
                body[-1] += [f"{worst:.4f}", kept]
    header = [
        "pair",
        "from",
        "rule",
        "n",
        "median",
        "p95",
        "p99",
        "p99 of the worst scene",
        "scenes within its bound",
    ]
    return _table(header, body)


def _verdict(measured: dict[str, list[Row]]) -> str:
    """Which method and which rule came out better, from the pooled errors."""
    pooled = {
        (method, rule): np.concatenate([row.accuracy[rule].cc for row in rows])
        for method, rows in measured.items()
        for rule in TANGENT_RULES
    }
    median = min(pooled, key=lambda key: float(np.median(pooled[key])))
    tail = min(pooled, key=lambda key: float(np.percentile(pooled[key], 99)))
    return (
        "On solid boxes, over all scenes and both pairs, "
        f"the lowest median comes from `{median[1]}` from the {median[0]},\n"
        f"the lowest 99th percentile from `{tail[1]}` from the {tail[0]}.\n"
    )


def page(scenes: list[Scene], count: int, seed: int = 0) -> str:
    """The whole page as Markdown."""
    measured = {
        "hull": list(measure_scenes(scenes, count, seed=seed)),
        "pixels": list(measure_scenes(scenes, count, published=True, seed=seed)),
    }
    parts = [_INTRODUCTION, "## Result\n", _verdict(measured), _summary_table(measured)]
    for method, rows in measured.items():
        for pair in Pair:
            parts += [f"## {pair}, from the {method}\n", _scene_table([row for row in rows if row.pair is pair])]
    parts.append(f"Made by `python -m tools.studies.cuboid_labels --count {count} --seed {seed}`.\n")
    return "\n".join(parts)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--real", default=os.environ.get("LABELGEN_REAL_DATA"), help="default: $LABELGEN_REAL_DATA")
    parser.add_argument("--out", type=Path, help="where to write the page; default: standard output")
    parser.add_argument("--count", type=int, default=400, help="boxes per scene and pair")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    try:
        if not args.real:
            raise DataError("no scenes: give --real DIR or set LABELGEN_REAL_DATA")
        text = page(load_scenes(args.real), args.count, args.seed)
        if args.out is None:
            print(text, end="")
        else:
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.write_text(text, encoding="utf-8")
    except LabelgenError as err:
        print(f"error: {err}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

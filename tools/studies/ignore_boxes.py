r"""Whether every vehicle that a mask shows has a label or an ignored box, on rendered sessions.

    python -m tools.studies.ignore_boxes degrade SESSION... --out DIR [--seed 0]
    labelgen bcs-masks SESSION --masks coco:DIR/NAME.json --rule wider --every 1 --size 480x270 --out SHARDS
    python -m tools.studies.ignore_boxes count SHARDS... --truth SESSION... --masks DIR

`degrade` makes masks like a network's out of exact ones: coarse outlines, edges that are off, boxes that are too
short, parts and whole vehicles that are missed, two vehicles in one mask, vehicles found twice. `count` compares the
shards of such masks with the truth. SESSION is a folder ROOT/dataset/NAME of `labelgen synth session`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from labelgen.atomic_files import make_folder, write_json
from labelgen.datasets.scene import find_scene
from labelgen.errors import LabelgenError
from labelgen.geometry import rectified_outline
from labelgen.geometry.boxes import covered_share, iou_matrix
from labelgen.json_file import parse_json
from labelgen.labels import Sample
from labelgen.masks.instances import crop_mask
from labelgen.shards import ShardDataset

__all__ = ["DEGRADATION", "Degradation", "count_vehicles", "degrade_mask", "degrade_session", "main"]

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Degradation:
    """How far masks are from exact ones; probabilities are per mask."""

    coarse_px: int = 4
    """Side of the cells in which the outline is drawn, px; Mask R-CNN's 28 x 28 cells on a vehicle of 110 px."""
    max_edge_px: float = 2.0
    """Largest distance by which the edge is too far inside or outside, px; less for vehicles under 40 px."""
    box_sigma: float = 0.03
    """Standard deviation of each side of the box that cuts the mask, as a share of the vehicle's size; it only cuts."""
    part_lost: float = 0.1
    """Probability that a part is missed: 20 to 60 % of the width or height, from one side."""
    missed: float = 0.03
    """Probability that the vehicle is missed."""
    missed_hidden: float = 0.5
    """The same for one of which less than a quarter can be seen."""
    merged: float = 0.1
    """Probability that the mask also takes a vehicle that it touches, which has none then."""
    twice: float = 0.05
    """Probability of a second mask of the vehicle, with a lower score."""


DEGRADATION = Degradation()


def degrade_mask(mask: Mask, rng: np.random.Generator, how: Degradation = DEGRADATION) -> Mask:
    """Return a mask as a network may give it.

    Args:
        mask: (H, W) bool, exact, with at least one pixel set.
        rng: random numbers.
        how: how far from exact.

    Returns:
        (H, W) bool; may be empty for a small vehicle.
    """
    height, width = mask.shape
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    # Drawn in coarse cells, with the outline where their mean crosses a level.
    cells = (max(2, -(-width // how.coarse_px)), max(2, -(-height // how.coarse_px)))
    small = cv2.resize(mask.astype(np.float32), cells, interpolation=cv2.INTER_AREA)
    smooth = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    out = smooth > rng.uniform(0.35, 0.6)
    edge = rng.uniform(-1, 1) * how.max_edge_px * min(1.0, min(w, h) / 40)
    if round(abs(edge)):
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(abs(edge)) + 1,) * 2)
        out = (cv2.dilate if edge > 0 else cv2.erode)(out.view(np.uint8), kernel) > 0
    cut = np.abs(rng.normal(0, how.box_sigma, 4)) * (w, h, w, h)
    if rng.random() < how.part_lost:
        side = rng.integers(4)
        cut[side] += rng.uniform(0.2, 0.6) * (w, h, w, h)[side]
    x0, y0 = round(x - 2 + cut[0]), round(y - 2 + cut[1])
    x1, y1 = round(x + w + 2 - cut[2]), round(y + h + 2 - cut[3])
    inside = np.zeros_like(out)
    inside[max(0, y0) : max(0, y1), max(0, x0) : max(0, x1)] = True
    return np.asarray(out & inside)


def degrade_session(session: Path, seed: int = 0, how: Degradation = DEGRADATION) -> dict[str, Any]:
    """Return a COCO file, as plain values, with masks as a network may give them.

    Args:
        session: folder ROOT/dataset/NAME of a synthetic session.
        seed: of the random numbers.
        how: how far from exact.

    Returns:
        the session's truth/NAME/masks.json with other masks and a `score`; `track_ids` are those of the vehicles that
        a mask shows.
    """
    truth = _truth(session, "masks.json")
    annotations: list[dict[str, Any]] = []
    for image, group in _by_image(truth):
        rng = np.random.default_rng([seed, int(image["id"])])
        masks = [coco_mask.decode(a["segmentation"]).astype(np.bool_) for a in group]
        taken = _merge(masks, rng, how)
        for i, (annotation, mask) in enumerate(zip(group, masks, strict=True)):
            lost = rng.random() < (how.missed_hidden if annotation["visible"] < 0.25 else how.missed)
            if taken[i] != i or lost:
                continue
            tracks = [group[j]["track_id"] for j in range(len(group)) if taken[j] == i]
            score = rng.uniform(0.7, 1)
            found = [(degrade_mask(mask, rng, how), score)]
            if rng.random() < how.twice:
                found.append((degrade_mask(mask, rng, how), score - 0.15))
            for shown, value in found:
                if shown.any():
                    entry = {key: annotation[key] for key in ("image_id", "category_id", "iscrowd")}
                    rle = coco_mask.encode(np.asfortranarray(shown))
                    rle["counts"] = rle["counts"].decode()
                    number = len(annotations) + 1
                    annotations.append(
                        {**entry, "id": number, "segmentation": rle, "score": round(value, 4), "track_ids": tracks}
                    )
    return {**truth, "annotations": annotations}


def _truth(session: Path, name: str) -> Any:
    return parse_json((session.resolve().parents[1] / "truth" / session.name / name).read_bytes())


def _by_image(truth: dict[str, Any]) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    groups: dict[int, list[dict[str, Any]]] = {image["id"]: [] for image in truth["images"]}
    for annotation in truth["annotations"]:
        groups[annotation["image_id"]].append(annotation)
    return ((image, groups[image["id"]]) for image in truth["images"])


def _merge(masks: list[Mask], rng: np.random.Generator, how: Degradation) -> list[int]:
    """Join some masks that touch, in place; return for each the number of the mask that shows its vehicle."""
    taken = list(range(len(masks)))
    for i, mask in enumerate(masks):
        near = cv2.dilate(mask.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        for j in range(i + 1, len(masks)):
            if taken[i] == i and taken[j] == j and (near & masks[j]).any() and rng.random() < how.merged:
                masks[i] = masks[i] | masks[j]
                taken[j] = i
    return taken


# -- counting -----------------------------------------------------------------------------------------------


def count_vehicles(
    samples: Sequence[Sample], session: Path, masks: dict[str, Any], min_height_px: float = 12.0
) -> tuple[Counter[str], list[str]]:
    """Count the vehicles on the road that have a label, an ignored box or neither.

    Vehicles are those of which the exact mask, rectified, is at least so high and lies on the road with a quarter of
    its pixels. The box of this mask is compared: it has a label from an IoU of 0.4, and is ignored where an ignored
    box covers half of it. Elsewhere an anchor that fits the vehicle would be taught as background. A label of an IoU
    from 0.2, or one that covers half of the box, comes from a mask of the vehicle, but from a poor one: it lacks a
    part of the vehicle, or holds another one as well.

    Args:
        samples: of the session, made from `masks`.
        session: folder ROOT/dataset/NAME of a synthetic session.
        masks: of `degrade_session`.
        min_height_px: least height, rectified px.

    Returns:
        counts by what the vehicles have: "label", "ignored", "poor label", "no mask" (no mask shows them) or
        "neither"; and a line for each of the last.
    """
    shown: dict[int, set[int]] = {}
    frames = {image["id"]: image["frame"] for image in masks["images"]}
    for annotation in masks["annotations"]:
        shown.setdefault(frames[annotation["image_id"]], set()).update(annotation["track_ids"])
    exact = {image["frame"]: group for image, group in _by_image(_truth(session, "masks.json"))}
    scene = find_scene(session).open()
    counts: Counter[str] = Counter()
    lines = []
    for sample in samples:
        for annotation in exact[sample.frame]:
            mask = coco_mask.decode(annotation["segmentation"]).astype(np.bool_)
            crop = crop_mask(mask)
            outline = None if crop is None else rectified_outline(sample.rectification, crop[1], crop[0])
            if outline is None or scene.road.pixels[mask].mean() < 0.25:
                continue
            box = outline.box_xyxy
            if box[3] - box[1] < min_height_px:
                continue
            iou = iou_matrix([box], sample.labels.boxes_xyxy).max(initial=0)
            share = covered_share([box], sample.ignored.boxes_xyxy).max(initial=0)
            if iou >= 0.4:
                what = "label"
            elif share >= 0.5:
                what = "ignored"
            elif iou >= 0.2 or covered_share([box], sample.labels.boxes_xyxy).max(initial=0) >= 0.5:
                what = "poor label"
            elif annotation["track_id"] not in shown.get(sample.frame, set()):
                what = "no mask"
            else:
                what = "neither"
                place = f"{sample.source} frame {sample.frame} track {annotation['track_id']}"
                lines.append(f"{place}: box {np.round(box).tolist()}, IoU {iou:.2f}, ignored {share:.2f}")
            counts[what] += 1
    return counts, lines


# -- command line -------------------------------------------------------------------------------------------

app = typer.Typer(add_completion=False)
SessionsArgument = Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Folders ROOT/dataset/NAME.")]


@app.command()
def degrade(
    sessions: SessionsArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where NAME.json of each session goes.")],
    seed: Annotated[int, typer.Option("--seed", help="Of what is wrong with the masks.")] = 0,
) -> None:
    """Write masks as a network may give them."""
    make_folder(out)
    for session in sessions:
        masks = degrade_session(session, seed)
        write_json(out / f"{session.name}.json", masks)
        typer.echo(f"{session.name}: {len(masks['annotations'])} masks")


@app.command()
def count(
    shards: Annotated[list[Path], typer.Argument(metavar="SHARDS...", help="Made of such masks.")],
    truth: Annotated[list[Path], typer.Option("--truth", metavar="SESSION", help="The sessions they were made of.")],
    masks: Annotated[Path, typer.Option("--masks", metavar="DIR", help="Of `degrade`.")],
    min_height: Annotated[float, typer.Option("--min-height", metavar="PX", help="Least height.")] = 12.0,
    verbose: Annotated[bool, typer.Option("--verbose", help="List the vehicles that have neither.")] = False,
) -> None:
    """Count vehicles on the road by whether they have a label, an ignored box or neither."""
    samples: dict[str, list[Sample]] = {}
    for sample in ShardDataset(shards):
        samples.setdefault(sample.source, []).append(sample)
    total: Counter[str] = Counter()
    for session in truth:
        described = json.loads((masks / f"{session.name}.json").read_text())
        counts, lines = count_vehicles(samples.get(session.name, []), session, described, min_height)
        total += counts
        for line in lines if verbose else []:
            typer.echo(line)
    for what, number in [*sorted(total.items()), ("all", total.total())]:
        typer.echo(f"{what:10s} {number}")


def main() -> None:
    """Run the command."""
    try:
        app()
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None


if __name__ == "__main__":
    main()

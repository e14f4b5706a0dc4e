"""Contact sheets: many labels on few pictures, drawn on the rectified and on the original images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from labelgen.drawing import (
    crop_around,
    draw_box3d,
    draw_dashed_box,
    draw_label,
    draw_text,
    fit_into,
    tile_pictures,
)
from labelgen.geometry.homography import apply_homography, bounding_boxes
from labelgen.labels import Flag, IgnoreReason, Sample, VehicleClass
from labelgen.media.image_file import write_image
from labelgen.shards import ShardDataset

__all__ = ["frame_sheets", "label_sheets", "pick_labels"]

_TILE = 220
_FLAG_LETTERS = {
    Flag.TRUNCATED: "cut",
    Flag.MISALIGNED: "misaligned",
    Flag.CANDIDATES_DISAGREE: "disagree",
    Flag.TOUCHING: "touching",
    Flag.OCCLUDED: "occluded",
}


def pick_labels(data: ShardDataset[Sample], count: int, seed: int) -> list[tuple[int, int]]:
    """Return the numbers of randomly chosen labels, in ascending order.

    Args:
        data: the shards.
        count: number of labels; all where there are fewer.
        seed: of the random choice.

    Returns:
        (sample, label) each: the number of the sample in the data set, and of the label in the sample.
    """
    per_sample = np.concatenate([np.diff(reader.table("labels/offset")) for reader in data.readers])
    starts = np.concatenate([[0], np.cumsum(per_sample)])
    total = int(starts[-1])
    labels = np.sort(np.random.default_rng(seed).choice(total, min(count, total), replace=False))
    samples = np.searchsorted(starts, labels, side="right") - 1
    return [(int(s), int(n - starts[s])) for s, n in zip(samples, labels, strict=True)]


def label_sheets(
    data: ShardDataset[Sample],
    picked: Sequence[tuple[int, int]],
    originals: Mapping[int, NDArray[np.uint8] | None],
    out: Path,
    *,
    per_sheet: int = 10,
) -> list[Path]:
    """Write sheets of labels, each on the rectified image and, where available, on the original.

    Args:
        data: the shards.
        picked: number of the sample and of the label within it, for each label to draw.
        originals: original image (H, W, 3) BGR by number of the sample; None where it is not available.
        out: folder of the sheets.
        per_sheet: number of labels on a sheet.

    Returns:
        The files, labels-00.png and so on.
    """
    samples = {number: data[number] for number, _ in picked}
    tiles = [_label_tile(samples[number], label, originals[number], f"{i}") for i, (number, label) in enumerate(picked)]
    return _write_sheets(tiles, out, "labels", per_sheet, 2)


def frame_sheets(data: ShardDataset[Sample], out: Path, *, count: int = 12, per_sheet: int = 6) -> list[Path]:
    """Write sheets of whole rectified images with all their labels and ignored boxes.

    They show vehicles that have neither.

    Args:
        data: the shards; samples are taken at equal distances.
        out: folder of the sheets.
        count: number of samples.
        per_sheet: number of samples on a sheet.

    Returns:
        The files, frames-00.png and so on.
    """
    numbers = sorted({int(n) for n in np.linspace(0, len(data) - 1, min(count, len(data)))})
    tiles = []
    for number in numbers:
        sample = data[number]
        picture = sample.image
        vertices, valid = sample.labels.vertices(sample.rectification.vpu)
        for box, cc, points, good in zip(sample.labels.boxes_xyxy, sample.labels.cc, vertices, valid, strict=True):
            draw_label(picture, box, float(cc), sample.rectification.vpu, points if good else None)
        for box, reason in zip(sample.ignored.boxes_xyxy, sample.ignored.reasons.tolist(), strict=True):
            draw_dashed_box(picture, box, IgnoreReason(reason).text)
        w, h = sample.rectification.size_wh
        tile = fit_into(picture, (640, 360) if w >= h else (360, 640))
        draw_text(tile, f"{sample.source} frame {sample.frame}", (6, 14))
        tiles.append(tile)
    return _write_sheets(tiles, out, "frames", per_sheet, 3 if tiles and tiles[0].shape[0] > tiles[0].shape[1] else 2)


def _write_sheets(tiles: Sequence[NDArray[np.uint8]], out: Path, name: str, per_sheet: int, columns: int) -> list[Path]:
    return [
        write_image(out / f"{name}-{i // per_sheet:02d}.png", tile_pictures(tiles[i : i + per_sheet], columns))
        for i in range(0, len(tiles), per_sheet)
    ]


def _label_tile(sample: Sample, label: int, original: NDArray[np.uint8] | None, title: str) -> NDArray[np.uint8]:
    labels, vpu = sample.labels, sample.rectification.vpu
    box, cc = labels.boxes_xyxy[label], float(labels.cc[label])
    vertices, valid = labels.vertices(vpu)
    plain, to_tile = crop_around(sample.image, box, 0.35, _TILE)
    drawn = plain.copy()
    tile_box = apply_homography(to_tile, box.reshape(2, 2)).reshape(4)
    tile_vpu = apply_homography(to_tile, vpu[None])[0]
    tile_vertices = apply_homography(to_tile, vertices[label]) if valid[label] else None
    for ignored_box in sample.ignored.boxes_xyxy:
        draw_dashed_box(drawn, apply_homography(to_tile, ignored_box.reshape(2, 2)).reshape(4))
    draw_label(drawn, tile_box, cc, tile_vpu, tile_vertices)
    flags = " ".join(text for flag, text in _FLAG_LETTERS.items() if labels.flags[label] & flag.value)
    kind = VehicleClass(int(labels.class_ids[label])).name.lower()
    sigma = float(labels.sigmas[label, 4])
    stated = f" +- {sigma:.3f}" if np.isfinite(sigma) else ""
    draw_text(drawn, f"{title}  {kind} {labels.scores[label]:.2f}  c_c {cc:.3f}{stated}", (5, 14))
    draw_text(drawn, flags, (5, _TILE - 6))
    return np.concatenate([plain, drawn, _original_tile(sample, label, original)], axis=1)


def _original_tile(sample: Sample, label: int, original: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    tile = np.full((_TILE, _TILE, 3), 70, dtype=np.uint8)
    vertices, valid = sample.vertices_px()
    if original is None or not valid[label] or not np.isfinite(vertices[label]).all():
        draw_text(tile, "original not available" if original is None else "no 3D box", (10, _TILE // 2))
        return tile
    offset = np.nan_to_num(sample.window_xyxy[:2])
    points = vertices[label] - offset
    tile, to_tile = crop_around(original, bounding_boxes(points), 0.35, _TILE)
    draw_box3d(tile, apply_homography(to_tile, points))
    draw_text(tile, f"{sample.source} #{sample.frame}"[-38:], (5, 14), 0.33)
    return tile

"""The audit of a data set: a folder with a page, contact sheets, figures and statistics."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import write_atomic
from labelgen.audit.contact_sheets import frame_sheets, label_sheets, pick_labels
from labelgen.audit.originals import Originals, open_original
from labelgen.audit.statistics import draw_statistics
from labelgen.audit.step_figures import mask_label_figure, rectification_figure
from labelgen.choices import Rule
from labelgen.datasets.scene import read_mask
from labelgen.errors import DataError, LabelgenError
from labelgen.labels import Sample
from labelgen.masks import (
    Clip,
    InstanceMasks,
    MaskOptions,
    MaskSource,
    create_mask_source,
    masked_frames,
    parse_masks,
    prime_masks,
)
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import FrameSource
from labelgen.media.image_file import write_image
from labelgen.shards import ShardDataset, summarise
from labelgen.staged_output import StagedOutput

__all__ = ["Audit", "make_audit"]

_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1400px;padding:0 1rem;background:#fafafa}
img{max-width:100%;border:1px solid #ccc;background:#fff;margin:.3rem 0}table{border-collapse:collapse}
td{padding:.15rem 1rem .15rem 0;border-bottom:1px solid #ddd}h2{margin-top:2rem}code{background:#eee;padding:0 .3em}"""


@dataclass
class Audit:
    """The files of an audit.

    Args:
        page: the HTML page.
        pictures: image files, by chapter of the page.
        notes: what could not be shown, and why.
    """

    page: Path
    pictures: dict[str, list[Path]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


_PICTURES = (
    "labels-[0-9]*.png",
    "frames-[0-9]*.png",
    "statistics.png",
    "rectification.png",
    "mask-to-label.png",
)


def make_audit(shards: Sequence[Path], out: Path, *, count: int = 50, seed: int = 0, overwrite: bool = False) -> Audit:
    """Make the audit of shards.

    Args:
        shards: shards or folders of shards, all of one pair and size.
        out: folder for the page and its pictures.
        count: number of labels on the contact sheets.
        seed: of the random choice of labels.
        overwrite: whether an audit that is there may be replaced.

    Raises:
        DataError: shards without a label, or of different pairs or sizes.
        OutputError: the folder holds an audit, or cannot be written.
    """
    kind = f"out {out}: it already holds an audit"
    with StagedOutput(out, "audit", ["index.html"], overwrite=overwrite, patterns=_PICTURES, kind=kind) as output:
        audit = _make(shards, output.path, count, seed)
        output.publish()
    pictures = {chapter: [out / path.name for path in paths] for chapter, paths in audit.pictures.items()}
    return Audit(out / audit.page.name, pictures, audit.notes)


def _make(shards: Sequence[Path], out: Path, count: int, seed: int) -> Audit:
    """Make the audit in an existing folder; see `make_audit`."""
    data = ShardDataset(shards)
    if not any(reader.label_count for reader in data.readers):
        raise DataError(f"{shards[0]}: no label in these shards, there is nothing to look at")
    kinds = sorted({f"{reader.pair} {reader.attributes['size']}" for reader in data.readers})
    if len(kinds) > 1:
        raise DataError(
            f"these shards are of different pairs or sizes ({', '.join(kinds)}); audit each kind on its own"
        )
    originals = Originals(data)
    audit = Audit(out / "index.html")
    picked = pick_labels(data, count, seed)
    images = originals.read([0, *(number for number, _ in picked)])
    audit.pictures["Labels chosen at random: picture, label, original"] = label_sheets(data, picked, images, out)
    audit.pictures["Whole rectified images with all their labels"] = frame_sheets(data, out)
    audit.pictures["Statistics"] = [draw_statistics(data, out / "statistics.png")]
    _explain(data, images[0], originals.place(0), out, audit)
    _write_page(data, audit)
    return audit


def _explain(
    data: ShardDataset[Sample], original: NDArray[np.uint8] | None, source: dict[str, Any], out: Path, audit: Audit
) -> None:
    """Add figures of the steps for the first sample, or a note where its original is not available."""
    sample = data[0]
    if original is None:
        audit.notes.append("no figure of the rectification: the original of the first sample is not available")
        return
    road = None
    if source.get("road_mask"):
        try:
            road = read_mask(Path(source["road_mask"]), image_wh=(original.shape[1], original.shape[0]))
        except LabelgenError as err:
            audit.notes.append(f"no road mask in the figure of the rectification: {err}")
    figure = rectification_figure(original, sample.rectification, sample.camera, sample.window_xyxy, road)
    audit.pictures["Steps of the rectification"] = [write_image(out / "rectification.png", figure)]
    if source.get("masks"):
        try:
            figure = _mask_figure(data, original, source)
        except LabelgenError as err:
            audit.notes.append(f"no figure from mask to label: {err}")
        else:
            audit.pictures["Steps from mask to label"] = [write_image(out / "mask-to-label.png", figure)]


def _mask_figure(data: ShardDataset[Sample], original: NDArray[np.uint8], source: dict[str, Any]) -> NDArray[np.uint8]:
    """Return the figure from mask to label for the largest possible vehicle of the first labelled frame.

    Args:
        data: the shards.
        original: (H, W, 3) BGR, the frame of the first sample.
        source: where the originals of the first sample lie, and the mask source that made its label.

    Raises:
        LabelgenError: there is no such figure; the message says why.
    """
    sample = data[0]
    frames = open_original(source)
    options = data.readers[0].settings.get(str(parse_masks(source["masks"]).kind))
    mask_source = create_mask_source(
        source["masks"],
        weights=source.get("weights"),
        score_threshold=float(_setting(data, "score", 0.5)),
        road_mask=read_mask(Path(source["road_mask"]), image_wh=frames.size_wh),
        frame_wh=frames.size_wh,
        clip=Clip.of(frames),
        camera=sample.camera,
        options=MaskOptions.from_dict(options),
    )
    rule = Rule.parse(str(_setting(data, "rule", Rule.WIDER)))
    masks = _masks_of(original, sample.frame, frames, mask_source)
    for i in sorted(range(len(masks)), key=lambda i: -int(masks.crops[i].sum())):
        x, y = (int(v) for v in masks.origins[i])
        figure = mask_label_figure(original, masks.crops[i], (x, y), sample.rectification, rule, sample.labels)
        if figure is not None:
            return figure
    raise DataError("no mask of the first labelled frame gives a label")


def _setting(data: ShardDataset[Sample], name: str, default: Any) -> Any:
    value = data.readers[0].settings.get(name)
    return default if value is None else value


def _masks_of(image: NDArray[np.uint8], number: int, frames: FrameSource, source: MaskSource) -> InstanceMasks:
    """Return the masks of one frame. A source that learns from the frames before it needs them decoded."""
    if not (source.prime_frames or source.every_frame or frames.path.is_dir()):
        return source.masks([image], [number], [""])[0]
    prime_masks(source, frames)
    for _, masks in masked_frames(frames, source, FrameChoice(wanted=number.__eq__, limit=number + 1)):
        return masks
    raise DataError(f"{frames.path}: it has no frame {number}")


def _write_page(data: ShardDataset[Sample], audit: Audit) -> None:
    summary = summarise(data.readers)
    rows = [
        ("shards", summary.shards),
        ("images", summary.images),
        ("labels", summary.labels),
        ("rejects", summary.rejects),
        *((f"&nbsp;&nbsp;{html.escape(reason)}", count) for reason, count in summary.reasons.most_common()),
        ("ignored boxes", summary.ignored.total()),
        *((f"&nbsp;&nbsp;{html.escape(reason)}", count) for reason, count in summary.ignored.most_common()),
        ("pair and size", f"{data.readers[0].pair} {data.readers[0].attributes['size']}"),
        *(("settings", html.escape(text)) for text in sorted({r.attributes["settings"] for r in data.readers})),
    ]
    parts = [f"<!doctype html><meta charset=utf-8><title>labelgen audit</title><style>{_STYLE}</style>"]
    parts.append("<h1>labelgen audit</h1>")
    parts.append("<table>" + "".join(f"<tr><td>{name}<td>{value}" for name, value in rows) + "</table>")
    parts.append(
        "<p>On rectified pictures: <b>2D box</b> green, <b>c_c</b> yellow, towards <b>VPU</b> magenta, 3D box with its "
        "front face red and the rest blue; <b>ignored boxes</b> dashed grey with their reason. Each label stands three "
        "times: bare, with the label, on the original.</p>"
    )
    parts += [f"<p>{html.escape(note)}</p>" for note in audit.notes]
    for chapter, pictures in audit.pictures.items():
        parts.append(f"<h2>{html.escape(chapter)}</h2>")
        parts += [f'<img src="{picture.name}" alt="{html.escape(chapter)}">' for picture in pictures]
    write_atomic(audit.page, "\n".join(parts).encode())

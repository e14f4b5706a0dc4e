"""The audit of a data set: one folder with a page, contact sheets, figures and statistics."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labelgen.atomic_files import make_folder, write_atomic
from labelgen.audit.contact_sheets import frame_sheets, label_sheets, save_picture
from labelgen.audit.originals import Originals
from labelgen.audit.statistics import draw_statistics
from labelgen.audit.step_figures import mask_label_figure, rectification_figure
from labelgen.choices import Rule
from labelgen.datasets.scene import read_mask
from labelgen.errors import DataError, LabelgenError
from labelgen.labels import Sample
from labelgen.masks import create_mask_source, masked_frames, prime_masks
from labelgen.media.open_frames import open_frames
from labelgen.shards import ShardDataset, summarise

__all__ = ["Audit", "make_audit"]

_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1400px;padding:0 1rem;background:#fafafa}
img{max-width:100%;border:1px solid #ccc;background:#fff;margin:.3rem 0}table{border-collapse:collapse}
td{padding:.15rem 1rem .15rem 0;border-bottom:1px solid #ddd}h2{margin-top:2rem}code{background:#eee;padding:0 .3em}"""


@dataclass
class Audit:
    """What was made.

    Args:
        page: the page to open.
        pictures: by chapter.
        notes: what could not be shown, and why.
    """

    page: Path
    pictures: dict[str, list[Path]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def make_audit(shards: Sequence[Path], out: Path, *, count: int = 50, seed: int = 0) -> Audit:
    """Make the audit folder.

    Args:
        shards: shards or folders of shards.
        out: folder for it.
        count: labels on the contact sheets.
        seed: which labels.

    Raises:
        DataError: no label in the shards.
    """
    data = ShardDataset(shards)
    if not any(reader.label_count for reader in data.readers):
        raise DataError(f"{shards[0]}: no label in these shards, there is nothing to look at")
    kinds = sorted({f"{reader.pair} {reader.attributes['size']}" for reader in data.readers})
    if len(kinds) > 1:
        raise DataError(
            f"these shards are of different pairs or sizes ({', '.join(kinds)}); audit each kind on its own"
        )
    make_folder(out)
    originals = Originals(data)
    audit = Audit(out / "index.html")
    audit.pictures["Labels chosen at random: picture, label, original"] = label_sheets(
        data, originals, out, count=count, seed=seed
    )
    audit.pictures["Whole rectified images with all their labels"] = frame_sheets(data, out)
    audit.pictures["Statistics"] = [draw_statistics(data, out / "statistics.png")]
    _explain(data, originals, out, audit)
    _write_page(data, audit)
    return audit


def _explain(data: ShardDataset[Sample], originals: Originals, out: Path, audit: Audit) -> None:
    """Figures of the steps for the first sample whose original is at hand."""
    sample = data[0]
    picture = originals.read([0])[0]
    if picture is None:
        audit.notes.append("no figure of the rectification: the original of the first sample is not at hand")
        return
    source = originals.place(0)
    road = None
    if source.get("road_mask"):
        try:
            road = read_mask(Path(source["road_mask"]))
        except LabelgenError as err:
            audit.notes.append(f"no road mask in the figure of the rectification: {err}")
    figure = rectification_figure(picture, sample.rectification, sample.camera, sample.window_xyxy, road)
    audit.pictures["Steps of the rectification"] = [save_picture(out / "rectification.png", figure)]
    if source.get("masks"):
        found: NDArray[np.uint8] | str
        try:
            found = _mask_figure(data, source)
        except LabelgenError as err:
            found = str(err)
        if isinstance(found, str):
            audit.notes.append(f"no figure from mask to label: {found}")
        else:
            audit.pictures["Steps from mask to label"] = [save_picture(out / "mask-to-label.png", found)]


def _mask_figure(data: ShardDataset[Sample], source: dict[str, Any]) -> NDArray[np.uint8] | str:
    """The figure for the first labelled frame, made with the same mask source; or why there is none."""
    sample = data[0]
    frames = open_frames(Path(source["path"]))
    masks = create_mask_source(
        source["masks"],
        weights=source.get("weights"),
        score_threshold=float(data.readers[0].settings.get("score", 0.5)),
        road_mask=read_mask(Path(source["road_mask"])),
        frame_wh=frames.size_wh,
    )
    prime_masks(masks, frames)
    rule = Rule.parse(str(data.readers[0].settings.get("rule", Rule.WIDER)))
    for frame, found in masked_frames(frames, masks, lambda number: number == sample.frame):
        assert found is not None
        for i in sorted(range(len(found)), key=lambda i: -int(found.crops[i].sum())):
            x, y = (int(v) for v in found.origins[i])
            figure = mask_label_figure(frame.image, found.crops[i], (x, y), sample.rectification, rule)
            if figure is not None:
                return figure
        break
    return "no mask of the first labelled frame gives a label"


def _write_page(data: ShardDataset[Sample], audit: Audit) -> None:
    summary = summarise(data.readers)
    rows = [
        ("shards", summary.shards),
        ("images", summary.images),
        ("labels", summary.labels),
        ("rejects", summary.rejects),
        *((f"&nbsp;&nbsp;{html.escape(reason)}", count) for reason, count in summary.reasons.most_common()),
        ("pair and size", f"{data.readers[0].pair} {data.readers[0].attributes['size']}"),
        *(("settings", html.escape(text)) for text in sorted({r.attributes["settings"] for r in data.readers})),
    ]
    parts = [f"<!doctype html><meta charset=utf-8><title>labelgen audit</title><style>{_STYLE}</style>"]
    parts.append("<h1>labelgen audit</h1>")
    parts.append("<table>" + "".join(f"<tr><td>{name}<td>{value}" for name, value in rows) + "</table>")
    parts.append(
        "<p>On rectified pictures: <b>2D box</b> green, <b>c_c</b> yellow, towards <b>VPU</b> magenta, 3D box with its "
        "front face red and the rest blue. Each label stands three times: bare, with the label, on the original.</p>"
    )
    parts += [f"<p>{html.escape(note)}</p>" for note in audit.notes]
    for chapter, pictures in audit.pictures.items():
        parts.append(f"<h2>{html.escape(chapter)}</h2>")
        parts += [f'<img src="{picture.name}" alt="{html.escape(chapter)}">' for picture in pictures]
    write_atomic(audit.page, "\n".join(parts).encode())

"""How the pictures of vehicles in a real and a synthetic video differ, in figures.

    python -m tools.lookalike_table REAL.mp4 SYNTHETIC.avi --min-px 36

Both videos are cut as for `tools.lookalike_sheet`. For each figure the table gives the median over the real and over
the synthetic crops, and how well the figure alone tells them apart: the chance that a synthetic crop has more of it
than a real one, 0.50 when it tells nothing. Last comes how many of the crops a linear rule on all figures but the width
sorts rightly when it was made without the crop it sorts; half of them by guessing.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from labelgen.errors import LabelgenError
from tools.lookalike_sheet import vehicle_crops

__all__ = ["FIGURES", "compare", "figures", "main", "told_apart"]

FIGURES = (
    "width px", "mean grey", "contrast", "mean gradient", "95 % gradient", "99 % gradient", "fine / all contrast",
    "middle / all contrast", "black px %", "white px %", "colour spread", "strongest colour",
    "cast b - y", "cast r - c",
)  # fmt: skip


def figures(crop: Any) -> list[float]:
    """`FIGURES` of a crop (h, w, 3) uint8 BGR; all but the first of its inner part, where the vehicle is."""
    import cv2
    import numpy as np

    height, width = crop.shape[:2]
    inner = crop[round(0.14 * height) : round(0.86 * height), round(0.14 * width) : round(0.86 * width)]
    planes = cv2.cvtColor(inner, cv2.COLOR_BGR2YCrCb).astype(np.float32)
    grey = planes[..., 0]
    colour = planes[..., 1:] - 128
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    fine = grey - cv2.GaussianBlur(grey, (0, 0), 1.0)
    middle = cv2.GaussianBlur(grey, (0, 0), 1.0) - cv2.GaussianBlur(grey, (0, 0), 3.0)
    spread = max(float(grey.std()), 1.0)
    strength = np.hypot(colour[..., 0], colour[..., 1])
    return [
        float(width), float(grey.mean()), float(grey.std()), float(gradient.mean()),
        float(np.percentile(gradient, 95)), float(np.percentile(gradient, 99)),
        float(fine.std()) / spread, float(middle.std()) / spread,
        100 * float((grey < 30).mean()), 100 * float((grey > 225).mean()), float(colour.std(axis=(0, 1)).mean()),
        float(np.percentile(strength, 98)), float(np.median(colour[..., 1])), float(np.median(colour[..., 0])),
    ]  # fmt: skip


def compare(real: list[Any], synthetic: list[Any]) -> list[tuple[str, float, float, float]]:
    """Per figure: its name, the medians over real and synthetic crops, and the chance that a synthetic one has more."""
    import numpy as np

    a, b = (np.array([figures(c) for c in crops]) for crops in (real, synthetic))
    more = (b[:, None] > a[None]).mean(axis=(0, 1)) + 0.5 * (b[:, None] == a[None]).mean(axis=(0, 1))
    rows = zip(FIGURES, np.median(a, axis=0).tolist(), np.median(b, axis=0).tolist(), more.tolist(), strict=True)
    return list(rows)


def told_apart(real: list[Any], synthetic: list[Any]) -> float:
    """Share of crops that Fisher's linear rule on all figures but the width sorts rightly, each left out in turn."""
    import numpy as np

    rows = np.array([figures(c)[1:] for c in [*real, *synthetic]])
    kinds = np.array([-1.0] * len(real) + [1.0] * len(synthetic))
    rows = (rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1e-9)
    right = 0
    for k in range(len(rows)):
        others = np.arange(len(rows)) != k
        means = [rows[others & (kinds == kind)].mean(axis=0) for kind in (-1, 1)]
        within = rows[others] - np.where(kinds[others, None] > 0, means[1], means[0])
        spread = within.T @ within / others.sum() + 0.3 * np.eye(rows.shape[1])
        weights = np.linalg.solve(spread, means[1] - means[0])
        right += bool(kinds[k] * ((rows[k] - (means[0] + means[1]) / 2) @ weights) > 0)
    return right / len(rows)


def main(
    real: Annotated[Path, typer.Argument(help="A real video.")],
    synthetic: Annotated[list[Path], typer.Argument(help="Synthetic videos.")],
    count: Annotated[int, typer.Option(min=5, help="Vehicles of each video.")] = 40,
    seed: Annotated[int, typer.Option(help="Choice.")] = 0,
    min_px: Annotated[int, typer.Option(help="Shorter side of a crop at least, px.")] = 36,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here, too.")] = None,
) -> None:
    """Compare the contrast and the colours of vehicles in real and synthetic videos."""
    crops = [crop for video in synthetic for crop in vehicle_crops(video, count, seed, min_px)]
    others = vehicle_crops(real, count, seed, min_px)
    rows, told = compare(others, crops), told_apart(others, crops)
    typer.echo(f"{'':>22} {'real':>9} {'synthetic':>9} {'synthetic has more':>20}")
    for name, a, b, more in rows:
        typer.echo(f"{name:>22} {a:9.2f} {b:9.2f} {more:20.2f}")
    typer.echo(f"{told:.0%} of {len(others) + len(crops)} crops sorted rightly by a linear rule on all but the width")
    if json_file is not None:
        json_file.write_text(
            json.dumps({n: [a, b, m] for n, a, b, m in rows} | {"told apart": told}, indent=1) + "\n", encoding="utf-8"
        )


if __name__ == "__main__":
    try:
        typer.run(main)
    except LabelgenError as err:
        raise SystemExit(f"error: {err}") from None

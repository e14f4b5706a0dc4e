"""Statistics of a data set as one figure: c_c, sizes, positions, candidates, rejects by reason."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from labelgen.atomic_files import write_atomic
from labelgen.labels import Sample
from labelgen.printable import printable
from labelgen.shards import ShardDataset, summarise

__all__ = ["draw_statistics"]


def draw_statistics(data: ShardDataset[Sample], path: Path) -> Path:
    """Write the figure with its six panels as an image file, and return its path."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    boxes, cc, candidates = (data.table(f"labels/{name}") for name in ("box", "cc", "candidates"))
    size_wh = data.readers[0].size_wh
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3).ravel()
    axes[0].hist(cc, bins=50, range=(0, 1), color="#3b78c2")
    axes[0].set(title=f"c_c of {len(cc)} labels", xlabel="c_c", ylabel="labels")
    widths, heights = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
    for values, name, colour in ((widths, "width", "#3b78c2"), (heights, "height", "#d1702e")):
        axes[1].hist(values, bins=50, histtype="step", label=name, color=colour)
    axes[1].set(title="box size", xlabel="px", ylabel="labels")
    axes[1].legend()
    axes[2].scatter(widths, heights, s=4, c=cc, cmap="viridis", vmin=0, vmax=1)
    axes[2].set(title="box width and height, colour c_c", xlabel="width, px", ylabel="height, px")
    x, y = (boxes[:, 0] + boxes[:, 2]) / 2, (boxes[:, 1] + boxes[:, 3]) / 2
    counts = axes[3].hist2d(x, y, bins=(40, 40), range=((0, size_wh[0]), (0, size_wh[1])), cmap="magma")
    axes[3].invert_yaxis()
    axes[3].set(title="positions of box centres", xlabel="x, px", ylabel="y, px", aspect="equal")
    figure.colorbar(counts[3], ax=axes[3], label="labels")
    apart = np.abs(np.diff(candidates, axis=1))[:, 0]
    apart = apart[np.isfinite(apart)]
    if apart.size:
        axes[4].hist(apart, bins=50, range=(0, max(0.3, float(np.percentile(apart, 99)))), color="#3b78c2")
    axes[4].set(title="distance of the two candidates" if apart.size else "no mask labels", xlabel="|c_c difference|")
    reasons = summarise(data.readers).reasons.most_common(12)
    # A dollar sign would begin a formula.
    axes[5].barh(
        [printable(reason).replace("$", r"\$") for reason, _ in reasons][::-1],
        [count for _, count in reasons][::-1],
        color="#8a8a8a",
    )
    axes[5].set(title="rejects by reason" if reasons else "no rejects", xlabel="inputs")
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_atomic(path, picture.getvalue())
    return path

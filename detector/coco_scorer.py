"""COCO's scorer of detections, with regions in which they count neither way."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pycocotools.cocoeval import COCOeval

from labelgen.labels import MIN_IGNORED_SHARE

__all__ = ["RegionScorer"]


class RegionScorer(COCOeval):  # type: ignore[misc]
    """Scorer that takes crowds marked as regions for ignored boxes.

    A detection belongs to a crowd by the share of its area that the crowd covers, and COCO asks for more of it at each
    higher threshold of IoU. For a region the share asked for is the same at all of them.
    """

    KEY: ClassVar[str] = "is_region"
    """Key of annotations, bool."""

    def computeIoU(self, imgId: Any, catId: Any) -> NDArray[np.float64] | list[Any]:  # noqa: N802
        """Return the overlap (D, G) of an image's detections with its annotations, as COCO asks for it."""
        overlap: NDArray[np.float64] | list[Any] = super().computeIoU(imgId, catId)
        if isinstance(overlap, np.ndarray):
            is_region = np.array([annotation[self.KEY] for annotation in self._gts[imgId, catId]], dtype=np.bool_)
            overlap[:, is_region] = overlap[:, is_region] >= MIN_IGNORED_SHARE
        return overlap

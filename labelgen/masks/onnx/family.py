"""The interface of the families of networks, told apart by the shapes of their outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from labelgen.errors import DataError
from labelgen.masks.onnx.candidates import Candidates
from labelgen.masks.onnx.placement import Placement, Window

__all__ = ["Family", "Trial", "box_corners", "checked_scores"]

# Half precision may round 1 up.
_MAX_SCORE = 1.01


@dataclass(frozen=True)
class Trial:
    """What a network gave for a grey picture, and what its file states.

    Args:
        outputs: arrays, in order.
        output_names: of the arrays.
        metadata: texts of the file.
        names: of the classes, where the file states them.
        picture_wh: size of the grey picture, px.
    """

    outputs: Sequence[NDArray[Any]]
    output_names: Sequence[str]
    metadata: Mapping[str, str]
    names: Mapping[int, str] | None
    picture_wh: tuple[int, int]


class Family(Protocol):
    """Networks whose pictures are made, and whose outputs are read, in one way.

    Attributes:
        title: name in messages.
        class_count: number of classes; 0 where the outputs do not show it.
    """

    @property
    def title(self) -> str: ...
    @property
    def class_count(self) -> int: ...

    def place(self, window: Window, picture_wh: tuple[int, int]) -> Placement:
        """Return how a window of the frame becomes a picture."""
        ...

    def normalise(self, pictures: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the network takes of pictures (B, 3, H, W) RGB from 0 to 1; may change them in place."""
        ...

    def read(
        self,
        outputs: Sequence[NDArray[Any]],
        index: int,
        picture_wh: tuple[int, int],
        classes: NDArray[np.uint8],
        min_score: float,
    ) -> Candidates:
        """Return the vehicles in one picture of a batch.

        Args:
            outputs: of the batch.
            index: of the picture.
            picture_wh: its size, px.
            classes: `VehicleClass` of each class number, see `labelgen.masks.onnx.network_classes`.
            min_score: candidates with a lower score are left out.

        Raises:
            DataError: scores beyond 1.
        """
        ...


def checked_scores(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return scores (N,), those just above 1 as 1.

    Raises:
        DataError: a score beyond 1: it is no probability.
    """
    if scores.size and float(scores.max()) > _MAX_SCORE:
        raise DataError(f"a class score of {scores.max():.3g}: expected scores from 0 to 1; export the network again")
    return np.minimum(scores, np.float32(1))


def box_corners(centres_sizes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return boxes (N, 4) given as centre x, y, width, height as x0, y0, x1, y1."""
    half = centres_sizes[:, 2:] / 2
    with np.errstate(invalid="ignore"):  # boxes that are not finite are refused later
        return np.concatenate([centres_sizes[:, :2] - half, centres_sizes[:, :2] + half], axis=1)

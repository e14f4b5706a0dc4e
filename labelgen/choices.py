"""Choices that are made by a word, in calls, files and on the command line: pair, region, rule and size.

This module imports nothing that takes time to load.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Self

from labelgen.errors import LabelgenError

__all__ = ["Choice", "Pair", "Region", "Rule", "parse_size"]


class Choice(StrEnum):
    """A choice between words."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the member of a value, in any case and with blanks around it.

        Raises:
            LabelgenError: no such value; the message names those that exist.
        """
        for member in cls:
            if member.value.lower() == text.strip().lower():
                return member
        name = cls.__name__.lower()
        raise LabelgenError(
            f"{name} {text}: unknown {name}; use one of {', '.join(member.value for member in cls)}", parameter=name
        )


class Pair(Choice):
    """The two vanishing points whose directions become axis-parallel in the rectified image.

    VP1 is the direction of travel, VP2 lies across the road, VP3 is vertical.
    """

    VP2_VP3 = "VP2-VP3"
    VP1_VP2 = "VP1-VP2"

    @property
    def vertical(self) -> int:
        """Number of the vanishing point whose lines become vertical."""
        return 3 if self is Pair.VP2_VP3 else 1

    @property
    def unused(self) -> int:
        """Number of VPU, the vanishing point that stays finite."""
        return 1 if self is Pair.VP2_VP3 else 3


class Region(Choice):
    """The part of the frame that a rectification is fitted to."""

    ROAD = "road"
    """The road mask (Kocur & Ftacnik 2020, section 3.2)."""
    FRAME = "frame"
    """The whole frame (Kocur 2019)."""
    NONE = "none"
    """Nothing: the frame is resized and not rectified (Orig2D)."""


class Rule(Choice):
    """How masks become labels.

    WIDER and CONDITIONED: from the box around the mask and the two candidates for c_c that its tangents give; see
    `labelgen.geometry.label_outlines`. FITTED: from a body laid over the masks of a passage; see
    `labelgen.labeling.label_passages`.
    """

    WIDER = "wider"
    """The candidate that gives the larger 3D box (Kocur & Ftacnik 2020, section 3.4)."""
    CONDITIONED = "conditioned"
    """The mean of both, each weighted by how little a shift of its tangent moves it."""
    FITTED = "fitted"
    """The cuboid of a vehicle's body that explains its masks."""

    @property
    def is_of_tangents(self) -> bool:
        """Whether labels come from a mask's tangents."""
        return self is not Rule.FITTED


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) in px of a size written as "640x360".

    Raises:
        LabelgenError: not of this form, or a side that is not between 16 and 8192 px.
    """
    match = re.fullmatch(r"\s*(\d{1,5})\s*[xX×]\s*(\d{1,5})\s*", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(16 <= n <= 8192 for n in size):
        raise LabelgenError(
            f"size {text}: unknown size; write WIDTHxHEIGHT in px, 16 to 8192, as 640x360", parameter="size"
        )
    return size

"""What a rectification is asked for: which vanishing points, which part of the frame, what size."""

from __future__ import annotations

import re
from enum import StrEnum

from labelgen.errors import LabelgenError

__all__ = ["Pair", "Region", "parse_size"]


class Region(StrEnum):
    """What a rectification is fitted to: the road, the whole frame (the earlier method), or nothing (Orig2D)."""

    ROAD = "road"
    FRAME = "frame"
    NONE = "none"

    @classmethod
    def parse(cls, text: str) -> Region:
        """Region from its name, in any case; LabelgenError names the known ones."""
        for region in cls:
            if region.value == text.strip().lower():
                return region
        raise LabelgenError(f"--region {text}: unknown region; use one of {', '.join(r.value for r in cls)}")


class Pair(StrEnum):
    """The two vanishing points whose directions become axis-parallel."""

    VP2_VP3 = "VP2-VP3"
    VP1_VP2 = "VP1-VP2"

    @classmethod
    def parse(cls, text: str) -> Pair:
        """Pair from its name, in any case; LabelgenError names the known ones."""
        for pair in cls:
            if pair.value == text.strip().upper():
                return pair
        raise LabelgenError(f"--pair {text}: unknown pair; use one of {', '.join(p.value for p in cls)}")

    @property
    def vertical(self) -> int:
        """Number of the vanishing point whose lines become vertical."""
        return 3 if self is Pair.VP2_VP3 else 1

    @property
    def unused(self) -> int:
        """Number of VPU, the vanishing point that stays finite."""
        return 1 if self is Pair.VP2_VP3 else 3


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) px from "640x360"; LabelgenError for anything else."""
    match = re.fullmatch(r"\s*(\d{1,5})\s*[xX×]\s*(\d{1,5})\s*", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(16 <= n <= 8192 for n in size):
        raise LabelgenError(f"--size {text}: unknown size; write WIDTHxHEIGHT in px, 16 to 8192, as 640x360")
    return size

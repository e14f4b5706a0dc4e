"""Count the frames that damage took from a video, so that later frames keep their numbers."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from typing import Any

__all__ = ["LostFrames"]


class LostFrames:
    """Frames whose packets went to the decoder, but which never came out of it."""

    def __init__(self) -> None:
        self._sent: list[int] = []
        self._lost = 0

    def noted(self, packets: Iterable[Any]) -> Iterator[Any]:
        """Yield packets on their way to the decoder, and note which frames they announce."""
        for packet in packets:
            if packet.pts is not None and packet.size and not packet.is_discard:
                heapq.heappush(self._sent, packet.pts)
            yield packet

    def count(self, pts: int | None, *, is_damaged: bool) -> int:
        """Return how many frames were lost before a decoded one.

        Args:
            pts: time stamp of the decoded frame; to be asked in the order in which frames are shown.
            is_damaged: whether the decoder has refused a packet so far. Before that nothing is lost: some recordings
                have packets without a frame.
        """
        while pts is not None and self._sent and self._sent[0] <= pts:
            is_before = heapq.heappop(self._sent) < pts
            self._lost += is_damaged and is_before
        return self._lost

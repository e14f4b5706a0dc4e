"""Skip packets of a video whose frames nobody wants; decoding resumes at a key frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

__all__ = ["KeyframeSeek"]


class KeyframeSeek:
    """Packets skipped in one pass over a video.

    Args:
        not_before_s: asked before each packet; no frame before this time is wanted, s since the first frame.
        lookahead_s: how far behind the wanted time a key frame may lie, s. Until one is found, that much of the
            compressed video is kept in memory.

    Attributes:
        skipped_packets: number of packets skipped so far, of one frame each.
        resumed_s: time of the key frame at which decoding last resumed, s.
    """

    def __init__(self, not_before_s: Callable[[], float], *, lookahead_s: float = 10.0) -> None:
        self._not_before_s, self._lookahead_s = not_before_s, lookahead_s
        self.skipped_packets = 0
        self.resumed_s = -math.inf
        self._resumed_pts: int | None = None

    def is_leading(self, pts: int | None) -> bool:
        """Return whether a decoded frame is shown before the key frame at which decoding resumed: it may be damaged.

        Args:
            pts: time stamp of the frame; frames are asked about in the order in which they are shown.
        """
        if self._resumed_pts is not None and (pts is None or pts >= self._resumed_pts):
            self._resumed_pts = None
        return self._resumed_pts is not None

    def needed(self, packets: Iterator[Any], time_of: Callable[[Any], float]) -> Iterator[Any]:
        """Yield the packets to decode, in order.

        Decoding resumes at the first key frame at or after the wanted time; where that lies beyond `lookahead_s`, at
        the last key frame before the wanted time.

        Args:
            packets: in the decoder's order; errors they raise pass through.
            time_of: returns a packet's time, s since the first frame; NaN where it has none.
        """
        for packet in packets:
            wanted_s = self._not_before_s()
            if not time_of(packet) < wanted_s:
                yield packet
                continue
            held, resume_at = [packet], 0
            for later in packets:
                held.append(later)
                if later.is_keyframe:
                    resume_at = len(held) - 1
                if time_of(later) >= wanted_s + (0 if later.is_keyframe else self._lookahead_s):
                    break
            if resume_at:
                self.skipped_packets += resume_at
                self.resumed_s, self._resumed_pts = time_of(held[resume_at]), held[resume_at].pts
            yield from held[resume_at:]

"""Packets of a video left out where nobody wants its frames: decoding goes on at a key frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

__all__ = ["Leap"]

# A leap may go on to a key frame so much later than was asked for. So much of the video, compressed, is kept in memory.
_BEYOND_S = 10.0


class Leap:
    """What is left out of one pass over a video.

    Args:
        not_before_s: asked before each packet: no frame that comes earlier is wanted, s since the first frame.

    Attributes:
        dropped: how many packets, of a frame each, were left out.
        landed_s: time of the key frame that the last leap ended at; frames before it may look wrong.
    """

    def __init__(self, not_before_s: Callable[[], float]) -> None:
        self._not_before_s = not_before_s
        self.dropped = 0
        self.landed_s = -math.inf

    def over(self, packets: Iterator[Any], time_of: Callable[[Any], float]) -> Iterator[Any]:
        """The packets that are needed, in order.

        The leap goes to the first key frame from the time on that is wanted; where that is too far away, to the last
        one before it.

        Args:
            packets: in the decoder's order; errors they raise pass through.
            time_of: a packet's time, s since the first frame; NaN where it has none.
        """
        for packet in packets:
            until = self._not_before_s()
            if not time_of(packet) < until:
                yield packet
                continue
            held, landing = [packet], 0
            for later in packets:
                held.append(later)
                if later.is_keyframe:
                    landing = len(held) - 1
                if time_of(later) >= until + (0 if later.is_keyframe else _BEYOND_S):
                    break
            if landing:
                self.dropped += landing
                self.landed_s = time_of(held[landing])
            yield from held[landing:]

"""Whole frames from interlaced ones: one frame for each, with its number and time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import av
from av.error import FFmpegError

from labelgen.media.container.frame_clock import TimedItem

__all__ = ["DEINTERLACED", "deinterlaced"]

DEINTERLACED = "its frames are deinterlaced, as asked"
# One frame for each frame, whether its header says that it is interlaced or not: cameras forget to say it.
_FILTER, _OPTIONS = "bwdif", "mode=send_frame:parity=auto:deint=all"


def deinterlaced(items: Iterator[TimedItem[Any]]) -> Iterator[TimedItem[Any]]:
    """Yield the same items with deinterlaced frames, each when the frame after it has come.

    Args:
        items: decoder's frames in order, with number and time. Where numbers are left out, the frames on both sides
            are not mixed.
    """
    waiting: deque[TimedItem[Any]] = deque()
    graph, shape, last = None, None, -1
    for item in items:
        frame = item.item
        here = (frame.width, frame.height, frame.format.name)
        if graph is not None and (here != shape or item.number != last + 1):
            yield from _finished(graph, waiting)
            graph = None
        if graph is None:
            graph, shape = _graph(frame), here
        last = item.number
        # The stamps tell the filter the order alone.
        frame.pts, frame.time_base = item.number, Fraction(1, 25)
        waiting.append(item)
        graph.push(frame)
        yield from _ready(graph, waiting)
    if graph is not None:
        yield from _finished(graph, waiting)


def _graph(frame: Any) -> Any:
    graph = av.filter.Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 25))
    change, sink = graph.add(_FILTER, _OPTIONS), graph.add("buffersink")
    source.link_to(change)
    change.link_to(sink)
    graph.configure()
    return graph


def _ready(graph: Any, waiting: deque[TimedItem[Any]]) -> Iterator[TimedItem[Any]]:
    while waiting:
        try:
            frame = graph.pull()
        except (BlockingIOError, EOFError, FFmpegError):
            return
        yield waiting.popleft()._replace(item=frame)


def _finished(graph: Any, waiting: deque[TimedItem[Any]]) -> Iterator[TimedItem[Any]]:
    """Yield what the filter still holds; a frame that it does not give back stays as it is."""
    graph.push(None)
    yield from _ready(graph, waiting)
    while waiting:
        yield waiting.popleft()

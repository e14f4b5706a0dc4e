"""Log what a source of frames assumed, and what was wrong with it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from labelgen.media.frames import FrameSource

__all__ = ["frame_notes"]

_log = logging.getLogger(__name__)


@contextmanager
def frame_notes(frames: FrameSource) -> Iterator[None]:
    """Log the notes of a source at once, and its problems at the end of the block, whatever ends it."""
    for note in frames.notes:
        _log.info("%s: %s", frames.name, note)
    try:
        yield
    finally:
        for problem in frames.problems:
            _log.warning("%s: %s", frames.name, problem)

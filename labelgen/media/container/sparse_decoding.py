"""Decode the wanted frames of a video and as few others as their pictures need.

A group of pictures is a key frame and the packets after it, up to the next key frame. Its packets say which frames it
holds before anything is decoded. So frames keep their numbers although a group without a wanted frame is passed over,
and another one is decoded up to its last wanted frame only, without the frames that no other frame refers to.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from av.error import FFmpegError
from av.video.frame import PictureType

from labelgen.media.frame_choice import FrameChooser

__all__ = ["SPARSE_RULES", "NotSparseError", "SparseDecoder", "SparseRules", "can_be_sparse"]

# Codecs of which each packet is one frame that is shown.
_CODECS = frozenset({"h264", "hevc", "mpeg4", "mpeg1video", "mpeg2video", "mjpeg", "prores", "dnxhd"})
_MPEG4 = "mpeg4"

ShownFrame = tuple[int, int, Any]
"""Number, time stamp and decoded picture of a frame; None for the picture of a frame that is not wanted."""


@dataclass(frozen=True)
class SparseRules:
    """When frames are left undecoded."""

    min_tail: int = 6
    """Frames behind the last wanted one of a group from which on they are left undecoded. The decoder is emptied before
    frames are passed over, and its threads are idle meanwhile."""
    max_group_bytes: int = 64 << 20
    """Size of a group of pictures, bytes, from which on a video is decoded in sequence. Two are kept in memory."""
    min_mpeg4_bytes: int = 12
    """Packets of MPEG-4 that are smaller may say that there is no frame."""


SPARSE_RULES = SparseRules()


class NotSparseError(Exception):
    """Packets do not say which frames there are, or a frame is damaged: the video must be decoded in sequence."""


def can_be_sparse(stream: Any) -> bool:
    """Return whether each packet of a video stream of PyAV is one frame that is shown, as far as its codec says."""
    return stream.codec_context.codec.canonical_name in _CODECS


@dataclass(eq=False)
class _Entry:
    """A frame that a packet announces.

    Args:
        number: of the frame.
        pts: its time stamp.
        is_key: whether it is the key frame of its group.
        is_wanted: whether its picture is asked for.
        is_awaited: whether the decoder must give it, unless something is damaged.
    """

    number: int
    pts: int
    is_key: bool
    is_wanted: bool
    is_awaited: bool = False


@dataclass(eq=False)
class _Group:
    """Packets of a group of pictures, in the decoder's order, and the frames they announce, in the order shown."""

    packets: list[Any] = field(default_factory=list)
    entries: list[_Entry] = field(default_factory=list)
    byte_count: int = 0

    @property
    def key_pts(self) -> int:
        return int(self.packets[0].pts)

    @property
    def refers_back(self) -> bool:
        """Whether a wanted frame is shown before the key frame: it may refer to the group before."""
        return any(entry.is_wanted and entry.pts < self.key_pts for entry in self.entries)

    def needed(self, *, whole: bool, rules: SparseRules) -> int:
        """Return how many packets of the beginning must be decoded."""
        wanted = {entry.pts for entry in self.entries if entry.is_wanted}
        total = len(self.packets)
        places = [place for place, packet in enumerate(self.packets) if packet.pts in wanted]
        count = total if whole else max(places, default=-1) + 1
        return total if count and total - count < rules.min_tail else count


class SparseDecoder:
    """One pass over a video in which only wanted frames, and what they refer to, are decoded.

    Args:
        context: codec context of the stream, of PyAV.
        chooser: of this pass; asked ahead of what `frames` yields.
        rules: thresholds.
    """

    def __init__(self, context: Any, chooser: FrameChooser, *, rules: SparseRules = SPARSE_RULES) -> None:
        self._context, self._chooser, self._rules = context, chooser, rules
        # Pictures of such a codec refer to no other ones: nothing has to be emptied before packets are passed over.
        self._is_intra = bool(context.codec.intra_only)
        self._least_bytes = rules.min_mpeg4_bytes if context.codec.canonical_name == _MPEG4 else 1
        self._entries: deque[_Entry] = deque()  # announced, but not yielded
        self._count = 0  # frames announced so far
        self._latest_pts = -math.inf
        self._is_first = True
        self._is_fed = False  # whether the decoder may hold frames
        self._is_continuous = True  # whether it has got all packets so far
        self._valid_from = -math.inf  # frames before this stamp refer to packets that were passed over
        self._held: deque[ShownFrame] = deque()

    def frames(self, packets: Iterator[Any]) -> Iterator[ShownFrame]:
        """Yield each frame in the order shown, whether wanted or not, up to the last one that is taken or farther.

        Args:
            packets: of the stream, in the decoder's order; errors they raise pass through.

        Raises:
            NotSparseError: the rest of the video must be decoded in sequence. What was yielded before is right.
        """
        group: _Group | None = None
        for following in self._groups(packets):
            self._announce(following)
            if group is not None:
                yield from self._decoded(group, whole=following.refers_back)
            group = following
            if self._chooser.is_over and self._count - 1 > self._chooser.last:
                break  # the frame after the last one is known as well: its stamp tells whether the last one's is right
        if group is not None:
            yield from self._decoded(group, whole=False)
        yield from self._emptied()
        yield from self._released(0)

    def _groups(self, packets: Iterator[Any]) -> Iterator[_Group]:
        group = _Group()
        for packet in packets:
            if packet.size == 0 and packet.pts is None:
                break  # PyAV's sign that the file has ended
            if packet.is_keyframe and group.packets:
                yield group
                group = _Group()
            if packet.pts is None or packet.size < self._least_bytes:
                raise NotSparseError
            if not group.packets and not packet.is_keyframe:
                raise NotSparseError
            group.packets.append(packet)
            group.byte_count += packet.size
            if group.byte_count > self._rules.max_group_bytes:
                raise NotSparseError
        if group.packets:
            yield group

    def _announce(self, group: _Group) -> None:
        """Number the frames of a group."""
        key = group.key_pts
        stamps = sorted(packet.pts for packet in group.packets if not packet.is_discard)
        if not stamps:
            return
        if stamps[0] <= self._latest_pts or any(before == after for before, after in pairwise(stamps)):
            raise NotSparseError
        if not self._count and stamps[0] < key:
            # Such frames refer to packets before the file's first one: only the decoder knows which of them it gives.
            raise NotSparseError
        for number, pts in enumerate(stamps, start=self._count):
            group.entries.append(_Entry(number, pts, pts == key, self._chooser.takes(number, pts == key)))
        self._count, self._latest_pts = self._count + len(stamps), stamps[-1]

    def _decoded(self, group: _Group, *, whole: bool) -> Iterator[ShownFrame]:
        """Decode what is needed of a group, or all of it."""
        # The first group is decoded in any case: it shows whether packets and frames are the same.
        is_first, self._is_first = self._is_first, False
        count = group.needed(whole=whole or is_first, rules=self._rules)
        if not count:
            if not self._is_intra:
                yield from self._emptied()
            self._is_continuous = False
            self._entries.extend(group.entries)
            if not self._is_fed:
                self._pass_over(math.inf)
                yield from self._released(0)
            return
        if not self._is_continuous and not self._is_intra:
            yield from self._emptied()
            self._context.flush_buffers()
            self._valid_from = group.key_pts
        for entry in group.entries:
            entry.is_awaited = entry.is_wanted or entry.is_key or is_first
        self._entries.extend(group.entries)
        needed = {entry.pts for entry in group.entries if entry.is_awaited}
        for packet in group.packets[:count]:
            if packet.is_corrupt:
                raise NotSparseError
            self._context.skip_frame = "DEFAULT" if packet.pts in needed else "NONREF"
            yield from self._given(packet)
        self._is_continuous = count == len(group.packets)
        if not self._is_continuous:
            yield from self._emptied()

    def _emptied(self) -> Iterator[ShownFrame]:
        """Take what the decoder still holds; all announced frames are passed then."""
        if self._is_fed:
            yield from self._given(None)
            self._is_fed = self._is_continuous = False
        self._pass_over(math.inf)
        yield from self._released(0)

    def _given(self, packet: Any) -> Iterator[ShownFrame]:
        """Decode a packet, or None for the end; yield what the decoder gives, and the frames before."""
        try:
            pictures = self._context.decode(packet)
        except (FFmpegError, EOFError):
            raise NotSparseError from None
        self._is_fed = True
        for picture in pictures:
            if picture.pts is None or (picture.is_corrupt and picture.pts >= self._valid_from):
                raise NotSparseError
            self._pass_over(picture.pts)
            if not self._entries or self._entries[0].pts != picture.pts:
                raise NotSparseError
            entry = self._entries.popleft()
            if entry.is_key and picture.pict_type != PictureType.I:
                # A recording that is refreshed bit by bit, or whose flags are wrong: it does not decode alone.
                raise NotSparseError
            self._held.append((entry.number, entry.pts, picture if entry.is_wanted else None))
            # A frame may refer to damaged ones that are shown later.
            yield from self._released(int(self._context.reorder_depth))

    def _pass_over(self, pts: float) -> None:
        """Take the announced frames before a stamp as those that the decoder does not give."""
        while self._entries and self._entries[0].pts < pts:
            entry = self._entries.popleft()
            if entry.is_awaited:
                raise NotSparseError
            self._held.append((entry.number, entry.pts, None))

    def _released(self, count: int) -> Iterator[ShownFrame]:
        """Yield the frames that are held back, but for so many."""
        while len(self._held) > count:
            yield self._held.popleft()

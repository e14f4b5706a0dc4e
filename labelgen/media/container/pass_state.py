"""How far one pass over a video file came, and what was wrong with the file."""

from __future__ import annotations

from labelgen.media.container.file_stamps import ClockCarry
from labelgen.problem_counts import count_of

__all__ = ["PassState", "ProblemCounts"]

# A frame count computed from duration times rate may be off by this many frames, or by this share of them.
_COUNT_SLACK = (3, 0.02)


class ProblemCounts:
    """Counts of what went wrong in one pass over a file.

    Attributes:
        end: why reading broke off; None where it did not.
    """

    def __init__(self) -> None:
        self.end: str | None = None
        self._packets = self._frames = self._sizes = 0
        self._first_packet = self._first_frame = self._first_size = 0
        self._other_wh = (0, 0)

    @property
    def has_damage(self) -> bool:
        """Whether the decoder has refused a packet."""
        return self._packets > 0

    def damaged_packet(self, number: int) -> None:
        """Count a packet that the decoder refuses, near the frame of this number."""
        self._first_packet = self._first_packet if self._packets else number
        self._packets += 1

    def damaged_frame(self, number: int, damaged: bool) -> None:
        """Count a frame if it was decoded with errors."""
        if damaged:
            self._first_frame = self._first_frame if self._frames else number
            self._frames += 1

    def other_size(self, number: int, size_wh: tuple[int, int]) -> None:
        """Count a frame of another size, px."""
        if not self._sizes:
            self._first_size, self._other_wh = number, size_wh
        self._sizes += 1

    def problems(self, count: int, announced: int | None, exact: bool, size_wh: tuple[int, int]) -> list[str]:
        """Describe each kind of problem in one line, given how many frames came and how many were announced."""
        lines = []
        if announced is not None:
            slack = 0 if exact else max(_COUNT_SLACK[0], int(announced * _COUNT_SLACK[1]))
            # Damaged packets are reported below; they are no sign that the file is truncated.
            if count + self._packets < announced - slack:
                about = "" if exact else "about "
                lines.append(
                    f"ended after {count} of {about}{announced} announced frames: the file is truncated or damaged"
                )
        if self.end is not None:
            lines.append(f"reading stopped after frame {count - 1}: {self.end.lower()}")
        if self._packets:
            lines.append(f"{count_of(self._packets, 'damaged packet')} skipped (first near frame {self._first_packet})")
        if self._frames:
            lines.append(
                f"{count_of(self._frames, 'frame')} decoded with errors, kept (first: frame {self._first_frame})"
            )
        if self._sizes:
            new, old = ("{}x{}".format(*wh) for wh in (self._other_wh, size_wh))
            lines.append(
                f"{count_of(self._sizes, 'frame')} of another size skipped (first: frame {self._first_size}, "
                f"{new} instead of {old})"
            )
        return lines


class PassState:
    """How far a pass over a file came, and what was wrong.

    Attributes:
        counts, carry: problems; there is no carry without time stamps.
        last: number of the last frame.
        is_finished: whether the file was read to its end.
    """

    def __init__(self) -> None:
        self.counts = ProblemCounts()
        self.carry: ClockCarry | None = None
        self.last, self.is_finished = -1, False

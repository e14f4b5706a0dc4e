"""What belongs to frames of one size, used for frames of another size.

Convention: sizes are (width, height) in px.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["is_off_centre", "scale_between", "size_of_middle", "size_text"]

# Sizes of one ratio differ by the rounding of one side to whole px.
_ROUNDING_PX = 1.0
# Share of the frame's sides by which real principal points lie off the middle at most.
_MAX_OFF_CENTRE = 0.15
# A principal point that is known to this many px is the exact middle of a size in whole px.
_EXACT_PX = 0.01


def is_off_centre(point_px: Sequence[float], frame_wh: tuple[int, int]) -> bool:
    """Return whether a point (x, y) px lies so far from the frame's middle that it is no principal point of it."""
    return any(abs(x / size - 0.5) > _MAX_OFF_CENTRE for x, size in zip(point_px, frame_wh, strict=True))


def size_of_middle(point_px: Sequence[float], frame_wh: tuple[int, int]) -> tuple[int, int] | None:
    """Return the other frame size whose middle a principal point is, for a calibration that states no size.

    A point far from the middle counts as the middle of a size of the frames' ratio, to the rounding of one side; a
    point nearer to it must be that to a hundredth of a px, in both axes, as measured points are not.

    Args:
        point_px: principal point (x, y), px.
        frame_wh: size of the frames that it shall be used for.

    Returns:
        the size; None where it is the frames' own, or where there is none of their ratio.
    """
    doubled = [2 * float(x) for x in point_px]
    width, height = (round(x) for x in doubled)
    if min(width, height) <= 0 or (width, height) == tuple(frame_wh):
        return None
    if is_off_centre(point_px, frame_wh):
        return None if scale_between((width, height), frame_wh) is None else (width, height)
    exact = all(abs(x - whole) <= _EXACT_PX for x, whole in zip(doubled, (width, height), strict=True))
    return (width, height) if exact and width * frame_wh[1] == height * frame_wh[0] else None


def scale_between(from_wh: tuple[int, int], to_wh: tuple[int, int]) -> float | None:
    """Return new width over old width where both sizes have the same ratio; None where they have not.

    Args:
        from_wh: size of the frames that something belongs to.
        to_wh: size of the frames that it shall be used for.
    """
    factor_x, factor_y = to_wh[0] / from_wh[0], to_wh[1] / from_wh[1]
    # The rounding may have happened at either size.
    error_px = min(
        abs(from_wh[1] * factor_x - to_wh[1]),
        abs(from_wh[0] * factor_y - to_wh[0]),
        abs(to_wh[1] / factor_x - from_wh[1]),
        abs(to_wh[0] / factor_y - from_wh[0]),
    )
    return factor_x if error_px <= _ROUNDING_PX else None


def size_text(size_wh: tuple[int, int]) -> str:
    """Return a size as text, such as 640x360."""
    return f"{size_wh[0]}x{size_wh[1]}"

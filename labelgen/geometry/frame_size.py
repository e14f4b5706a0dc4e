"""What belongs to frames of one size, used for frames of another size.

Convention: sizes are (width, height) in px.
"""

from __future__ import annotations

__all__ = ["scale_between", "size_text"]

# Sizes of one ratio differ by the rounding of one side to whole px.
_ROUNDING_PX = 1.0


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

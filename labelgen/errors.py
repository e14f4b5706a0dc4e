"""Errors a user can mend. The command line prints them as one line and exits with code 2."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = [
    "CalibrationError",
    "DataError",
    "LabelgenError",
    "NoVehiclesError",
    "NoWeightsError",
    "OutputError",
    "RectificationError",
]


class LabelgenError(Exception):
    """Base of every error caused by input, settings or the machine rather than by a bug.

    The message says what was wrong, where, and how to mend it, in one line.

    Args:
        message: the line.
        parameter: name of the function parameter whose value is wrong or missing, as in the function's signature, or
            several. The command line names the options that set them.

    Attributes:
        parameters: the names, none or several.
    """

    def __init__(self, message: str = "", *, parameter: str | tuple[str, ...] | None = None) -> None:
        super().__init__(message)
        self.parameters = (parameter,) if isinstance(parameter, str) else tuple(parameter or ())


class CalibrationError(LabelgenError):
    """The given vanishing points, principal point or scale describe no camera above a road."""


class RectificationError(LabelgenError):
    """The camera and road mask admit no usable rectification."""


class DataError(LabelgenError):
    """A file or data set is missing, damaged, or not of the expected layout."""


class NoVehiclesError(DataError):
    """Not one vehicle was found in the input.

    Args:
        message: the line, with the reasons.
        problems: what was skipped or left out on the way, one line for each kind.
        parameter: see `LabelgenError`.

    Attributes:
        problems: as given.
    """

    def __init__(
        self, message: str = "", *, problems: Sequence[str] = (), parameter: str | tuple[str, ...] | None = None
    ) -> None:
        super().__init__(message, parameter=parameter)
        self.problems = tuple(problems)


class NoWeightsError(LabelgenError):
    """Weights of a network that cannot be had.

    Args:
        message: the line.
        other_masks: names of mask sources that do without them.
        parameter: see `LabelgenError`.

    Attributes:
        other_masks: as given.
    """

    def __init__(
        self, message: str = "", *, other_masks: Sequence[str] = (), parameter: str | tuple[str, ...] | None = None
    ) -> None:
        super().__init__(message, parameter=parameter)
        self.other_masks = tuple(other_masks)


class OutputError(LabelgenError):
    """The output cannot be written, or would overwrite something."""

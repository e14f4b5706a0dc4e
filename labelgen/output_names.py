"""Names of folders and files made from the names of inputs, which never lead out of the output folder."""

from __future__ import annotations

from labelgen.atomic_files import TEMPORARY_PREFIX
from labelgen.errors import OutputError

__all__ = ["check_name", "folder_name"]


def folder_name(text: str, default: str = "video") -> str:
    """Return a name for a folder of results: the text itself, or the default where it would lead elsewhere.

    Args:
        text: name of an input without its extension; `...avi` gives `..`.
        default: the other name.
    """
    return default if _leads_elsewhere(text) else text


def check_name(text: str, parameter: str) -> str:
    """Return a name that the user gives for a folder of results.

    Raises:
        OutputError: it would lead out of the output folder.
    """
    if _leads_elsewhere(text):
        raise OutputError(
            f"{parameter} {text!r}: not the name of a folder; give one without slashes", parameter=parameter
        )
    return text


def _leads_elsewhere(text: str) -> bool:
    return text.strip() in ("", ".", "..") or any(sign in text for sign in "/\\\0") or text.startswith(TEMPORARY_PREFIX)

"""Read JSON of any origin: UTF-8 with or without a byte order mark, UTF-16 and UTF-32; every defect is one error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from labelgen.errors import DataError, LabelgenError

__all__ = ["parse_json", "read_json"]

_MAX_REASON = 200


def parse_json(text: bytes | str) -> Any:
    """Parse JSON text.

    Args:
        text: in UTF-8, UTF-16 or UTF-32, with or without a byte order mark, or decoded.

    Raises:
        ValueError: not JSON, or nested too deep; the message is one line.
    """
    try:
        return json.loads(text.removeprefix("\ufeff") if isinstance(text, str) else text)
    except RecursionError:
        raise ValueError("nested too deep") from None
    except ValueError as err:
        raise ValueError((str(err).splitlines() or ["damaged"])[0][:_MAX_REASON]) from None


def read_json(path: Path, label: str = "", *, error: type[LabelgenError] = DataError, hint: str = "") -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        label: name of the file in errors; its path by default.
        error: class of the errors.
        hint: end of the message about a file that is not JSON: how to mend it.

    Raises:
        LabelgenError: of the class `error`: no such file, it cannot be read, or it is not JSON.
    """
    label = label or str(path)
    try:
        return parse_json(path.read_bytes())
    except FileNotFoundError:
        raise error(f"{label}: no such file") from None
    except OSError as err:
        raise error(f"{label}: {err.strerror or err}") from None
    except ValueError as err:  # also a path that is no file's name
        raise error(f"{label}: not JSON ({err}){hint}") from None

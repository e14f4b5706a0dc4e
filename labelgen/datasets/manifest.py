"""Data manifests: where a data set is looked for, its layout, splits and exclusions; one TOML file each."""

from __future__ import annotations

import os
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from labelgen.errors import DataError

__all__ = ["find_root", "load_manifest"]


def load_manifest(name: str) -> dict[str, Any]:
    """Load a manifest of data_manifests/.

    Args:
        name: file name without suffix, for instance "boxcars116k".

    Raises:
        DataError: there is no manifest of that name.
    """
    try:
        text = files("data_manifests").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    except (ModuleNotFoundError, FileNotFoundError):
        raise DataError(f"data manifest {name}: not installed; reinstall labelgen") from None
    return tomllib.loads(text)


def find_root(manifest: dict[str, Any], root: Path | None) -> Path:
    """Find the folder of a data set.

    Args:
        manifest: see `load_manifest`.
        root: the folder; None takes it from the manifest's environment variable, or the first of the manifest's places
            that exists.

    Raises:
        DataError: there is no such folder. The message says what to set.
    """
    title, variable = manifest["title"], manifest["environment"]
    if root is not None:
        if not root.is_dir():
            raise DataError(f"root {root}: no such folder; give the folder of {title}", parameter="root")
        return root
    if os.environ.get(variable):
        root = Path(os.environ[variable]).expanduser()
        if not root.is_dir():
            raise DataError(f"{variable}={root}: no such folder; set it to the folder of {title}")
        return root
    places = [Path(place).expanduser() for place in manifest["places"]]
    for place in places:
        if place.is_dir():
            return place
    raise DataError(
        f"{title} not found: give its folder or set {variable}=DIR (looked in {', '.join(map(str, places))}); "
        f"to get it, {manifest['obtain']}; or make a synthetic one with labelgen synth boxcars",
        parameter="root",
    )

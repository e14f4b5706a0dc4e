"""Data manifests: where a data set lives, its layout, splits and exclusions. One TOML each in data_manifests/."""

from __future__ import annotations

import os
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from labelgen.errors import DataError

__all__ = ["find_root", "load_manifest"]


def load_manifest(name: str) -> dict[str, Any]:
    """A manifest by its name, for instance "boxcars116k".

    Raises:
        DataError: there is none of that name.
    """
    try:
        text = files("data_manifests").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    except (ModuleNotFoundError, FileNotFoundError):
        raise DataError(f"data manifest {name}: not installed; reinstall labelgen") from None
    return tomllib.loads(text)


def find_root(manifest: dict[str, Any], given: Path | None) -> Path:
    """Folder of a data set: as given, from the environment, or in the manifest's places.

    Raises:
        DataError: not there; says exactly what to set.
    """
    title, variable = manifest["title"], manifest["environment"]
    if given is not None:
        if not given.is_dir():
            raise DataError(f"--root {given}: no such folder; give the folder of {title}")
        return given
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
        f"{title} not found: give --root DIR or set {variable}=DIR (looked in {', '.join(map(str, places))}); "
        f"to get it, {manifest['obtain']}; or make a synthetic one with labelgen synth boxcars"
    )

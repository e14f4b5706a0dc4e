"""The pictures of the README, from the folder that `make demo` leaves.

python -m tools.studies.readme_pictures demo [--out docs/pictures]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2

from labelgen.atomic_files import make_folder, write_atomic
from labelgen.errors import DataError

__all__ = ["main", "make_pictures"]

_PICTURES = {
    "labels.jpg": "audit/masks/labels-00.png",
    "mask-to-label.jpg": "audit/masks/mask-to-label.png",
    "rectification.jpg": "audit/masks/rectification.png",
}
_WIDTH = 1200


def make_pictures(demo: Path, out: Path) -> list[Path]:
    """Scale and compress the demo's pictures.

    Raises:
        DataError: the demo has not been run.
    """
    make_folder(out)
    written = []
    for name, source in _PICTURES.items():
        picture = cv2.imread(str(demo / source))
        if picture is None:
            raise DataError(f"{demo / source}: not there; run labelgen demo --out {demo} first")
        gain = min(1.0, _WIDTH / picture.shape[1])
        small = cv2.resize(picture, None, fx=gain, fy=gain, interpolation=cv2.INTER_AREA)
        write_atomic(out / name, cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes())
        written.append(out / name)
    return written


def main() -> None:
    """Command line of the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    options = parser.parse_args()
    for path in make_pictures(options.demo, options.out):
        print(path)


if __name__ == "__main__":
    main()

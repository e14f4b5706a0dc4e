"""A folder of images as a source of frames."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from labelgen.errors import DataError
from labelgen.media.frames import Frame, always
from labelgen.media.image_file import read_image
from labelgen.problem_counts import ProblemCounts

__all__ = ["ImageFolder"]

_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"}


def _natural_key(name: str) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key that puts img2 before img10; the name itself breaks ties such as img1 and img01."""
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if i % 2 else (-1, part) for i, part in enumerate(parts)], name


class ImageFolder:
    """The images of one folder, in natural order, as a `labelgen.media.frames.FrameSource`.

    Subfolders and files whose name starts with a dot are ignored. A frame's number is its position among all image
    files, so an unreadable file leaves a gap and does not renumber the others.

    Args:
        path: the folder.
        fps: frames per second; without it frames have no time.

    Attributes:
        file_names: names of the image files, in natural order.

    Raises:
        DataError: no such folder, no image file in it, or none that can be read.
    """

    is_live = False
    count_is_exact = True
    failure: Exception | None = None

    def __init__(self, path: str | Path, *, fps: float | None = None) -> None:
        self.path = Path(path)
        self.name = self.path.resolve().name
        self.fps = fps
        self.untimed = "" if fps else "images have no time stamps"
        self.notes: list[str] = []
        self.problems: list[str] = []
        try:
            names = [p.name for p in self.path.iterdir() if p.suffix.lower() in _SUFFIXES and p.is_file()]
        except OSError as error:
            raise DataError(f"{self.path}: cannot be listed ({error.strerror})") from None
        self.file_names = sorted((n for n in names if not n.startswith(".")), key=_natural_key)
        if not self.file_names:
            raise DataError(f"{self.path}: no images in this folder; expected files such as *.jpg or *.png")
        self.frame_count: int | None = len(self.file_names)
        first, reason = None, ""
        for name in self.file_names:
            try:
                first = read_image(self.path / name, label=name)
                break
            except DataError as error:
                reason = reason or str(error)
        if first is None:
            raise DataError(f"{self.path}: none of its {len(self.file_names)} image files can be read ({reason})")
        self.size_wh = (first.shape[1], first.shape[0])

    def frames(
        self, wanted: Callable[[int], bool] = always, not_before_s: Callable[[], float] | None = None
    ) -> Iterator[Frame]:
        """Return the wanted frames; see `FrameSource.frames`. `problems` counts the files that were skipped."""
        counts, self.problems = ProblemCounts(), []
        for number, name in enumerate(self.file_names):
            if not wanted(number):
                continue
            try:
                image = read_image(self.path / name, label=name)
                if (image.shape[1], image.shape[0]) != self.size_wh:
                    now, was = (f"{w}x{h}" for w, h in ((image.shape[1], image.shape[0]), self.size_wh))
                    raise _OtherSizeError(f"{name}: {now} px instead of the first image's {was}")
            except DataError as error:
                kind = "of another size" if isinstance(error, _OtherSizeError) else "they cannot be read"
                counts.add(kind, str(error), noun="image")
                self.problems = counts.lines()
                continue
            yield Frame(number, number / self.fps if self.fps else math.nan, image, name)


class _OtherSizeError(DataError):
    """An image is of another size than the first one."""

"""The outputs of one run: made in a hidden folder beside their final places, then moved up together.

`ROOT/.labelgen-NAME/` holds a lock and what has been made so far, under the names that it has below ROOT in the end.
When all is there it is flushed to disk, `publish.json` lists what moves up and which older outputs go, and then that is
done: older outputs go, the primary one first, and then the new ones come, the primary one last, so that outputs of two
runs never lie side by side. A run that was killed in between is completed by the next one that writes there. Older
outputs stay as they are until then.

Only regular files whose names the run states are ever written over or deleted.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import IO, Any

from labelgen.atomic_files import (
    TEMPORARY_PREFIX,
    as_output_error,
    make_folder,
    sync_file,
    sync_folder,
    write_json,
)
from labelgen.errors import OutputError
from labelgen.interruption import uninterrupted
from labelgen.json_file import parse_json
from labelgen.output_lock import take_lock

__all__ = ["StagedOutput", "is_staged", "staged_file"]

_LOCK, _JOURNAL = "lock", "publish.json"
_MAX_NAME_BYTES = 100


class StagedOutput:
    """Context manager for the outputs of one run, which are there whole in the end or not at all.

    Args:
        root: folder in which, or in whose subfolders, all outputs lie; made if missing.
        name: of the run, the same for all runs with these outputs.
        outputs: paths below `root` that a run may write, the primary one first. An older one that the run does not
            make anew is deleted when the new ones are moved up.
        overwrite: whether outputs that are there may be replaced.
        keep: whether what has been made stays in the staging folder when the block ends without `publish`. The next
            run begins anew.
        needs_overwrite: whether such a rest of an earlier run is replaced with `overwrite` only.
        patterns: the same for outputs whose names are not known before: paths with the wildcards of `fnmatch`.
        kind: what the message says of outputs that are there already; None names the file.

    Attributes:
        path: the staging folder.
        published: whether the outputs are in their final places.

    Raises:
        OutputError: on entering: outputs are there already, cannot be written, or are being written by another job.
    """

    def __init__(
        self, root: Path, name: str, outputs: Sequence[str], *, overwrite: bool, keep: bool = False,
        needs_overwrite: bool = False, patterns: Sequence[str] = (), kind: str | None = None,
    ) -> None:  # fmt: skip
        self.root, self._outputs, self._patterns = root, tuple(outputs), tuple(patterns)
        self.path = root / f"{TEMPORARY_PREFIX}{_short(name)}"
        self._overwrite, self._keep, self._needs_overwrite, self._kind = overwrite, keep, needs_overwrite, kind
        self._lock: IO[str] | None = None
        self._made: list[Path] = []
        self.published = False

    def __enter__(self) -> StagedOutput:
        self._refuse_obstacles()
        self._made = [folder for folder in (self.root, *self.root.parents) if not folder.exists()]
        self._lock = take_lock(self.path / _LOCK, self.root)
        try:
            self._complete()
            rest = self._staged()
            self._refuse_to_replace(rest)
            for name in rest:
                (self.path / name).unlink()
        except BaseException:
            self._end(discard=True)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end(discard=not self._keep or self.published)

    def stage(self, name: str) -> Path:
        """Return where to write an output, its path below the root given; its folder is made."""
        path = self.path / name
        make_folder(path.parent)
        return path

    def publish(self) -> None:
        """Move everything that has been written to its final place. Ctrl-C and SIGTERM wait until it is there.

        Raises:
            OutputError: it cannot be written; older outputs stay, or the next run completes what was begun.
        """
        names = self._staged()
        for name in names:
            with as_output_error(self.root / name):
                sync_file(self.path / name)
        old = [path.relative_to(self.root).as_posix() for path in self._existing()]
        with uninterrupted():
            write_json(self.path / _JOURNAL, {"move": names, "remove": [name for name in old if name not in names]})
            self._complete()
        self.published = True

    def _refuse_obstacles(self) -> None:
        """Refuse links and files in the way, and folders that cannot be written to."""
        if self.path.is_symlink() or (self.path.exists() and not self.path.is_dir()):
            raise OutputError(f"{self.path}: not a folder that labelgen made; remove it", parameter="out")
        folders = {(self.root / name).parent for name in self._outputs}
        for folder in sorted({*folders, self.root}):
            there = next(place for place in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(place))
            if not there.is_dir():
                raise OutputError(
                    f"out {self.root}: {there} is in the way, where a folder is needed; choose another place",
                    parameter="out",
                )
            if not os.access(there, os.W_OK | os.X_OK):
                raise OutputError(
                    f"cannot write {folder}: permission denied, or a read-only file system; choose another place",
                    parameter="out",
                )
        for path in (self.root / name for name in self._outputs):
            if path.exists() and not path.is_file():
                what = "a folder" if path.is_dir() else "no regular file"
                raise OutputError(f"{path}: {what} is in the way; move it elsewhere", parameter="out")

    def _refuse_to_replace(self, rest: Sequence[str]) -> None:
        if self._overwrite:
            return
        existing = self._existing()
        if existing:
            what = self._kind or f"{existing[0]}: it exists already"
            raise OutputError(f"{what}; choose another place, or overwrite it", parameter="overwrite")
        if rest and self._needs_overwrite:
            raise OutputError(
                f"{self.path}: it holds what a run made that did not end; move it elsewhere, or overwrite it",
                parameter="overwrite",
            )

    def _complete(self) -> None:
        """Move up what a journal lists, if there is one; begins anew at any point."""
        journal = self._read_journal()
        if journal is None:
            return
        primary, moves = self._outputs[0], [name for name in journal["move"] if _is_file(self.path / name)]
        removals = journal["remove"]
        if len(moves) + len(removals) > 1:  # at no time do outputs of both runs lie side by side
            removals = [*moves, *removals]
        for name in sorted(removals, key=lambda name: (name != primary, name)):
            with as_output_error(self.root / name):
                if _is_file(self.root / name) or (self.root / name).is_symlink():
                    (self.root / name).unlink()
        for name in sorted(moves, key=lambda name: (name == primary, name)):
            make_folder((self.root / name).parent)
            with as_output_error(self.root / name):
                _move(self.path / name, self.root / name)
        for folder in {(self.root / name).parent for name in moves}:
            sync_folder(folder)
        with as_output_error(self.path):
            (self.path / _JOURNAL).unlink()

    def _read_journal(self) -> dict[str, list[str]] | None:
        """Return the journal of an interrupted publication; None where there is none that can be trusted."""
        try:
            data: Any = parse_json((self.path / _JOURNAL).read_bytes()) if _is_file(self.path / _JOURNAL) else None
            lists = {key: [str(name) for name in data[key]] for key in ("move", "remove")}
        except (OSError, ValueError, TypeError, LookupError):
            return None
        return lists if all(self._is_own(name) for names in lists.values() for name in names) else None

    def _existing(self) -> list[Path]:
        """Return the outputs of an older run, the primary one first."""
        found: list[Path] = []
        for path in (self.root / name for name in self._outputs):
            if path.is_file() or path.is_symlink():
                found.append(path)
        for pattern in self._patterns:
            found += sorted(path for path in self.root.glob(pattern) if path.is_file())
        return list(dict.fromkeys(found))

    def _staged(self) -> list[str]:
        """Return the outputs in the staging folder, by their paths below the root."""
        files = (path for path in self.path.rglob("*") if _is_file(path))
        names = (path.relative_to(self.path).as_posix() for path in files)
        return sorted(name for name in names if self._is_own(name))

    def _is_own(self, name: str) -> bool:
        parts = PurePosixPath(name).parts
        if ".." in parts or PurePosixPath(name).is_absolute():
            return False
        patterns = [PurePosixPath(pattern).parts for pattern in self._patterns]
        return name in self._outputs or any(
            len(parts) == len(pattern) and all(map(fnmatchcase, parts, pattern)) for pattern in patterns
        )

    def _end(self, *, discard: bool) -> None:
        """Delete what is labelgen's own in the staging folder, and the folders that are empty; release the lock."""
        if self._lock is None:
            return
        with contextlib.suppress(OSError):
            if discard and not _is_file(self.path / _JOURNAL):
                for name in self._staged():
                    (self.path / name).unlink()
            folders = [path for path in self.path.rglob("*") if path.is_dir() and not path.is_symlink()]
            for temporary in self.path.rglob(f"{TEMPORARY_PREFIX}*.tmp"):
                temporary.unlink()
            for folder in sorted(folders, reverse=True):
                _remove_if_empty(folder)
            if [path.name for path in self.path.iterdir()] == [_LOCK]:
                (self.path / _LOCK).unlink()
                self.path.rmdir()
        for folder in self._made:  # leave no empty folder of a run that wrote nothing
            _remove_if_empty(folder)
        self._lock.close()


@contextlib.contextmanager
def staged_file(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield where to write a single output file; it is moved to its final place when the block ends without an error.

    Args:
        path: of the file. A link is followed, and a device or pipe is written to directly.
        overwrite: whether a file that is there may be replaced.

    Raises:
        OutputError: see `StagedOutput`.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    place = path.absolute() if not path.is_symlink() else path.resolve()
    with StagedOutput(place.parent, place.name, [place.name], overwrite=overwrite) as output:
        yield output.stage(place.name)
        output.publish()


def is_staged(path: Path) -> bool:
    """Return whether a file lies in the staging folder of a run that has not ended, or was killed."""
    return any(part.startswith(TEMPORARY_PREFIX) for part in path.absolute().parent.parts)


def _short(name: str) -> str:
    """Return a name that a file system takes with a prefix."""
    raw = os.fsencode(name)
    return name if len(raw) <= _MAX_NAME_BYTES else hashlib.sha256(raw).hexdigest()[:16]


def _is_file(path: Path) -> bool:
    """Return whether a path is a regular file, and no link to one."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


def _move(source: Path, target: Path) -> None:
    """Move a file over another one; a reader sees the old or the new one, also across file systems."""
    try:
        os.replace(source, target)
    except OSError as err:
        if err.errno != errno.EXDEV:
            raise
        temporary = target.parent / f"{TEMPORARY_PREFIX}{os.getpid()}.tmp"
        try:
            shutil.copyfile(source, temporary)
            sync_file(temporary)
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        source.unlink()


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()

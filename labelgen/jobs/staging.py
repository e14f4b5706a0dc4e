"""The staging folder, in which a data set is made until it is complete.

`OUT/.labelgen-job/` holds `job.json` (the job's identity), a lock, and the shards made so far. When the index is there,
too, the data set is published: the old index is removed first, then the old shards, then the new shards are moved to
`OUT`, and the new index last. A job that was killed at any moment, also during publication, continues from there. An
older data set stays complete until the newer one is complete.

Nothing is followed or deleted that labelgen did not write: links are refused, and so are foreign files in the staging
folder. A staged index counts only if it is the job's own and all its shards are whole; otherwise it is made again.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from labelgen.atomic_files import TEMPORARY_PREFIX, as_output_error, remove_temporary_files, sync_folder, write_json
from labelgen.errors import DataError, OutputError
from labelgen.interruption import uninterrupted
from labelgen.jobs.kept_masks import KEPT_MASKS, KEPT_PARTS, kept_masks_name
from labelgen.json_file import parse_json
from labelgen.output_lock import take_lock
from labelgen.shards.index import INDEX_NAME, REJECTS_NAME, file_hash, read_index
from labelgen.shards.validate import content_is_intact

__all__ = ["STAGING_NAME", "Staging", "check_output"]

STAGING_NAME = ".labelgen-job"
_JOB_NAME, _LOCK_NAME = "job.json", "lock"
_SHARDS, _TEMPORARY = "shard-*.h5", f"{TEMPORARY_PREFIX}*.tmp"
_MAX_NAMED = 3


def check_output(out: Path, *, overwrite: bool) -> None:
    """Find out whether a job may write a data set into a folder, before long work that precedes the job.

    Args:
        out: final folder of the data set.
        overwrite: whether a finished data set may be replaced.

    Raises:
        OutputError: the folder is in use, holds a finished data set, or cannot be written.
    """
    Staging(out, {}, overwrite=overwrite).check()


class Staging:
    """Context manager that locks the staging folder of one job.

    Args:
        out: final folder of the data set.
        description: identity of the job.
        overwrite: whether a finished data set, or another job's unfinished one, may be replaced.

    Attributes:
        path: the staging folder.
        resumed: number of shards that an interrupted run of the same job had made.
        published: whether the data set is in its final folder.

    Raises:
        OutputError: on entering: the folder is in use, is a link, holds something else, or cannot be written.
    """

    def __init__(self, out: Path, description: Mapping[str, Any], *, overwrite: bool) -> None:
        self.out = out
        self.path = out / STAGING_NAME
        self.resumed = 0
        self.published = False
        self._description = dict(description)
        self._overwrite = overwrite
        self._lock: IO[str] | None = None

    def __enter__(self) -> Staging:
        self._begin(self._prepare)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._release()

    def _begin(self, prepare: Callable[[], None]) -> list[Path]:
        """Take the lock and prepare; returns the folders that were made for it."""
        with as_output_error(self.out):
            if self.out.exists() and not self.out.is_dir():
                raise OutputError(
                    f"out {self.out}: a file of that name is in the way; choose another folder", parameter="out"
                )
            if self.path.is_symlink():
                raise OutputError(
                    f"{self.path}: a link, and labelgen writes to no folder that a link leads to; remove it",
                    parameter="out",
                )
            fresh = [folder for folder in (self.path, self.out) if not folder.exists()]
        self._lock = take_lock(self.path / _LOCK_NAME, self.out)
        try:
            prepare()
        except BaseException:
            if fresh:  # leave no empty folder of a job that did not begin
                self.discard(only_if_fresh=self.out in fresh)
            self._release()
            raise
        return fresh

    def check(self) -> None:
        """See `check_output`."""
        fresh = self._begin(self._refuse_finished)
        if fresh:
            self.discard(only_if_fresh=self.out in fresh)
        self._release()

    def publish(self) -> None:
        """Move the complete data set to its final folder."""
        _publish(self.path, self.out, read_index(self.path))
        self.published = True

    def discard(self, *, only_if_fresh: bool = True) -> None:
        """Delete the staging folder, and the final folder if it is empty.

        Args:
            only_if_fresh: whether to delete an empty final folder.
        """
        _remove_own(self.path)
        if only_if_fresh:
            with contextlib.suppress(OSError):
                self.out.rmdir()

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()

    def _prepare(self) -> None:
        job = self._read_job()
        self._refuse_foreign_files(job)
        index = self._read_staged_index(job)
        if index is not None and (self._overwrite or not (self.out / INDEX_NAME).exists()):
            _publish(self.path, self.out, index)  # the job was killed during publication
            self._release()  # the lock went with the folder
            if job == self._description:
                self.published = True
                return
            self._lock = take_lock(self.path / _LOCK_NAME, self.out)
            job = None
        if not self._overwrite:
            self._refuse_to_replace(job)
        if job != self._description:
            self._clear()
            write_json(self.path / _JOB_NAME, self._description)
        for name in (INDEX_NAME, REJECTS_NAME):  # made anew from the shards
            (self.path / name).unlink(missing_ok=True)
        remove_temporary_files(self.path)
        for shard in sorted(self.path.glob(_SHARDS)):
            if content_is_intact(shard):
                self.resumed += 1
            else:
                shard.unlink()

    def _refuse_foreign_files(self, job: Any) -> None:
        """Refuse a staging folder with what labelgen did not write, or that belongs to no job."""
        with as_output_error(self.path):
            entries = sorted(self.path.iterdir())
        foreign = [path.name for path in entries if not _is_own(path)]
        if not foreign and not (self.path / _JOB_NAME).exists():
            foreign = [path.name for path in entries if path.name != _LOCK_NAME and not path.match(_TEMPORARY)]
        if foreign:
            named = ", ".join(foreign[:_MAX_NAMED]) + (", ..." if len(foreign) > _MAX_NAMED else "")
            raise OutputError(
                f"{self.path}: it holds what no labelgen job wrote ({named}); move it elsewhere, or choose another "
                "folder",
                parameter="out",
            )
        for name in (INDEX_NAME, REJECTS_NAME):
            if (self.out / name).is_dir():
                raise OutputError(f"{self.out / name}: a folder is in the way; move it elsewhere", parameter="out")

    def _read_staged_index(self, job: Any) -> dict[str, Any] | None:
        """Return the index of a publication that can be completed; None where there is none.

        Shards that were moved up already, while another one is lost, are moved back.
        """
        if not (self.path / INDEX_NAME).is_file():
            return None
        try:
            index = read_index(self.path)
        except DataError:
            return None
        entries = index["shards"]
        if not entries or index.get("job") != job or not all(Path(entry["name"]).match(_SHARDS) for entry in entries):
            return None
        places = {entry["name"]: self._place_of(entry) for entry in entries}
        if all(places.values()):
            return index
        if not (self.out / INDEX_NAME).exists():  # otherwise nothing was moved up yet
            with as_output_error(self.out):
                for name, place in places.items():
                    if place is not None and place.parent == self.out:
                        os.replace(place, self.path / name)
        return None

    def _place_of(self, entry: Mapping[str, Any]) -> Path | None:
        """Return where a shard of the staged index lies, whole: in the staging or in the final folder."""
        for folder in (self.path, self.out):
            path = folder / str(entry["name"])
            with contextlib.suppress(OSError):
                if _is_file(path) and file_hash(path) == entry.get("file_sha256"):
                    return path
        return None

    def _refuse_finished(self) -> None:
        if (self.out / INDEX_NAME).exists() and not self._overwrite:
            raise OutputError(
                f"{self.out}: it already holds a finished data set; overwrite it or choose another folder",
                parameter="overwrite",
            )

    def _refuse_to_replace(self, job: Any) -> None:
        self._refuse_finished()
        if any(self.out.glob("shard-*.h5")):
            raise OutputError(
                f"{self.out}: it holds shards without an index; overwrite them or choose another folder",
                parameter="overwrite",
            )
        if job is not None and job != self._description:
            raise OutputError(
                f"{self.out}: it holds an unfinished job with other settings or input; overwrite it or choose another "
                "folder",
                parameter="overwrite",
            )

    def _read_job(self) -> Any:
        try:
            return parse_json((self.path / _JOB_NAME).read_bytes())
        except (OSError, ValueError):
            return None  # no job was begun here, or its file is damaged

    def _clear(self) -> None:
        with as_output_error(self.path):
            for path in _own_files(self.path):
                if path.name != _LOCK_NAME:
                    path.unlink()


def _is_file(path: Path) -> bool:
    """Tell whether a path is a regular file, and no link to one."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


def _is_own(path: Path) -> bool:
    """Tell whether a path in a staging folder is a file as jobs write them."""
    named = path.name in (_JOB_NAME, _LOCK_NAME, INDEX_NAME, REJECTS_NAME)
    return _is_file(path) and (named or any(map(path.match, (_SHARDS, KEPT_MASKS, KEPT_PARTS, _TEMPORARY))))


def _own_files(folder: Path) -> list[Path]:
    """Return the files of jobs in a staging folder. The job's identity comes last: without it, nothing is claimed."""
    return sorted(filter(_is_own, folder.iterdir()), key=lambda path: path.name == _JOB_NAME)


def _remove_own(staged: Path) -> None:
    """Delete the files of jobs from a staging folder, and the folder if that leaves it empty."""
    with contextlib.suppress(OSError):
        for path in _own_files(staged):
            path.unlink()
        staged.rmdir()


def _publish(staged: Path, out: Path, index: Mapping[str, Any]) -> None:
    """Replace the data set of a folder by the staged one; continues a replacement that was interrupted."""
    names = [str(entry["name"]) for entry in index["shards"]]
    with uninterrupted(), as_output_error(out):
        (out / INDEX_NAME).unlink(missing_ok=True)
        for old in out.glob(_SHARDS):
            if old.name not in names or (staged / old.name).exists():
                old.unlink()
        kept = _kept_masks(index)
        for old in out.glob(KEPT_MASKS):
            if old.name not in kept or (staged / old.name).exists():
                old.unlink()
        for name in (*names, *kept, REJECTS_NAME, INDEX_NAME):
            if (staged / name).exists():
                os.replace(staged / name, out / name)
        sync_folder(out)
    _remove_own(staged)


def _kept_masks(index: Mapping[str, Any]) -> list[str]:
    """Return the names of the files of kept masks that belong to the shards of an index."""
    job = index.get("job")
    settings = job.get("settings") if isinstance(job, Mapping) else None
    if not (isinstance(settings, Mapping) and settings.get("keep_masks")):
        return []
    return sorted({kept_masks_name(str(entry["name"]).rpartition("-")[0]) for entry in index["shards"]})

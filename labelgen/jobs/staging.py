"""The staging folder, in which a data set is made until it is complete.

`OUT/.labelgen-job/` holds `job.json` (the job's identity), a lock, and the shards made so far. When the index is there,
too, the data set is published: the old index is removed first, then the old shards, then the new shards are moved to
`OUT`, and the new index last. A job that was killed at any moment, also during publication, continues from there. An
older data set stays complete until the newer one is complete.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from labelgen.atomic_files import as_output_error, make_folder, remove_temporary_files, write_json
from labelgen.errors import OutputError
from labelgen.json_file import parse_json
from labelgen.shards.index import INDEX_NAME, REJECTS_NAME, read_index
from labelgen.shards.validate import content_is_intact

try:
    import fcntl
except ImportError:  # not on Windows, where two jobs are not kept apart
    fcntl = None  # type: ignore[assignment]

__all__ = ["STAGING_NAME", "Staging"]

STAGING_NAME = ".labelgen-job"
_JOB_NAME = "job.json"


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
        OutputError: on entering: the folder is in use, holds something else, or cannot be written.
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
        with as_output_error(self.out):
            if self.out.exists() and not self.out.is_dir():
                raise OutputError(
                    f"out {self.out}: a file of that name is in the way; choose another folder", parameter="out"
                )
            fresh = [folder for folder in (self.path, self.out) if not folder.exists()]
        make_folder(self.path)
        self._take_lock()
        try:
            self._prepare()
        except BaseException:
            self._release()
            if fresh:  # leave no empty folder of a job that did not begin
                self.discard(only_if_fresh=self.out in fresh)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._release()

    def publish(self) -> None:
        """Move the complete data set to its final folder."""
        _publish(self.path, self.out)
        self.published = True

    def discard(self, *, only_if_fresh: bool = True) -> None:
        """Delete the staging folder, and the final folder if it is empty.

        Args:
            only_if_fresh: whether to delete an empty final folder.
        """
        shutil.rmtree(self.path, ignore_errors=True)
        if only_if_fresh:
            with contextlib.suppress(OSError):
                self.out.rmdir()

    def _take_lock(self) -> None:
        with as_output_error(self.path):
            self._lock = (self.path / "lock").open("a")
        if fcntl is not None:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                self._lock.close()
                raise OutputError(
                    f"out {self.out}: another labelgen job is writing into it; wait for it or choose another folder",
                    parameter="out",
                ) from None

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()

    def _prepare(self) -> None:
        job = self._read_job()
        if (self.path / INDEX_NAME).exists():  # the job was killed during publication
            _publish(self.path, self.out)
            make_folder(self.path)
            if job == self._description:
                self.published = True
                return
            job = None
        if not self._overwrite:
            self._refuse_to_replace(job)
        if job != self._description:
            self._clear()
            write_json(self.path / _JOB_NAME, self._description)
        remove_temporary_files(self.path)
        for shard in sorted(self.path.glob("shard-*.h5")):
            if content_is_intact(shard):
                self.resumed += 1
            else:
                shard.unlink()

    def _refuse_to_replace(self, job: Any) -> None:
        if (self.out / INDEX_NAME).exists():
            raise OutputError(
                f"{self.out}: it already holds a finished data set; overwrite it or choose another folder",
                parameter="overwrite",
            )
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
            for path in self.path.iterdir():
                if path.name != "lock":
                    shutil.rmtree(path) if path.is_dir() else path.unlink()


def _publish(staged: Path, out: Path) -> None:
    """Replace the data set of a folder by the staged one; continues a replacement that was interrupted."""
    names = [str(entry["name"]) for entry in read_index(staged)["shards"]]
    with as_output_error(out):
        (out / INDEX_NAME).unlink(missing_ok=True)
        for old in out.glob("shard-*.h5"):
            if old.name not in names or (staged / old.name).exists():
                old.unlink()
        for name in (*names, REJECTS_NAME, INDEX_NAME):
            if (staged / name).exists():
                os.replace(staged / name, out / name)
        shutil.rmtree(staged, ignore_errors=True)

"""Running a job: units of work -> shards -> index, resumable, in one process or many.

Which sample goes to which shard depends on the input alone, and a shard on disk is always whole. So a job that
was interrupted goes on at the first missing shard, and any number of workers gives the same bytes.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing.connection import wait as wait_for_any
from pathlib import Path
from typing import Any, Protocol

import cv2

from labelgen.errors import DataError, LabelgenError
from labelgen.jobs.staging import Staging
from labelgen.progress import progress_bar
from labelgen.shards import DatasetSummary, ShardReader, find_shards, summarise, write_index

__all__ = ["Job", "Progress", "Unit", "finished_part", "run_job"]

Progress = Callable[[int], object]


class Unit(Protocol):
    """Shards that one process makes, one after the other. Units are picklable and independent."""

    @property
    def size(self) -> int | None:
        """How many inputs it looks at, where known."""

    def shards(self, out: Path) -> list[Path] | None:
        """Its shards in order if all are on disk, else None."""

    def run(self, out: Path, progress: Progress) -> None:
        """Make the shards that are missing; `progress` takes the number of inputs done since the last call."""


@dataclass(frozen=True)
class Job:
    """What to do and how to recognise it again.

    Args:
        command: name of the command.
        settings: everything that decides the content of the shards.
        inputs: what identifies the input files.
        units: the work.
        originals: where the originals lie on this machine, by the shards' source; not part of the job's identity.
    """

    command: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Any]
    units: Sequence[Unit]
    originals: Mapping[str, Any] = field(default_factory=dict)

    def describe(self) -> dict[str, Any]:
        """Identity of the job: the same on every run of the same command on the same input."""
        return {"command": self.command, "settings": dict(self.settings), "inputs": dict(self.inputs)}


def run_job(job: Job, out: Path, *, overwrite: bool = False, workers: int = 1) -> DatasetSummary:
    """Make all shards of a job, then the index; a data set that was there before stays whole until then.

    Args:
        job: the work.
        out: output folder.
        overwrite: whether a finished data set, or another job's unfinished one, may be replaced.
        workers: processes; 0 for one per core.

    Raises:
        OutputError: the folder is in use, holds something else, or cannot be written.
        LabelgenError: no label came out of it; the folder is left as it was found.
    """
    with Staging(out, job.describe(), overwrite=overwrite) as staging:
        if not staging.published:
            _make_all(job, staging.path, workers)
            shards = [shard for unit in job.units for shard in unit.shards(staging.path) or ()]
            summary = summarise([ShardReader(shard) for shard in shards])
            if summary.labels == 0:
                staging.discard()
                top = ", ".join(f"{n} x {reason}" for reason, n in summary.reasons.most_common(4))
                raise LabelgenError(
                    "no vehicles found: not one label came out of the input "
                    f"({top or 'there was no input'}); nothing was written"
                )
            write_index(staging.path, shards, job.describe(), job.originals)
            staging.publish()
    summary = summarise([ShardReader(shard) for shard in find_shards([out])])
    if staging.resumed:
        summary.warnings.append(f"went on with an interrupted job: {staging.resumed} shards were there")
    return summary


def _make_all(job: Job, folder: Path, workers: int) -> None:
    todo = [unit for unit in job.units if unit.shards(folder) is None]
    sizes = [unit.size for unit in todo]
    total = sum(size for size in sizes if size is not None) if None not in sizes else None
    count = min(workers or _cores(), len(todo))
    with progress_bar(total, "img") as advance:
        if count <= 1:
            for unit in todo:
                unit.run(folder, advance)
        else:
            _run_in_processes(todo, folder, count, advance)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _run_in_processes(units: Sequence[Unit], folder: Path, count: int, advance: Progress) -> None:
    context = multiprocessing.get_context("spawn")
    done: Any = context.Queue()
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker, initargs=(done,))
    try:
        pending: set[Future[None]] = {pool.submit(_run_unit, unit, folder) for unit in units}
        while pending:
            finished, pending = wait(pending, timeout=0.2)
            _drain(done, advance)
            for future in finished:
                future.result()
        _drain(done, advance)
    except BrokenProcessPool:
        raise LabelgenError(
            "a worker process was killed, perhaps for want of memory; run the command again with fewer --workers"
        ) from None
    except BaseException:
        # Whole videos may be under way: what they have finished is on disk, the rest is not waited for.
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _drain(done: Any, advance: Progress) -> None:
    while True:
        try:
            advance(done.get_nowait())
        except queue.Empty:
            return


_report: Any = None


def _start_worker(done: Any) -> None:
    global _report
    _report = done
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """A worker whose parent was killed must not go on writing."""
    wait_for_any([sentinel])
    os._exit(1)


def _run_unit(unit: Unit, folder: Path) -> None:
    unit.run(folder, _report.put)


def finished_part(path: Path, **expected: Any) -> ShardReader | None:
    """Reader of a shard that is on disk and is the expected one; None where it is not there.

    Args:
        path: of the shard.
        expected: values of its attributes.
    """
    if not path.exists():
        return None
    with ShardReader(path) as reader:
        try:
            same = all(reader.attributes[key] == value for key, value in expected.items())
        except DataError:
            return None
        return reader if same else None

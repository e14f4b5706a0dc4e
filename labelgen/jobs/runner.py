"""Running a job: units of work make shards, then the index is written; resumable, in one process or several.

Which sample goes to which shard depends on the input alone, and a shard on disk is always complete. An interrupted job
therefore continues at the first missing shard, and any number of workers gives the same bytes.
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

from labelgen.errors import DataError, LabelgenError, NoVehiclesError
from labelgen.jobs.staging import Staging
from labelgen.progress import progress_bar
from labelgen.shards import DatasetSummary, ShardReader, find_shards, summarise, write_index
from labelgen.shards.schema import VERSION

__all__ = ["Job", "Progress", "Unit", "finished_part", "run_job"]

Progress = Callable[[int], object]


class Unit(Protocol):
    """The work of one process: one or several shards, made in order. Units are picklable and independent."""

    @property
    def size(self) -> int | None:
        """Number of its inputs; None where unknown."""

    def shards(self, out: Path) -> list[Path] | None:
        """Return its shards in order if all are in the folder `out`, else None."""

    def run(self, out: Path, progress: Progress) -> None:
        """Make the shards that are missing; `progress` is called with the number of inputs since its last call."""


@dataclass(frozen=True)
class Job:
    """The work of a command, and the identity by which a later run recognises it.

    Args:
        command: name of the command.
        settings: all values that decide the content of the shards.
        inputs: names and hashes of the input files.
        units: the work.
        originals: where the original images lie on this machine, by the shards' source; not part of the identity.
    """

    command: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Any]
    units: Sequence[Unit]
    originals: Mapping[str, Any] = field(default_factory=dict)

    def describe(self) -> dict[str, Any]:
        """Return the identity of the job: the same for the same command on the same input."""
        return {"command": self.command, "settings": dict(self.settings), "inputs": dict(self.inputs)}


def run_job(job: Job, out: Path, *, overwrite: bool = False, workers: int = 1) -> DatasetSummary:
    """Make all shards of a job and their index. An older data set in the folder stays complete until then.

    Args:
        job: the work.
        out: output folder.
        overwrite: whether a finished data set, or another job's unfinished one, may be replaced.
        workers: number of processes; 0 for one per core.

    Returns:
        Counts of the data set.

    Raises:
        OutputError: the folder is in use, holds something else, or cannot be written.
        NoVehiclesError: the job gave no label; the folder is then left as it was.
    """
    with Staging(out, job.describe(), overwrite=overwrite) as staging:
        if not staging.published:
            _make_all(job, staging.path, workers)
            shards = [shard for unit in job.units for shard in unit.shards(staging.path) or ()]
            summary = summarise([ShardReader(shard) for shard in shards])
            if summary.labels == 0:
                staging.discard()
                top = ", ".join(f"{n} x {reason}" for reason, n in summary.reasons.most_common(4))
                raise NoVehiclesError(
                    "no vehicles found: not one label came out of the input "
                    f"({top or 'there was no input'}); nothing was written",
                    problems=summary.problems,
                )
            write_index(staging.path, shards, job.describe(), job.originals)
            staging.publish()
    summary = summarise([ShardReader(shard) for shard in find_shards([out])])
    if staging.resumed:
        summary.notes.append(f"went on with an interrupted job: {staging.resumed} shards were there")
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
    counts: Any = context.Queue()
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker, initargs=(counts,))
    try:
        pending: set[Future[None]] = {pool.submit(_run_unit, unit, folder) for unit in units}
        while pending:
            finished, pending = wait(pending, timeout=0.2)
            _drain(counts, advance)
            for future in finished:
                future.result()
        _drain(counts, advance)
    except BrokenProcessPool:
        raise LabelgenError(
            "a worker process was killed, perhaps for lack of memory; run it again with fewer workers",
            parameter="workers",
        ) from None
    except BaseException:
        # A worker may need hours for its video; its finished shards are on disk, so it is not waited for.
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _drain(counts: Any, advance: Progress) -> None:
    while True:
        try:
            advance(counts.get_nowait())
        except queue.Empty:
            return


_report: Any = None


def _start_worker(counts: Any) -> None:
    global _report
    _report = counts
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """End this process when its parent ends: it must not continue to write."""
    wait_for_any([sentinel])
    os._exit(1)


def _run_unit(unit: Unit, folder: Path) -> None:
    unit.run(folder, _report.put)


def finished_part(path: Path, **expected: Any) -> ShardReader | None:
    """Return the reader of a shard on disk that has the expected attributes and the newest format, else None.

    Args:
        path: the shard.
        expected: values of its attributes, by name.
    """
    if not path.exists():
        return None
    with ShardReader(path) as reader:
        try:
            wanted = {"version": VERSION, **expected}
            same = all(reader.attributes[key] == value for key, value in wanted.items())
        except DataError:
            return None
        return reader if same else None

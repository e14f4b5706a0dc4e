"""Running a job: units of work -> shards -> index, resumable, in one process or many.

Which sample goes to which shard depends on the input alone, and a shard on disk is always whole. So a job that
was interrupted goes on at the first missing shard, and any number of workers gives the same bytes.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import cv2
from tqdm import tqdm

from labelgen.errors import DataError, LabelgenError, OutputError
from labelgen.files import make_folder, remove_temporary_files, write_json
from labelgen.shards import DatasetSummary, ShardReader, write_index
from labelgen.shards.index import INDEX_NAME, REJECTS_NAME

__all__ = ["Job", "Progress", "Unit", "clear_output", "finished_part", "run_job"]

JOB_NAME = "job.json"
Progress = Callable[[int], None]


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
        sources: where the originals lie on this machine; not part of the job's identity.
    """

    command: str
    settings: Mapping[str, Any]
    inputs: Mapping[str, Any]
    units: Sequence[Unit]
    sources: Mapping[str, Any] = field(default_factory=dict)

    def describe(self) -> dict[str, Any]:
        """Identity of the job: the same on every run of the same command on the same input."""
        return {"command": self.command, "settings": dict(self.settings), "inputs": dict(self.inputs)}


def run_job(job: Job, out: Path, *, overwrite: bool = False, workers: int = 1) -> DatasetSummary:
    """Make all shards of a job, then the index.

    Args:
        job: the work.
        out: output folder.
        overwrite: whether a finished data set, or another job's leftovers, may be replaced.
        workers: processes; 0 for one per core.

    Raises:
        OutputError: the folder holds something else, or cannot be written.
        LabelgenError: no label came out of it; the folder is left as it was found, less what was replaced.
    """
    warnings = _prepare(job, out, overwrite)
    todo = [unit for unit in job.units if unit.shards(out) is None]
    if len(todo) < len(job.units):
        warnings.append(
            f"went on with an interrupted job: {len(job.units) - len(todo)} of {len(job.units)} parts were there"
        )
    sizes = [unit.size for unit in todo]
    total = sum(size for size in sizes if size is not None) if None not in sizes else None
    count = min(workers or len(os.sched_getaffinity(0)), len(todo))
    interval = 0.1 if sys.stderr.isatty() else 10.0  # a log file wants a line now and then
    with tqdm(total=total, unit="img", dynamic_ncols=True, smoothing=0.1, mininterval=interval) as bar:
        if count <= 1:
            for unit in todo:
                unit.run(out, bar.update)
        else:
            _run_in_processes(todo, out, count, bar)
    shards = [shard for unit in job.units for shard in unit.shards(out) or ()]
    summary = write_index(out, shards, job.describe(), job.sources)
    if summary.labels == 0:
        clear_output(out)
        reasons = ", ".join(f"{n} x {reason}" for reason, n in summary.reasons.most_common(4)) or "there was no input"
        raise LabelgenError(f"no vehicles found: not one label came out of the input ({reasons}); nothing was written")
    (out / JOB_NAME).unlink(missing_ok=True)
    summary.warnings += warnings
    return summary


def _run_in_processes(units: Sequence[Unit], out: Path, count: int, bar: tqdm[Any]) -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker) as pool:
        pending = {pool.submit(_run_unit, unit, out) for unit in units}
        try:
            for done in as_completed(pending):
                bar.update(done.result())
        except BrokenProcessPool:
            raise LabelgenError(
                "a worker process was killed, perhaps for want of memory; run the command again with fewer --workers"
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)


def _run_unit(unit: Unit, out: Path) -> int:
    done = 0

    def count(n: int) -> None:
        nonlocal done
        done += n

    unit.run(out, count)
    return done


def finished_part(path: Path) -> ShardReader | None:
    """Reader of a shard that is on disk and whole; None where it is not there.

    Raises:
        DataError: the file is there but damaged.
    """
    if not path.exists():
        return None
    with ShardReader(path) as reader:
        assert reader.attributes is not None
        return reader


def _prepare(job: Job, out: Path, overwrite: bool) -> list[str]:
    if out.exists() and not out.is_dir():
        raise OutputError(f"--out {out}: a file of that name is in the way; choose another folder")
    description = job.describe()
    make_folder(out)
    finished, started = (out / INDEX_NAME).exists(), (out / JOB_NAME).exists()
    leftovers = finished or started or any(out.glob("shard-*.h5"))
    if leftovers and not overwrite:
        if finished:
            raise OutputError(
                f"--out {out}: it already holds a finished data set; add --overwrite or choose another folder"
            )
        if not started or _read_job(out) != description:
            raise OutputError(
                f"--out {out}: it holds an unfinished job with other settings or input; add --overwrite to drop it "
                "or choose another folder"
            )
    write_json(out / JOB_NAME, description)
    remove_temporary_files(out)
    if leftovers and overwrite:
        clear_output(out, keep_job=True)
    return []


def _read_job(out: Path) -> Any:
    try:
        return json.loads((out / JOB_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise DataError(f"{out / JOB_NAME}: not readable ({err}); add --overwrite to start anew") from None


def clear_output(out: Path, *, keep_job: bool = False) -> None:
    """Remove a data set from a folder: the index first, so that it never looks complete; nothing else is touched."""
    names = [out / INDEX_NAME, out / REJECTS_NAME, *sorted(out.glob("shard-*.h5"))]
    for path in names if keep_job else [*names, out / JOB_NAME]:
        path.unlink(missing_ok=True)
    if not keep_job and not any(out.iterdir()):
        out.rmdir()

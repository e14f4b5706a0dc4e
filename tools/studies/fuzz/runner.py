"""Runs cases: each in a child with bounds of time and memory, several at a time."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from labelgen.cli.main import main as run_command
from tools.studies.fuzz.cases import CLASSES
from tools.studies.fuzz.checks import wrong_success
from tools.studies.fuzz.good_files import make_good_files

__all__ = ["Failure", "fuzz"]

_MEMORY = 1_000_000_000
# A case hangs after so many seconds of work or of waiting; on a busy machine it may take longer than both.
_SECONDS = 20
_POLL_SECONDS = 0.02
_RIGHT = ("done", "refused")


@dataclass(frozen=True)
class Failure:
    """A case that went wrong.

    Args:
        name: class and number of the case.
        change: what was changed.
        arguments: of the command.
        problem: what went wrong.
        output: end of what the command printed.
    """

    name: str
    change: str
    arguments: str
    problem: str
    output: str


def fuzz(
    count: int,
    seed: int,
    *,
    classes: Sequence[str] = (),
    only: tuple[str, int] | None = None,
    keep: Path | None = None,
    jobs: int = 1,
    report: Callable[[int, Failure | None], None] | None = None,
) -> tuple[Counter[str], list[Failure]]:
    """Run cases.

    Args:
        count: number of cases, spread over the classes.
        seed: decides all changes.
        classes: names of the classes; all where empty.
        only: class and number of one case.
        keep: folder for its files.
        jobs: how many run at a time.
        report: called after each case with the number of cases so far, and with what went wrong.

    Returns:
        numbers of cases by class and outcome, and those that went wrong.
    """
    names = list(classes or CLASSES)
    cases = [(names[number % len(names)], number) for number in range(count)] if only is None else [only]
    outcomes: Counter[str] = Counter()
    failures: list[Failure] = []
    with tempfile.TemporaryDirectory() as folder:
        good = Path(folder) / "good"
        make_good_files(good)
        for done, (name, outcome, failure) in enumerate(_run_all(cases, good, Path(folder), seed, keep, jobs), start=1):
            outcomes[f"{name}: {outcome}"] += 1
            failures += [] if failure is None else [failure]
            if report is not None:
                report(done, failure)
    return outcomes, failures


_Result = tuple[str, str, Failure | None]


def _run_all(
    cases: Sequence[tuple[str, int]], good: Path, folder: Path, seed: int, keep: Path | None, jobs: int
) -> Iterator[_Result]:
    run = partial(_run_one, good=good, folder=folder, seed=seed, keep=keep)
    if jobs == 1:
        yield from map(run, cases)
        return
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("fork")) as pool:
        yield from pool.map(run, cases)


def _run_one(case: tuple[str, int], good: Path, folder: Path, seed: int, keep: Path | None) -> _Result:
    name, number = case
    work = keep or folder / f"work{os.getpid()}"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    rng = np.random.default_rng([seed, number])
    arguments, change = CLASSES[name](rng, good, work)
    problem, output = _run_case([str(argument) for argument in arguments], work)
    if problem in _RIGHT:
        return name, problem, None
    shown = " ".join(map(str, arguments)).encode("utf-8", "backslashreplace").decode()
    return name, "wrong", Failure(f"{name}:{number}", change, shown, problem, output[-3000:])


def _run_case(arguments: list[str], work: Path) -> tuple[str, str]:
    """Run a command in a child; return the outcome and what it printed."""
    output = work / "output.txt"
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        _be_child(arguments, output, work)
    worked_s = waited_s = 0.0
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if max(worked_s, waited_s) > _SECONDS:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return f"more than {_SECONDS} s of {'work' if worked_s > waited_s else 'waiting'}", output.read_text(
                errors="replace"
            )
        time.sleep(_POLL_SECONDS)
        worked_s, is_waiting = _state(child)
        waited_s = waited_s + _POLL_SECONDS if is_waiting else 0.0
    printed = output.read_text(errors="replace")
    if os.WIFSIGNALED(status):
        return f"ended by signal {os.WTERMSIG(status)}", printed
    code = os.WEXITSTATUS(status)
    if "Traceback (most recent call last)" in printed:
        return "a traceback", printed
    if re.search(r"MemoryError|[Uu]nable to allocate|bad_alloc|Insufficient memory|can't allocate memory", printed):
        return "out of memory", printed
    if code == 0:
        wrong = wrong_success(arguments[0], work, printed)
        return (f"wrong success: {wrong}" if wrong else "done"), printed
    if code == 2 and "labelgen: error: " in printed:
        return "refused", printed
    return f"exit code {code}", printed


def _state(process: int) -> tuple[float, bool]:
    """Return how many seconds a process has worked, and whether all its threads wait for something but a processor."""
    worked_s, is_waiting = 0.0, True
    with contextlib.suppress(OSError, ValueError):
        folder = Path(f"/proc/{process}")
        user, system = _fields(folder / "stat")[11:13]
        worked_s = (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
        is_waiting = all(_fields(stat)[0] not in "RZX" for stat in folder.glob("task/*/stat"))
    return worked_s, is_waiting


def _fields(stat: Path) -> list[str]:
    return stat.read_text().rpartition(")")[2].split()


def _be_child(arguments: list[str], output: Path, work: Path) -> None:
    """Run the command in this process, which then ends."""
    code = 70
    try:
        os.setsid()
        os.chdir(work)
        handle = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.stdout = open(1, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        with contextlib.suppress(OSError):
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, used + _MEMORY))
        try:
            run_command(arguments)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        sys.stdout.flush()
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)

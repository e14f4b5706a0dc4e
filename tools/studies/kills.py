"""Every command that writes, killed at random moments: older results whole, or new ones whole, and nothing between.

    python -m tools.studies.kills --count 200 --seed 0

A case starts a command in a process of its own, mostly over older results, and ends it by SIGKILL, SIGTERM or SIGINT:
before a random one of its changes to the file system (half of them while results are moved up, which are its last
changes), or after a random time. In some cases the disk is full instead: a limit on the size of files. Then it checks
what lies there, runs the command again without disturbance, and compares the bytes with those of a run that was never
disturbed. Cases that fail are listed; `--only NUMBER` runs one again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from labelgen.cli.main import main as run_command
from tools.studies.kill_jobs import JOBS, command_of, input_commands

__all__ = ["JOBS", "Failure", "kills"]

_TIMEOUT_S = 300
_LAST_EVENTS = 30
"""Changes at the end of a run among which half of the moments are: there results are moved up."""

Content = dict[str, str]
"""Hashes of files by their paths, without those in hidden folders of unfinished runs."""


@dataclass(frozen=True)
class Failure:
    """A case that went wrong.

    Args:
        number: of the case.
        name: of the command.
        how: what was done to it.
        problem: what was wrong.
        output: end of what was printed.
    """

    number: int
    name: str
    how: str
    problem: str
    output: str


# -- processes ----------------------------------------------------------------------------------------------


class Result(NamedTuple):
    """How a process ended: its exit code, negative for a signal; changes to the file system; seconds; its output."""

    code: int
    events: int
    seconds: float
    output: str


def _run(
    arguments: Sequence[str], log: Path, *, number: int = 0, event: int = 0, after_s: float = 0.0, limit: int = 0
) -> Result:
    """Run a command in a process of its own.

    Args:
        arguments: of the command.
        log: file for what it prints.
        number: signal to send; 0 for none.
        event: before which change to the file system; 0 for a moment by time.
        after_s: seconds after which it is sent.
        limit: largest size of a file in bytes; 0 for none.
    """
    counts = log.with_suffix(".events")
    begin = time.monotonic()
    child = os.fork()
    if child == 0:
        _be_child(arguments, log, counts, number if event else 0, event, limit)
    timer = None
    if number and not event:
        timer = threading.Timer(after_s, lambda: os.kill(child, number))
        timer.start()
    status: int | None = None
    while status is None and time.monotonic() < begin + _TIMEOUT_S:
        done, ended = os.waitpid(child, os.WNOHANG)
        status = ended if done else None
        time.sleep(0.002)
    if timer is not None:
        timer.cancel()
        timer.join()
    if status is None:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    events = counts.stat().st_size if counts.exists() else 0
    code = -1000 if status is None else os.waitstatus_to_exitcode(status)
    return Result(code, events, time.monotonic() - begin, log.read_text(errors="replace"))


_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")


def _be_child(arguments: Sequence[str], log: Path, counts: Path, number: int, event: int, limit: int) -> None:
    """Run the command in this process, which then ends."""
    code = 70
    try:
        os.setsid()
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.stdout = open(1, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
        tally = os.open(counts, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
        seen = 0

        def watch(name: str, details: tuple[Any, ...]) -> None:
            nonlocal seen
            writes = name == "open" and isinstance(details[2], int) and details[2] & (os.O_WRONLY | os.O_RDWR)
            if name in _CHANGES or (writes and details[0] not in (1, 2)):
                seen += 1
                os.write(tally, b".")
                if seen == event and number:
                    os.kill(os.getpid(), number)

        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        else:
            sys.addaudithook(watch)
        run_command(list(arguments))
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


# -- checks -------------------------------------------------------------------------------------------------


def _content(out: Path, *, hidden: bool = False) -> Content:
    """Return what lies under final names, or with `hidden` in the folders of unfinished runs, by final names."""
    found: Content = {}
    for path in sorted(out.rglob("*")):
        parts = path.relative_to(out).parts
        is_hidden = any(part.startswith(".labelgen-") for part in parts)
        if path.is_file() and is_hidden == hidden:
            name = "/".join(part for part in parts if not part.startswith(".labelgen-"))
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _problem(name: str, out: Path, before: Content, new: Content, result: Result, number: int) -> str:
    """Return what is wrong after a run was ended; "" where nothing is."""
    if "Traceback (most recent call last)" in result.output:
        return "a traceback"
    allowed = {0, 128 + number, -number} if number else {0, 2}
    if result.code not in allowed:
        return f"exit code {result.code}"
    if not number and result.code == 2 and not re.search(r"cannot write /\S+: file too large", result.output):
        return "no line that names the file"
    if JOBS[name].resumes:
        return _checkpoint_problem(out)
    now = _content(out)
    if now in (before, new):
        return ""
    if JOBS[name].may_be_shorter and number in (signal.SIGINT, signal.SIGTERM) and _is_whole_session(out):
        return ""
    if number == signal.SIGKILL and _is_half_moved_up(now, _content(out, hidden=True), before, new):
        return ""
    changed = [key for key in {*now, *new} if now.get(key) != new.get(key)]
    return f"neither the older nor the newer results: {', '.join(sorted(changed)[:5])}"


def _is_half_moved_up(now: Content, staged: Content, before: Content, new: Content) -> bool:
    """Return whether all new files are whole in either place, and files of two runs do not lie side by side."""
    if {**staged, **now} != {**staged, **now, **new} and {**now, **staged} != {**now, **staged, **new}:
        return False
    return all(before.get(key) == value for key, value in now.items()) or all(
        new.get(key) == value for key, value in now.items()
    )


def _is_whole_session(out: Path) -> bool:
    truth = out / "truth" / "session0_center"
    frames = len((truth / "boxes.jsonl").read_text().splitlines())
    video = cv2.VideoCapture(str(out / "dataset" / "session0_center" / "video.avi"))
    count = 0
    while video.read()[0]:
        count += 1
    return frames == count == len(json.loads((truth / "masks.json").read_text())["images"])


def _checkpoint_problem(out: Path) -> str:
    """Return what is wrong with the checkpoints of a run folder, which are whole at any time."""
    import torch

    for path in out.glob("*.ckpt"):
        try:
            torch.load(path, weights_only=True)
        except Exception as err:
            return f"{path.name} cannot be read: {err}"
    return ""


def _weights(out: Path) -> Content:
    """Return the hashes of the weights in a run folder."""
    import torch

    data = torch.load(out / "last.ckpt", weights_only=True)
    return {key: hashlib.sha256(value.numpy().tobytes()).hexdigest() for key, value in data["state_dict"].items()}


class _Undisturbed(NamedTuple):
    """What a command writes over older results, in how many changes, bytes and seconds."""

    older: Path
    before: Content
    new: Content
    run: Result
    largest: int


def _undisturbed(name: str, root: Path, work: Path, store: Path) -> _Undisturbed:
    out = work / "out"
    shutil.rmtree(out, ignore_errors=True)
    result = _run(command_of(name, root, out, new=False), work / "log.txt")
    before, older = _content(out), store / name.replace(" ", "-")
    shutil.copytree(out, older)
    if result.code == 0:
        result = _run(command_of(name, root, out, new=True), work / "log.txt")
    if result.code != 0:
        raise RuntimeError(f"{name}: {result.output}")
    new = _weights(out) if JOBS[name].resumes else _content(out)
    largest = max(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return _Undisturbed(older, before, new, result, largest)


def _case(
    number: int, rng: np.random.Generator, name: str, root: Path, work: Path, known: _Undisturbed
) -> Failure | str:
    """Run one case; return what was done, or what went wrong."""
    out, log = work / "out", work / "log.txt"
    shutil.rmtree(out, ignore_errors=True)
    over_older = bool(rng.random() < 0.7)
    if over_older:
        shutil.copytree(known.older, out)
    before = known.before if over_older else {}
    command = command_of(name, root, out, new=True)
    kind = rng.choice(["SIGKILL", "SIGINT", "SIGTERM", "full disk"], p=[0.45, 0.25, 0.15, 0.15])
    if kind == "full disk":
        limit = int(rng.integers(200, max(300, known.largest)))
        how, result, sent = f"{kind} at {limit} bytes", _run(command, log, limit=limit), 0
    else:
        sent = int(signal.Signals[kind])
        last = max(1, known.run.events - _LAST_EVENTS)
        event = int(rng.integers(last if rng.random() < 0.5 else 1, known.run.events + 1)) if rng.random() < 0.7 else 0
        after_s = float(rng.uniform(0.05, max(0.1, known.run.seconds)))
        moment = f"at change {event} of {known.run.events}" if event else f"after {after_s:.2f} s"
        how, result = f"{kind} {moment}", _run(command, log, number=sent, event=event, after_s=after_s)
    how += " over older results" if over_older else ""
    problem = _problem(name, out, before, known.new, result, sent)
    if not problem:
        again = _run(_again(name, command, out, known), log)
        problem = _problem_of_rerun(name, out, known, again)
        result = again if problem else result
    return Failure(number, name, how, problem, result.output[-1500:]) if problem else f"{name}: {kind}"


def _again(name: str, command: list[str], out: Path, known: _Undisturbed) -> list[str]:
    """Return the command that goes on, or that begins anew where nothing can be continued."""
    older, last = known.older / "last.ckpt", out / "last.ckpt"
    if JOBS[name].resumes and last.exists() and (not older.exists() or last.read_bytes() != older.read_bytes()):
        return [argument for argument in command if argument != "--overwrite"] + ["--resume"]
    return command


def _problem_of_rerun(name: str, out: Path, known: _Undisturbed, again: Result) -> str:
    if again.code != 0:
        return f"the same command ends with {again.code}"
    if (_weights(out) if JOBS[name].resumes else _content(out)) != known.new:
        return "the same command gives other results than undisturbed"
    left = [path.name for path in out.rglob(".labelgen-*")]
    return f"left behind: {', '.join(left)}" if left else ""


def kills(
    count: int,
    seed: int,
    *,
    only: int | None = None,
    names: Sequence[str] = tuple(JOBS),
    report: Callable[[str], object] = lambda line: None,
) -> tuple[Counter[str], list[Failure]]:
    """Run cases.

    Args:
        count: number of them.
        seed: of all random choices.
        only: number of the single case to run; None for all.
        names: commands to choose from.
        report: called with a line for each case.

    Returns:
        How many cases of each kind went well, and those that did not.
    """
    _import_all()
    outcomes: Counter[str] = Counter()
    failures: list[Failure] = []
    with tempfile.TemporaryDirectory(prefix="labelgen-kills-") as folder:
        root, work, store = (Path(folder) / part for part in ("inputs", "work", "older"))
        for place in (root, work, store):
            place.mkdir()
        for arguments in input_commands(root):
            made = _run(arguments, work / "log.txt")
            if made.code != 0:
                raise RuntimeError(f"{arguments}: {made.output}")
        known: dict[str, _Undisturbed] = {}
        for number in range(count) if only is None else [only]:
            rng = np.random.default_rng([seed, number])
            name = names[number % len(names)]
            if name not in known:
                known[name] = _undisturbed(name, root, work, store)
            outcome = _case(number, rng, name, root, work, known[name])
            report(f"{number} {outcome if isinstance(outcome, str) else 'WRONG ' + outcome.name}")
            if isinstance(outcome, Failure):
                failures.append(outcome)
            else:
                outcomes[outcome] += 1
    return outcomes, failures


def _import_all() -> None:
    """Import here what the commands need, so that it is there in every process."""
    from importlib import import_module

    cv2.setNumThreads(1)
    for module in (
        "detector.training.train", "detector.training.callbacks", "detector.training.machine",
        "detector.training.lightning_module", "detector.speed.job", "detector.speed.pipeline", "detector.inference",
        "detector.evaluation.report", "labelgen.audit.page", "labelgen.jobs.video", "labelgen.jobs.boxcars",
        "labelgen.synth.truth.session", "labelgen.synth.truth.boxcars116k", "labelgen.cli.synth", "av", "h5py",
        "matplotlib.figure", "pycocotools.mask",
    ):  # fmt: skip
        import_module(module)


def main() -> None:
    """Run the study and print what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int)
    options = parser.parse_args()
    outcomes, failures = kills(
        options.count, options.seed, only=options.only, report=lambda line: print(line, flush=True)
    )
    for failure in failures:
        print(f"{failure.number} {failure.name}: {failure.how}\n  {failure.problem}\n{failure.output}")
    for kind, number in sorted(outcomes.items()):
        print(f"{number:5} {kind}")
    print(f"{outcomes.total() + len(failures)} cases, {len(failures)} wrong")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()

"""Outputs are there whole or not at all, whatever ends the run and whenever."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from samples import write_shard

from labelgen.datasets.scene import input_name
from labelgen.errors import OutputError
from labelgen.jobs.staging import Staging
from labelgen.media.stream import stream_name
from labelgen.output_lock import take_lock
from labelgen.shards import write_index
from labelgen.staged_output import StagedOutput, is_staged, staged_file

forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
OLD = {"main.json": "old", "sub/rows.csv": "old", "sub/1.jpg": "old", "sub/2.jpg": "old"}
NEW = {"main.json": "new", "sub/1.jpg": "new"}


def output(root: Path, **settings: bool) -> StagedOutput:
    settings = {"overwrite": True, **settings}
    return StagedOutput(root, "job", ["main.json", "sub/rows.csv"], patterns=["sub/[0-9].jpg"], **settings)


def write(root: Path, files: dict[str, str], **settings: bool) -> None:
    with output(root, **settings) as staged:
        for name, text in files.items():
            staged.stage(name).write_text(text)
        staged.publish()


def content(root: Path) -> dict[str, str]:
    return {path.relative_to(root).as_posix(): path.read_text() for path in root.rglob("*") if path.is_file()}


def test_newer_outputs_replace_older_ones_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mine.jpg").write_text("mine")
    write(tmp_path, OLD, overwrite=False)
    with pytest.raises(OutputError, match=r"main\.json: it exists already; choose another place, or overwrite it"):
        write(tmp_path, NEW, overwrite=False)
    write(tmp_path, NEW)
    assert content(tmp_path) == {**NEW, "sub/mine.jpg": "mine"}


@pytest.mark.parametrize("keep", [False, True])
def test_a_run_that_fails_leaves_older_outputs(tmp_path: Path, keep: bool) -> None:
    write(tmp_path, OLD)
    with pytest.raises(UnicodeEncodeError):
        write(tmp_path, {"main.json": "half", "sub/rows.csv": "\ud800"}, keep=keep)
    rest = (
        {".labelgen-job/lock": "", ".labelgen-job/main.json": "half", ".labelgen-job/sub/rows.csv": ""} if keep else {}
    )
    assert content(tmp_path) == {**OLD, **rest}
    assert is_staged(tmp_path / ".labelgen-job" / "main.json")
    if keep:
        with pytest.raises(OutputError, match="what a run made that did not end; move it elsewhere, or overwrite it"):
            write_over_rest(tmp_path)
    write(tmp_path, NEW)
    assert content(tmp_path) == NEW


def write_over_rest(root: Path) -> None:
    for path in (root / name for name in OLD):
        path.unlink()
    write(root, NEW, overwrite=False, needs_overwrite=True)


def test_a_run_that_fails_leaves_no_new_folder(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), output(tmp_path / "a" / "b"):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_two_runs_with_one_output(tmp_path: Path) -> None:
    with output(tmp_path) as first:
        with pytest.raises(OutputError, match="another labelgen job is writing into it"):
            write(tmp_path, NEW)
        first.stage("main.json").write_text("first")
        first.publish()
    assert content(tmp_path) == {"main.json": "first"}


def test_a_lock_that_was_deleted_while_another_job_waited_keeps_nobody_out(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "lock"
    first = take_lock(path, tmp_path)
    path.unlink()
    path.parent.rmdir()
    second = take_lock(path, tmp_path)
    with pytest.raises(OutputError):
        take_lock(path, tmp_path)
    first.close()
    second.close()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda root: (root / "main.json").mkdir(), r"main\.json: a folder is in the way"),
        (lambda root: (root / "sub").write_text(""), "sub is in the way, where a folder is needed"),
        (lambda root: (root / ".labelgen-job").symlink_to(root), r"\.labelgen-job: not a folder that labelgen made"),
        (lambda root: (root / ".labelgen-job").write_text(""), r"\.labelgen-job: not a folder that labelgen made"),
    ],
)
def test_what_is_in_the_way_is_found_before_the_work(tmp_path: Path, make: Callable[[Path], None], says: str) -> None:
    make(tmp_path)
    with pytest.raises(OutputError, match=says), output(tmp_path):
        pytest.fail("the work began")


def test_a_single_file_follows_its_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link.json").symlink_to(tmp_path / "real" / "x[1].json")
    with staged_file(tmp_path / "link.json", overwrite=False) as path:
        path.write_text("text")
    assert (tmp_path / "link.json").is_symlink()
    assert content(tmp_path / "real") == {"x[1].json": "text"}


def publish_job(root: Path) -> None:
    write(root, NEW)


def publish_shards(root: Path, seed: int = 7) -> None:
    job = {"command": "test", "settings": {}, "inputs": {"seed": seed}}
    with Staging(root, job, overwrite=True) as staging:
        if not staging.published:
            shards = [staging.path / f"shard-{i:05d}.h5" for i in range(2)]
            for i, shard in enumerate(shards):
                write_shard(shard, seed=seed + i)
            write_index(staging.path, shards, job)
            staging.publish()


def run_and_end(action: Callable[[Path], None], root: Path, number: int, event: int) -> int:
    """Run an action in a process that gets a signal before its change number `event` to the file system."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    seen = 0

    def watch(name: str, _: object) -> None:
        nonlocal seen
        if name in ("os.rename", "os.remove", "os.rmdir", "os.mkdir"):
            seen += 1
            if seen == event:
                os.kill(os.getpid(), number)

    code = 0
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.addaudithook(watch)
    try:
        action(root)
    except KeyboardInterrupt:
        code = 130
    os._exit(code)


@forks
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("kind", ["files", "shards"])
def test_ended_at_any_change_older_or_newer_outputs_are_whole(tmp_path: Path, kind: str, number: int) -> None:
    action = publish_job if kind == "files" else publish_shards
    for event in range(1, 60):
        root = tmp_path / str(event)
        if kind == "files":
            write(root, OLD)
        else:
            publish_shards(root, seed=1)
        before = files_of(root)
        code = run_and_end(action, root, number, event)
        after = {name: data for name, data in files_of(root).items() if not name.startswith(".labelgen-")}
        action(root)
        new = files_of(root)
        assert not [name for name in new if name.startswith(".labelgen-")]
        if number == signal.SIGINT:
            assert after in (before, new), event
        else:  # a subset of one of them: files of two runs never lie side by side
            assert after.items() <= before.items() or after.items() <= new.items() or kind == "shards", event
        if code == 0:
            assert event > 5
            return
    pytest.fail("there are more changes than expected")


def files_of(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("file", "name"),
    [("...avi", "video"), ("clip.mp4", "clip"), ("a.b.mp4", "a.b"), ("-x.mp4", "-x"), (".labelgen-job.mp4", "video")],
)
def test_no_name_leads_out_of_the_output_folder(tmp_path: Path, file: str, name: str) -> None:
    assert input_name(tmp_path / file) == name


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("rtsp://host/...avi", "stream"),
        ("rtsp://host/..", "stream"),
        ("http://host/cam/1.mjpg?a=/../x", "x"),
        ("rtsp://host/", "stream"),
        ("rtsp://host/a%2F..%2Fb", "a_2F."),
    ],
)
def test_no_address_leads_out_of_the_output_folder(url: str, name: str) -> None:
    assert stream_name(url) == name

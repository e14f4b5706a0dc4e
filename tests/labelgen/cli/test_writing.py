"""How the commands write: locked, checked before the work, ended by signals and full disks in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from clips import write_clip
from detector_shards import write_painted_shards

from detector.speed.detection_file import DetectionFile
from labelgen.datasets.fingerprint import fingerprint
from labelgen.errors import DataError
from labelgen.output_lock import take_lock
from labelgen.shards import ShardReader
from labelgen.shards.dataset import check_finished

REPOSITORY = Path(__file__).resolve().parents[3]
LOCKED = {
    "synth session": (".labelgen-synth-session0_center/lock", ["--size", "64x36"]),
    "synth boxcars": (".labelgen-synth/lock", []),
    "speed": ("clip/.labelgen-speed-transform3d/lock", ["clip.mp4", "--from", "masks:coco:masks.json"]),
    "bcs-masks": (".labelgen-job/lock", ["clip.mp4", "--masks", "coco:masks.json"]),
    "merge": (".labelgen-job/lock", ["shards"]),
    "audit": (".labelgen-audit/lock", ["shards"]),
    "calibrate": (".labelgen-file.png/lock", ["clip.mp4"]),
    "road-mask": (".labelgen-file.png/lock", ["clip.mp4"]),
    "rectify": (".labelgen-file.png/lock", ["clip.mp4"]),
}


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    write_clip(tmp_path, 10)
    write_painted_shards(tmp_path / "shards", 2)
    return tmp_path


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("command", LOCKED)
def test_two_jobs_with_one_output_are_refused(labelgen, inputs: Path, command: str, overwrite: bool) -> None:
    lock, arguments = LOCKED[command]
    out = inputs / "out"
    before = [take_lock(out / lock, out)]
    named = out / "file.png" if "file.png" in lock else out
    done = labelgen(*command.split(), *arguments, "--out", named, *(["--overwrite"] if overwrite else []))
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("labelgen: error:")]
    assert "another labelgen job is writing into it" in line
    assert [path for path in out.rglob("*") if path.is_file()] == [out / lock]
    before[0].close()


def run_code(code: str, *arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", f"{code}\nfrom labelgen.cli.main import main; main()", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, cwd=cwd, capture_output=True, text=True, timeout=200,
    )  # fmt: skip


SIGNAL_AT_WORK = """
import os, sys
def watch(name, details):
    if name == "open" and ".labelgen-" in str(details[0]) and "lock" in str(details[0]):
        os.kill(os.getpid(), {number})
sys.addaudithook(watch)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals")
@pytest.mark.parametrize(
    ("command", "number", "says"),
    [
        (["merge", "shards"], signal.SIGINT, "interrupted"),
        (["merge", "shards"], signal.SIGTERM, "terminated"),
        (["synth", "boxcars"], signal.SIGTERM, "terminated"),
        (
            ["bcs-masks", "clip.mp4", "--masks", "coco:masks.json"],
            signal.SIGINT,
            "interrupted; the same command goes on where it stopped",
        ),
    ],
)
def test_a_signal_is_one_line_and_its_exit_code(inputs: Path, command: list[str], number: int, says: str) -> None:
    done = run_code(SIGNAL_AT_WORK.format(number=int(number)), *command, "--out", "out", cwd=inputs)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", f"labelgen: {says}\n")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs limits")
def test_a_full_disk_is_one_line_with_the_path(tmp_path: Path) -> None:
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))"
    arguments = ["synth", "session", "--out", "out", "--size", "320x180", "--duration", "0.4"]
    done = run_code(limit, *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert f"labelgen: error: cannot write {Path('out', '.labelgen-synth')}" in done.stderr
    assert "file too large" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_calibration_of_another_video_of_the_same_name_is_not_used(labelgen, inputs: Path) -> None:
    """What a first video left in the folder is used for it again, and refused for the second."""
    made = inputs / "out" / "clip"
    made.mkdir(parents=True)
    (inputs / "clip.calibration.json").rename(made / "calibration.json")
    origin = fingerprint(inputs / "clip.mp4")
    (made / "made_from.json").write_text(f'{{"calibration.json": "{origin}"}}')
    arguments = ["speed", "clip.mp4", "--from", "masks:coco:masks.json", "--out", "out"]
    first = labelgen(*arguments)
    assert "using out/clip/calibration.json of an earlier run" in first.stderr
    (inputs / "other").mkdir()
    write_clip(inputs / "other", 12)
    (inputs / "other" / "clip.calibration.json").unlink()
    second = labelgen("speed", "other/clip.mp4", *arguments[2:], "--overwrite")
    assert "using out/clip/calibration.json" not in second.stderr  # it is made anew
    (made / "calibration.json").write_text("{}")
    third = labelgen("bcs-masks", "other/clip.mp4", "--masks", "coco:masks.json", "--out", "out/clip")
    assert third.returncode == 2
    assert "calibration.json: it was made from another video of that name; choose another folder" in third.stderr


def test_detections_of_a_run_that_has_not_ended_are_refused(tmp_path: Path) -> None:
    path = tmp_path / ".labelgen-speed-transform3d" / "detections_transform3d.jsonl"
    path.parent.mkdir()
    path.write_text("{}")
    with pytest.raises(DataError, match="of a run that has not ended; wait for it, or run it again"):
        DetectionFile.open(path)


def test_an_unfinished_data_set_is_refused_unless_its_shards_are_named(tmp_path: Path) -> None:
    folder = write_painted_shards(tmp_path / "shards", 2)
    shard = folder / "shard-00000.h5"
    readers = [ShardReader(shard)]
    check_finished(folder, readers)  # whole by the numbers of its shards
    (folder / ".labelgen-job").mkdir()
    with pytest.raises(
        DataError, match=r"an unfinished data set, as it has no dataset\.json; .* name its shards as files"
    ):
        check_finished(folder, readers)
    check_finished(shard, readers)


def test_a_name_of_a_session_stays_inside(labelgen, tmp_path: Path) -> None:
    done = labelgen("synth", "session", "--out", "out", "--name", "../x")
    assert done.returncode == 2
    assert "not the name of a folder; give one without slashes" in done.stderr
    assert not list(tmp_path.iterdir())

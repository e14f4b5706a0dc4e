"""The staging folder: no link is followed, nothing foreign deleted, and what is damaged is made again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from samples import write_shard

from labelgen.errors import OutputError
from labelgen.jobs.staging import Staging
from labelgen.shards import validate_shards, write_index

JOB = {"command": "test", "settings": {}, "inputs": {"a": 1}}
OTHER = {**JOB, "inputs": {"a": 2}}


def _make(out: Path, job: dict = JOB, *, seed: int = 0, overwrite: bool = False, publish: bool = True) -> Staging:
    """Run a job of two shards."""
    with Staging(out, job, overwrite=overwrite) as staging:
        if not staging.published:
            shards = [staging.path / f"shard-{i:05d}.h5" for i in range(2)]
            for i, shard in enumerate(shards):
                if not shard.exists():
                    write_shard(shard, seed=seed + 10 * i)
            write_index(staging.path, shards, job)
            if publish:
                staging.publish()
    return staging


def _content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_staging_folder_that_is_a_link_is_refused_and_its_target_stays(tmp_path: Path, overwrite: bool) -> None:
    target = tmp_path / "photos"
    target.mkdir()
    (target / "holiday.jpg").write_bytes(b"dear")
    (target / "shard-00000.h5").write_bytes(b"dear, too")
    out = tmp_path / "out"
    out.mkdir()
    (out / ".labelgen-job").symlink_to(target, target_is_directory=True)
    before = _content(target)
    with pytest.raises(OutputError, match=r"\.labelgen-job: a link, .*; remove it"):
        _make(out, overwrite=overwrite)
    assert _content(target) == before
    assert (out / ".labelgen-job").is_symlink()


@pytest.mark.parametrize("name", ["lock", "job.json", "shard-00007.h5", "dataset.json"])
def test_links_inside_the_staging_folder_are_not_followed(tmp_path: Path, name: str) -> None:
    target = tmp_path / "dear.txt"
    target.write_bytes(b"dear")
    staged = tmp_path / "out" / ".labelgen-job"
    staged.mkdir(parents=True)
    if name != "job.json":
        (staged / "job.json").write_text(json.dumps(OTHER))
    (staged / name).symlink_to(target)
    with pytest.raises(OutputError, match=name):
        _make(tmp_path / "out", overwrite=True)
    assert target.read_bytes() == b"dear"
    assert (staged / name).is_symlink()


@pytest.mark.parametrize("claimed", [False, True])
@pytest.mark.parametrize("name", ["notes.txt", "folder/notes.txt", "shard-00000.h5"])
def test_foreign_files_in_the_staging_folder_are_refused_and_stay(tmp_path: Path, name: str, claimed: bool) -> None:
    staged = tmp_path / "out" / ".labelgen-job"
    (staged / name).parent.mkdir(parents=True)
    (staged / name).write_bytes(b"dear")
    if claimed:
        (staged / "job.json").write_text(json.dumps(OTHER))
    if claimed and name.startswith("shard"):  # that is another job's, which may be replaced
        _make(tmp_path / "out", overwrite=True)
        assert not staged.exists()
        return
    with pytest.raises(OutputError, match=rf"holds what no labelgen job wrote \({name.split('/')[0]}\); move it"):
        _make(tmp_path / "out", overwrite=True)
    assert (staged / name).read_bytes() == b"dear"


def test_files_that_come_while_a_job_runs_stay(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with Staging(out, JOB, overwrite=False) as staging:
        (staging.path / "notes.txt").write_bytes(b"dear")
        write_shard(staging.path / "shard-00000.h5")
        write_index(staging.path, [staging.path / "shard-00000.h5"], JOB)
        staging.publish()
    assert [path.name for path in (out / ".labelgen-job").iterdir()] == ["notes.txt"]
    assert not any(validate_shards([out]).values())


DAMAGED = {
    "no JSON": b"{",
    "no index": b"[]",
    "empty": json.dumps({"shards": [], "job": JOB}).encode(),
    "of another job": None,
    "names a folder": json.dumps({"shards": [{"name": ".labelgen-job"}], "job": JOB}).encode(),
    "names what is not there": json.dumps({"shards": [{"name": "shard-9.h5", "file_sha256": ""}], "job": JOB}).encode(),
}


@pytest.mark.parametrize("kind", DAMAGED)
@pytest.mark.parametrize("finished", [False, True])
def test_a_damaged_or_forged_staged_index_is_made_again(tmp_path: Path, kind: str, finished: bool) -> None:
    out = tmp_path / "out"
    if finished:
        _make(out, OTHER, seed=50)
    before = _content(out) if finished else {}
    _make(out, overwrite=finished, publish=False)
    index = out / ".labelgen-job" / "dataset.json"
    text = DAMAGED[kind]
    index.write_bytes(json.dumps({**json.loads(index.read_text()), "job": OTHER}).encode() if text is None else text)
    if finished:
        with pytest.raises(OutputError, match="already holds a finished data set"):
            _make(out)
        assert {key: value for key, value in _content(out).items() if not key.startswith(".")} == before
    staging = _make(out, overwrite=finished)
    assert (staging.resumed, staging.published) == (2, True)
    _make(tmp_path / "wanted")
    assert _content(out) == _content(tmp_path / "wanted")


def test_a_finished_staged_data_set_does_not_replace_one_unasked(tmp_path: Path) -> None:
    out = tmp_path / "out"
    _make(out, OTHER, seed=50)
    before = _content(out)
    _make(out, overwrite=True, publish=False)
    with pytest.raises(OutputError, match="already holds a finished data set"):
        _make(out)
    assert {key: value for key, value in _content(out).items() if not key.startswith(".")} == before


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_publication_that_was_interrupted_is_completed_without_overwrite(tmp_path: Path, moved: int) -> None:
    out = tmp_path / "out"
    staged = _make(out, publish=False).path
    for i in range(moved):
        shutil.move(staged / f"shard-{i:05d}.h5", out / f"shard-{i:05d}.h5")
    assert _make(out).published
    _make(tmp_path / "wanted")
    assert _content(out) == _content(tmp_path / "wanted")


def test_a_shard_lost_while_publishing_is_made_again(tmp_path: Path) -> None:
    out = tmp_path / "out"
    staged = _make(out, publish=False).path
    shutil.move(staged / "shard-00000.h5", out / "shard-00000.h5")
    (staged / "shard-00001.h5").unlink()
    staging = _make(out)
    assert (staging.resumed, staging.published) == (1, True)
    _make(tmp_path / "wanted")
    assert _content(out) == _content(tmp_path / "wanted")


def test_a_merge_interrupted_while_publishing_is_completed(labelgen, tmp_path: Path) -> None:
    _make(tmp_path / "a")
    _make(tmp_path / "b", OTHER, seed=50)
    assert labelgen("merge", "a", "b", "--out", "wanted").returncode == 0
    out = tmp_path / "out"
    staged = out / ".labelgen-job"
    staged.mkdir(parents=True)
    for path in (tmp_path / "wanted").iterdir():
        shutil.copy(path, (out if path.name == "shard-00000.h5" else staged) / path.name)
    job = json.loads((staged / "dataset.json").read_text())["job"]
    (staged / "job.json").write_text(json.dumps(job))
    done = labelgen("merge", "a", "b", "--out", "out")
    assert done.returncode == 0, done.stderr
    assert _content(out) == _content(tmp_path / "wanted")

"""`labelgen inspect`, `validate`, `merge` and `audit` from the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from boxcars_trees import write_tree
from clips import write_clip
from samples import SIZE, make_sample, write_shard

from labelgen.geometry import Pair
from labelgen.labels import IgnoredBoxes, IgnoreReason
from labelgen.shards import ShardDataset, ShardWriter


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two small data sets, boxcars and masks, whose originals are at hand."""
    from typer.testing import CliRunner

    from labelgen.cli.main import app

    root = tmp_path_factory.mktemp("data")
    write_tree(root / "tree", vehicles=4)
    clip = write_clip(root / "clip", 20)
    masks = ["bcs-masks", clip, "--masks", f"coco:{root / 'clip' / 'masks.json'}", "--every", "5"]
    commands = [
        ["boxcars", "--root", root / "tree", "--out", root / "boxcars", "--cameras", "all", "--all-directions"],
        [*masks, "--rule", "wider", "--out", root / "masks"],
        [*masks, "--out", root / "fitted"],
    ]
    for command in commands:
        done = CliRunner().invoke(app, [str(part) for part in command])
        assert done.exit_code == 0, done.output
    return root


def test_inspect(labelgen, shards: Path, tmp_path: Path) -> None:
    done = labelgen("inspect", shards / "masks", "--json", "i.json")
    assert done.returncode == 0, done.stderr
    data = json.loads((tmp_path / "i.json").read_text())
    assert (data["images"], data["labels"], data["shards"]) == (4, 8, 1)
    assert data["classes"] == {"car": 8}
    assert data["settings"]["rule"] == "wider"
    assert set(data["spread"]) == {"c_c", "box width, px", "box height, px", "labels per image"}
    assert "VP2-VP3" in done.stdout


def test_fitted_labels_are_the_default_and_state_their_deviations(labelgen, shards: Path, tmp_path: Path) -> None:
    data = ShardDataset(shards / "fitted")
    assert data.readers[0].settings["rule"] == "fitted"
    for sample in data:
        assert np.isfinite(sample.labels.sigmas).all()
        assert np.isnan(sample.labels.candidates).all()
    clip = shards / "clip" / "clip.mp4"
    calibration = json.loads((shards / "clip" / "clip.calibration.json").read_text())
    del calibration["camera_calibration"]["scale"]
    (tmp_path / "unscaled.json").write_text(json.dumps(calibration))
    command = ("bcs-masks", clip, "--masks", f"coco:{shards / 'clip' / 'masks.json'}", "--every", 5)
    done = labelgen(*command, "--calibration", "unscaled.json", "--out", "unscaled")
    assert done.returncode == 0, done.stderr
    assert "has no scale: labels by the rule wider" in done.stderr
    assert ShardDataset(tmp_path / "unscaled").readers[0].settings["rule"] == "wider"
    done = labelgen(*command, "--calibration", "unscaled.json", "--rule", "fitted", "--out", "refused")
    assert done.returncode == 2
    assert "no scale, which the rule fitted needs" in done.stderr
    assert not (tmp_path / "refused").exists()


def test_validate_finds_one_changed_byte(labelgen, shards: Path, tmp_path: Path) -> None:
    assert labelgen("validate", shards / "boxcars", shards / "masks").returncode == 0
    folder = tmp_path / "copy"
    folder.mkdir()
    for path in (shards / "masks").iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    shard = folder / "shard-00000.h5"
    data = bytearray(shard.read_bytes())
    jpeg = data.find(b"\xff\xd8\xff")
    data[jpeg + 400] ^= 0xFF
    shard.write_bytes(data)
    done = labelgen("validate", folder, "--json", "v.json")
    assert done.returncode == 2
    assert "shard-00000.h5: not the file named in dataset.json (its hash differs)" in done.stderr
    report = json.loads((tmp_path / "v.json").read_text())
    assert report["valid"] is False
    assert list(report["problems"]) == [str(folder)]
    alone = labelgen("validate", shard)
    assert alone.returncode == 2
    assert "its content is not what was written (hash differs)" in alone.stderr


def test_merge(labelgen, shards: Path, tmp_path: Path) -> None:
    done = labelgen("merge", shards / "masks", shards / "boxcars", "--out", "both")
    assert done.returncode == 2
    assert "different pairs or sizes" in done.stderr
    assert not (tmp_path / "both").exists()
    assert labelgen("merge", shards / "masks", "--out", "both", "--json", "m.json").returncode == 0
    assert json.loads((tmp_path / "m.json").read_text())["labels"] == 8
    assert labelgen("validate", "both").returncode == 0
    again = labelgen("merge", shards / "masks", "--out", "both")
    assert again.returncode == 2
    assert "already holds a finished data set; overwrite it" in again.stderr
    assert "(options --overwrite, --out)" in again.stderr
    assert labelgen("merge", shards / "masks", "--out", "both", "--overwrite").returncode == 0
    assert "one of the folders to merge" in labelgen("merge", "both", "--out", "both").stderr


@pytest.mark.parametrize("name", ["boxcars", "masks", "fitted"])
def test_audit(labelgen, shards: Path, tmp_path: Path, name: str) -> None:
    done = labelgen("audit", shards / name, "--out", "look", "--count", 12, "--json", "a.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "a.json").read_text())
    chapters = set(report["pictures"])
    assert {"Statistics", "Steps of the rectification"} <= chapters
    assert ("Steps from mask to label" in chapters) == (name != "boxcars")
    page = (tmp_path / "look" / "index.html").read_text()
    for pictures in report["pictures"].values():
        assert pictures
        for picture in pictures:
            image = cv2.imread(str(tmp_path / picture))
            assert image is not None
            assert image.std() > 5
            assert Path(picture).name in page
    assert report["notes"] == []
    assert labelgen("audit", shards / name, "--out", "look").returncode == 2


def test_audit_without_the_originals(labelgen, shards: Path, tmp_path: Path) -> None:
    """A data set alone, moved to another machine."""
    folder = tmp_path / "alone"
    folder.mkdir()
    (folder / "shard-00000.h5").write_bytes((shards / "masks" / "shard-00000.h5").read_bytes())
    done = labelgen("audit", folder, "--out", "look", "--count", 3)
    assert done.returncode == 0, done.stderr
    assert "the original of the first sample is not available" in done.stderr
    assert (tmp_path / "look" / "labels-00.png").exists()


def test_ignored_boxes_are_counted_by_reason(labelgen, tmp_path: Path) -> None:
    write_shard(tmp_path / "shard-00000.h5", samples=5)  # one box in samples 0, 2 and 4, of reasons 0, 2 and 4
    done = labelgen("inspect", "shard-00000.h5", "--json", "i.json")
    assert done.returncode == 0, done.stderr
    data = json.loads((tmp_path / "i.json").read_text())
    assert data["ignored"] == 3
    assert data["ignored_by_reason"] == {"no valid 3D box": 1, "other": 1, "too small": 1}
    assert "ignored boxes" in done.stdout
    assert "no valid 3D box" in done.stdout


def test_an_audit_shows_ignored_boxes_dashed_with_their_reason(labelgen, tmp_path: Path) -> None:
    box = np.array([[6.0, 12.0, 40.0, 30.0]])
    blank = cv2.imencode(".png", np.zeros((SIZE[1], SIZE[0], 3), np.uint8))[1].tobytes()
    pictures = {}
    for name, ignored in (("with", IgnoredBoxes(box, [IgnoreReason.OFF_ROAD])), ("without", IgnoredBoxes.empty())):
        with ShardWriter(tmp_path / f"{name}.h5", Pair.VP2_VP3, SIZE, source="clip") as writer:
            writer.add(replace(make_sample(0), encoded=blank, ignored=ignored))
        done = labelgen("audit", f"{name}.h5", "--out", name)
        assert done.returncode == 0, done.stderr
        pictures[name] = cv2.imread(str(tmp_path / name / "frames-00.png"))
    changed = (pictures["with"] != pictures["without"]).any(axis=2)
    gain, gap = 640 // SIZE[0], 6  # the picture is enlarged, with a margin
    right_side = changed[gap + 16 * gain : gap + 30 * gain, gap + 40 * gain - 2 : gap + 40 * gain + 2].any(axis=1)
    assert 0.2 < right_side.mean() < 0.9
    assert not changed[gap + 20 * gain : gap + 25 * gain, gap + 46 * gain :].any()
    page = (tmp_path / "with" / "index.html").read_text()
    assert "ignored boxes<td>1" in page
    assert "off the road<td>1" in page


def test_masks_without_a_label_become_ignored_boxes(labelgen, shards: Path, tmp_path: Path) -> None:
    clip = shards / "clip" / "clip.mp4"
    options = [clip, "--masks", f"coco:{shards / 'clip' / 'masks.json'}", "--every", "5", "--rule", "wider"]
    boxes = [sample.labels.boxes_xyxy for sample in ShardDataset(shards / "masks")]
    heights = np.array([pair[:, 3] - pair[:, 1] for pair in boxes])  # (frames, 2)
    limit = float(heights[0].mean())
    low = heights < limit
    for workers in (1, 2):
        out = f"out{workers}"
        more = ["--min-height", limit, "--workers", workers, "--out", out, "--json", f"{out}.json"]
        done = labelgen("bcs-masks", *options, *more)
        assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out1.json").read_text())
    assert report["rejects_by_reason"]["too small"] == low.sum()
    assert report["ignored"] == low[~low.all(axis=1)].sum() > 0  # frames without a label are left out
    assert report["ignored_by_reason"] == {"too small": report["ignored"]}
    assert (tmp_path / "out1" / "shard-00000.h5").read_bytes() == (tmp_path / "out2" / "shard-00000.h5").read_bytes()
    before = {sample.frame: sample for sample in ShardDataset(shards / "masks")}
    for sample in ShardDataset(tmp_path / "out1"):
        assert sample.encoded == before[sample.frame].encoded
        wanted = before[sample.frame].labels.boxes_xyxy.tolist()
        for box in sample.labels.boxes_xyxy.tolist():
            wanted.remove(box)
        for (x0, y0, x1, y1), ignored in zip(wanted, sample.ignored.boxes_xyxy.tolist(), strict=True):
            assert ignored[0] < x0 < x1 < ignored[2]
            assert ignored[1] < y0 < y1 <= ignored[3]

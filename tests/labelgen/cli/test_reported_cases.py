"""Inputs of real users that broke the commands, and their siblings: the right figures, or one line."""

from __future__ import annotations

import csv
import json
import os
import shutil
import statistics
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import pytest
from clips import write_clip

from labelgen.shards import ShardDataset

FRAMES, EVERY = 30, 5
RIGHT = (0, 6, 12)
"""Exit code, images and labels of the clip."""

Data = dict[str, Any]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("reported"), FRAMES)


def each(part: str, **changes: Callable[[Any], Any]) -> Callable[[Data], None]:
    """Change fields of every entry of a part of a COCO file."""

    def change(data: Data) -> None:
        for entry in data[part]:
            for key, new in changes.items():
                entry[key] = new(entry.get(key))

    return change


def named(name: str) -> Callable[[Data], None]:
    """Name each frame by its number, and leave the number out."""

    def change(data: Data) -> None:
        for image in data["images"]:
            image["file_name"] = name.format(image.pop("frame"))

    return change


SIBLINGS: dict[str, tuple[Callable[[Data], None], str]] = {
    "class ids with a blank": (each("annotations", category_id=lambda n: f" {n} "), "utf-8"),
    "class ids of the list as text": (each("categories", id=str), "utf-8"),
    "image ids of the list as text": (each("images", id=str), "utf-8"),
    "image ids as floats": (each("annotations", image_id=float), "utf-8"),
    "no ids of annotations": (each("annotations", id=lambda _: None), "utf-8"),
    "scores as text": (each("annotations", score=str), "utf-8"),
    "sizes as text": (each("images", width=str, height=str), "utf-8"),
    "a mark before the text": (each("images"), "utf-8-sig"),
    "crowd as a truth value": (each("annotations", iscrowd=lambda _: True), "utf-8"),
    "crowd as a float": (each("annotations", iscrowd=lambda _: 1.0), "utf-8"),
    "crowd as text": (each("annotations", iscrowd=lambda _: "1"), "utf-8"),
    "names in capitals": (named("FRAME_{:06d}.JPEG"), "utf-8"),
    "names with a drive": (named("C:\\Users\\me\\{:06d}.png"), "utf-8"),
    "names of a web address": (named("https://host/bucket/{:06d}.png"), "utf-8"),
    "names with a hash and a folder": (named("train/f_{0:04d}_png.rf.{0:032x}.jpg"), "utf-8"),
    "names with the video before": (named("clip_{:05d}.jpg"), "utf-8"),
    "names in a folder of the video's file": (named("clip.mp4/{:05d}.jpg"), "utf-8"),
}


@pytest.mark.parametrize("name", SIBLINGS)
def test_siblings_of_reported_masks(labelgen: Any, clip: Path, tmp_path: Path, name: str) -> None:
    change, encoding = SIBLINGS[name]
    data = json.loads((clip.parent / "masks.json").read_text())
    change(data)
    (tmp_path / "m.json").write_bytes(json.dumps(data).encode(encoding))
    done = labelgen(
        "bcs-masks", "--rule", "wider", clip, "--masks", "coco:m.json", "--every", EVERY, "--out", "out",
        "--json", "r.json",
    )  # fmt: skip
    report = json.loads((tmp_path / "r.json").read_text())
    assert (done.returncode, report.get("images"), report.get("labels")) == RIGHT, done.stderr


@pytest.mark.parametrize(
    ("size_wh", "options", "told"),
    [
        ((320, 180), (), "masks made for frames of 320x180 px, but the frames are 640x360"),
        ((1280, 720), (), "masks made for frames of 1280x720 px, but the frames are 640x360"),
        ((640, 480), ("--scale-masks",), "masks made for frames of 640x480 px, but the frames are 640x360"),
    ],
)
def test_masks_of_another_size(
    labelgen: Any, clip: Path, tmp_path: Path, size_wh: tuple[int, int], options: tuple[str, ...], told: str
) -> None:
    data = json.loads((clip.parent / "masks.json").read_text())
    each("images", width=lambda _: size_wh[0], height=lambda _: size_wh[1])(data)
    (width, height) = size_wh
    each("annotations", segmentation=lambda _: [[10, 10, width - 10, 10, width - 10, height - 10]])(data)
    (tmp_path / "m.json").write_text(json.dumps(data))
    done = labelgen(
        "bcs-masks", "--rule", "wider", clip, "--masks", "coco:m.json", "--every", EVERY, "--out", "out", *options
    )
    assert done.returncode == 2
    assert told in done.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("folder", ["a:b", "http:x", "50%_é ü", "pipe:1", "x?y#z", "concat:a|b", "%04d"])
def test_odd_names_of_outputs(labelgen: Any, clip: Path, tmp_path: Path, folder: str) -> None:
    masks = f"masks:coco:{clip.parent / 'masks.json'}"
    done = labelgen("speed", clip, "--from", masks, "--duration", 0.6, "--render", "--out", folder)
    video = tmp_path / folder / "clip" / "annotated_transform3d.avi"
    with av.open(f"file:{video}") as container:
        assert sum(1 for _ in container.decode(video=0)) == 15
    assert done.returncode in (0, 2)  # too short for a vehicle
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("suffix", ["avi", "mkv", "ts", "mp4"])
def test_files_without_their_end(labelgen: Any, clip: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"clip.{suffix}"
    options = {"movflags": "faststart"} if suffix == "mp4" else {}
    with av.open(str(clip)) as source, av.open(str(path), "w", options=options) as container:
        stream: Any = container.add_stream("mpeg2video" if suffix == "ts" else "mpeg4", rate=25)
        stream.width, stream.height, stream.bit_rate = 640, 360, 3_000_000
        for number, frame in enumerate(source.decode(video=0)):
            frame.pts, frame.time_base, frame.pict_type = number, Fraction(1, 25), 0
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    for kind in (".calibration.json", ".mask.png"):
        shutil.copy(clip.with_suffix("").with_suffix(kind), tmp_path / f"clip{kind}")
    done = labelgen(
        "bcs-masks", "--rule", "wider", path, "--masks", f"coco:{clip.parent / 'masks.json'}", "--every", EVERY,
        "--out", "out",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    if suffix == "ts":  # it announces nothing: a recording that is cut is a shorter recording
        assert len(ShardDataset(tmp_path / "out")) < RIGHT[1]
    else:
        assert "announced frames: the file is truncated or damaged" in done.stderr


# -- the reported inputs themselves, where they are --------------------------------------------------------------


@pytest.fixture(scope="module")
def cases() -> Path:
    folder = Path(os.environ.get("LABELGEN_REAL_DATA") or "nowhere").parent / "cases"
    if not folder.is_dir():
        pytest.skip("the reported inputs are not on this machine")
    return folder


def speeds(folder: Path) -> tuple[int, float]:
    """Number of vehicles and median speed in km/h."""
    [path] = folder.rglob("vehicles_transform3d.csv")
    with path.open(newline="") as file:
        values = [float(row["speed_kmh"]) for row in csv.DictReader(file)]
    return len(values), statistics.median(values)


TRUTH = "masks:coco:_base/truth.json"
SPEEDS = {
    "bom": "_base/base.mp4 --calibration bom/bom.calibration.json",
    "bom of the masks": "_base/base.mp4 --from masks:coco:bom/masks.json",
    "calibration_of_another_size": "_base/base.mp4 --calibration calibration_of_another_size/main_stream.json",
    "cvat_iscrowd": "_base/base.mp4 --from masks:coco:cvat_iscrowd/masks.json",
    "fps_ignored h264": "fps_ignored/pi.h264 --fps 10",
    "fps_ignored avi": "fps_ignored/rpi600.avi --fps 10",
    "fps_ignored mkv": "fps_ignored/k1000.mkv --fps 10",
    "ids category_float": "_base/base.mp4 --from masks:coco:ids_of_other_types/category_float.json",
    "ids category_str": "_base/base.mp4 --from masks:coco:ids_of_other_types/category_str.json",
    "ids image_str": "_base/base.mp4 --from masks:coco:ids_of_other_types/image_str.json",
    "ids results_stem": "_base/base.mp4 --from masks:coco:ids_of_other_types/results_stem.json",
    "roboflow_names": "_base/base.mp4 --from masks:coco:roboflow_names/masks.json",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SPEEDS)
def test_speeds_of_reported_cases(labelgen: Any, cases: Path, tmp_path: Path, name: str) -> None:
    words = SPEEDS[name].split() if "--from" in SPEEDS[name] else [*SPEEDS[name].split(), "--from", TRUTH]
    places = [word.replace("masks:coco:", f"masks:coco:{cases}/") if "/" in word else word for word in words]
    places = [str(cases / word) if "/" in word and not word.startswith("masks:") else word for word in places]
    done = labelgen("speed", *places, "--out", "out")
    assert done.returncode == 0, done.stderr
    assert speeds(tmp_path / "out") == (9, pytest.approx(103.7, abs=0.15))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exact", "nfd", "percent", "labelstudio", "suffix"])
def test_names_of_a_reported_folder(labelgen: Any, cases: Path, tmp_path: Path, name: str) -> None:
    folder = cases / "names_that_match_nothing"
    done = labelgen(
        "bcs-masks",
        "--rule",
        "wider",
        folder / "imgs",
        "--masks",
        f"coco:{folder / name}.json",
        "--every",
        1,
        "--out",
        "o",
    )
    assert done.returncode == 0, done.stderr
    assert "6 of 60 image entries used" in done.stderr
    masks = f"coco:{cases / '_base' / 'truth.json'}"
    base = labelgen(
        "bcs-masks", "--rule", "wider", cases / "_base" / "base.mp4", "--masks", masks, "--every", 10, "--out", "r"
    )
    assert base.returncode == 0
    right = {sample.frame: sample.labels.boxes_xyxy for sample in ShardDataset(tmp_path / "r")}
    for sample in ShardDataset(tmp_path / "o"):
        assert sample.labels.boxes_xyxy == pytest.approx(right.pop(10 * sample.frame), abs=0.01)
    assert not right


@pytest.mark.slow
def test_the_other_reported_cases(labelgen: Any, cases: Path, tmp_path: Path) -> None:
    base = cases / "_base" / "base.mp4"
    masks = ("--masks", f"coco:{cases / '_base' / 'truth.json'}")
    refused = labelgen(
        "bcs-masks",
        "--rule",
        "wider",
        base,
        "--masks",
        f"coco:{cases}/polygons_of_another_size/masks.json",
        "--out",
        "p",
    )
    assert refused.returncode == 2
    assert "366 masks made for frames of 640x360 px, but the frames are 320x180" in refused.stderr
    scaled = labelgen("bcs-masks", "--rule", "wider", base, "--masks",
                      f"coco:{cases}/polygons_of_another_size/masks.json",
        "--every", 5, "--scale-masks", "--out", "q")  # fmt: skip
    assert scaled.returncode == 0
    assert 44 <= len(ShardDataset(tmp_path / "q").table("labels/cc")) <= 48
    assert labelgen("bcs-masks", "--rule", "wider", base, *masks, "--every", 5, "--out", "right").returncode == 0
    right = {sample.frame: sample.labels.boxes_xyxy for sample in ShardDataset(tmp_path / "right")}
    assert sum(map(len, right.values())) == 46
    for name in ("masks", "masks_frame_key"):
        two = cases / "two_videos_one_coco"
        done = labelgen(
            "bcs-masks",
            "--rule",
            "wider",
            two / "camB.mp4",
            "--masks",
            f"coco:{two / name}.json",
            "--every",
            5,
            "--out",
            name,
        )
        assert done.returncode == 0
        assert "30 of 60 image entries used, 30 of other videos" in done.stderr
        for sample in ShardDataset(tmp_path / name):
            assert sample.labels.boxes_xyxy == pytest.approx(right[sample.frame + 30], abs=1.5)
    source = TRUTH.replace("_base", f"{cases}/_base")
    cut = labelgen("speed", cases / "damaged_file_not_told" / "cut.avi", "--from", source, "--out", "cut")
    assert "ended after 31 of 60 announced frames" in cut.stderr
    lost = labelgen("speed", cases / "damaged_file_not_told" / "no_moov.mp4", "--out", "lost")
    assert lost.returncode == 2
    assert "its end is missing" in lost.stderr

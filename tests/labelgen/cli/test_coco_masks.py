"""COCO files of other tools, through the commands: right values or one clear line, and what was left out is told."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clips import CAMERA, write_clip

FRAMES = 30


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("coco"), FRAMES, name="camA.mp4")


def _masks(clip: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((clip.parent / "masks.json").read_text())
    return data


def _named(clip: Path, name: str, first: int = 0) -> dict[str, Any]:
    data = _masks(clip)
    for image in data["images"]:
        image["file_name"] = name.format(image.pop("frame") + first)
    return data


def _bcs_masks(labelgen, clip: Path, tmp_path: Path, data: Any, *options: object) -> tuple[Any, dict[str, Any]]:
    (tmp_path / "m.json").write_text(json.dumps(data))
    report = tmp_path / "report.json"
    done = labelgen(
        "bcs-masks", clip, "--masks", "coco:m.json", "--every", 5, "--out", "out", "--json", report, *options
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    return done, json.loads(report.read_text()) if report.exists() else {}


@pytest.mark.parametrize(
    ("name", "first", "options", "told"),
    [
        ("{:06d}.png", 0, [], "30 of 30 image entries used"),
        ("{:06d}.png", 1, [], "1 is taken as the first frame"),
        ("{:06d}.png", 1, ["--first-frame", 1], "30 of 30 image entries used"),
        ("{:06d}.png", 7, ["--first-frame", 7], "30 of 30 image entries used"),
        ("f_{0:06d}_jpg.rf.{0:032x}.jpg", 0, [], "30 of 30 image entries used"),
    ],
)
def test_names_of_frames(labelgen, clip: Path, tmp_path: Path, name: str, first: int, options: list, told: str) -> None:
    done, report = _bcs_masks(labelgen, clip, tmp_path, _named(clip, name, first), *options)
    assert (done.returncode, report["images"], report["labels"]) == (0, 6, 12)
    assert done.stderr.count(told) == 1
    assert "first_frame" not in done.stderr


def test_a_file_named_like_an_option_keeps_its_name(labelgen, clip: Path, tmp_path: Path) -> None:
    data = _named(clip, "{:06d}.png", 1)
    data["images"] = [image for image in data["images"] if image["id"] in (3, 10)]
    (tmp_path / "every_5.json").write_text(json.dumps(data))
    done = labelgen("bcs-masks", clip, "--masks", "coco:every_5.json", "--every", 9, "--out", "out")
    assert done.returncode == 2
    assert "error: every_5.json: no vehicles found: every 9: no annotated frame is among these" in done.stderr


def test_the_other_videos_entries_are_left_out(labelgen, clip: Path, tmp_path: Path) -> None:
    data = _named(clip, "camA/{:06d}.png")
    for image in list(data["images"]):
        data["images"].append({**image, "id": 1000 + image["id"], "file_name": image["file_name"].replace("A", "B")})
    done, report = _bcs_masks(labelgen, clip, tmp_path, data)
    assert (done.returncode, report["images"], report["labels"], report["problems"]) == (0, 6, 12, [])
    assert "m.json: 30 of 60 image entries used, 30 of other videos" in done.stderr
    for image in data["images"]:
        image["file_name"] = image["file_name"].replace("cam", "other")
    done, _ = _bcs_masks(labelgen, clip, tmp_path, data, "--overwrite")
    assert done.returncode == 2
    assert "30 frames are named by several image entries, such as frame 0 by otherA/000000.png" in done.stderr


@pytest.mark.parametrize("command", ["bcs-masks", "speed"])
@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (
            {"every": 1},
            ["--every", 7],
            "every 7: no annotated frame is among these; frames 1, 2, 3, ...",
        ),
        ({"first": 500, "last": 28}, [], "they number frames 500 to 528, but camA.mp4 has 30 frames"),
        ({"category_id": 1}, [], "60 annotations of other categories (60 id 1) left out"),
        ({"segmentation": None}, [], "60 annotations skipped: it has no segmentation, such as annotation 1"),
        ({"size": (1280, 720)}, [], "60 masks made for frames of 1280x720 px, but the frames are 640x360"),
        ({"names": "gizmo"}, [], "none of its categories is a vehicle (found gizmo); name them car"),
        ({"category_id": 0}, [], "its class ids begin with 0, which COCO's do not; say what they mean"),
    ],
)
def test_nothing_to_label_is_one_line_with_the_reason(
    labelgen, clip: Path, tmp_path: Path, command: str, change: dict[str, Any], options: list, message: str
) -> None:
    if command == "speed" and "every" in change:
        pytest.skip("speed takes every frame")
    data = _named(clip, "{:06d}.png", change.get("first", 0))
    data["images"] = [image for image in data["images"] if image["id"] <= change.get("last", FRAMES)]
    data["annotations"] = [a for a in data["annotations"] if a["image_id"] <= change.get("last", FRAMES)]
    if "every" in change:
        data["images"] = [image for image in data["images"] if image["id"] in (1, 2, 3, 4, 5, 6)]
        data["annotations"] = [a for a in data["annotations"] if a["image_id"] in (1, 2, 3, 4, 5, 6)]
    for a in data["annotations"]:
        a.update({key: value for key, value in change.items() if key in ("category_id", "segmentation")})
        if "size" in change:
            a["segmentation"] = [[10, 10, 900, 10, 900, 700]]
    for category in data["categories"]:
        category["name"] = change.get("names", category["name"])
    if "category_id" in change:
        del data["categories"]
    for image in data["images"]:
        image["width"], image["height"] = change.get("size", (640, 360))
    if command == "speed":
        (tmp_path / "m.json").write_text(json.dumps(data))
        done = labelgen("speed", clip, "--from", "masks:coco:m.json", "--out", "out", "--json", "report.json")
    else:
        done, _ = _bcs_masks(labelgen, clip, tmp_path, data, *options)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("labelgen: error")]
    assert message in line
    assert not (tmp_path / "out").exists()
    if "category_id" not in change or change["category_id"]:
        assert message in json.loads((tmp_path / "report.json").read_text())["error"]


def test_scaled_masks_give_the_same_labels(labelgen, clip: Path, tmp_path: Path) -> None:
    data = _masks(clip)
    exact = _bcs_masks(labelgen, clip, tmp_path, data)[1]
    for image in data["images"]:
        image["width"], image["height"] = 1280, 720
    # Rectangles, whose corners are known, on frames of twice the size.
    for a in data["annotations"]:
        a["segmentation"] = {"size": [720, 1280], "counts": _doubled(a["segmentation"])}
    done, report = _bcs_masks(labelgen, clip, tmp_path, data, "--scale-masks", "--overwrite")
    assert done.returncode == 0, done.stderr
    assert (report["images"], report["labels"], report["problems"]) == (exact["images"], exact["labels"], [])


def _doubled(rle: dict[str, Any]) -> str:
    import numpy as np
    from pycocotools import mask as coco

    mask = coco.decode(rle)
    encoded = coco.encode(np.asfortranarray(mask.repeat(2, axis=0).repeat(2, axis=1)))
    return str(encoded["counts"].decode())


def test_problems_are_in_the_summary_and_in_the_report(labelgen, clip: Path, tmp_path: Path) -> None:
    data = _masks(clip)
    data["annotations"] += [{"id": 9, "image_id": 5, "category_id": 3}] * 20
    data["images"].append({"id": 99, "frame": 99})
    done, report = _bcs_masks(labelgen, clip, tmp_path, data)
    expected = [
        "m.json: 30 of 31 image entries used, 1 beyond the video",
        "m.json: 20 annotations skipped: it has no segmentation, such as annotation 9: it has no segmentation",
    ]
    assert report["problems"] == expected
    assert [line for line in done.stderr.splitlines() if line.startswith("warning")] == [
        f"warning: {e}" for e in expected
    ]
    (tmp_path / "out2").mkdir()
    done = labelgen("speed", clip, "--from", "masks:coco:m.json", "--out", "out2", "--json", "speed.json")
    assert json.loads((tmp_path / "speed.json").read_text())["problems"] == expected


def test_classes_by_option(labelgen, clip: Path, tmp_path: Path) -> None:
    data = _masks(clip)
    del data["categories"]
    for a in data["annotations"]:
        a["category_id"] = 0
    done, report = _bcs_masks(labelgen, clip, tmp_path, data, "--classes", "0=truck")
    assert (done.returncode, report["labels"]) == (0, 12)
    done, _ = _bcs_masks(labelgen, clip, tmp_path, data, "--classes", "0=boat", "--overwrite")
    assert done.returncode == 2
    assert "--classes 0=boat: expected names or ids of categories" in done.stderr


def test_no_vehicles_is_exit_code_2_with_the_reasons(labelgen, tmp_path: Path) -> None:
    empty = write_clip(tmp_path, 12, name="empty.mp4", cars=False)
    done = labelgen("speed", empty, "--from", "masks:coco:masks.json", "--out", "out", "--json", "report.json")
    assert done.returncode == 2
    assert "no vehicles found in empty: 0 detections in 12 frames" in done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["vehicles"] == 0
    assert "no vehicles found" in report["error"]


def test_names_that_would_steer_the_terminal_are_escaped(labelgen, clip: Path, tmp_path: Path) -> None:
    data = _masks(clip)
    data["annotations"].append({"id": "\x1b[2J\u202e", "image_id": 5, "category_id": 3})
    name = "evil\x1b]0;title\x07.mp4"
    (tmp_path / name).write_bytes(clip.read_bytes())
    for suffix in (".calibration.json", ".mask.png"):
        (tmp_path / (name.removesuffix(".mp4") + suffix)).write_bytes(
            clip.with_suffix("").with_suffix(suffix).read_bytes()
        )
    done, _ = _bcs_masks(labelgen, tmp_path / name, tmp_path, data)
    assert done.returncode == 0, done.stderr
    for text in (done.stdout, done.stderr):
        assert not set(text) & {"\x1b", "\x07", "\u202e"}
    assert "evil\\x1b]0;title\\x07" in done.stdout
    missing = labelgen("bcs-masks", "no\x1b[31m.mp4", "--out", "none")
    assert missing.returncode == 2
    assert "\x1b" not in missing.stderr


def test_a_calibration_of_another_size_gives_the_same_speeds(labelgen, clip: Path, tmp_path: Path) -> None:
    rows = []
    # Of these frames; of larger ones, as it states; of larger and of smaller ones, as its principal point shows.
    unstated = [replace(CAMERA.resized(factor), image_wh=None) for factor in (2.0, 0.75)]
    for number, camera in enumerate([CAMERA, CAMERA.resized(3.0), *unstated]):
        camera.save(tmp_path / "c.json")
        done = labelgen(
            "speed", clip, "--calibration", "c.json", "--from", f"masks:coco:{clip.parent / 'masks.json'}",
            "--out", f"out{number}",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert ("scaled to the frames' 640x360" in done.stderr) == bool(number)
        (table,) = (tmp_path / f"out{number}").glob("*/vehicles_*.csv")
        rows.append([line.split(",") for line in table.read_text().splitlines()])
    heading = rows[0][0]
    for column in ("speed_kmh", "length_m", "width_m", "height_m"):
        exact, *scaled = ([float(row[heading.index(column)]) for row in table[1:]] for table in rows)
        assert exact
        for values in scaled:
            assert values == pytest.approx(exact, abs=0.011)


@pytest.mark.parametrize("command", ["speed", "bcs-masks", "rectify", "road-mask"])
def test_a_calibration_of_another_shape_is_refused(labelgen, clip: Path, tmp_path: Path, command: str) -> None:
    replace(CAMERA, pp=np.array([320.0, 240.0]), image_wh=None).save(tmp_path / "c.json")
    mask = [] if command == "road-mask" else ["--road-mask", clip.with_suffix("").with_suffix(".mask.png")]
    done = labelgen(command, clip, "--calibration", "c.json", *mask, "--out", "out.png")
    assert done.returncode == 2
    assert "principal point (320, 240) is far from the middle (320, 180)" in done.stderr


def test_an_image_id_of_two_images_is_refused(labelgen, tmp_path: Path) -> None:
    """Two exports joined, whose ids begin anew: nothing says which video an annotation belongs to."""
    clip = write_clip(tmp_path, 12)
    data = json.loads((tmp_path / "masks.json").read_text())
    data["images"] += [{**image, "file_name": f"other/{n:06d}.jpg"} for n, image in enumerate(data["images"])]
    (tmp_path / "joined.json").write_text(json.dumps(data))
    done = labelgen("bcs-masks", clip, "--masks", "coco:joined.json", "--every", 5, "--out", "out")
    assert done.returncode == 2
    assert "stands for two images" in done.stderr
    assert "id of its own" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("victim", ["clip.mp4", "masks.json", "clip.calibration.json"])
def test_a_report_replaces_nothing_but_a_report(labelgen, tmp_path: Path, victim: str) -> None:
    clip = write_clip(tmp_path, 12)
    before = (tmp_path / victim).read_bytes()
    command = ("bcs-masks", clip, "--masks", f"coco:{tmp_path / 'masks.json'}", "--every", 5, "--out", "out")
    done = labelgen(*command, "--json", tmp_path / victim)
    assert done.returncode == 2
    assert "is no report of labelgen" in done.stderr
    assert (tmp_path / victim).read_bytes() == before
    for overwrite in ((), ("--overwrite",)):
        assert labelgen(*command, *overwrite, "--json", "report.json").returncode == 0


@pytest.mark.parametrize("command", ["calibrate", "rectify"])
def test_no_input_is_replaced_even_with_overwrite(labelgen, tmp_path: Path, command: str) -> None:
    clip = write_clip(tmp_path, 4)
    picture = tmp_path / "clip.png"
    picture.write_bytes((tmp_path / "clip.mask.png").read_bytes())
    victim = clip if command == "calibrate" else picture
    before = victim.read_bytes()
    done = labelgen(command, victim, "--out", victim, "--overwrite")
    assert done.returncode == 2
    assert "it is an input itself" in done.stderr
    assert victim.read_bytes() == before

"""Videos as cameras and users make them, through the commands: rates, stamps, names, files without their end."""

from __future__ import annotations

import csv
import json
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from clips import write_clip
from speed_scenes import Drive, frame_times, write_scene
from stream_server import serve_stream

from labelgen.audit.originals import Originals
from labelgen.cli.main import main
from labelgen.media.video_reader import VideoFile
from labelgen.shards import ShardDataset

DRIVES = [Drive(60.0, 38.0, 2.0), Drive(72.0, 16.0, -3.0, 1), Drive(48.0, 60.0, 2.2)]
SPEEDS = [48.0, 60.0, 72.0]
FPS = 15


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of road.mp4, 15 frames per second, with calibration, mask and masks.json."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, DRIVES, frame_times(4.0, FPS))
    return folder


def pictures(scene: Path) -> list[np.ndarray]:
    with av.open(str(scene / "road.mp4")) as container:
        return [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]


def beside(scene: Path, folder: Path) -> Path:
    for name in ("road.calibration.json", "road.mask.png"):
        shutil.copy(scene / name, folder / name)
    return folder


def encode(path: Path, images: list[np.ndarray], *, rate: int, codec: str, kind: str | None, step: int = 1) -> Path:
    with av.open(f"file:{path}", "w", format=kind) as container:
        stream: Any = container.add_stream(codec, rate=rate, options={"qmin": "2", "qmax": "4", "crf": "20"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format=stream.pix_fmt)
            frame.pts, frame.time_base = number * step, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def measured(folder: Path) -> list[float]:
    with (folder / "vehicles_transform3d.csv").open(newline="") as file:
        return sorted(float(row["speed_kmh"]) for row in csv.DictReader(file))


WRONG_RATES = [
    ("road.h264", 25, "libx264", "h264", 1, "its frames have no time stamps"),
    ("road.mjpeg", 25, "mjpeg", "mjpeg", 1, "its frames have no time stamps"),
    ("road.avi", 600, "mpeg4", "avi", 1, "its header says 600 frames per second, which cannot be"),
    ("road.mkv", 1000, "libx264", None, 1, "its time stamps cannot be those of a camera"),
]


@pytest.mark.parametrize(("name", "rate", "codec", "kind", "step", "reason"), WRONG_RATES)
def test_a_rate_that_the_user_gives(
    labelgen: Any, scene: Path, tmp_path: Path, name: str, rate: int, codec: str, kind: str | None, step: int,
    reason: str,
) -> None:  # fmt: skip
    path = encode(beside(scene, tmp_path) / name, pictures(scene), rate=rate, codec=codec, kind=kind, step=step)
    command = ("speed", path, "--near-end", "outline", "--from", f"masks:coco:{scene / 'masks.json'}")
    refused = labelgen(*command, "--out", "none")
    assert refused.returncode == 2
    [line] = [line for line in refused.stderr.splitlines() if "error" in line]
    assert reason in line
    assert "so there are no speeds; give fps (option --fps)" in line
    assert not (tmp_path / "none").exists()
    done = labelgen(*command, "--out", "out", "--fps", FPS, "--json", "s.json")
    assert done.returncode == 0
    assert measured(tmp_path / "out" / "road") == pytest.approx(SPEEDS, abs=0.5)
    assert any("at the given 15" in line for line in json.loads((tmp_path / "s.json").read_text())["problems"])
    assert "at the given 15" in done.stderr


def test_a_rate_in_the_header_that_the_stamps_belie(labelgen: Any, scene: Path, tmp_path: Path) -> None:
    with av.open(str(tmp_path / "road.mkv"), "w") as container:
        stream: Any = container.add_stream("libx264", rate=1000, options={"crf": "20"})
        stream.height, stream.width, stream.pix_fmt = 360, 640, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, image in enumerate(pictures(scene)):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = round(number * 1000 / FPS), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    masks = f"masks:coco:{scene / 'masks.json'}"
    done = labelgen("speed", beside(scene, tmp_path) / "road.mkv", "--near-end", "outline", "--from", masks,
                    "--out", "out")  # fmt: skip
    assert done.returncode == 0
    assert measured(tmp_path / "out" / "road") == pytest.approx(SPEEDS, abs=0.7)
    assert "its time stamps say 14.9" in done.stderr
    assert "truncated" not in done.stderr


def test_a_low_rate_is_told(labelgen: Any, tmp_path: Path) -> None:
    path = write_scene(tmp_path, DRIVES, frame_times(6.0, 2))
    done = labelgen("speed", path, "--from", f"masks:coco:{tmp_path / 'masks.json'}", "--out", "out")
    assert "at 2 frames per second vehicles are seen too seldom to be followed" in done.stderr


def test_detections_without_times_need_a_rate(labelgen: Any, scene: Path, tmp_path: Path) -> None:
    masks = f"masks:coco:{scene / 'masks.json'}"
    near = ("--near-end", "outline")
    assert labelgen("speed", scene / "road.mp4", *near, "--from", masks, "--out", "a").returncode == 0
    head, *lines = (tmp_path / "a" / "road" / "detections_transform3d.jsonl").read_text().splitlines()
    untimed = [
        json.dumps({**json.loads(head), "fps": None}),
        *(json.dumps({**json.loads(x), "time_s": None}) for x in lines),
    ]
    (tmp_path / "d.jsonl").write_text("\n".join(untimed))
    command = ("speed", scene / "road.mp4", "--from", "detections:d.jsonl")
    refused = labelgen(*command, "--out", "b")
    assert refused.returncode == 2
    assert "has no time, so there are no speeds; give fps (option --fps)" in refused.stderr
    assert labelgen(*command, "--out", "c", "--fps", FPS).returncode == 0
    assert measured(tmp_path / "c" / "road") == pytest.approx(SPEEDS, abs=0.5)


def test_outputs_with_colons(labelgen: Any, scene: Path, tmp_path: Path) -> None:
    masks = f"masks:coco:{scene / 'masks.json'}"
    assert labelgen("speed", scene / "road.mp4", "--from", masks, "--out", "run:1", "--render").returncode == 0
    with av.open(f"file:{tmp_path / 'run:1' / 'road' / 'annotated_transform3d.avi'}") as video:
        assert sum(1 for _ in video.decode(video=0)) == 4 * FPS
    done = labelgen("synth", "session", "--out", "s:1", "--duration", 1, "--fps", 5, "--size", "320x180")
    assert done.returncode == 0
    [video_file] = (tmp_path / "s:1").rglob("video.avi")
    with av.open(f"file:{video_file}") as video:
        assert sum(1 for _ in video.decode(video=0)) == 5


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of which the second half is missing, with all that belongs to it."""
    folder = tmp_path_factory.mktemp("cut")
    path = write_clip(folder, 40, name="clip.avi")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


@pytest.mark.parametrize("command", ["speed", "bcs-masks", "calibrate", "road-mask"])
def test_every_command_tells_that_a_file_is_cut(labelgen: Any, cut: Path, command: str) -> None:
    """Also where nothing comes of it: the clip is too short to calibrate a camera."""
    options = {
        "speed": ("--from", f"masks:coco:{cut.parent / 'masks.json'}", "--out", "out"),
        "bcs-masks": ("--masks", f"coco:{cut.parent / 'masks.json'}", "--every", 2, "--out", "out"),
        "calibrate": ("--out", "c.json"),
        "road-mask": ("--out", "m.png"),
    }[command]
    done = labelgen(command, cut, *options)
    said = [line for line in done.stderr.splitlines() if "of 40 announced frames: the file is truncated" in line]
    assert len(said) == 1
    assert said[0].startswith("warning: ")
    assert done.returncode in (0, 2)


def test_problems_of_a_video_are_in_the_report(labelgen: Any, cut: Path, tmp_path: Path) -> None:
    masks = f"coco:{cut.parent / 'masks.json'}"
    done = labelgen("bcs-masks", cut, "--masks", masks, "--every", 2, "--out", "out", "--json", "r.json")
    assert done.returncode == 0
    problems = json.loads((tmp_path / "r.json").read_text())["problems"]
    assert any("announced frames: the file is truncated" in line for line in problems)


def test_a_file_without_its_index(labelgen: Any, tmp_path: Path) -> None:
    data = write_clip(tmp_path, 10).read_bytes()
    (tmp_path / "clip.mp4").write_bytes(data[: data.find(b"moov") - 4])
    for command in ("speed", "bcs-masks", "calibrate", "road-mask", "rectify"):
        done = labelgen(command, "clip.mp4", "--out", "out.png" if command in ("road-mask", "rectify") else "out")
        assert done.returncode == 2
        [line] = [line for line in done.stderr.splitlines() if "error" in line]
        assert "clip.mp4: its end is missing" in line


@pytest.mark.parametrize("command", ["speed", "bcs-masks", "calibrate", "road-mask", "detect", "rectify"])
def test_every_command_that_reads_video_takes_a_rate_and_a_stream(labelgen: Any, command: str) -> None:
    text = labelgen(command, "--help").stdout
    assert "--fps" in text
    assert "--stream" in text
    assert "--deinterlace" in text


def test_interlaced_videos(labelgen: Any, scene: Path, tmp_path: Path) -> None:
    path = beside(scene, tmp_path) / "road.mkv"
    images = pictures(scene)
    with av.open(str(path), "w") as container:
        options = {"x264-params": "bff=1", "crf": "12", "bf": "0"}
        stream: Any = container.add_stream("libx264", rate=FPS, options=options)
        stream.width, stream.height, stream.pix_fmt = 640, 360, "yuv420p"
        for image, later in zip(images, [*images[1:], images[-1]], strict=True):
            woven = image.copy()
            woven[::2] = later[::2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(woven, format="bgr24")))
        container.mux(stream.encode(None))
    masks = f"coco:{scene / 'masks.json'}"
    told = labelgen("speed", path, "--from", f"masks:{masks}", "--near-end", "outline", "--out", "a")
    assert "its frames are interlaced: moving edges are torn; for exact results set --deinterlace" in told.stderr
    done = labelgen("speed", path, "--from", f"masks:{masks}", "--near-end", "outline", "--deinterlace", "--out", "b")
    assert done.returncode == 0
    assert ["frames", str(len(images))] in [line.split() for line in done.stdout.splitlines()]
    assert measured(tmp_path / "b" / "road") == pytest.approx(SPEEDS, abs=0.5)
    assert "its frames are deinterlaced, as asked" in done.stderr
    command = ("bcs-masks", path, "--masks", masks, "--every", 20)
    for options in ((), ("--deinterlace",)):
        assert labelgen(*command, *options, "--out", "shards", "--overwrite").returncode == 0
        original = json.loads((tmp_path / "shards" / "dataset.json").read_text())["shards"][0]["original"]
        assert original.get("deinterlace") == ("yes" if options else None)
    samples = ShardDataset(tmp_path / "shards")
    (original_image,) = Originals(samples).read([0]).values()
    assert original_image is not None
    assert np.array_equal(original_image, next(VideoFile(path, deinterlace=True).frames()).image)
    assert labelgen(*command, "--out", "shards").returncode == 2  # other settings
    refused = labelgen("rectify", scene, "--deinterlace", "--calibration", scene / "road.calibration.json",
                       "--road-mask", scene / "road.mask.png", "--out", "x.png")  # fmt: skip
    assert refused.returncode == 2


def test_another_stream_of_a_file(labelgen: Any, scene: Path, tmp_path: Path) -> None:
    with av.open(str(tmp_path / "road.mkv"), "w") as container:
        streams: list[Any] = []
        for size in ((640, 360), (320, 180)):
            stream: Any = container.add_stream("libx264", rate=FPS, options={"crf": "20"})
            stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            streams.append(stream)
        for number, image in enumerate(pictures(scene)):
            for stream in streams:
                small = cv2.resize(image, (stream.width, stream.height))
                frame = av.VideoFrame.from_ndarray(small, format="bgr24")
                frame.pts, frame.time_base = number, Fraction(1, FPS)
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    command = ("speed", beside(scene, tmp_path) / "road.mkv", "--from", f"masks:coco:{scene / 'masks.json'}")
    done = labelgen(*command, "--near-end", "outline", "--out", "a")
    assert done.returncode == 0
    assert measured(tmp_path / "a" / "road") == pytest.approx(SPEEDS, abs=0.5)
    assert "2 video streams; the largest, number 0 (from 0) of 640x360 is used" in done.stderr
    refused = labelgen(*command, "--out", "b", "--stream", 2)
    assert refused.returncode == 2
    assert "--stream 2" in refused.stderr


def test_labels_of_a_raw_stream_carry_the_given_rate(labelgen: Any, scene: Path, tmp_path: Path) -> None:
    path = encode(beside(scene, tmp_path) / "road.h264", pictures(scene), rate=25, codec="libx264", kind="h264")
    masks = f"coco:{scene / 'masks.json'}"
    command = ("bcs-masks", path, "--masks", masks, "--every", 10)
    assert labelgen(*command, "--fps", FPS, "--stream", 0, "--out", "a").returncode == 0
    samples = ShardDataset(tmp_path / "a")
    found = [(samples[n].frame, samples[n].time_s) for n in range(len(samples))]
    assert [time_s for _, time_s in found] == pytest.approx([frame / FPS for frame, _ in found])
    assert labelgen("validate", "a").returncode == 0
    assert labelgen("audit", "a", "--out", "looked").returncode == 0
    assert labelgen(*command, "--out", "b").returncode == 0  # labels need no times


# -- streams ----------------------------------------------------------------------------------------------------------


def mjpeg_parts(scene: Path) -> list[bytes]:
    parts = []
    for image in pictures(scene):
        jpeg = cv2.imencode(".jpg", image)[1].tobytes()
        parts.append(b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n" % (len(jpeg), jpeg))
    return parts


def measure_stream(scene: Path, url: str, *options: object) -> int:
    arguments = [
        "speed", url, "--calibration", scene / "road.calibration.json", "--road-mask", scene / "road.mask.png",
        "--from", f"masks:coco:{scene / 'masks.json'}", "--near-end", "outline", *options,
    ]  # fmt: skip
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


@pytest.mark.parametrize("options", [(), ("--fps", FPS)])
def test_a_stream_without_stamps_is_timed_by_arrival(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[object, ...]
) -> None:
    kind = "multipart/x-mixed-replace; boundary=frame"
    # With a given rate the moments of arrival do not matter.
    every_s = 0.0 if options else 1 / FPS
    with serve_stream(mjpeg_parts(scene), kind=kind, every_s=every_s) as url:
        code = measure_stream(scene, url, *options, "--out", tmp_path, "--stall", 5)
    assert code == 2  # such a stream does not end
    said = capsys.readouterr().err
    assert "the connection broke off after 60 frames" in said
    assert "the stream has no time stamps: frames are timed" in said
    assert measured(tmp_path / "camera") == pytest.approx(SPEEDS, rel=0.01 if options else 0.05)


def test_a_dropped_stream_is_an_error(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path / "road.ts", pictures(scene), rate=FPS, codec="libx264", kind="mpegts")
    data = (tmp_path / "road.ts").read_bytes()
    for announced in (None, 2 * len(data)):
        with serve_stream(data, announced=announced) as url:
            assert measure_stream(scene, url, "--out", tmp_path, "--overwrite", "--stall", 5) == 2
        said = capsys.readouterr().err
        assert "the connection broke off after" in said
        assert "3 finished vehicles are in" in said
    assert measured(tmp_path / "camera") == pytest.approx(SPEEDS, abs=0.5)

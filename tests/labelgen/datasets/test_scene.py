"""Scenes: their files found beside the input, and opened once."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from clips import CAMERA, write_clip

from labelgen.datasets.scene import SceneFiles, find_scene, open_stream
from labelgen.datasets.scene_picture import read_picture
from labelgen.errors import DataError

PICTURE = np.full((4, 6, 3), 90, np.uint8)
PNG = cv2.imencode(".png", PICTURE)[1].tobytes()


def _scene_files(folder: Path, stem: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{stem}.calibration.json").write_text(json.dumps({"vp1": [1, 2]}))
    (folder / f"{stem}.mask.png").write_bytes(PNG)


@pytest.mark.parametrize("given", [".", "../frames", "../frames/", "../frames/.."])
def test_folders_are_known_by_their_real_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    name = "frames" if not given.endswith("..") else tmp_path.name
    _scene_files(tmp_path if name == "frames" else tmp_path.parent, name)
    monkeypatch.chdir(frames)
    scene = find_scene(Path(given))
    assert scene.name == name
    assert scene.calibration_path.name == f"{name}.calibration.json"


def test_a_linked_video_may_have_its_files_beside_the_link_or_the_target(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "real.mp4").write_bytes(b"")
    link = tmp_path / "link.mp4"
    os.symlink(tmp_path / "store" / "real.mp4", link)
    _scene_files(tmp_path / "store", "real")
    assert find_scene(link).calibration_path.name == "real.calibration.json"
    _scene_files(tmp_path, "link")
    assert find_scene(link).calibration_path.name == "link.calibration.json"


def test_a_frame_of_a_session_without_its_video_needs_the_video(tmp_path: Path) -> None:
    session = tmp_path / "dataset" / "session9_left"
    _scene_files(session, "unused")
    (session / "video_mask.png").write_bytes(PNG)
    (session / "screen.png").write_bytes(PNG)
    scene = find_scene(session, calibration=session / "unused.calibration.json", need_frames=False)
    np.testing.assert_array_equal(read_picture(scene), PICTURE)
    with pytest.raises(DataError, match="session9_left: frame 5 needs its video, which is not there"):
        read_picture(scene, 5)
    (session / "screen.png").unlink()
    scene = find_scene(session, calibration=session / "unused.calibration.json", need_frames=False)
    with pytest.raises(DataError, match="neither a video nor a picture of the empty road"):
        read_picture(scene)


def test_an_opened_scene_has_all_that_belongs_together(tmp_path: Path) -> None:
    write_clip(tmp_path, 3, name="road.mp4")
    files = find_scene(tmp_path / "road.mp4")
    assert files.missing == frozenset()
    scene = files.open(fps=12.5)
    assert scene.files is files
    assert (scene.name, scene.fps, scene.lane_lines, scene.notes) == ("road", 12.5, None, ())
    assert scene.frames.size_wh == scene.camera.image_wh == scene.road.size_wh
    np.testing.assert_array_equal(scene.camera.vp1, CAMERA.vp1)
    assert len(list(scene.frames.frames())) == 3


def test_what_is_missing_may_be_asked_for(tmp_path: Path) -> None:
    write_clip(tmp_path, 2, name="road.mp4")
    (tmp_path / "road.mask.png").unlink()
    with pytest.raises(DataError, match=r"no road mask \(looked for road.mask.png in") as caught:
        find_scene(tmp_path / "road.mp4")
    assert caught.value.parameters == ("road_mask",)
    assert find_scene(tmp_path / "road.mp4", may_lack=True).missing == {"road mask"}
    with pytest.raises(DataError, match=r"no road mask at .*none\.png"):
        find_scene(tmp_path / "road.mp4", road_mask=tmp_path / "none.png", may_lack=True)


def test_a_session_without_its_video_cannot_be_opened() -> None:
    with pytest.raises(DataError, match="its video is not there"):
        SceneFiles("session0_left", None, Path("c.json"), Path("m.png")).open()


def test_a_stream_has_nothing_beside_it() -> None:
    with pytest.raises(DataError, match="a calibration and a road mask of its own") as caught:
        open_stream("rtsp://127.0.0.1:1/live", calibration=None, road_mask=None)
    assert caught.value.parameters == ("calibration", "road_mask")


def test_calibration_and_road_mask_of_another_size_are_scaled_and_noted(tmp_path: Path) -> None:
    write_clip(tmp_path, 3, name="road.mp4")
    exact = find_scene(tmp_path / "road.mp4").open()
    size = exact.frames.size_wh
    replace(CAMERA, image_wh=size).resized(2.0).save(tmp_path / "road.calibration.json")
    double = cv2.resize(exact.road.pixels.astype(np.uint8) * 255, (2 * size[0], 2 * size[1]), interpolation=0)
    cv2.imwrite(str(tmp_path / "road.mask.png"), double)
    scene = find_scene(tmp_path / "road.mp4").open()
    np.testing.assert_allclose(scene.camera.vp1, exact.camera.vp1)
    np.testing.assert_allclose(scene.camera.scale, exact.camera.scale)
    np.testing.assert_array_equal(scene.road.pixels, exact.road.pixels)
    sizes = f"of {2 * size[0]}x{2 * size[1]} px, scaled to the frames' {size[0]}x{size[1]}"
    assert scene.notes == (f"calibration road.calibration.json: {sizes}", f"road mask road.mask.png: {sizes}")


def test_a_road_mask_of_another_ratio_is_refused(tmp_path: Path) -> None:
    write_clip(tmp_path, 3, name="road.mp4")
    cv2.imwrite(str(tmp_path / "road.mask.png"), np.full((300, 300), 255, np.uint8))
    with pytest.raises(DataError, match=r"road\.mask\.png: it is 300x300 px, but the frames are"):
        find_scene(tmp_path / "road.mp4").open()


def test_a_calibration_that_shows_another_size_is_scaled(tmp_path: Path) -> None:
    write_clip(tmp_path, 3, name="road.mp4")
    replace(CAMERA.resized(2.0), image_wh=None).save(tmp_path / "road.calibration.json")
    (note,) = find_scene(tmp_path / "road.mp4").open().notes
    assert note.endswith("of 1280x720 px, as its principal point shows, scaled to the frames' 640x360")

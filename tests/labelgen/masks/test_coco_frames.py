"""Which image entry of a COCO file belongs to which frame, with names as exporters write them."""

from __future__ import annotations

import hashlib
import unicodedata
import urllib.parse
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest

from labelgen.errors import DataError
from labelgen.masks.clip import Clip
from labelgen.masks.coco_file import ImageEntry
from labelgen.masks.coco_frames import match_files, match_video

COUNT = 12
VIDEO = Clip(Path("/data/day1/camB.mp4"), (64, 48), COUNT)


def _hash(k: int) -> str:
    return hashlib.md5(str(k).encode()).hexdigest()


def _named(name: Callable[[int], str], count: int = COUNT) -> list[ImageEntry]:
    return [ImageEntry(name(k)) for k in range(count)]


VIDEO_NAMES: dict[str, Callable[[int], str]] = {
    "plain": lambda k: f"frame_{k:06d}.jpg",
    "in folders": lambda k: f"images/train/frame_{k:06d}.PNG",
    "roboflow": lambda k: f"frame_{k:06d}_jpg.rf.{_hash(k)}.jpg",
    "roboflow, another suffix": lambda k: f"camB-{k}_png.rf.{_hash(k)[:20]}.jpg",
    "label studio": lambda k: f"../../upload/4/{_hash(k)[:8]}-frame_{k:06d}.jpg",
    "hash behind": lambda k: f"frame_{k:04d}-{_hash(k)}.jpg",
    "uuid behind": lambda k: f"frame_{k:04d}_{uuid.uuid5(uuid.NAMESPACE_URL, str(k))}.jpg",
    "percent": lambda k: urllib.parse.quote(f"Köln Süd {k:06d}.jpg"),
    "text behind": lambda k: f"frame_{k:06d}_left.jpg",
    "no suffix": lambda k: f"frame_{k}",
    "times before": lambda k: f"2024-05-01 10.00.{k:02d} {k:06d}.jpg",
    "eight digits": lambda k: f"frame_{k:08d}.jpg",
    "splits of one video": lambda k: f"{('train', 'valid', 'test')[k % 3]}/frame_{k:06d}.jpg",
}


@pytest.mark.parametrize("case", list(VIDEO_NAMES))
def test_names_of_frames_of_a_video(case: str) -> None:
    match = match_video(_named(VIDEO_NAMES[case]), VIDEO, None)
    assert match.by_number == {k: k for k in range(COUNT)}
    assert (match.problems, match.no_frames) == ((), None)
    assert match.usage == "12 of 12 image entries used"


TWO_VIDEOS: dict[str, Callable[[str, int], ImageEntry]] = {
    "folders": lambda v, k: ImageEntry(f"{v}/frame_{k:06d}.png"),
    "folders of files": lambda v, k: ImageEntry(f"export/{v}.mp4/{k}.png"),
    "prefixes": lambda v, k: ImageEntry(f"images/{v}_frame_{k:06d}.png"),
    "prefixes and hashes": lambda v, k: ImageEntry(f"{_hash(k)[:8]}-{v}-{k:06d}_png.rf.{_hash(k)}.jpg"),
    "other case and marks": lambda v, k: ImageEntry(f"{v[:3].upper()}_{v[3:]}/frame_{k:06d}.png"),
    "frame key": lambda v, k: ImageEntry(f"{v}.mp4", k),
    "frame key and picture": lambda v, k: ImageEntry(f"{v}/{1000 + k}.png", k),
    "videos list": lambda v, k: ImageEntry(f"{k:06d}.png", video=f"{v}.mp4"),
    "one folder above": lambda v, k: ImageEntry(f"{v}/day/frame_{k:06d}.png"),
}


@pytest.mark.parametrize("case", list(TWO_VIDEOS))
@pytest.mark.parametrize(("video", "other"), [("camB", "camA"), ("camB1", "camB11")])
def test_folders_and_names_tell_videos_apart(case: str, video: str, other: str) -> None:
    entries = [TWO_VIDEOS[case](v, k) for k in range(COUNT) for v in (other, video)]
    match = match_video(entries, Clip(Path(f"{video}.mp4"), None, COUNT), None)
    assert match.by_number == {k: 2 * k + 1 for k in range(COUNT)}
    assert match.usage == "12 of 24 image entries used, 12 of other videos"
    assert match.problems == ()


def test_sessions_are_told_apart_by_their_folders() -> None:
    entries = [ImageEntry(f"session{s}/video.avi", k) for s in range(3) for k in range(COUNT)]
    match = match_video(entries, Clip(Path("/x/session1/video.avi"), None, COUNT), None)
    assert match.by_number == {k: COUNT + k for k in range(COUNT)}


@pytest.mark.parametrize(
    "entries",
    [
        [ImageEntry(f"{v}/frame_{k:06d}.png") for v in ("camA", "camC") for k in range(COUNT)],
        [ImageEntry(f"{v}.mp4", k) for v in ("camA", "camC") for k in range(COUNT)],
        # Three changed copies of each picture, as exporters make them to enlarge a training set.
        [ImageEntry(f"f_{k}_jpg.rf.{_hash(3 * k + c)}.jpg") for k in range(COUNT) for c in range(3)],
        [ImageEntry(f"frame_{k} (1).jpg") for k in range(COUNT)],
    ],
)
def test_entries_that_cannot_be_told_apart_are_refused(entries: list[ImageEntry]) -> None:
    with pytest.raises(DataError, match=r"named by several image entries, such as frame . by .* and nothing tells"):
        match_video(entries, VIDEO, None)


@pytest.mark.parametrize(
    ("numbers", "count", "first_frame", "expected", "told"),
    [
        (range(1, 13), 12, None, 1, "1 is taken as the first frame"),
        ([1, 5, 12], 12, None, 1, "1 is taken as the first frame"),
        (range(1000, 1012), 12, None, 1000, "1000 is taken as the first frame"),
        (range(12), 12, None, 0, ""),
        ([1, 5, 11], 12, None, 0, "say so with first_frame 1"),
        ([1, 5, 11], 12, 1, 1, ""),
        ([3, 5, 11], 12, None, 0, ""),
        (range(1, 13), 12, 0, 0, "1 beyond the video"),
        (range(15), 12, None, 0, "12 of 15 image entries used, 3 beyond the video"),
    ],
)
def test_the_number_of_the_first_frame(
    numbers: list[int], count: int, first_frame: int | None, expected: int, told: str
) -> None:
    clip = Clip(Path("camB.mp4"), None, count)
    entries = [ImageEntry(f"{n:06d}.jpg") for n in numbers]
    match = match_video(entries, clip, first_frame)
    assert sorted(match.by_number) == [n - expected for n in numbers]
    assert told in "".join(match.problems)
    assert bool(told) == bool(match.problems)


def test_entries_of_the_same_frame_and_without_a_number_are_counted() -> None:
    entries = [*_named(VIDEO_NAMES["plain"]), ImageEntry("frame_000003.jpg"), ImageEntry("cover.jpg"), ImageEntry()]
    match = match_video(entries, VIDEO, None)
    assert match.by_number == {k: k for k in range(COUNT)}
    assert match.problems == ("12 of 15 image entries used, 1 names the same frame, 2 name no frame",)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (
            [ImageEntry(f"{k}.jpg") for k in range(500, 520)],
            "they number frames 500 to 519, but camB.mp4 has 12 frames",
        ),
        ([ImageEntry("a.jpg")], "none has a frame number"),
    ],
)
def test_entries_of_no_frame_say_why(entries: list[ImageEntry], message: str) -> None:
    reason = match_video(entries, VIDEO, None).no_frames
    assert reason is not None
    assert message in str(reason)


@pytest.mark.parametrize(
    ("numbers", "every", "message"),
    [
        ([10, 20, 30], 25, "use every 10"),
        ([1, 6, 11], 5, "use every 1, or, if the first frame is number 1, first_frame 1 with every 5"),
        ([7], 5, "use every 7"),
    ],
)
def test_frames_that_every_misses_are_told_with_the_right_value(numbers: list[int], every: int, message: str) -> None:
    entries = [ImageEntry(f"{n:06d}.jpg") for n in numbers]
    reason = match_video(entries, Clip(Path("v.mp4"), None, 40, every=every), None).no_frames
    assert reason is not None
    assert message in str(reason)
    assert reason.parameters == ("every",)
    assert match_video(entries, Clip(Path("v.mp4"), None, 40, every=1), None).no_frames is None


FILES = [unicodedata.normalize("NFC", f"Köln Süd {k:06d}.jpg") for k in range(0, 60, 10)]
FOLDER_NAMES: dict[str, Callable[[str], str]] = {
    "exact": lambda name: name,
    "decomposed": lambda name: unicodedata.normalize("NFD", name),
    "percent": urllib.parse.quote,
    "percent, decomposed": lambda name: urllib.parse.quote(unicodedata.normalize("NFD", name)),
    "another suffix": lambda name: name.replace(".jpg", ".png"),
    "upper case": str.upper,
    "no suffix": lambda name: name.removesuffix(".jpg"),
    "label studio": lambda name: f"../../media/upload/4/{_hash(len(name))[:8]}-{name}",
    "label studio, cleaned": lambda name: f"upload/{_hash(3)[:8]}-{name.replace(' ', '_')}",
    "roboflow": lambda name: f"{name.replace(' ', '-').replace('.jpg', '_jpg')}.rf.{_hash(len(name))}.jpg",
}


@pytest.mark.parametrize("case", list(FOLDER_NAMES))
def test_names_of_the_images_of_a_folder(case: str) -> None:
    # The file knows more images than the folder holds.
    entries = [ImageEntry(FOLDER_NAMES[case](f"Köln Süd {k:06d}.jpg")) for k in range(60)]
    match = match_files(entries, FILES, Clip(Path("imgs"), None, len(FILES), tuple(FILES)))
    assert match.by_name == {name: 10 * k for k, name in enumerate(FILES)}
    assert match.usage == "6 of 60 image entries used, 54 name no image of the folder"


def test_the_folder_tells_which_of_two_images_is_meant() -> None:
    entries = [ImageEntry(f"{folder}/1.png") for folder in ("left", "right")]
    assert match_files(entries, ["1.png"], Clip(Path("/data/right"))).by_name == {"1.png": 1}
    with pytest.raises(DataError, match=r"several of its images are 1\.png, such as left/1\.png and right/1\.png"):
        match_files(entries, ["1.png"], Clip(Path("/data/imgs")))


def test_files_that_differ_in_their_suffix_only_keep_their_own_entries() -> None:
    entries = [ImageEntry("a.png"), ImageEntry("a.jpg")]
    assert match_files(entries, ["a.jpg", "a.png"], Clip(Path("imgs"))).by_name == {"a.jpg": 1, "a.png": 0}
    # One entry is not given to two files.
    assert match_files(entries[:1], ["a.jpg", "a.png"], Clip(Path("imgs"))).by_name == {"a.png": 0}


@pytest.mark.parametrize(
    ("files", "numbers", "expected"),
    [
        (["000010.jpg", "000020.jpg"], [20], {1: 0}),
        (["000010.jpg", "000020.jpg"], [0, 1], {0: 0, 1: 1}),
        (["a.jpg", "b.jpg"], [0, 7], {0: 0}),
        # Image ids of COCO files mostly begin with 1.
        (["a.jpg", "b.jpg"], [1, 2], {0: 0, 1: 1}),
        (["000001.jpg", "000002.jpg"], [1, 2], {0: 0, 1: 1}),
    ],
)
def test_numbers_of_results_are_file_names_or_positions(
    files: list[str], numbers: list[int], expected: dict[int, int]
) -> None:
    entries = [ImageEntry(id_number=number) for number in numbers]
    assert match_files(entries, files, Clip(Path("imgs"), None, 2, tuple(files))).by_number == expected


def test_positions_counted_from_1_are_told() -> None:
    clip = Clip(Path("imgs"), None, 2, ("a.jpg", "b.jpg"))
    entries = [ImageEntry(id_number=number) for number in (1, 2)]
    (note,) = match_files(entries, ["a.jpg", "b.jpg"], clip).problems
    assert "1 is taken as the first frame" in note
    assert match_files(entries, ["a.jpg", "b.jpg"], clip, 0).by_number == {1: 0}
    assert match_files(entries, ["a.jpg", "b.jpg"], clip, 1).problems == ()


def test_names_of_no_image_of_the_folder_are_shown() -> None:
    reason = match_files([ImageEntry("x/other.png")], ["a.jpg"], Clip(Path("imgs"))).no_frames
    assert "it names images such as x/other.png, the folder holds such as a.jpg" in str(reason)

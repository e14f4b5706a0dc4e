"""Which image entry of a COCO file belongs to which frame.

Of a video, an entry's frame is the number that it states (`frame`), or the last number of its file name. Of a folder of
images, it is the file of the same name; what exporters do to names is undone: folders, hashes before and behind,
percent-encoding, other Unicode forms, other extensions. Folders and the rest of the names tell videos apart. Where
several entries name the same frame and nothing tells which is meant, that is an error.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from urllib.parse import unquote

from labelgen.errors import DataError
from labelgen.masks.clip import Clip
from labelgen.masks.coco_file import ImageEntry
from labelgen.problem_counts import count_of

__all__ = ["EntryMatch", "match_files", "match_video", "unnamed_by_number"]

_PICTURE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm", ".gif", ".avif"}
# Roboflow writes NAME.jpg as NAME_jpg.rf.HASH.jpg.
_APPENDED_HASH = re.compile(r"\.rf\.[0-9a-z]{8,}$", re.IGNORECASE)
_APPENDED_SUFFIX = re.compile(r"_(jpe?g|png|bmp|tiff?|webp)$", re.IGNORECASE)
# Label Studio writes NAME as HASH-NAME, other tools put a longer hash or a UUID before or behind.
_HASH = r"(?:[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}|[0-9a-f]{32,64}|[0-9a-f]{8})"
_HASH_BEFORE = re.compile(rf"^{_HASH}[-_.]", re.IGNORECASE)
_HASH_BEHIND = re.compile(rf"[-_.]{_HASH}$", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"([0-9]+)[^0-9]*$")
_MAX_DIGITS = 18
# Numbers behind names are hashes where at least this share of them holds a letter; frame numbers hold none.
_MIN_LETTERS_SHARE = 0.5


@dataclass(frozen=True)
class EntryMatch:
    """Entries by frame.

    Args:
        by_number: number of the entry of a frame number.
        by_name: number of the entry of a file name, in a folder of images.
        usage: one line: how many entries are used, and what about the others.
        problems: what to be careful about, one line each; the usage too, where entries are lost.
        no_frames: why no frame has an entry; None where one has.
    """

    by_number: dict[int, int] = field(default_factory=dict)
    by_name: dict[str, int] = field(default_factory=dict)
    usage: str = ""
    problems: tuple[str, ...] = ()
    no_frames: DataError | None = None


@dataclass(frozen=True)
class _Named:
    """An entry that names a frame of a video.

    Args:
        entry: its number.
        number: of the frame, as the file counts.
        group: what tells videos apart: folders and the name before the number.
        text: the entry in messages.
        is_stated: whether the entry states the number by a key of its own.
    """

    entry: int
    number: int
    group: tuple[str, ...]
    text: str
    is_stated: bool


def match_video(entries: Sequence[ImageEntry], clip: Clip, first_frame: int | None) -> EntryMatch:
    """Find the entries of the frames of a video.

    Args:
        entries: of the file.
        clip: the video; its path may be empty where it is not known.
        first_frame: number that the file gives to the first frame; None takes 0, or what the numbers show.

    Raises:
        DataError: several entries name the same frame, and nothing tells which belongs to this video.
    """
    named = _named_frames(entries)
    chosen = _of_this_video(named, clip)
    by_number: dict[int, _Named] = {}
    repeated = 0
    for item in chosen:
        other = by_number.setdefault(item.number, item)
        if other is item:
            continue
        if (other.group, other.text) != (item.group, item.text):
            raise _ambiguous(chosen, clip)
        repeated += 1
    problems = []
    is_stated = any(item.is_stated for item in by_number.values())
    first, note = _first_number(list(by_number), clip.frame_count, first_frame, is_stated)
    if note:
        problems.append(note)
    frames = {number - first: item.entry for number, item in by_number.items()}
    beyond = sum(n < 0 or (clip.frame_count is not None and n >= clip.frame_count) for n in frames)
    counts = {
        "beyond the video": beyond,
        f"name{'s' if repeated == 1 else ''} the same frame": repeated,
        f"name{'s' if len(entries) - len(named) == 1 else ''} no frame": len(entries) - len(named),
        "of other videos": len(named) - len(chosen),
    }
    used = len(frames) - beyond
    usage = _usage(used, len(entries), counts)
    if any(count for what, count in counts.items() if what != "of other videos"):
        problems.insert(0, usage)
    problems += _foreign_video(chosen, clip)
    no_frames = None
    if not used and entries:
        reason = _why_none(sorted(frames), first, clip)
        no_frames = DataError(f"{usage}: {reason}", parameter="first_frame" if frames else None)
    elif clip.every > 1 and entries:
        no_frames = _missed_by_every(sorted(frames), clip)
    return EntryMatch(frames, {}, usage, tuple(problems), no_frames)


def match_files(
    entries: Sequence[ImageEntry], files: Sequence[str], clip: Clip, first_frame: int | None = None
) -> EntryMatch:
    """Find the entries of the images of a folder.

    Args:
        entries: of the file.
        files: names of the images, in the order of the frames.
        clip: the folder; its path may be empty where it is not known.
        first_frame: number that the file gives to the first image, where it names none by its file.

    Raises:
        DataError: several entries name the same image, and nothing tells which is meant.
    """
    own_keys = [_keys(e.name) if e.name and not _is_video_frame(e) else () for e in entries]
    file_keys = [_keys(name) for name in files]
    by_name: dict[str, int] = {}
    claimed: set[int] = set()
    repeated = 0
    for level in range(len(_keys("x"))):
        at_level: dict[str, list[int]] = defaultdict(list)
        for number, keys in enumerate(own_keys):
            if keys and number not in claimed:
                at_level[keys[level]].append(number)
        waiting: dict[str, list[str]] = defaultdict(list)
        for name, keys in zip(files, file_keys, strict=True):
            if name not in by_name:
                waiting[keys[level]].append(name)
        for key, names in waiting.items():
            # Two files that are alike at this level, such as a.jpg and a.png, cannot be told apart by it.
            if len(names) > 1 or not at_level.get(key):
                continue
            candidates = _in_folder(entries, at_level[key], clip)
            if len({entries[k].name for k in candidates}) > 1:
                shown = " and ".join(sorted({entries[k].name for k in candidates})[:2])
                raise DataError(
                    f"several of its images are {names[0]}, such as {shown}, and no folder tells which is of "
                    f"{clip.path.name or 'these frames'}; put each video's entries into a folder of its name"
                )
            by_name[names[0]] = candidates[0]
            claimed.update(candidates)
            repeated += len(candidates) - 1
    by_number, note = _unnamed_by_index(entries, files, claimed, first_frame)
    used = len(by_name) + len(by_number)
    left = len(entries) - used - repeated
    usage = _usage(used, len(entries), {"name the same image": repeated, "name no image of the folder": left})
    no_frames = None
    if not used and entries:
        shown = next((e.name for e in entries if e.name), "no file name")
        no_frames = DataError(f"{usage}: it names images such as {shown}, the folder holds such as {files[0]}")
    elif clip.every > 1 and entries:
        position = {name: number for number, name in enumerate(files)}
        no_frames = _missed_by_every(sorted({*by_number, *(position[name] for name in by_name)}), clip)
    return EntryMatch(
        by_number, by_name, usage, tuple([usage] * bool(left or repeated) + [note] * bool(note)), no_frames
    )


def unnamed_by_number(entries: Sequence[ImageEntry]) -> dict[int, int]:
    """Return the entries without a picture's name by the number that they state, or by their id."""
    numbers = [(e.frame if e.frame is not None else e.id_number, k) for k, e in enumerate(entries)]
    return {number: k for number, k in reversed(numbers) if number is not None}


def _usage(used: int, total: int, counts: dict[str, int]) -> str:
    rest = "".join(f", {count} {what}" for what, count in counts.items() if count)
    return f"{used} of {count_of(total, 'image entry')} used{rest}"


# -- videos -----------------------------------------------------------------------------------------


def _named_frames(entries: Sequence[ImageEntry]) -> list[_Named]:
    """Return the entries that name a frame, with its number."""
    stems = {k: PurePosixPath(unquote(e.name)).stem for k, e in enumerate(entries) if e.name and e.frame is None}
    plain = {k: _APPENDED_SUFFIX.sub("", _APPENDED_HASH.sub("", stem)) for k, stem in stems.items()}
    hashes = {k: match[0] for k, stem in plain.items() if (match := _HASH_BEHIND.search(stem))}
    if len(hashes) == len(plain) and plain:
        letters = sum(any(c.isalpha() for c in text) for text in hashes.values())
        if letters >= _MIN_LETTERS_SHARE * len(hashes):
            plain = {k: _HASH_BEHIND.sub("", stem) for k, stem in plain.items()}
    named = []
    for k, entry in enumerate(entries):
        path = PurePosixPath(unquote(entry.name)) if entry.name else None
        if entry.frame is not None:
            # The file name of a stated frame is its video's, or a picture's in the video's folder.
            parts = path.parts if path is not None else ()
            if path is not None and path.suffix.lower() in _PICTURE_SUFFIXES:
                parts = parts[:-1]
            text = f"{entry.name or 'an entry'} frame {entry.frame}"
            named.append(_Named(k, entry.frame, (*_video(entry), *parts), text, True))
        elif entry.id_number is not None:
            named.append(_Named(k, entry.id_number, (), f"id {entry.id_number}", False))
        elif path is not None and (match := _LAST_NUMBER.search(plain[k])) and len(match[1]) <= _MAX_DIGITS:
            before = _HASH_BEFORE.sub("", plain[k][: match.start()])
            named.append(_Named(k, int(match[1]), (*_video(entry), *path.parts[:-1], before), entry.name, False))
    return named


def _video(entry: ImageEntry) -> tuple[str, ...]:
    return PurePosixPath(entry.video).parts if entry.video else ()


def _of_this_video(named: list[_Named], clip: Clip) -> list[_Named]:
    """Return the entries whose folders or names are like the video's; all where none are."""
    groups = {item.group for item in named}
    if len(groups) < 2 or not clip.path.name:
        return named
    ranks = {group: _likeness(group, clip) for group in groups}
    best = max(ranks.values())
    if best == (0, 0, 0):
        return named
    return [item for item in named if ranks[item.group] == best or not item.group]


def _likeness(group: tuple[str, ...], clip: Clip) -> tuple[int, int, int]:
    """Return how well the parts of a group name a video: by its name as it is, by the name's letters, by its folder."""
    stem, folder = unicodedata.normalize("NFC", clip.path.stem), clip.path.absolute().parent.name
    exact = alike = in_folder = 0
    for part in group:
        text = unicodedata.normalize("NFC", part)
        exact |= text in (stem, clip.path.name) or bool(re.match(rf"{re.escape(stem)}[^0-9a-z]", text, re.IGNORECASE))
        alike |= _begins_alike(_letters(text), _letters(stem))
        in_folder |= bool(folder) and _letters(text) == _letters(folder)
    return int(exact), int(exact or alike), int(in_folder)


def _begins_alike(text: str, name: str) -> bool:
    """Return whether a text begins with a name; cam11 does not begin with cam1."""
    return text.startswith(name) and not (name[-1:].isdigit() and text[len(name) :][:1].isdigit())


def _ambiguous(chosen: Iterable[_Named], clip: Clip) -> DataError:
    by_number: dict[int, dict[tuple[tuple[str, ...], str], _Named]] = defaultdict(dict)
    for item in chosen:
        by_number[item.number].setdefault((item.group, item.text), item)
    several = {number: list(items.values()) for number, items in by_number.items() if len(items) > 1}
    number, items = min(several.items(), key=lambda pair: pair[0])
    many = f"{len(several)} frames are" if len(several) > 1 else "a frame is"
    return DataError(
        f"{many} named by several image entries, such as frame {number} by {items[0].text} and {items[1].text}, and "
        f"nothing tells which is of {clip.path.name or 'this video'}; keep one entry for each frame, and put the "
        "entries of each video into a folder of its name"
    )


def _first_number(counted: list[int], total: int | None, given: int | None, is_stated: bool) -> tuple[int, str | None]:
    """Return the number of the first frame, and a note where it is not what the file's user would expect.

    Args:
        counted: numbers of frames, as the file counts.
        total: number of frames there are, where known.
        given: number of the first frame, where the user says it.
        is_stated: whether the file states frame numbers by a key of its own, so that they are not shifted.
    """
    if given is not None:
        return given, None
    if not counted:
        return 0, None
    low, high = min(counted), max(counted)
    if total and low > 0 and not is_stated:
        is_whole = len(set(counted)) == high - low + 1 == total
        if is_whole or (low == 1 and high == total):
            return low, (
                f"its frames are numbered {low} to {high}, there are {total}: {low} is taken as the first frame "
                "(first_frame 0 if it is not)"
            )
    if low == 1:
        return 0, "no image entry is of frame 0: if it numbers frames from 1, say so with first_frame 1"
    return 0, None


def _foreign_video(chosen: list[_Named], clip: Clip) -> list[str]:
    """Return a note if all stated frames are of a file of another name."""
    others = {item.group[-1] for item in chosen if item.is_stated and item.group}
    if not clip.path.name or len(others) != 1 or not chosen:
        return []
    (other,) = others
    if not PurePosixPath(other).suffix or _letters(PurePosixPath(other).stem) == _letters(clip.path.stem):
        return []
    return [f"its image entries are of {other}; they are taken as {clip.path.name}'s"]


def _why_none(frames: list[int], first: int, clip: Clip) -> str:
    if not frames:
        return "none has a frame number, or a file name that ends in one"
    low, high = frames[0] + first, frames[-1] + first
    total = f"{clip.frame_count} frames" if clip.frame_count else "other frames"
    return (
        f"they number frames {low} to {high}, but {clip.path.name or 'the video'} has {total}; give the video that "
        "they are of, or the number of its first frame"
    )


def _missed_by_every(frames: list[int], clip: Clip) -> DataError | None:
    """Return an error if no annotated frame is among every so many-th, with what would take them."""
    inside = [n for n in frames if n >= 0 and (clip.frame_count is None or n < clip.frame_count)]
    if not inside or any(n % clip.every == 0 for n in inside):
        return None
    shown = ", ".join(map(str, inside[:3])) + (", ..." if len(inside) > 3 else "")
    right = math.gcd(*inside)
    text = f"every {clip.every}: no annotated frame is among these; frames {shown} are annotated"
    step = math.gcd(*(n - inside[0] for n in inside))
    text += f": use every {right or 1}"
    if step > right and inside[0] < step:
        text += f", or, if the first frame is number {inside[0]}, first_frame {inside[0]} with every {step}"
    return DataError(text, parameter="every")


# -- folders of images ------------------------------------------------------------------------------


def _keys(name: str) -> tuple[str, ...]:
    """Return the texts under which an image is looked up, from the name as it is to what exporters leave of it."""
    whole = unicodedata.normalize("NFC", name)
    base = PurePosixPath(whole).name
    decoded = unicodedata.normalize("NFC", unquote(base)).casefold()
    path = PurePosixPath(decoded)
    stem = _HASH_BEFORE.sub("", _APPENDED_SUFFIX.sub("", _APPENDED_HASH.sub("", path.stem)))
    return whole, base, decoded, path.stem, stem, _letters(stem)


def _letters(text: str) -> str:
    """Return the letters and digits of a text: exporters replace the rest."""
    folded = unicodedata.normalize("NFC", text).casefold()
    return "".join(c for c in folded if c.isalnum()) or folded


def _in_folder(entries: Sequence[ImageEntry], candidates: list[int], clip: Clip) -> list[int]:
    """Return the candidates that lie in a folder of the clip's name; all where none do."""
    folder = _letters(clip.path.absolute().name) if clip.path.name else ""
    inside = [
        k
        for k in candidates
        if folder and folder in map(_letters, (*_video(entries[k]), *PurePosixPath(entries[k].name).parts[:-1]))
    ]
    return inside or candidates


def _is_video_frame(entry: ImageEntry) -> bool:
    """Return whether an entry states a frame of a video file, so that its file name is no picture's."""
    return entry.frame is not None and PurePosixPath(entry.name).suffix.lower() not in _PICTURE_SUFFIXES


def _unnamed_by_index(
    entries: Sequence[ImageEntry], files: Sequence[str], claimed: set[int], first_frame: int | None
) -> tuple[dict[int, int], str]:
    """Return the entries without a picture's name by frame, and a note on how they are counted.

    Their number is the one that all images are named by, or the position of the image.
    """
    stems = [PurePosixPath(name).stem for name in files]
    numbered = {k: e.id_number for k, e in enumerate(entries) if e.id_number is not None and k not in claimed}
    stated = {k: e.frame for k, e in enumerate(entries) if e.frame is not None and k not in claimed}
    positions = {int(stem): at for at, stem in enumerate(stems) if stem.isascii() and stem.isdigit()}
    note: str | None = None
    if not stated and len(positions) == len(files) and set(numbered.values()) <= set(positions):
        frames = {positions[number]: k for k, number in numbered.items()}
    else:
        counts = {**numbered, **stated}
        first, note = _first_number(list(counts.values()), len(files), first_frame, bool(stated))
        frames = {number - first: k for k, number in reversed(counts.items()) if 0 <= number - first < len(files)}
    return frames, note or ""

"""The mask job: from videos with instance masks to shards of rectified frames with labels."""

from __future__ import annotations

import json
import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from labelgen.choices import Pair, Region, Rule
from labelgen.datasets.fingerprint import fingerprint
from labelgen.datasets.scene import Scene, SceneFiles
from labelgen.errors import LabelgenError, NoVehiclesError
from labelgen.geometry.rectification import Rectification
from labelgen.jobs.frame_labels import FrameLabeler, LabelledFrame, PassageLabeler, SingleFrameLabeler
from labelgen.jobs.kept_masks import KeptMasks
from labelgen.jobs.mask_settings import MaskSettings, with_rule
from labelgen.jobs.runner import Job, Progress, finished_part
from labelgen.labels import Sample
from labelgen.masks import (
    Clip,
    MaskSource,
    check_masks,
    create_mask_source,
    labelled_frames,
    parse_masks,
    prime_masks,
)
from labelgen.media.frame_choice import FrameChoice
from labelgen.media.frames import Frame
from labelgen.shards import Reject, ShardReader, ShardWriter
from labelgen.shards.image_codec import ImageCodec
from labelgen.shards.rejects import INPUT_PROBLEM

__all__ = ["VideoUnit", "video_job"]

_log = logging.getLogger(__name__)

# Frames that are decoded ahead of the masks; each is kept in full.
_FRAMES_AHEAD = 4
_OVERLAP_S = 10.0
"""Time before and after a shard whose masks its labels may rest on, seconds: longer than most passages."""
_USUAL_FPS = 25.0


def video_job(
    scenes: Sequence[SceneFiles],
    pair: Pair,
    size_wh: tuple[int, int],
    settings: MaskSettings,
    *,
    region: Region = Region.ROAD,
    every: int = 25,
    keyframes: bool = False,
    limit: int | None = None,
    per_shard: int = 500,
    codec: ImageCodec | None = None,
    keep_masks: bool = False,
) -> Job:
    """Plan the labels of videos.

    Calibrations, road masks and the mask source are opened here, so that their errors come before anything is written.

    Args:
        scenes: the inputs.
        pair: the vanishing points whose directions become axis-parallel.
        size_wh: size of the rectified frames, px.
        settings: the mask source, and how masks become labels.
        region: what is rectified.
        every: label every so many-th frame; with `keyframes`, the least number of frames from one to the next.
        keyframes: label only frames that decode alone.
        limit: largest number of frames to label in each video; None for all.
        per_shard: number of labelled frames in a shard, with or without vehicles.
        codec: encoding of the images; JPEG of quality 95 by default.
        keep_masks: whether the masks are written beside the shards, see `labelgen.jobs.kept_masks`.

    Raises:
        LabelgenError: an input is given twice, or a calibration, road mask or mask source is not usable.
    """
    codec = codec or ImageCodec()
    settings = with_rule(settings, scenes, region)
    common = {"kind": "masks", "region": str(region), **settings.describe(), "every": every, **codec.describe()}
    # Only where they are given, so that other shards stay as they are.
    if keyframes:
        common["keyframes"] = True
    for key in ("given_fps", "stream"):
        values = {getattr(files, key) for files in scenes} - {None}
        if values:
            common[key.removeprefix("given_")] = values.pop()
    if any(files.deinterlace for files in scenes):
        common["deinterlace"] = True
    units: list[VideoUnit] = []
    reasons: list[NoVehiclesError] = []
    inputs = {}
    for number, files in enumerate(_with_distinct_names(scenes)):
        prefix = "shard" if len(scenes) == 1 else f"shard-{number:03d}-{files.name}"
        scene = files.open()
        choice = FrameChoice(every, keyframes, limit)
        size = None if keyframes else _taken(scene.frames.frame_count, every, limit)
        unit = VideoUnit(
            files, pair, size_wh, region, settings, choice, per_shard, codec, common, prefix, size, keep_masks
        )
        for note in scene.frames.notes:
            _log.info("%s: %s", files.name, note)
        unit.rectification(scene)
        # Masks made before are looked up for each video; other sources are the same for all.
        if number == 0 or settings.is_made_before:
            source = unit.mask_source(scene)
            if keyframes:
                _check_keyframes(source, settings.masks)
            problem = _no_masks(source)
            reasons += [problem] if problem else []
        units.append(unit)
        used = (scene.frames.path, files.calibration_path, files.mask_path)
        inputs[f"{number}: {files.name}"] = [fingerprint(path) for path in used]
    if reasons and len(reasons) == len(units):
        raise reasons[0]
    originals = {unit.files.name: unit.whereabouts() for unit in units}
    job_settings = {
        "pair": str(pair),
        "size": f"{size_wh[0]}x{size_wh[1]}",
        "limit": limit,
        "per_shard": per_shard,
        **common,
        **({"keep_masks": True} if keep_masks else {}),
    }
    return Job("bcs-masks", job_settings, inputs, units, originals)


def _check_keyframes(source: MaskSource, masks: str) -> None:
    """Refuse key frames only for a source that needs the frames in between.

    Raises:
        LabelgenError: it does.
    """
    if source.every_frame:
        raise LabelgenError(
            f"keyframes: masks {masks} learn from all frames, so these must be decoded in any case; leave it out",
            parameter="keyframes",
        )


def _no_masks(source: MaskSource) -> NoVehiclesError | None:
    """Return why ready-made masks have none for a video; None where they have one."""
    try:
        check_masks(source)
    except NoVehiclesError as err:
        return err
    return None


def _rate_problem(scene: Scene) -> list[str]:
    """Return a note if the video runs at another frame rate than the data set states, in a list."""
    announced = scene.frames.fps
    if announced is None or scene.fps is None or abs(announced - scene.fps) <= 0.01 * scene.fps:
        return []
    return [f"the video runs at {announced:g} frames per second, the data set says {scene.fps:g}; times may be wrong"]


def _with_distinct_names(scenes: Sequence[SceneFiles]) -> list[SceneFiles]:
    """Return the scenes with distinct names, equal ones numbered: the source of a label must name one video."""
    paths: set[Path] = set()
    used: Counter[str] = Counter()
    named = []
    for scene in scenes:
        path = Path(scene.frames_path or "").resolve()
        if path in paths:
            raise LabelgenError(f"{path}: it is given twice; name each input once")
        paths.add(path)
        used[scene.name] += 1
        count = used[scene.name]
        named.append(scene if count == 1 else replace(scene, name=f"{scene.name}-{count}"))
    return named


def _taken(frame_count: int | None, every: int, limit: int | None) -> int | None:
    """Return how many frames a video is expected to give, where that is known."""
    if frame_count is None:
        return limit
    taken = -(-frame_count // every)
    return taken if limit is None else min(taken, limit)


@dataclass(frozen=True)
class VideoUnit:
    """All shards of one video.

    Args:
        files: the scene.
        pair: the vanishing points whose directions become axis-parallel.
        size_wh: size of the rectified frames, px.
        region: what is rectified.
        masks: the mask source, and how masks become labels.
        choice: which frames are labelled.
        per_shard: number of labelled frames in a shard.
        codec: encoding of the images.
        settings: what decides the labels, for the shards.
        prefix: start of the shards' file names.
        size: expected number of labelled frames, where known.
        keep_masks: whether the masks are written beside the shards.
    """

    files: SceneFiles
    pair: Pair
    size_wh: tuple[int, int]
    region: Region
    masks: MaskSettings
    choice: FrameChoice
    per_shard: int
    codec: ImageCodec
    settings: Mapping[str, Any]
    prefix: str
    size: int | None
    keep_masks: bool = False

    def whereabouts(self) -> dict[str, str | None]:
        """Return where the originals lie on this machine."""
        name = parse_masks(self.masks.masks)
        return {
            "path": str(Path(self.files.frames_path or "").resolve()),
            "calibration": str(self.files.calibration_path.resolve()),
            "road_mask": str(self.files.mask_path.resolve()),
            "masks": f"{name.label}:{name.file.resolve()}" if name.file else name.label,
            "weights": str(self.masks.weights.resolve()) if self.masks.weights else None,
            **({} if self.files.stream is None else {"stream": str(self.files.stream)}),
            **({"deinterlace": "yes"} if self.files.deinterlace else {}),
        }

    def rectification(self, scene: Scene) -> Rectification:
        """Return the rectification of the opened scene.

        Raises:
            LabelgenError: camera and road mask admit none.
        """
        return Rectification.of_region(self.region, scene.camera, scene.road, self.pair, self.size_wh)

    def mask_source(self, scene: Scene) -> MaskSource:
        """Open the mask source for the scene.

        Raises:
            LabelgenError: it cannot be used.
        """
        return create_mask_source(
            self.masks.masks,
            weights=self.masks.weights,
            score_threshold=self.masks.score,
            road_mask=scene.road.pixels,
            device=self.masks.device,
            frame_wh=scene.frames.size_wh,
            # Which frames are key frames is not known before the video is read.
            clip=Clip.of(scene.frames, every=1 if self.choice.keyframes else self.choice.every),
            camera=scene.camera,
            options=self.masks.options,
        )

    def _path(self, out: Path, part: int) -> Path:
        return out / f"{self.prefix}-{part:05d}.h5"

    def _finished_shards(self, out: Path) -> list[ShardReader]:
        """Return the shards on disk, in order, up to the first that is missing."""
        readers: list[ShardReader] = []
        expected = {
            "pair": str(self.pair),
            "size": f"{self.size_wh[0]}x{self.size_wh[1]}",
            "source": self.files.name,
            "settings": json.dumps(dict(self.settings), sort_keys=True),
        }
        while (reader := finished_part(self._path(out, len(readers)), part=len(readers), **expected)) is not None:
            readers.append(reader)
        return readers

    def shards(self, out: Path) -> list[Path] | None:
        """See `Unit`."""
        readers = self._finished_shards(out)
        # The kept masks are complete before the last shard is.
        if readers and readers[-1].attributes["last"]:
            return [reader.path for reader in readers]
        return None

    def run(self, out: Path, progress: Progress) -> None:
        """See `Unit`."""
        scene = self.files.open()
        frames, rectification, source = scene.frames, self.rectification(scene), self.mask_source(scene)
        finished = len(self._finished_shards(out))
        if self.keep_masks:
            finished = min(finished, KeptMasks(out, self.prefix, self.files.name).complete_parts())
        prime_masks(source, frames)
        first = finished * self._part_frames  # the frames before are in finished shards
        if self.size is not None:
            progress(min(self.size, finished * self.per_shard))
        labeler = self._labeler(scene, rectification, first)
        # Passages go on over the border of two shards.
        asked = max(0, first - self._part_frames) if self.masks.rule is Rule.FITTED else first
        choice = replace(self.choice, wanted=lambda number: number >= asked)
        with ExitStack() as outer, ExitStack() as stack:
            kept = outer.enter_context(KeptMasks(out, self.prefix, self.files.name)) if self.keep_masks else None
            writer = stack.enter_context(self._writer(out, finished))

            def write(labelled: Iterable[LabelledFrame]) -> None:
                nonlocal writer
                for frame in labelled:
                    while self._part_of(frame.number) > writer.part:
                        stack.close()
                        writer = stack.enter_context(self._writer(out, writer.part + 1))
                    self._write(frame, scene, rectification, writer)

            found = labelled_frames(frames, source, scene.camera, choice, self._part_of, ahead=_FRAMES_AHEAD)
            with closing(found) as coming:
                for frame, masks in coming:
                    if frame.number >= first:
                        progress(1)
                        if kept is not None:
                            kept.add(self._part_of(frame.number), frame, masks)
                    write(labeler.add(frame, masks))
            write(labeler.finish())
            if kept is not None:
                kept.finish()
            writer.last = True
            lost = _no_masks(source)
            for problem in [
                *_rate_problem(scene),
                *scene.notes,
                *frames.problems,
                *source.problems,
                *([str(lost)] if lost else []),
            ]:
                writer.reject(Reject(self.files.name, -1, -1, INPUT_PROBLEM, problem))

    def _labeler(self, scene: Scene, rectification: Rectification, first: int) -> FrameLabeler:
        def encode(frame: Frame) -> bytes:
            return self.codec.encode(rectification.warp_image(frame.image))

        if self.masks.rule is not Rule.FITTED or self.region is Region.NONE:
            return SingleFrameLabeler(
                scene, rectification, self.region, self.masks.rule or Rule.WIDER, self.masks.limits, encode
            )
        return PassageLabeler(
            scene,
            rectification,
            self.masks.limits,
            encode,
            are_silhouettes=parse_masks(self.masks.masks).are_silhouettes,
            part_frames=self._part_frames,
            overlap=min(math.ceil(_OVERLAP_S * (scene.fps or _USUAL_FPS)), self._part_frames),
            first=first,
        )

    def _write(self, frame: LabelledFrame, scene: Scene, rectification: Rectification, writer: ShardWriter) -> None:
        name, (labels, rejects, ignored) = self.files.name, frame.given
        for item, reason, detail in rejects:
            writer.reject(Reject(name, frame.number, item, reason, detail))
        if not len(labels):
            writer.reject(Reject(name, frame.number, -1, "frame without a labelled vehicle"))
            return
        window = np.array([0.0, 0.0, *scene.frames.size_wh])
        split = self.files.split_of(frame.number)
        writer.add(
            Sample(
                frame.encoded,
                labels,
                rectification,
                scene.camera,
                name,
                frame.number,
                frame.time_s,
                split,
                window,
                ignored,
            )
        )

    @property
    def _part_frames(self) -> int:
        """Number of frames of the video in which a shard's frames lie."""
        return self.per_shard * self.choice.every

    def _part_of(self, number: int) -> int:
        return number // self._part_frames

    def _writer(self, out: Path, part: int) -> ShardWriter:
        path = self._path(out, part)
        return ShardWriter(path, self.pair, self.size_wh, source=self.files.name, part=part, settings=self.settings)

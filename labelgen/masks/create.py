"""Creates mask sources by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from labelgen.errors import LabelgenError
from labelgen.geometry.camera import Camera
from labelgen.masks.clip import Clip
from labelgen.masks.mask_options import MASK_OPTIONS, MaskOptions
from labelgen.masks.source import MaskKind, MaskName, MaskSource, parse_masks

__all__ = ["create_mask_source"]

_OPTIONS_OF = {MaskKind.COCO: {"first_frame", "scale_masks", "classes"}, MaskKind.ONNX: {"classes", "tiles"}}


def create_mask_source(
    masks: str,
    *,
    weights: str | Path | None = None,
    score_threshold: float = 0.5,
    road_mask: NDArray[Any] | None = None,
    device: str | None = None,
    frame_wh: tuple[int, int] | None = None,
    clip: Clip | None = None,
    camera: Camera | None = None,
    options: MaskOptions = MASK_OPTIONS,
) -> MaskSource:
    """Create a mask source by name.

    Args:
        masks: "maskrcnn", "background", "coco:FILE" or "onnx:FILE"; with "gated:" before it, a background model's
            silhouettes inside the boxes of these masks.
        weights: state dict that replaces torchvision's COCO weights; maskrcnn only.
        score_threshold: masks with a lower score are left out.
        road_mask: (H, W), not 0 on the road, on which vehicles must stand; used by background, and by tiles of onnx.
        device: torch device such as "cuda:1", by default a GPU if there is one; used by maskrcnn and onnx.
        frame_wh: size of the frames, px; coco checks all masks against it at once.
        clip: the frames that the masks are asked for; coco tells by it which of its images are these.
        camera: of the frames; onnx chooses by it the tiles "auto".
        options: how the COCO file is to be read, or the network to be used.

    Raises:
        LabelgenError: unknown name, or weights or options for a source that takes none.
        DataError: weights, masks or a network that cannot be used.
    """
    name = parse_masks(masks)
    if weights is not None and name.kind is not MaskKind.MASKRCNN:
        raise LabelgenError(f"weights: only the mask source maskrcnn takes weights, not {masks}", parameter="weights")
    _check_options(name, masks, options)
    if name.is_gated:
        from labelgen.masks.background.source import BackgroundMasks
        from labelgen.masks.gated import GatedMasks

        detections = _create(name, weights, score_threshold, road_mask, device, frame_wh, clip, camera, options)
        return GatedMasks(detections, BackgroundMasks(road_mask=road_mask))
    return _create(name, weights, score_threshold, road_mask, device, frame_wh, clip, camera, options)


def _create(
    name: MaskName,
    weights: str | Path | None,
    score_threshold: float,
    road_mask: NDArray[Any] | None,
    device: str | None,
    frame_wh: tuple[int, int] | None,
    clip: Clip | None,
    camera: Camera | None,
    options: MaskOptions,
) -> MaskSource:
    if name.kind is MaskKind.COCO:
        from labelgen.masks.coco import CocoMasks

        assert name.file is not None
        return CocoMasks(name.file, score_threshold=score_threshold, frame_wh=frame_wh, clip=clip, options=options)
    if name.kind is MaskKind.ONNX:
        from labelgen.masks.onnx.source import OnnxMasks

        assert name.file is not None
        return OnnxMasks(
            name.file,
            score_threshold=score_threshold,
            device=device,
            options=options,
            camera=camera,
            road_mask=road_mask,
        )
    if name.kind is MaskKind.BACKGROUND:
        from labelgen.masks.background.source import BackgroundMasks

        return BackgroundMasks(road_mask=road_mask, score_threshold=score_threshold)
    from labelgen.masks.maskrcnn import MaskRcnnMasks

    return MaskRcnnMasks(weights=weights, score_threshold=score_threshold, device=device)


def _check_options(name: MaskName, masks: str, options: MaskOptions) -> None:
    """Refuse options that the source does not take."""
    unused = tuple(key for key in options.describe() if key not in _OPTIONS_OF.get(name.kind, set()))
    if unused:
        takers = [f"{kind}:FILE" for kind, keys in _OPTIONS_OF.items() if keys.issuperset(unused)]
        raise LabelgenError(
            f"{' and '.join(unused)}: only masks {' or '.join(takers) or 'of other kinds'} take that, "
            f"not masks {masks}",
            parameter=unused,
        )

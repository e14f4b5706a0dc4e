"""What a training begins with: a detector of the same shape, torchvision's RetinaNet, or a trunk alone.

The files of torchvision's pretrained networks are state dicts; where a network cannot be downloaded, its file may be
brought along.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from detector.checkpoint import WEIGHTS_PREFIX
from detector.model.retinanet import CcRetinaNet
from labelgen.errors import DataError

__all__ = ["load_pretrained"]

# Counted in training, of no use for anything, and not in the files of frozen normalisations.
_COUNTER = "num_batches_tracked"


def load_pretrained(model: CcRetinaNet, data: Mapping[str, Any], where: str) -> str:
    """Put weights into a model, as much of them as fits.

    Args:
        model: to be trained.
        data: a checkpoint with a "state_dict", or a bare state dict: of a detector of the same shape (all of it is
            taken), of torchvision's RetinaNet with the same trunk (that, and what else has the same shape), or of the
            trunk as torchvision has it for classification.
        where: they come from, for messages.

    Returns:
        what was taken: "detector", "torchvision RetinaNet" or "trunk".

    Raises:
        DataError: they fit in none of these ways.
    """
    state = {
        str(key).removeprefix(WEIGHTS_PREFIX): value
        for key, value in dict(data.get("state_dict", data)).items()
        if isinstance(value, Tensor)
    }
    own = model.state_dict()
    if _misfits(own, state) == []:
        model.load_state_dict({key: state.get(key, own[key]) for key in own})
        return "detector"
    body = "backbone.body."
    whole = any(key.startswith(body) for key in state)
    # A trunk that is the first part of a network is named for it there.
    trunk = {key.removeprefix(body if whole else "features."): value for key, value in state.items()}
    misfits = _misfits(model.backbone.body.state_dict(), trunk)
    if misfits:
        shown = ", ".join(misfits[:3]) + (f" and {len(misfits) - 3} more" if len(misfits) > 3 else "")
        raise DataError(
            f"{where}: its weights are of another network ({shown} differ); give a checkpoint of this preset and "
            "backbone, or torchvision's file of RetinaNet or of the backbone"
        )
    if whole:
        _take(model, state)
        return "torchvision RetinaNet"
    _take(model.backbone.body, trunk)
    return "trunk"


def _misfits(own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> list[str]:
    """Names of own weights that are not given, or in another shape, and of given ones that the own parts lack."""
    parts = {key.partition(".")[0] for key in own}
    missing = [key for key, value in own.items() if key not in given or given[key].shape != value.shape]
    # A deeper network of the same kind has all of a shallower one's, and more.
    unknown = [key for key in given if key.partition(".")[0] in parts and key not in own]
    return [key for key in missing + unknown if not key.endswith(_COUNTER)]


def _take(part: nn.Module, given: Mapping[str, Tensor]) -> None:
    own = part.state_dict()
    fitting = {key: value for key, value in given.items() if key in own and own[key].shape == value.shape}
    part.load_state_dict({**own, **fitting})

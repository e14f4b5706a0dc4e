"""Weights to start training from: a detector of the same shape, torchvision's RetinaNet, or a trunk alone.

The files of torchvision's pretrained networks are state dicts. On a machine without network access, such a file can be
given instead of a download.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from detector.checkpoint import WEIGHTS_PREFIX
from detector.model.retinanet import CcRetinaNet
from labelgen.errors import DataError
from labelgen.torch_file import first_not_finite

__all__ = ["load_pretrained"]

_BATCH_COUNTER = "num_batches_tracked"
"""Buffer of batch normalisations that changes nothing, and that files of frozen normalisations lack."""


def load_pretrained(model: CcRetinaNet, data: Mapping[str, Any], where: str) -> str:
    """Load into a model those weights of a file that fit.

    Args:
        model: is changed.
        data: a checkpoint with a "state_dict", or a bare state dict. It is of a detector of the same shape (all
            weights are loaded), of torchvision's RetinaNet with the same trunk (the trunk is loaded, and all else of
            the same shape), or of the trunk as a classification network of torchvision.
        where: the weights come from, for messages.

    Returns:
        what the weights are of: "detector", "torchvision RetinaNet" or "trunk".

    Raises:
        DataError: they are of none of these.
    """
    given = data.get("state_dict", data)
    if not isinstance(given, Mapping):
        raise DataError(f"{where}: it has no weights")
    state = {str(k).removeprefix(WEIGHTS_PREFIX): value for k, value in given.items() if isinstance(value, Tensor)}
    broken = first_not_finite(state)
    if broken is not None:
        raise DataError(f"{where}: its weights are not finite ({broken}); take another file")
    own = model.state_dict()
    if _misfits(own, state) == []:
        model.load_state_dict({key: state.get(key, own[key]) for key in own})
        return "detector"
    body = "backbone.body."
    is_retinanet = any(key.startswith(body) for key in state)
    # In some classification networks the trunk is the part called "features".
    trunk = {key.removeprefix(body if is_retinanet else "features."): value for key, value in state.items()}
    misfits = _misfits(model.backbone.body.state_dict(), trunk)
    if misfits:
        shown = ", ".join(misfits[:3]) + (f" and {len(misfits) - 3} more" if len(misfits) > 3 else "")
        raise DataError(
            f"{where}: its weights are of another network ({shown} differ); give a checkpoint of this preset and "
            "backbone, or torchvision's file of RetinaNet or of the backbone"
        )
    if is_retinanet:
        _load_fitting(model, state)
        return "torchvision RetinaNet"
    _load_fitting(model.backbone.body, trunk)
    return "trunk"


def _misfits(own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> list[str]:
    """List own weights that are not given, or have another shape, and given ones that the same modules lack."""
    parts = {key.partition(".")[0] for key in own}
    missing = [key for key, value in own.items() if key not in given or given[key].shape != value.shape]
    # A deeper network of the same kind has all weights of a shallower one, and more.
    unknown = [key for key in given if key.partition(".")[0] in parts and key not in own]
    return [key for key in missing + unknown if not key.endswith(_BATCH_COUNTER)]


def _load_fitting(module: nn.Module, given: Mapping[str, Tensor]) -> None:
    own = module.state_dict()
    fitting = {key: value for key, value in given.items() if key in own and own[key].shape == value.shape}
    module.load_state_dict({**own, **fitting})

"""The network: torchvision's RetinaNet with c_c, its backbones, anchors, and c_c from vehicle sizes."""

from __future__ import annotations

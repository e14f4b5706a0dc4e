"""Training: presets, weights to start from, Lightning's module and callbacks, the training loop."""

from __future__ import annotations

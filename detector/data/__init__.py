"""Training samples: shards, augmentation, batches."""

from __future__ import annotations

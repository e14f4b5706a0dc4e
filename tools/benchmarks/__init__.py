"""Benchmarks: ratios of run times, measured side by side in one process."""

from __future__ import annotations

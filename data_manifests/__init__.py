"""Data manifests: one TOML file per data set, read by `labelgen.datasets.manifest`."""

from __future__ import annotations

"""Fixtures for the whole suite."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real recordings; the test is skipped where it is not set."""
    value = os.environ.get("LABELGEN_REAL_DATA")
    if not value:
        pytest.skip("LABELGEN_REAL_DATA is not set: no real recordings on this machine")
    return Path(value)


@pytest.fixture
def labelgen(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run the `labelgen` command in a process of its own, in the test's folder."""

    def run(*arguments: object, timeout: float = 200, **env: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "labelgen", *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), **env},
            capture_output=True,
            text=True,
            timeout=timeout,
        )

    return run

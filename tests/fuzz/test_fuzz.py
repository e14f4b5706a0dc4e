"""Damaged and hostile files through the public commands: no traceback, crash, hang or explosion of memory."""

from __future__ import annotations

import sys

import pytest

from tools.studies.fuzz import CLASSES, fuzz

pytest.importorskip("lightning")


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs fork, and limits of memory")
def test_no_damaged_file_ends_in_anything_but_a_result_or_one_line() -> None:
    """A short run of the study, which the command `python -m tools.studies.fuzz` repeats at length."""
    outcomes, failures = fuzz(10 * len(CLASSES), 0)
    assert not failures, "\n".join(f"{f.name}: {f.problem}: {f.change}\n{f.arguments}\n{f.output}" for f in failures)
    assert outcomes.total() == 10 * len(CLASSES)
    assert {key.partition(":")[0] for key in outcomes} == set(CLASSES)

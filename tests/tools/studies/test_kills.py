"""Commands killed at random moments: older results whole, or newer ones."""

from __future__ import annotations

import sys

import pytest

from tools.studies.kills import kills

pytest.importorskip("lightning")
NAMES = ("synth session", "bcs-masks", "merge", "speed", "rectify")


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs fork, and limits of file sizes")
def test_killed_commands_leave_whole_results() -> None:
    """A short run of the study, which the command `python -m tools.studies.kills` repeats at length."""
    outcomes, failures = kills(15, 0, names=NAMES)
    assert not failures, "\n".join(f"{f.name}: {f.how}: {f.problem}\n{f.output}" for f in failures)
    assert outcomes.total() == 15

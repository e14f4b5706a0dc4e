"""Damaged and hostile inputs of every kind through the public commands, each in a process of its own.

    python -m tools.studies.fuzz --count 2000 --seed 0

A case takes good files, changes one by a seeded rule, and runs a command on it. Right is exit code 0 with outputs that
can be, or 2 with a reason in one line. Wrong are tracebacks, ends by a signal, more than 20 s of work, more than 1 GB
of memory beyond that of the imports, and wrong successes: numbers that are none, impossible speeds, invalid shards.
Cases that fail are listed with their seed; `--only CLASS:NUMBER` runs one again.
"""

from __future__ import annotations

from tools.studies.fuzz.cases import CLASSES
from tools.studies.fuzz.runner import Failure, fuzz

__all__ = ["CLASSES", "Failure", "fuzz"]

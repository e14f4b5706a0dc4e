"""The command `python -m tools.studies.fuzz`."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import torch

import tools.studies.fuzz as study
from tools.studies.fuzz import CLASSES, Failure, fuzz


def main() -> None:
    """Parse the options, run and print."""
    parser = argparse.ArgumentParser(description=study.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=2000, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="decides all changes")
    parser.add_argument("--classes", nargs="*", default=[], choices=list(CLASSES), help="kinds; all by default")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument("--only", metavar="CLASS:NUMBER", help="run one case again")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep its files here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    name, _, number = (options.only or "").partition(":")
    outcomes, failures = fuzz(
        options.count, options.seed, classes=options.classes, only=(name, int(number)) if options.only else None,
        keep=options.keep, jobs=options.jobs, report=_report,
    )  # fmt: skip
    for key, value in sorted(outcomes.items()):
        print(f"  {key:<28} {value}")
    print(f"\n{sum(outcomes.values())} cases, {len(failures)} wrong")
    raise SystemExit(1 if failures else 0)


def _report(done: int, failure: Failure | None) -> None:
    """Print what went wrong at once, and every hundredth case how far the run is."""
    if failure is not None:
        print(f"\n{failure.name}: {failure.problem}\n  {failure.change}\n  labelgen {failure.arguments}")
        print("\n".join(f"    {line}" for line in failure.output.splitlines()[-14:]), flush=True)
    elif done % 100 == 0:
        print(f"{done} cases", flush=True)


if __name__ == "__main__":
    main()

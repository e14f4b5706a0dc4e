"""Throughput of the box codec: one million random boxes, decoded and encoded on one thread.

python -m tools.benchmarks.codec [--count 1000000] [--repeat 3]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import numpy as np

from labelgen.geometry import decode_boxes, encode_boxes

__all__ = ["benchmark", "main"]


def benchmark(count: int, repeat: int = 3) -> dict[str, float]:
    """Return the seconds to decode and to encode `count` boxes, the best of `repeat` runs, by name."""
    rng = np.random.default_rng(0)
    corners = np.sort(rng.uniform([0, 0], [640, 360], (count, 2, 2)), axis=1)
    boxes, cc = corners.reshape(-1, 4), rng.uniform(0, 1, count)
    vpu = np.array([-100.0, -150.0])
    vertices = decode_boxes(boxes, cc, vpu)[0]
    return {
        "decode_s": _best_s(lambda: decode_boxes(boxes, cc, vpu), repeat),
        "encode_s": _best_s(lambda: encode_boxes(vertices, vpu), repeat),
    }


def _best_s(call: Callable[[], object], repeat: int) -> float:
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark and print one line per direction; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args(argv)
    for name, seconds in benchmark(args.count, args.repeat).items():
        print(f"{name[:-2]}: {args.count} boxes in {seconds:.2f} s, {args.count / seconds:,.0f} per second, one thread")
    return 0


if __name__ == "__main__":
    sys.exit(main())

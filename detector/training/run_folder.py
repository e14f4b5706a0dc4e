"""The run folder: one training at a time, and no files of an older run beside those of a newer one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lightning.fabric.utilities.rank_zero import rank_zero_only

from labelgen.atomic_files import TEMPORARY_PREFIX
from labelgen.errors import OutputError
from labelgen.output_lock import take_lock

__all__ = ["leftovers_of", "locked_run_folder"]

_LOCK = f"{TEMPORARY_PREFIX}train.lock"


@contextmanager
def locked_run_folder(out: Path) -> Iterator[None]:
    """Make and lock a run folder for the time of the block. Of several processes of one training the first locks it.

    Args:
        out: the folder; deleted at the end if nothing is in it.

    Raises:
        OutputError: another training is at work in it, or it cannot be written.
    """
    if getattr(rank_zero_only, "rank", 0) != 0:
        yield
        return
    if out.exists() and not out.is_dir():
        raise OutputError(f"out {out}: a file of that name is in the way; choose another folder", parameter="out")
    lock = take_lock(out / _LOCK, out)
    try:
        yield
    finally:
        with suppress(OSError):
            (out / _LOCK).unlink()
            out.rmdir()
        lock.close()


def leftovers_of(out: Path) -> list[Path]:
    """Return the checkpoints and pictures of an older run in a folder."""
    return [*out.glob("*.ckpt"), *(out / "pictures").glob("epoch-*.jpg")]

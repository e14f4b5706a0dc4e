"""Check a pickle's instructions before it is loaded: what a short file can cost is bounded by its size.

A pickle is a program for a small stack machine. A few of its bytes can ask for a huge table of memorised values, build
a key whose hash takes years or overflows the processor's stack, or fill the memory. This module runs the same program
on numbers that stand for the values: how many parts have to be hashed for each of them.

Source: the Python standard library, `pickletools` (the instructions and their arguments).
"""

from __future__ import annotations

import mmap
import pickle as p
from dataclasses import dataclass

from labelgen.errors import DataError

__all__ = ["PickleLimits", "scan_pickle"]


@dataclass(frozen=True)
class PickleLimits:
    """What a pickle may cost.

    Args:
        key_parts: parts of a dictionary's key or a set's element, nested ones included. Keys of data are numbers, text
            and pairs of them. A number of more than 8 bytes counts as too many.
        base_bytes: bytes of memory that any file may take.
        bytes_per_byte: bytes of memory for each byte of the file, by this module's rough count. BrnoCompSpeed's ground
            truth, which consists of single numbers, takes 57.
    """

    key_parts: int = 100
    base_bytes: int = 256_000_000
    bytes_per_byte: int = 100


_CAP = 1 << 40
_DIGITS = 20
# Bytes of memory, roughly: a value in its list, and a container with its place in the tables of loading.
_VALUE, _CONTAINER, _MEMO = 48, 320, 112


def _code(*codes: bytes) -> tuple[int, ...]:
    return tuple(code[0] for code in codes)


_FIXED = {
    **dict.fromkeys(_code(p.NONE, p.NEWTRUE, p.NEWFALSE), 0),
    p.BININT[0]: 4,
    p.BININT1[0]: 1,
    p.BININT2[0]: 2,
    p.BINFLOAT[0]: 8,
}
# Bytes of the length that stands before a text or number, and whether it is signed.
_COUNTED = {
    **dict.fromkeys(_code(p.SHORT_BINSTRING, p.SHORT_BINUNICODE, p.SHORT_BINBYTES, p.LONG1), (1, False)),
    **dict.fromkeys(_code(p.BINUNICODE, p.BINBYTES), (4, False)),
    **dict.fromkeys(_code(p.BINSTRING, p.LONG4), (4, True)),
    **dict.fromkeys(_code(p.BINUNICODE8, p.BINBYTES8, p.BYTEARRAY8), (8, False)),
}
_LINES = frozenset(_code(p.INT, p.LONG, p.FLOAT, p.STRING, p.UNICODE))
_NUMBER_LINES = frozenset(_code(p.INT, p.LONG))
_LONGS = frozenset(_code(p.LONG1, p.LONG4))
_EMPTY = frozenset(_code(p.EMPTY_LIST, p.EMPTY_DICT, p.EMPTY_TUPLE, p.EMPTY_SET))
_PUTS = {p.BINPUT[0]: 1, p.LONG_BINPUT[0]: 4}
_GETS = {p.BINGET[0]: 1, p.LONG_BINGET[0]: 4}
_TUPLES = {p.TUPLE1[0]: 1, p.TUPLE2[0]: 2, p.TUPLE3[0]: 3}
# Instructions that take the values above the last mark.
_MARKED = frozenset(_code(p.TUPLE, p.LIST, p.DICT, p.FROZENSET, p.APPENDS, p.SETITEMS, p.ADDITEMS, p.POP_MARK, p.OBJ))
# How many values an instruction takes; it leaves one.
_CALLS = {p.REDUCE[0]: 2, p.BUILD[0]: 2, p.NEWOBJ[0]: 2, p.STACK_GLOBAL[0]: 2, p.NEWOBJ_EX[0]: 3}
_TUPLE, _DICT, _FROZENSET, _SETITEMS, _ADDITEMS = _code(p.TUPLE, p.DICT, p.FROZENSET, p.SETITEMS, p.ADDITEMS)
_MARK, _POP, _POP_MARK, _DUP, _STOP = _code(p.MARK, p.POP, p.POP_MARK, p.DUP, p.STOP)
_PUT, _GET, _MEMOIZE, _APPEND, _SETITEM = _code(p.PUT, p.GET, p.MEMOIZE, p.APPEND, p.SETITEM)
(_BINPERSID,) = _code(p.BINPERSID)
_GLOBAL, _INST, _PROTO, _FRAME, _APPENDS = _code(p.GLOBAL, p.INST, p.PROTO, p.FRAME, p.APPENDS)


class _Scan:
    """The stack machine: each value on its stack is the number of parts that hashing it visits."""

    def __init__(self, data: bytes | mmap.mmap, limits: PickleLimits, start: int, persistent: bool) -> None:
        self.data, self.limits, self.at, self.persistent = data, limits, start, persistent
        self.stack: list[int] = []
        self.marks: list[int] = []
        self.memo: dict[int, int] = {}
        self.memory = 0
        self.allowed = limits.base_bytes + limits.bytes_per_byte * len(data)

    def run(self) -> None:
        """Walk through all instructions up to the end."""
        data, stack, memo = self.data, self.stack, self.memo
        fixed, counted, puts, gets = _FIXED, _COUNTED, _PUTS, _GETS
        while True:
            op = data[self.at]
            self.at += 1
            if op in fixed:
                self.at += fixed[op]
                self.memory += _VALUE
                stack.append(1)
            elif op in counted:
                self._counted(op)
            elif op in puts:
                self._put(self._integer(puts[op]))
            elif op in gets:
                stack.append(memo[self._integer(gets[op])])
            elif op == _MARK:
                self.marks.append(len(stack))
            elif op in _EMPTY:
                stack.append(1)
                self._count(_CONTAINER)
            elif op in _MARKED:
                self._marked(op)
            elif op == _APPEND:
                self._pop(1)
                self._need(1)
            elif op == _SETITEM:
                key, _ = self._pop(2)
                self._need(1)
                self._keys([key])
                self.memory += 2 * _VALUE
            elif op in _TUPLES:
                self._push_tuple(self._pop(_TUPLES[op]))
            elif op in _CALLS:
                self._pop(_CALLS[op])
                stack.append(1)
                self._count(_CONTAINER)
            elif op == _STOP:
                self._need(1)
                self._count(0)
                return
            else:
                self._seldom(op)

    def _seldom(self, op: int) -> None:
        if op in _LINES:
            text = self._line()
            long = op in _NUMBER_LINES and len(text) > _DIGITS
            self.memory += _VALUE + 4 * len(text)
            self.stack.append(_CAP if long else 1)
        elif op in (_GLOBAL, _INST):
            self._line()
            self._line()
            if op == _INST:
                self._above_mark()
            self.stack.append(1)
            self._count(_CONTAINER)
        elif op == _MEMOIZE:
            self._put(len(self.memo))
        elif op in (_PUT, _GET):
            text = self._line()
            if len(text) > _DIGITS:
                raise ValueError("a memorised value's number is too long")
            if op == _PUT:
                self._put(int(text))
            else:
                self.stack.append(self.memo[int(text)])
        elif op == _BINPERSID and self.persistent:
            self._pop(1)
            self.stack.append(1)
            self._count(_CONTAINER)
        elif op == _PROTO:
            self.at += 1
        elif op == _FRAME:
            if self._integer(8) > len(self.data) - self.at:
                raise EOFError("pickle data was truncated")
        elif op == _DUP:
            self._need(1)
            self.stack.append(self.stack[-1])
            self._count(_VALUE)
        elif op == _POP:
            if self.marks and self.marks[-1] == len(self.stack):
                self.marks.pop()
            else:
                self._pop(1)
        else:
            raise ValueError(f"it has the instruction {bytes([op])!r}, which data does not need")

    def _integer(self, size: int, signed: bool = False) -> int:
        start = self.at
        self.at += size
        return int.from_bytes(self.data[start : self.at], "little", signed=signed)

    def _line(self) -> bytes:
        end = self.data.find(b"\n", self.at)
        if end < 0:
            raise EOFError("pickle data was truncated")
        text = self.data[self.at : end]
        self.at = end + 1
        return text

    def _counted(self, op: int) -> None:
        size = self._integer(*_COUNTED[op])
        if not 0 <= size <= len(self.data) - self.at:
            raise EOFError("pickle data was truncated")
        self.at += size
        self.memory += _VALUE + size
        self.stack.append(_CAP if op in _LONGS and size > 8 else 1)

    def _count(self, memory: int) -> None:
        self.memory += memory
        if self.memory > self.allowed:
            raise DataError("it would take far more memory than a file of its size needs")

    def _put(self, number: int) -> None:
        self._need(1)
        if not 0 <= number <= self.at:  # whatever is memorised takes at least one byte
            raise DataError(f"it memorises value number {number}, more than its size can hold")
        self.memo[number] = self.stack[-1]
        self._count(_MEMO)

    def _need(self, count: int) -> None:
        if len(self.stack) - (self.marks[-1] if self.marks else 0) < count:
            raise ValueError("unpickling stack underflow")

    def _pop(self, count: int) -> list[int]:
        self._need(count)
        values = self.stack[-count:]
        del self.stack[-count:]
        return values

    def _above_mark(self) -> list[int]:
        if not self.marks:
            raise ValueError("could not find MARK")
        start = self.marks.pop()
        values = self.stack[start:]
        del self.stack[start:]
        return values

    def _marked(self, op: int) -> None:
        values = self._above_mark()
        if op == _TUPLE:
            self._push_tuple(values)
            return
        if op == _POP_MARK:
            return
        if op in (_DICT, _SETITEMS):
            self._keys(values[::2])
        elif op in (_FROZENSET, _ADDITEMS):
            self._keys(values)
        if op in (_SETITEMS, _ADDITEMS, _APPENDS):
            self._need(1)
        else:
            self.stack.append(1)
        self._count(_CONTAINER + 2 * _VALUE * len(values))

    def _push_tuple(self, values: list[int]) -> None:
        self.stack.append(min(1 + sum(values), _CAP))
        self._count(_CONTAINER)

    def _keys(self, weights: list[int]) -> None:
        if weights and max(weights) > self.limits.key_parts:
            raise DataError("it has a key of very many parts, or a very long number as a key")


def scan_pickle(
    data: bytes | mmap.mmap, limits: PickleLimits | None = None, *, start: int = 0, persistent: bool = False
) -> int:
    """Check that loading a pickle takes memory and time in proportion to its size.

    Args:
        data: the pickle.
        limits: what it may cost; None for the defaults.
        start: where it begins.
        persistent: whether it may name values that lie outside of it, as PyTorch's files do.

    Returns:
        where it ends.

    Raises:
        DataError: it costs more.
        EOFError, LookupError, ValueError: it is damaged, or has instructions that plain data does not need.
    """
    scan = _Scan(data, limits or PickleLimits(), start, persistent)
    try:
        scan.run()
    except IndexError:
        raise EOFError("pickle data was truncated") from None
    return scan.at

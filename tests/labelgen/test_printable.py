"""Text of any origin, made fit to be printed."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from labelgen.printable import hide_passwords, printable, spreadsheet_text
from labelgen.problem_counts import ProblemCounts, count_of


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Köln Süd 日本 🚗.mp4", "Köln Süd 日本 🚗.mp4"),
        ("a\x1b[2Jb", "a\\x1b[2Jb"),
        ("\x9b31m", "\\x9b31m"),
        ("a\rb\nc\td", "a\\rb\\nc\\td"),
        ("gpj.\u202ecod", "gpj.\\u202ecod"),
        ("half \ud83d", "half \\ud83d"),
        ("\x07\x00\x7f", "\\x07\\x00\\x7f"),
        ("\u2028next", "\\u2028next"),
    ],
)
def test_what_steers_a_terminal_is_escaped(text: str, expected: str) -> None:
    assert printable(text) == expected


@given(st.text(st.characters(exclude_categories=[])))
def test_printable_text_can_be_printed_and_is_one_line(text: str) -> None:
    safe = printable(text)
    safe.encode("utf-8")
    assert len(safe.splitlines()) <= 1
    assert "\x1b" not in safe
    assert printable(safe) == safe
    assert printable("a\nb", keep="\n") == "a\nb"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("stream rtsp://me:secret@cam/1: no", "stream rtsp://me:***@cam/1: no"),
        ("http://u:p@ss:w@h:80/x and rtmp://a:b@c", "http://u:***@h:80/x and rtmp://a:***@c"),
        ("http://host:80/a@b", "http://host:80/a@b"),
        ("https://user@host/x", "https://user@host/x"),
    ],
)
def test_passwords_are_hidden(text: str, expected: str) -> None:
    assert hide_passwords(text) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [("=1+1", "'=1+1"), ("@a", "'@a"), ("-x", "'-x"), ("session0", "session0"), ("-", "-"), ("", "")],
)
def test_csv_cells_are_no_formulas(text: str, expected: str) -> None:
    assert spreadsheet_text(text) == expected


def test_problems_are_one_line_for_each_kind() -> None:
    problems = ProblemCounts()
    for number in range(1000):
        problems.add("empty", f"annotation {number}: empty")
    problems.add("not an image", "a.png: not an image", noun="image entry")
    assert problems.lines() == [
        "1000 annotations skipped: empty, such as annotation 0: empty",
        "a.png: not an image; skipped",
    ]
    assert [count_of(n, "image entry") for n in (0, 1, 2)] == ["0 image entries", "1 image entry", "2 image entries"]


def test_passwords_are_looked_for_in_time_that_grows_with_the_text_alone() -> None:
    """Searched from each of its characters, a text like this takes a minute."""
    start = time.perf_counter()
    assert hide_passwords("x" * 100_000 + "://user:secret@camera").endswith("://user:***@camera")
    assert time.perf_counter() - start < 5

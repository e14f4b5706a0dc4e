"""Make text of any origin fit to be printed."""

from __future__ import annotations

import re
import unicodedata

__all__ = ["hide_passwords", "printable", "spreadsheet_text"]

# Control characters, direction marks and other invisible formatting, lone surrogates, line and paragraph separators.
_HIDDEN_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}
# Formatting that scripts and emoji need: the zero-width joiner and non-joiner, and the soft hyphen.
_NEEDED = {"\u200c", "\u200d", "\u00ad"}

# The word before :// begins where no other one ends: otherwise a long text is searched from each of its characters.
_PASSWORD = re.compile(r"((?<![a-z0-9+.-])[a-z][a-z0-9+.-]*://[^/\s:@]*:)[^/\s]+@", re.IGNORECASE)


def printable(text: str, *, keep: str = "") -> str:
    """Return text in which nothing can steer a terminal: hidden characters are written as escapes.

    Names of files, and texts inside files, may hold what clears a screen, changes its title or reverses the text.

    Args:
        text: of any origin.
        keep: characters that stay although they are hidden, such as a line feed in text of several lines.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        char
        if char in keep or char in _NEEDED or unicodedata.category(char) not in _HIDDEN_CATEGORIES
        else char.encode("unicode_escape").decode()
        for char in text
    )


def hide_passwords(text: str) -> str:
    """Return text with the passwords of its URLs replaced, as in rtsp://user:***@camera/1."""
    return _PASSWORD.sub(r"\1***@", text)


def spreadsheet_text(text: str) -> str:
    """Return the text of a CSV cell that no spreadsheet takes for a formula."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") and text != "-" else text

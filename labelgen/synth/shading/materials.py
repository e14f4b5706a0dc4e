"""Materials of a surface, as stored in the fourth channel of a texture."""

from __future__ import annotations

__all__ = ["CHROME", "GLASS", "LAMP", "LIT", "MATTE", "PAINT", "PLATE"]

MATTE, PAINT, GLASS, LAMP, CHROME, PLATE, LIT = range(7)

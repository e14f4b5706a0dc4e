"""What mkdocs calls while it builds the site: adds the page of the command line, made from the commands themselves."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

__all__ = ["on_files"]

# mkdocs loads this file by its path, so the checkout is not on the import path.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


def on_files(files: Files, config: Any) -> Files:
    """Add the generated page to the pages that mkdocs found."""
    from tools.docs.command_line import PAGE, command_line_page

    files.append(File.generated(config, PAGE, content=command_line_page()))
    return files

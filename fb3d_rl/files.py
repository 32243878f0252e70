"""Replace files in one step, so that nothing is ever half-written."""

from __future__ import annotations

import os
from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by ``text`` (UTF-8) in one step: readers see the old or the new file, never half."""
    # surrogateescape: error texts may quote file names whose bytes are not valid UTF-8.
    write_bytes(path, text.encode("utf-8", "surrogateescape"))


def write_bytes(path: Path, *contents: bytes | memoryview) -> None:
    """The same for ``contents``, one after the other, as they are."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    with beside.open("wb") as file:
        file.writelines(contents)
    os.replace(beside, path)

"""Replace files in one step, so that nothing is ever half-written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to write beside ``path`` that takes its place in the end: readers see the old or the new file, never half.

    An error leaves nothing of it, and ``path`` as it was; one of the disk names ``path``.
    """
    # The suffix stays, from which some writers tell the format.
    beside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield beside
        os.replace(beside, path)
    except Exception as error:
        # A full disk names no file, and torch covers it with words of its own.
        cause = error if isinstance(error, OSError) else error.__context__
        if isinstance(cause, OSError) and cause.errno is not None and cause.filename is None:
            raise OSError(cause.errno, os.strerror(cause.errno), str(path)) from error
        raise
    finally:
        beside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by ``text`` (UTF-8) in one step."""
    # surrogateescape: error texts may quote file names whose bytes are not valid UTF-8.
    write_bytes(path, text.encode("utf-8", "surrogateescape"))


def write_bytes(path: Path, *contents: bytes | memoryview) -> None:
    """Replace ``path`` by ``contents``, one after the other, in one step."""
    with replacing(path) as beside, beside.open("wb") as file:
        file.writelines(contents)

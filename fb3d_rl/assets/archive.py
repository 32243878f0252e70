"""Unpack archives from untrusted sources: nothing is written outside the target, which appears whole or not at all."""

from __future__ import annotations

import shutil
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from lzma import LZMAError
from pathlib import Path

from fb3d_rl.errors import UserError

BROKEN = (
    zipfile.BadZipFile, tarfile.TarError, zlib.error, LZMAError, struct.error,
    EOFError, LookupError, OSError, OverflowError, RuntimeError, ValueError,
)  # fmt: skip
"""What the readers raise for files that are no archives, are damaged or encrypted, or lead out of the target."""


def unpack(archive: Path, out: Path, progress: Callable[[int], None] = lambda size: None) -> None:
    """Unpack a .zip or .tar (.gz, .bz2, .xz) archive as the folder ``out``.

    Entries and links that lead outside of it, and devices, are refused or written inside.

    Args:
        archive: the file.
        out: the folder; it must not exist yet.
        progress: called with the size of each file, bytes, after it is written.

    Raises:
        UserError: the archive is missing, broken or unsafe, does not fit the disk, or ``out`` exists.
    """
    if not archive.is_file():
        raise UserError(f"{archive} is no file; name a .zip or .tar archive")
    if out.exists():
        raise UserError(f"{out} exists already; name a folder that does not")
    out.parent.mkdir(parents=True, exist_ok=True)
    room = shutil.disk_usage(out.parent).free
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as partial:
        inside = Path(partial) / out.name
        inside.mkdir()
        try:
            if zipfile.is_zipfile(archive):
                _unpack_zip(archive, inside, room, progress)
            else:
                _unpack_tar(archive, inside, room, progress)
        except BROKEN as error:
            if isinstance(error, OSError) and error.filename is not None:  # an error of the disk, not of the archive
                raise
            raise UserError(f"{archive} cannot be unpacked ({error}); download it again") from error
        inside.rename(out)


def _unpack_zip(archive: Path, out: Path, room: int, progress: Callable[[int], None]) -> None:
    with zipfile.ZipFile(archive) as file:
        _fits(archive, sum(entry.file_size for entry in file.infolist()), room)
        for entry in file.infolist():
            file.extract(entry, out)  # takes ".." and roots out of names, and reads no more than file_size
            progress(entry.file_size)


def _unpack_tar(archive: Path, out: Path, room: int, progress: Callable[[int], None]) -> None:
    with tarfile.open(archive) as file:
        size = 0
        for entry in file:
            size += entry.size
            _fits(archive, size, room)
            file.extract(entry, out, filter="data")
            progress(entry.size)


def _fits(archive: Path, size: int, room: int) -> None:
    if size > room:
        raise UserError(f"{archive} holds more than the {room / 1e9:.1f} GB that are free; unpack it elsewhere")

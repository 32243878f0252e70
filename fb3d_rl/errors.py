"""Errors that a user can fix; each ends a command with one sentence and an exit code."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable

from fb3d_rl.interrupt import caused


class UserError(Exception):
    """An error that the user caused and can fix; its message is one clear sentence.

    Commands print only the message and end with exit code 2.
    """


class Interrupted(UserError):
    """Ctrl-C ended the work; the message says what is kept."""


def exit_code(work: Callable[[], int | None], interrupted: str) -> int:
    """Run a command and turn an error that the user can fix into one sentence on stderr.

    Args:
        work: the command; returns its exit code, or None for 0.
        interrupted: what Ctrl-C leaves behind.

    Returns:
        The exit code: 2 after an error.
    """
    try:
        return work() or 0
    except Interrupted as error:
        sentence = str(error)
    except (Exception, KeyboardInterrupt) as error:
        if caused(error):
            sentence = f"interrupted; {interrupted}"
        elif isinstance(error, UserError):
            sentence = str(error)
        elif isinstance(error, OSError) and (disk_error := of_disk(error)) is not None:
            sentence = disk_error
        else:
            raise
    print(f"error: {sentence}", file=sys.stderr)
    return 2


def of_disk(error: OSError) -> str | None:
    """The sentence for an error of the disk or a file; None for other errors."""
    if error.filename is not None:
        return f"{error.filename} cannot be written or read ({error.strerror})"
    full = (errno.ENOSPC, getattr(errno, "EDQUOT", None))
    return f"the disk has no room ({error.strerror})" if error.errno in full else None

"""Errors that a user can mend, and the one sentence and exit code in which they end a command."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable

from fb3d_rl.interrupt import caused


class UserError(Exception):
    """An error that the user caused and can mend; its message is one clear sentence.

    Commands print the message alone and end with exit code 2.
    """


class Interrupted(UserError):
    """Ctrl-C ended the work; the message says what is kept."""


def exit_code(work: Callable[[], int | None], interrupted: str) -> int:
    """Run a command and turn what the user can mend into one sentence on stderr.

    Args:
        work: the command; returns its exit code, or None for 0.
        interrupted: what Ctrl-C leaves behind.

    Returns:
        The exit code: 2 after an error.
    """
    try:
        return work() or 0
    except UserError as error:
        sentence = str(error)
    except (Exception, KeyboardInterrupt) as error:
        if caused(error):
            sentence = f"interrupted; {interrupted}"
        elif isinstance(error, OSError) and (found := of_disk(error)) is not None:
            sentence = found
        else:
            raise
    print(f"error: {sentence}", file=sys.stderr)
    return 2


def of_disk(error: OSError) -> str | None:
    """What the disk or a file is at fault of; None if it is not."""
    if error.filename is not None:
        return f"{error.filename} cannot be written or read ({error.strerror})"
    full = (errno.ENOSPC, getattr(errno, "EDQUOT", None))
    return f"the disk has no room ({error.strerror})" if error.errno in full else None

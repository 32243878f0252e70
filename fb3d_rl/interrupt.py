"""Ctrl-C ends a command in one line, from its first moment to its last.

The imports here are of modules that Python has loaded when it starts: what takes time before :func:`expect` is called
could be interrupted.
"""

from __future__ import annotations

import _signal
import _thread
import atexit
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType
    from typing import Any, NoReturn

CODE = 2
"""Exit code after Ctrl-C."""

_begun = False  # run() was called
_waiting = False  # Ctrl-C was pressed during an import, and is to come again after it
_raised = False  # Ctrl-C became an exception, which a library may have swallowed


def expect() -> None:
    """Have Ctrl-C end this command in one line from now on. A launch script calls it before anything that takes time.

    While nothing but the script's own imports is under way, that is at once: an exception could be lost in them, or
    come out as another one. Later it is a ``KeyboardInterrupt``, and one that is lost all the same comes again.
    """
    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:  # not ignored, as it is in the background
        _signal.signal(_signal.SIGINT, _pressed)
        sys.unraisablehook = _lost
        atexit.register(_signal.signal, _signal.SIGINT, _signal.SIG_IGN)  # the last of all that is done


def run(main: Callable[[], int | None]) -> NoReturn:
    """End the process with the exit code of ``main``, with one line if Ctrl-C is what ends it."""
    global _begun
    _begun = True
    try:
        code: Any = main()
    except SystemExit as end:
        code = end.code
    except BaseException as error:
        if not caused(error):
            raise
        print("error: interrupted", file=sys.stderr)
        code = CODE
    if _signal.getsignal(_signal.SIGINT) is _pressed:  # what is done at exit would print an exception
        _signal.signal(_signal.SIGINT, lambda *_: os._exit(code if isinstance(code, int) else int(code is not None)))
    sys.exit(code)


class Deferred:
    """Where Ctrl-C waits for the end of the ``with`` block.

    For calls of libraries that catch every exception: a ``KeyboardInterrupt`` in them would be lost, or come out as a
    statement about the file that they read.
    """

    blocks = 0
    pressed = False

    def __enter__(self) -> None:
        Deferred.blocks += 1

    def __exit__(self, *_: object) -> None:
        Deferred.blocks -= 1
        if not Deferred.blocks and Deferred.pressed:
            Deferred.pressed = False
            _signal.raise_signal(_signal.SIGINT)


def caused(error: BaseException) -> bool:
    """Whether Ctrl-C is what ``error`` comes from.

    Clean-up that it interrupts may raise another exception, and a library that catches it may report one of its own.
    """
    if _raised:
        return True
    seen: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        if isinstance(cause, KeyboardInterrupt):
            return True
        seen.add(id(cause))
        cause = cause.__cause__ or cause.__context__
    return False


def _pressed(number: int, frame: FrameType | None) -> None:
    global _waiting, _raised
    if Deferred.blocks:
        Deferred.pressed = True
        return
    importer = _importer(frame)
    if _begun and importer is None:
        _raised = True
        raise KeyboardInterrupt
    if not _begun or _waiting or importer == "__main__":
        os.write(2, b"error: interrupted before the work began\n" if not _waiting else b"error: interrupted\n")
        os._exit(CODE)
    _waiting = True
    _again()


def _importer(frame: FrameType | None) -> str | None:
    """Name of the module in which the outermost import began that is under way; None if there is none."""
    found = None
    while frame is not None:
        back = frame.f_back
        if _imports(frame) and back is not None and not _imports(back):
            found = str(back.f_globals.get("__name__"))
        frame = back
    return found


def _imports(frame: FrameType) -> bool:
    return frame.f_code.co_filename.startswith("<frozen importlib")


def _again() -> None:
    """Press Ctrl-C again when no import is under way."""
    import threading
    import time

    def press() -> None:
        global _waiting
        main = threading.main_thread().ident
        time.sleep(0.05)
        while main is not None and _importer(sys._current_frames().get(main)) is not None:
            time.sleep(0.05)
        _waiting = False
        if main is not None and hasattr(_signal, "pthread_kill"):
            _signal.pthread_kill(main, _signal.SIGINT)  # which also ends a wait in a system call
        else:
            _thread.interrupt_main()

    threading.Thread(target=press, daemon=True).start()


def _lost(unraisable: Any) -> None:
    """Where Python cannot raise an exception, as in a finalizer, it would print it and go on."""
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        _again()
    else:
        sys.__unraisablehook__(unraisable)

"""The user's own code by name: ``package.module:object``, from what is installed and from the working directory."""

from __future__ import annotations

import importlib
import re
import sys
import traceback
from pathlib import Path
from typing import Any

from fb3d_rl.errors import UserError

NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


def plugin(target: str, key: str, folder: str | None = None) -> Any:
    """The object of the name "package.module:object".

    Args:
        target: the name.
        key: of the configuration, for messages.
        folder: where modules are looked for after those that are installed; None: the working directory.

    Raises:
        UserError: there is no such module or object, or importing it fails.
    """
    if NAME.fullmatch(target) is None:
        raise UserError(f"{key}={target} names nothing: give package.module:object")
    place = folder or str(Path.cwd())
    if place not in sys.path:
        sys.path.append(place)  # at the end, so that a file of the user's hides no module of a library
    module, _, path = target.partition(":")
    importlib.invalidate_caches()  # the file may be new
    try:
        found: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            raise UserError(
                f"{key}={target}: there is no module {error.name}, neither installed nor in {place}"
            ) from error
        raise UserError(f"{key}={target} cannot be imported: {said(error)}") from error
    except (Exception, SystemExit) as error:  # noqa: BLE001, it is code of others
        raise UserError(f"{key}={target} cannot be imported: {said(error)}") from error
    for name in path.split("."):
        if not hasattr(found, name):
            others = [other for other in vars(found) if not other.startswith("_") and callable(getattr(found, other))]
            has = f"; it has {', '.join(others[:8])}" if others else ""
            raise UserError(f"{key}={target}: {module} has no {name}{has}")
        found = getattr(found, name)
    return found


def said(error: BaseException) -> str:
    """An exception of the user's code in one line, with the place where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    mine = [frame for frame in frames if "site-packages" not in frame.filename] or frames
    where = f" ({Path(mine[-1].filename).name}, line {mine[-1].lineno})" if mine else ""
    return " ".join(f"{type(error).__name__}: {error}{where}".split())

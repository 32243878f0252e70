"""viser's server, for this machine only: its page loads nothing from the internet, and it serves its own files only.

The page of viser 0.2 fetches Google Analytics, and its server follows paths with dots to files outside its
folder. Versions from 1.0 on do neither, but want an older rich than ``requirements.lock`` holds.
"""

from __future__ import annotations

import io
import re
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

HOST = "127.0.0.1"
"""Only this machine reaches the page, since a visitor may run the policy."""


def start_server(port: int, name: str) -> Any:
    """A ``viser.ViserServer`` called ``name`` that listens on ``port``, or on the next free one if it is taken."""
    import viser
    from viser import infra

    class Closed(infra.WebsockServer):
        def __init__(self, **kwargs: Any) -> None:
            super().__init__(**{**kwargs, "http_server_root": _Client(kwargs["http_server_root"])})

    # viser has no setting for the folder that it serves; so the folder is replaced in the call of its web server.
    with patch.object(infra, "WebsockServer", Closed), redirect_stdout(io.StringIO()):  # it has a banner of its own
        return viser.ViserServer(host=HOST, port=port, label=name, verbose=False)


class _Client:
    """The files of viser's web client below ``root``, by name; its page without scripts of other hosts."""

    def __init__(self, root: Path) -> None:
        self._root, self._own = root.resolve(), tempfile.TemporaryDirectory(prefix="fb3d_rl_page_")
        page = (root / "index.html").read_text(encoding="utf-8")
        self._page = Path(self._own.name) / "index.html"
        self._page.write_text(re.sub(r'<script[^>]*\bsrc="https?:[^>]*>\s*</script>', "", page), encoding="utf-8")

    def __truediv__(self, name: str) -> Path:
        """The path of the file of that name; one that does not exist if it is not the client's."""
        path = (self._root / name).resolve()
        if self._root not in path.parents:
            return Path(self._own.name) / "nowhere"
        return self._page if path == self._root / "index.html" else path

"""A cache on disk of the objects that were read, by the content of their files.

Parsing the text of an object's meshes takes fifty times as long as reading its entry here. An entry begins with the
digest of the rest of it; one that does not match, or is of another version, is ignored. The folder may be deleted at
any time.
"""

from __future__ import annotations

import hashlib
import io
import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
import trimesh

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link, Mesh, Mimic
from fb3d_rl.files import write_bytes

VERSION = 4
"""Version of the entries and of the reader whose results they hold; raise it when either changes."""

WARNED = "FB3D_CACHE_WARNED"
"""Environment variable that is set once the user was warned that the cache cannot be written."""

DIGEST = hashlib.sha256().digest_size

Parsed = tuple[tuple[Link, ...], tuple[str, ...], tuple[str, ...]]
"""An object's links, the remarks of its reader, and those of them on lost geometry."""


def cache_folder() -> Path:
    """The folder of the entries: ``FB3D_CACHE``, or the user's cache folder of this platform."""
    chosen = os.environ.get("FB3D_CACHE")
    return Path(chosen) if chosen else platformdirs.user_cache_path("fb3d_rl")


def digest_of(folder: Path, files: Iterable[Path]) -> str:
    """SHA-256 of the names and contents of a folder's ``files``: independent of where the folder is."""
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        digest.update(f"\0{file.relative_to(folder).as_posix()}\0{len(content)}\0".encode("utf-8", "surrogateescape"))
        digest.update(content)
    return digest.hexdigest()


def content_digest(obj: ArticulatedObject) -> str:
    """A digest of the object: of its files, or of its links if it was made in memory."""
    return obj.content or hashlib.sha256(_pack((obj.links, (), ()))).hexdigest()


def cached(digest: str, read: Callable[[], Parsed]) -> Parsed:
    """The result of ``read`` for files of this content (:func:`digest_of`), which is called if no entry has it.

    If entries cannot be written, objects are read again each time; a note says so once.
    """
    key = hashlib.sha256(f"{VERSION} {trimesh.__version__} {digest}".encode())
    entry = cache_folder() / f"objects/{key.hexdigest()}"
    with suppress(OSError):
        stored = memoryview(entry.read_bytes())
        if hashlib.sha256(stored[DIGEST:]).digest() == stored[:DIGEST]:
            return _unpack(stored[DIGEST:])
    parsed = read()
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        payload = _pack(parsed)
        write_bytes(entry, hashlib.sha256(payload).digest(), payload)
    except OSError as error:
        _warn(error)
    return parsed


def _warn(error: OSError) -> None:
    """Print once for all processes of a command that there is no cache."""
    process = multiprocessing.current_process()
    # Workers that start later inherit the variable; of those that start together only the first prints.
    if WARNED in os.environ or not (multiprocessing.parent_process() is None or process.name.endswith("-1")):
        return
    os.environ[WARNED] = "1"
    print(
        f"note: the cache {cache_folder()} cannot be written ({error.strerror}), so objects are read more slowly; "
        "FB3D_CACHE=DIR chooses another folder",
        file=sys.stderr,
    )


def _pack(parsed: Parsed) -> memoryview:
    """A table in JSON, then the vertices [V, 3] and faces [F, 3] of all meshes, each mesh once."""
    links, dropped, lost = parsed
    meshes = {id(mesh): mesh for link in links for mesh in (*link.visuals, *link.collisions)}
    number = {key: k for k, key in enumerate(meshes)}

    def joint(link: Link) -> object:
        if link.joint is None:
            return None
        entry = {**asdict(link.joint), "origin": link.joint.origin.tolist(), "axis": [*link.joint.axis]}
        if link.joint.mimic is None:
            del entry["mimic"]  # as it was before there were any: what is derived from these bytes stays the same
        return entry

    table = {
        "links": [
            {
                "name": link.name,
                "semantic": link.semantic,
                "parent": link.parent,
                "joint": joint(link),
                "visuals": [number[id(mesh)] for mesh in link.visuals],
                "collisions": [number[id(mesh)] for mesh in link.collisions],
            }
            for link in links
        ],
        "dropped": dropped,
        "lost": lost,
        "meshes": [(len(mesh.vertices), len(mesh.faces)) for mesh in meshes.values()],
    }
    out = io.BytesIO()
    nothing = np.zeros((0, 3))
    for array in (
        np.frombuffer(json.dumps(table).encode(), dtype=np.uint8),
        np.concatenate([nothing, *(mesh.vertices for mesh in meshes.values())]),
        np.concatenate([nothing, *(mesh.faces for mesh in meshes.values())]).astype(np.int32),
    ):
        np.save(out, array, allow_pickle=False)
    return out.getbuffer()


def _unpack(payload: memoryview) -> Parsed:
    stream = io.BytesIO(payload)
    text, vertices, faces = (np.load(stream, allow_pickle=False) for _ in range(3))
    table = json.loads(text.tobytes())
    counts = np.array(table["meshes"], dtype=np.int64).reshape(-1, 2)
    ends = counts.cumsum(0)[:-1]
    meshes = [
        Mesh(corners, triangles)
        for corners, triangles in zip(
            np.split(vertices, ends[:, 0]), np.split(faces.astype(np.int64), ends[:, 1]), strict=True
        )
    ]

    def joint(entry: dict[str, Any] | None) -> Joint | None:
        if entry is None:
            return None
        arrays = {key: np.array(entry[key], dtype=np.float64) for key in ("origin", "axis")}
        lower, upper = entry["limits"]
        mimic = Mimic(*entry["mimic"]) if "mimic" in entry else None
        return Joint(**{**entry, **arrays, "limits": (lower, upper), "mimic": mimic})

    links = tuple(
        Link(
            **{
                **entry,
                "joint": joint(entry["joint"]),
                "visuals": tuple(meshes[k] for k in entry["visuals"]),
                "collisions": tuple(meshes[k] for k in entry["collisions"]),
            }
        )
        for entry in table["links"]
    )
    return links, tuple(table["dropped"]), tuple(table["lost"])

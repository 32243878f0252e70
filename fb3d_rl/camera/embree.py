"""Embree scenes, on one device per process."""

from __future__ import annotations

import functools
import os

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.errors import UserError

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore import EmbreeDevice
    from embreex.rtcore_scene import EmbreeScene
except ImportError as error:  # no wheel for this platform
    raise UserError("ray casting needs the package embreex; install it with `pip install embreex`") from error


@functools.cache
def _device() -> EmbreeDevice:
    """One device for all scenes: each takes one of the process's 1024 thread-local keys."""
    return EmbreeDevice()


def use_one_thread() -> None:
    """Let Embree build its scenes in the calling thread alone, if none was built yet: it would start as many threads as
    there are cores, in each of as many worker processes. Has no effect outside Linux.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})  # what it counts, once
    try:
        triangle_scene(np.eye(3, dtype=np.float32)[None]).run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    finally:
        os.sched_setaffinity(0, allowed)


def triangle_scene(vertices: NDArray[np.float32], faces: NDArray[np.int32] | None = None) -> EmbreeScene:
    """A static scene of triangles, ready for ``run(origins, directions, ...)``.

    Args:
        vertices: [V, 3], or the corners [F, 3, 3] of each triangle.
        faces: [F, 3] indices of vertices; not with corners.
    """
    scene = EmbreeScene(_device())
    TriangleMesh(scene, vertices, faces)
    return scene

"""Embree scenes, on one device per process."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.contract import UserError

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore import EmbreeDevice
    from embreex.rtcore_scene import EmbreeScene
except ImportError as error:  # no wheel for this platform
    raise UserError("ray casting needs the package embreex; install it with `pip install embreex`") from error


@functools.cache
def _device() -> EmbreeDevice:
    """Each device takes one of the 1024 thread-local keys that a process has, and a scene makes its own unless told."""
    return EmbreeDevice()


def triangle_scene(triangles: NDArray[np.float32]) -> EmbreeScene:
    """A static scene of ``triangles`` [F, 3, 3], ready for ``run(origins, directions, ...)``."""
    scene = EmbreeScene(_device())
    TriangleMesh(scene, triangles)
    return scene

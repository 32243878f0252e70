"""Embree's threads."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import os
import numpy as np
from fb3d_rl.camera import embree

before = len(os.listdir("/proc/self/task"))
allowed = os.sched_getaffinity(0)
embree.use_one_thread()
assert os.sched_getaffinity(0) == allowed
corners = np.random.default_rng(0).random((50_000, 3, 3)).astype(np.float32)
scene = embree.triangle_scene(corners)
scene.run(corners[:10, 0], corners[:10, 1])
print(len(os.listdir("/proc/self/task")) - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="threads are kept away on Linux")
def test_scenes_are_built_in_the_calling_thread_alone() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.strip() == "0", done.stderr

"""The kernel for GPUs where there is none: run by Triton's interpreter, and compiled down to machine code."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton")
pytestmark = pytest.mark.slow

INTERPRETED = """
import torch
from fb3d_rl.geometry import points as ops
from fb3d_rl.geometry.farthest_triton import farthest_point_sample

points = torch.rand(5, 300, 3, generator=torch.Generator().manual_seed(0))
points[1, 100:] = points[1, :1]
valid = torch.ones(5, 300, dtype=torch.bool)
valid[2, :50] = valid[3, 200:] = valid[4] = False
assert torch.equal(farthest_point_sample(points, 120, valid), ops.farthest_point_sample(points, 120, valid))
"""

COMPILED = """
import triton
from triton.backends.compiler import GPUTarget
from fb3d_rl.geometry.farthest_triton import LARGEST, sample

kinds = {"points": "*fp32", "valid": "*i1", "chosen": "*i64", "count": "i32", "n": "i32", "block": "constexpr"}
for block in (256, 2048, LARGEST):
    for generation in (75, 80, 90):
        source = triton.compiler.ASTSource(fn=sample, signature=kinds, constexprs={"block": block})
        assert triton.compile(source, target=GPUTarget("cuda", generation, 32), options={"num_warps": 8}).asm["cubin"]
"""


@pytest.mark.parametrize(("program", "interpret"), [(INTERPRETED, "1"), (COMPILED, "0")])
def test_the_kernel_chooses_as_pytorch_does_and_compiles(program: str, interpret: str) -> None:
    # Triton decides between its interpreter and its compiler when it is imported.
    environment = os.environ | {"TRITON_INTERPRET": interpret}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr

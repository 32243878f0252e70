"""The kernels for GPUs where there is none: run by Triton's interpreter, and compiled down to machine code."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton")
pytestmark = pytest.mark.slow

SAMPLING = """
import torch
from fb3d_rl.geometry import points as ops
from fb3d_rl.geometry.farthest_triton import farthest_point_sample

points = torch.rand(5, 300, 3, generator=torch.Generator().manual_seed(0))
points[1, 100:] = points[1, :1]
valid = torch.ones(5, 300, dtype=torch.bool)
valid[2, :50] = valid[3, 200:] = valid[4] = False
assert torch.equal(farthest_point_sample(points, 120, valid), ops.farthest_point_sample(points, 120, valid))
"""

NEIGHBORS = """
import torch
from fb3d_rl.geometry import neighbors_triton as kernels
from fb3d_rl.geometry import points as ops
from fb3d_rl.models.delayed import pooled_max

generator = torch.Generator().manual_seed(0)
points = torch.rand(4, 300, 3, generator=generator)
points[1, 100:] = points[1, :1]
valid = torch.ones(4, 300, dtype=torch.bool)
valid[2, :50] = valid[3, 200:] = False
centres = points[:, :40] + 0.01
index, mask = kernels.ball_query(points, centres, 0.3, 20, valid)
expected, real = ops.ball_query(points, centres, 0.3, 20, valid)
assert torch.equal(index, expected) and torch.equal(mask, real)
index, mask = kernels.ball_query(points, centres + 5.0, 0.3, 20, valid)  # nothing is near
assert not mask.any() and (index == 0).all()

some = valid[:, :40].clone()
some[0, 30:] = False
squared, index = kernels.three_nearest(centres, points, some)
true, expected = ops.knn(centres, points, 3, some)
torch.testing.assert_close(squared, true)
assert torch.equal(index[[0, 3]], expected[[0, 3]])  # in the others, many points are equally near

rows = torch.randn(1200, 48, generator=generator, requires_grad=True)
index, mask = ops.ball_query(points, centres, 0.3, 20, valid)
index, mask = (index + 300 * torch.arange(4)[:, None, None]).flatten(0, 1), mask.flatten(0, 1)
weight = torch.randn(160, 48, generator=generator)
best, expected = kernels.largest_rows(rows, index), pooled_max(rows, index, mask)
assert torch.equal(best, expected)
torch.testing.assert_close(*(torch.autograd.grad((found * weight).sum(), rows)[0] for found in (best, expected)))
"""

NORM = """
import torch
from fb3d_rl.models import norm_triton
from fb3d_rl.models.dense import _PaddedNorm

generator = torch.Generator().manual_seed(0)
for clouds, points, channels in ((3, 50, 64), (2, 70, 32), (2, 33, 257)):
    rows = (torch.randn(clouds * points, channels, generator=generator) * 3 + 2).requires_grad_()
    present = (torch.rand(clouds, 1, points, generator=generator) < 0.8).float()
    scale, shift = (torch.randn(channels, generator=generator).requires_grad_() for _ in range(2))
    plain = _PaddedNorm.apply(rows, present, scale, shift, 1e-5)
    given = rows.detach(), present.flatten(), scale.detach(), shift.detach(), 1e-5
    output, mean, variance, count = norm_triton.normalized(*given)
    for mine, theirs in zip((output, mean, variance, count), plain, strict=True):
        torch.testing.assert_close(mine, theirs.detach(), rtol=1e-4, atol=1e-5)
    gradient = torch.randn(output.shape, generator=generator)
    inverse = (variance + 1e-5).rsqrt()
    mine = norm_triton.gradients(gradient, rows.detach(), output, present.flatten(), mean, inverse, scale.detach())
    # Padding has no gradient, and gives none.
    expected = torch.autograd.grad(plain[0], (rows, scale, shift), gradient * present.view(-1, 1))
    for a, b in zip(mine, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
    assert (mine[0][present.flatten() == 0] == 0).all()
"""

COMPILED = """
import triton
from triton.backends.compiler import GPUTarget
from fb3d_rl.geometry import farthest_triton, neighbors_triton
from fb3d_rl.models import norm_triton


def compiled(kernel, arguments, **constants):
    kinds = {"f": "*fp32", "b": "*i1", "l": "*i64", "n": "*i32", "i": "i32", "x": "fp32"}
    names = kernel.arg_names
    signature = dict(zip(names, (kinds[kind] for kind in arguments))) | {name: "constexpr" for name in constants}
    assert list(signature) == names, signature
    for generation in (75, 80, 90):
        source = triton.compiler.ASTSource(fn=kernel, signature=signature, constexprs=constants)
        assert triton.compile(source, target=GPUTarget("cuda", generation, 32), options={"num_warps": 8}).asm["cubin"]


for block in (256, 2048, farthest_triton.LARGEST):
    compiled(farthest_triton.sample, "fbli", count=240, block=block)
    compiled(neighbors_triton.inside_balls, "fbflnxiii", block=block, slots=64)
for block in (64, 256):
    compiled(neighbors_triton.nearest, "fbflfii", block=block, rows=neighbors_triton.QUERIES)
    compiled(neighbors_triton.largest, "flfli", most=64, block=block)
    size = norm_triton.VALUES // block
    for kernel, tensors in (("moments", 3), ("apply", 4), ("slopes", 6), ("spread", 9)):
        compiled(getattr(norm_triton, kernel), "f" * tensors + "ii", size=size, block=block)
"""


@pytest.mark.parametrize(
    ("program", "interpret"), [(SAMPLING, "1"), (NEIGHBORS, "1"), (NORM, "1"), (COMPILED, "0")],
    ids=["sampling", "neighbors", "norm", "compiled"],
)  # fmt: skip
def test_the_kernels_do_as_pytorch_does_and_compile(program: str, interpret: str) -> None:
    # Triton decides between its interpreter and its compiler when it is imported.
    environment = os.environ | {"TRITON_INTERPRET": interpret}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr

"""Shortest rotations between vectors, against scipy and their own definitions."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fb3d_rl.geometry.transforms import alignment, length, normalize, rotate

PAIRS = torch.randn(60, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
A, B = PAIRS.unbind(1)
DIAGONALS = torch.tensor(
    [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=torch.float64
)


def close(actual: Tensor, expected: Tensor | np.ndarray | float, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(actual, expected, rtol=0, atol=atol)


def test_rotate_is_scipys() -> None:
    close(rotate(A, 2 * B), Rotation.from_rotvec(2 * B.numpy()).apply(A.numpy()))
    close(rotate(A, torch.zeros_like(A)), A, atol=0)


def test_alignment_takes_source_to_target_the_shortest_way() -> None:
    turn = alignment(A, B)
    close(normalize(rotate(A, turn)), normalize(B), atol=1e-10)
    close(length(turn)[:, 0], (normalize(A) * normalize(B)).sum(-1).acos(), atol=1e-7)
    close((turn * A).sum(-1), 0.0, atol=1e-10)
    # scipy's answer for one pair of vectors is the shortest rotation, too.
    best, _ = Rotation.align_vectors(normalize(B)[:1].numpy(), normalize(A)[:1].numpy())
    close(turn[0], best.as_rotvec(), atol=1e-6)


def test_alignment_of_opposite_vectors_turns_by_pi_across_them() -> None:
    source = torch.cat([DIAGONALS, A])
    turn = alignment(source, -2.5 * source)
    close(length(turn), math.pi)
    close(rotate(source, turn), -source, atol=1e-10)


def test_alignment_near_opposite_vectors_is_right() -> None:
    source, across = normalize(A), normalize(torch.linalg.cross(A, B))
    for gap in (1e-2, 1e-4, 1e-6):
        target = -math.cos(gap) * source + math.sin(gap) * across
        close(rotate(source, alignment(source, target)), target, atol=1e-9)


def test_alignment_of_parallel_or_zero_vectors_is_no_turn() -> None:
    zero = torch.zeros_like(A)
    for source, target in ((A, 3 * A), (zero, A), (A, zero), (zero, zero)):
        close(alignment(source, target), 0.0, atol=1e-7)


def test_pairs_of_all_kinds_in_one_batch_do_not_mix() -> None:
    source, target = torch.stack([A[0], A[1], A[2]]), torch.stack([B[0], -A[1], 2 * A[2]])
    for i, turn in enumerate(alignment(source, target)):
        assert torch.equal(turn, alignment(source[i : i + 1], target[i : i + 1])[0])

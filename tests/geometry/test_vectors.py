"""Single vectors, against scipy and their own definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fb3d_rl.geometry import vectors as vec

PAIRS = np.random.default_rng(0).normal(size=(60, 2, 3))
DIAGONALS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)


def close(actual: object, expected: object, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(actual, expected, rtol=0, atol=atol)


def test_length_normalize_and_cross_are_numpys() -> None:
    for a, b in PAIRS:
        close(vec.length(a), np.linalg.norm(a))
        close(vec.normalize(a), a / np.linalg.norm(a))
        close(vec.cross(a, b), np.cross(a, b))
    close(vec.normalize(np.array([1e-13, 0.0, 0.0])), np.zeros(3), atol=0)


def test_rotate_is_scipys() -> None:
    for a, b in PAIRS:
        close(vec.rotate(a, 2 * b), Rotation.from_rotvec(2 * b).apply(a))
        close(vec.rotate(a, np.zeros(3)), a, atol=0)


def test_alignment_takes_source_to_target_the_shortest_way() -> None:
    for source, target in PAIRS:
        turn = vec.alignment(source, target)
        close(vec.normalize(vec.rotate(source, turn)), vec.normalize(target), atol=1e-10)
        close(vec.length(turn), math.acos(vec.normalize(source) @ vec.normalize(target)), atol=1e-7)
        close(turn @ source, 0.0, atol=1e-10)
    # scipy's answer for one pair of vectors is the shortest rotation, too.
    best, _ = Rotation.align_vectors(vec.normalize(target)[None], vec.normalize(source)[None])
    close(turn, best.as_rotvec(), atol=1e-6)


@pytest.mark.parametrize("source", [*DIAGONALS, *PAIRS[:8, 0]])
def test_alignment_of_opposite_vectors_turns_by_pi_across_them(source: np.ndarray) -> None:
    turn = vec.alignment(source, -2.5 * source)
    close(vec.length(turn), math.pi)
    close(vec.rotate(source, turn), -source, atol=1e-10)


def test_alignment_near_opposite_vectors_is_right() -> None:
    for a, b in PAIRS:
        source, across = vec.normalize(a), vec.normalize(np.cross(a, b))
        for gap in (1e-2, 1e-4, 1e-6):
            target = -math.cos(gap) * source + math.sin(gap) * across
            close(vec.rotate(source, vec.alignment(source, target)), target, atol=1e-9)


def test_alignment_of_parallel_or_zero_vectors_is_no_turn() -> None:
    zero = np.zeros(3)
    for axis, _ in PAIRS:
        for source, target in ((axis, 3 * axis), (zero, axis), (axis, zero), (zero, zero)):
            close(vec.alignment(source, target), zero, atol=1e-7)

"""Single 3-vectors in NumPy, float64: for decisions about one gripper, where tensor operations are slower."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
"""[3]."""


def length(vector: Vector) -> float:
    """Euclidean norm."""
    return math.sqrt(vector @ vector)


def normalize(vector: Vector, eps: float = 1e-12) -> Vector:
    """Scale a vector to unit length; one shorter than ``eps`` becomes 0."""
    norm = length(vector)
    return vector / norm if norm > eps else np.zeros_like(vector)


def cross(a: Vector, b: Vector) -> Vector:
    """The vector a x b, in a tenth of the time of ``numpy.cross``."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def alignment(source: Vector, target: Vector) -> Vector:
    """Rotation vector (rad) of the shortest rotation that takes ``source`` to ``target``.

    Supplement I.F with its two errors corrected: the angle is ``phi_12`` about the *unit* axis ``v1 x v2 / |v1 x v2|``
    (the text halves ``omega`` in place of ``phi_12`` and leaves the axis unnormalised), and opposite vectors turn by
    pi about an axis perpendicular to both, where the cross product vanishes. ``phi_12`` is taken by atan2, which
    unlike arccos keeps its digits near 0 and pi. A zero vector aligns with anything: rotation 0.
    """
    a, b = normalize(source), normalize(target)
    axis = cross(a, b)
    sine, cosine = length(axis), float(a @ b)
    if sine > 1e-7:
        return axis * (math.atan2(sine, cosine) / sine)
    if cosine >= 0.0:
        return np.zeros(3)
    # Perpendicular to a: cross with the coordinate axis along which a is shortest.
    return math.pi * normalize(cross(a, np.eye(3)[np.abs(a).argmin()]))


def rotate(vector: Vector, rotation: Vector) -> Vector:
    """Turn a vector by a rotation vector (rad): Rodrigues' formula."""
    angle = length(rotation)
    axis = normalize(rotation)
    once = cross(axis, vector)
    return vector + math.sin(angle) * once + (1.0 - math.cos(angle)) * cross(axis, once)

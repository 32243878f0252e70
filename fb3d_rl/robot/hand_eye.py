"""Hand-eye calibration: where a fixed camera stands in the robot's base, from a marker on the flange (supplement I.C).

Each sample i tells ``T_base_flange[i] @ T_flange_marker == T_base_camera @ T_camera_marker[i]``; both constant
transforms are unknown. A closed form (Park and Martin, "Robot sensor calibration: solving AX=XB on the Euclidean
group", 1994) starts a Levenberg-Marquardt-like least-squares fit with a robust loss, which refines both.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fb3d_rl.errors import UserError

Array = NDArray[np.float64]
Compare = Callable[[Array, Array], Array]
"""From T_camera_marker [N, 4, 4] and further unknowns [U] to residuals [N, K]."""

FEWEST = 5
"""Samples that a calibration needs; three determine it, five show whether they agree."""

LEAST_TURN = 5.0
"""Root mean square (degrees) that the poses have to turn about a second axis; with less, noise decides the result."""

DISAGREES = 5.0
"""A sample is an outlier if one of its residuals is so many times the noise that the others show."""

SOFT = 2.0
"""Residuals count by their squares up to about so many times the noise, and by their size beyond."""


@dataclass(frozen=True)
class HandEye:
    """A calibration and how much it can be trusted."""

    camera: Array
    """T_base_camera [4, 4], m."""
    marker: Array
    """T_flange_marker [4, 4], m."""
    covariance: Array
    """[6, 6] of the camera's error: rotation vector (rad, in the base's axes), then position (m)."""
    scale: float
    """How many times larger the marker is than its corners were said to be; 1 where poses are compared."""
    scale_error: float
    """Standard error of ``scale``."""
    turned: Array
    """How strongly the poses turn about their first, second and third main axis [3], root mean square degrees."""
    rotation_errors: Array
    """Angle [N] (degrees) between each marker as it was measured and as the result has it."""
    position_errors: Array
    """Distance [N] (m) between them."""
    outliers: NDArray[np.bool_]
    """Samples [N] that disagree with the others; they do not count, unless most are such."""

    @property
    def rotation_error(self) -> float:
        """Standard error of the camera's orientation, degrees."""
        return math.degrees(math.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def position_error(self) -> float:
        """Standard error of the camera's position, m."""
        return math.sqrt(np.trace(self.covariance[3:, 3:]))

    def point_error(self, point: Array) -> float:
        """Standard error (m) of a point [3] of the camera's frame once it is in the robot's base."""
        x, y, z = self.camera[:3, :3] @ point
        lever = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # rotation vector x point, as a matrix
        jacobian = np.concatenate([lever, np.eye(3)], axis=1)
        return math.sqrt(np.trace(jacobian @ self.covariance @ jacobian.T))


def calibrate(flange: Array, seen: Array, rays: Array | None = None, square: Array | None = None) -> HandEye:
    """Calibrate from poses of the flange and of the marker.

    With ``rays`` the fit compares the marker's corners in the image, whose noise is the same in all directions; a pose
    from four corners is far less certain in its tilt and depth than across. The marker's size is then found, too: the
    robot's motions are in metres, and printers scale. Without, the fit compares poses.

    Args:
        flange: T_base_flange [N, 4, 4], as the robot tells them.
        seen: T_camera_marker [N, 4, 4], as the camera measured them.
        rays: the corners [N, 4, 2] in the image, x / z and y / z in the camera's frame.
        square: the corners [4, 3] (m) in the marker's frame; with ``rays``.

    Raises:
        UserError: the samples are too few, not finite, or turn about one axis only.
    """
    if len(flange) != len(seen):
        raise UserError(f"there are {len(flange)} poses of the robot but {len(seen)} of the marker; give equally many")
    if len(flange) < FEWEST:
        raise UserError(f"{len(flange)} samples are too few to calibrate; take at least {FEWEST}, better 30")
    if not (np.isfinite(flange).all() and np.isfinite(seen).all()):
        raise UserError("a pose of the robot or of the marker is not finite; leave that sample out")
    turned = turning(flange)
    if turned[1] < LEAST_TURN:
        about = "hardly turn" if turned[0] < LEAST_TURN else "turn about one axis only"
        raise UserError(
            f"the flange's poses {about} ({turned[0]:.1f} and {turned[1]:.1f} degrees about their two main axes), "
            f"which leaves the camera undetermined; turn the flange by 30 degrees or more about different axes"
        )
    if rays is None or square is None:
        compare: Compare = lambda marker, _: _pose_residuals(marker, seen)  # noqa: E731
        kinds, further = np.array([0, 0, 0, 1, 1, 1]), 0
    else:
        compare = lambda marker, size: _corner_residuals(marker, rays, square * np.exp(size))  # noqa: E731
        kinds, further = np.zeros(8, dtype=int), 1
    camera, marker, sizes, covariance, outliers = _refined(flange, *park_martin(flange, seen), compare, kinds, further)
    scale = float(np.exp(sizes.sum()))
    scaled = seen.copy()
    scaled[:, :3, 3] *= scale
    residuals = _pose_residuals(np.linalg.inv(camera) @ flange @ marker, scaled)
    return HandEye(
        camera=camera,
        marker=marker,
        covariance=covariance[:6, :6],
        scale=scale,
        scale_error=scale * math.sqrt(covariance[12, 12]) if further else 0.0,
        turned=turned,
        rotation_errors=np.degrees(np.linalg.norm(residuals[:, :3], axis=1)),
        position_errors=np.linalg.norm(residuals[:, 3:], axis=1),
        outliers=outliers,
    )


def turning(flange: Array) -> Array:
    """How strongly poses [N, 4, 4] turn relative to each other about their main axes [3], largest first.

    Root mean squares (degrees) of the rotation vectors of all pairs along the principal axes of these vectors. The
    second is near 0 if all turn about one axis, however they are ordered.
    """
    vectors, _ = _relative(flange)
    return np.degrees(np.linalg.svd(vectors, compute_uv=False)) / math.sqrt(len(vectors))


def park_martin(flange: Array, seen: Array) -> tuple[Array, Array]:
    """T_base_camera and T_flange_marker [4, 4] in closed form.

    The motion A from one sample to another in the base's frame and B in the camera's obey ``A X = X B``. The rotation
    of X aligns the rotation vectors of B with those of A (Park's and Martin's ``(M^T M)^(-1/2) M^T`` is the same
    polar factor), then its translation solves linear equations. A rigid motion has the same angle in every frame:
    pairs whose two angles differ far more than those of the others hold a wrong sample and do not count.

    Args:
        flange: T_base_flange [N, 4, 4].
        seen: T_camera_marker [N, 4, 4].
    """
    (in_base, a), (in_camera, b) = _relative(flange), _relative(seen)
    angle, other = np.linalg.norm(in_base, axis=1), np.linalg.norm(in_camera, axis=1)
    gap = np.abs(angle - other)
    # Near half a turn noise reverses the axis.
    good = (gap <= 3.0 * np.median(gap) + 1e-9) & (np.maximum(angle, other) < math.radians(170.0))
    rotation = Rotation.align_vectors(in_base[good], in_camera[good])[0].as_matrix()
    left = a[good, :3, :3] - np.eye(3)
    right = b[good, :3, 3] @ rotation.T - a[good, :3, 3]
    camera = np.eye(4)
    camera[:3, :3] = rotation
    camera[:3, 3] = np.linalg.lstsq(left.reshape(-1, 3), right.reshape(-1), rcond=None)[0]
    markers = np.linalg.inv(flange) @ camera @ seen
    marker = np.eye(4)
    marker[:3, :3] = Rotation.from_matrix(markers[:, :3, :3]).mean().as_matrix()
    marker[:3, 3] = np.median(markers[:, :3, 3], axis=0)
    return camera, marker


def _relative(poses: Array) -> tuple[Array, Array]:
    """Rotation vectors [P, 3] and transforms [P, 4, 4] ``poses[j] @ inv(poses[i])`` of all pairs i < j."""
    i, j = np.triu_indices(len(poses), 1)
    motions = poses[j] @ np.linalg.inv(poses[i])
    return Rotation.from_matrix(motions[:, :3, :3]).as_rotvec(), motions


def _pose_residuals(marker: Array, seen: Array) -> Array:
    """Rotation vectors (rad) and translations (m) [N, 6] between T_camera_marker [N, 4, 4] and measured ones."""
    turns = Rotation.from_matrix(np.swapaxes(seen[:, :3, :3], 1, 2) @ marker[:, :3, :3]).as_rotvec()
    return np.concatenate([turns, marker[:, :3, 3] - seen[:, :3, 3]], axis=1)


def _corner_residuals(marker: Array, rays: Array, square: Array) -> Array:
    """Differences [N, 8] of the corners' x / z and y / z for T_camera_marker [N, 4, 4] from measured ``rays``."""
    corners = square @ np.swapaxes(marker[:, :3, :3], 1, 2) + marker[:, None, :3, 3]
    return (corners[..., :2] / corners[..., 2:] - rays).reshape(len(marker), 8)


def _refined(
    flange: Array, camera: Array, marker: Array, compare: Compare, kinds: NDArray[np.int64], further: int
) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
    """Refine both transforms, and ``further`` unknowns that start at 0, by least squares with the loss soft_l1.

    The residuals' own spread is the scale of the loss, and weighs rotations against translations; it is estimated
    anew for each of three fits, the last of which leaves out the samples that disagree, unless most do.

    Args:
        flange: T_base_flange [N, 4, 4].
        camera: T_base_camera to start from.
        marker: T_flange_marker to start from.
        compare: the residuals.
        kinds: of the residuals [K]; those of one kind have the same unit and scale.
        further: how many further unknowns ``compare`` takes.

    Returns:
        T_base_camera, T_flange_marker, the further unknowns, the covariance of all and which samples are outliers [N].
    """
    unknowns = 12 + further
    # Residuals are smaller than the noise, since the unknowns follow them.
    widen = 1.4826 / math.sqrt(1.0 - unknowns / (len(flange) * len(kinds)))

    def residuals(change: Array) -> Array:
        predicted = np.linalg.inv(_changed(camera, change[:6])) @ flange @ _changed(marker, change[6:12])
        return compare(predicted, change[12:])

    change, kept = np.zeros(unknowns), np.ones(len(flange), dtype=bool)
    for last in (False, False, True):
        now = np.abs(residuals(change))
        noise = np.array([np.median(now[:, kinds == kind]) for kind in kinds]) * widen + 1e-10
        agree = np.asarray((now <= DISAGREES * noise).all(1))
        if last and 2 * agree.sum() > len(flange):
            kept = agree
        fit = least_squares(
            lambda change: (residuals(change)[kept] / noise).ravel(),  # noqa: B023 - called within this pass only
            change, loss="soft_l1", f_scale=SOFT, x_scale="jac", xtol=1e-10, ftol=1e-10, gtol=1e-10, max_nfev=200,
        )  # fmt: skip
        change = fit.x
    scaled = residuals(change) / noise
    outliers = np.asarray(np.abs(scaled).max(1) > DISAGREES)
    found = _changed(camera, change[:6]), _changed(marker, change[6:12]), change[12:]
    return *found, _covariance(fit.jac, scaled[kept]), outliers


def _covariance(jacobian: Array, scaled: Array) -> Array:
    """Covariance [U, U] of the unknowns, with errors that the residuals of one sample share (Huber's sandwich).

    A robot that is off by half a millimetre moves all corners of its sample together; as errors of their own they would
    seem to cancel.

    Args:
        jacobian: [N * K, U] as least_squares returns it, scaled such that J^T J is the Hessian of the robust loss.
        scaled: residuals [N, K] in units of their noise.
    """
    count, unknowns = len(scaled), jacobian.shape[1]
    # With z = (r / SOFT)^2 rows are scaled by (1 + z)^(-3/4), and the gradient of the loss is J r (1 + z)^(-1/2).
    pull = scaled * (1.0 + (scaled / SOFT) ** 2) ** 0.25
    scores = (jacobian.reshape(count, -1, unknowns) * pull[..., None]).sum(1)
    bread = np.linalg.inv(jacobian.T @ jacobian)
    # A pose has 6 numbers; the unknowns take some of the 6 N.
    return bread @ (scores.T @ scores) @ bread / (1.0 - unknowns / (6 * count))


def _changed(pose: Array, change: Array) -> Array:
    """``pose`` [4, 4] turned by a rotation vector and shifted, ``change`` [6], in the axes of its parent frame."""
    changed = pose.copy()
    changed[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ pose[:3, :3]
    changed[:3, 3] += change[3:]
    return changed

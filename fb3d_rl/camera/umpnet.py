"""UMPNet's camera (Xu, He and Song, RA-L 2022): it stands still, and objects are placed before it.

The world here is UMPNet's in the object's own size: the origin is on the ground below the object's base, the camera on
the -x side, which the object's front faces, and lengths are those of UMPNet's world over :data:`SCALE`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.camera.raycast import NOTHING, RaycastCamera
from fb3d_rl.camera.views import View

SCALE = 0.55
"""How many metres in UMPNet's world one metre of an object is."""

BASE = (0.0, -0.5, 0.0)
"""Where in UMPNet's world objects stand, m."""

CAMERA = (0.0, -2.0, 2.0)
"""Where the camera stands; it looks at the origin of that world."""

ROWS = 0.75
"""The picture is 640 x 480: rows above and below the middle 3/4 of the square are not seen."""

TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From UMPNet's axes (the camera on the -y side) to ours (on the -x side)."""


def camera_pose() -> NDArray[np.float64]:
    """T_world_camera [4, 4]; camera x right, y down, z forward."""
    place, target = (TURN @ (np.array(point) - BASE) / SCALE for point in (CAMERA, (0.0, 0.0, 0.0)))
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], axis=1), place
    return pose


class UmpnetCamera(RaycastCamera):
    """640 x 480 pixels, 69.4 degrees wide, at (0, -2, 2) and looking at the origin of UMPNet's world, without noise.

    A view's azimuth turns the camera about the vertical through the object's base, as UMPNet turns the object the other
    way; its elevation means nothing. The options' resolution and fov are those of a row.
    """

    def pose(self, view: View) -> NDArray[np.float64]:
        """See the base class."""
        turn = np.eye(4)
        turn[:3, :3] = self.turn(view).T
        return np.asarray(turn @ camera_pose())

    def turn(self, view: View) -> NDArray[np.float64]:
        """See the base class: the camera stands still, so the object is turned."""
        return Rotation.from_euler("z", -view.azimuth, degrees=True).as_matrix()

    def _nearest(self, poses: NDArray[np.float64], view: View) -> NDArray[np.uint64]:
        image = super()._nearest(poses, view)
        beside = round(0.5 * (1.0 - ROWS) * len(image))
        image[:beside], image[len(image) - beside :] = NOTHING, NOTHING
        return image

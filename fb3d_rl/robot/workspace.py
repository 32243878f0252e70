"""The cell of the paper's robot as boxes: table, beams and camera, in the frame of the robot's base."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fb3d_rl.robot.collision import Box

TABLE = -0.015
"""Height of the table's top below the robot's base, m (supplement I.D)."""

SIZE = (1.00, 1.08)
"""Of the workspace between the beams along x and y, m (supplement I.B, which does not say which is which)."""

CENTRE = (0.70, 0.0)
"""Of the workspace, m: the robot stands before the middle of a long side (ours)."""

BEAM = 0.045
"""Width of a beam, m: Vention's profiles measure 45 mm."""

POST = 0.9
"""Height of the beams at the four corners, m (ours)."""

CAMERA = (0.15, 0.60, 0.95)
"""Centre of the camera's box, m (ours): on the post at the robot's left, looking at the workspace's centre."""

CAMERA_SIZE = (0.14, 0.11, 0.05)
"""Of the box around an Azure Kinect, which measures 126 x 103 x 39 mm, m."""


def box(centre: ArrayLike, size: ArrayLike) -> Box:
    """A box [3] (m) with edges along the base's axes around a centre [3] (m)."""
    pose = np.eye(4)
    pose[:3, 3] = centre
    return Box(pose, np.asarray(size, dtype=np.float64))


def cell(camera: ArrayLike = CAMERA) -> list[Box]:
    """Table, beams around the workspace, posts at its corners and the camera; the camera's centre [3] in m."""
    (x, y), (long, wide) = CENTRE, SIZE
    out = (long + BEAM) / 2, (wide + BEAM) / 2
    boxes = [box((x, y, TABLE - 0.025), (long + 0.3, wide + 0.3, 0.05))]
    for side in (-1, 1):
        boxes.append(box((x + side * out[0], y, TABLE + BEAM / 2), (BEAM, wide + 2 * BEAM, BEAM)))
        boxes.append(box((x, y + side * out[1], TABLE + BEAM / 2), (long + 2 * BEAM, BEAM, BEAM)))
        for end in (-1, 1):
            boxes.append(box((x + end * out[0], y + side * out[1], TABLE + POST / 2), (BEAM, BEAM, POST)))
    boxes.append(box(camera, 3 * (max(CAMERA_SIZE),)))  # turned as it may be
    return boxes

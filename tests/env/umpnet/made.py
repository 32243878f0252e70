"""Scenes for tests."""

from __future__ import annotations

from typing import Any

from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.umpnet import SCALE
from fb3d_rl.env.umpnet.scenes import JointState, Scene, bullet_order


def scene_of(obj: ArticulatedObject, yaw: float = 100.0, **joint: Any) -> Scene:
    """A scene of the object's first joint, which starts at 20 % and is to come to 90 % of its range."""
    order = bullet_order(obj)
    unit = SCALE if obj.joint_of(obj.movable[0]).type == "prismatic" else 1.0
    lower, upper = (unit * x for x in obj.limits[0])
    state = {
        "lower": lower,
        "upper": upper,
        "goal": lower + 0.9 * (upper - lower),
        "start": lower + 0.2 * (upper - lower),
    }
    turned = tuple(Rotation.from_euler("z", yaw, degrees=True).as_quat().tolist())
    number = order.index(obj.movable[0])
    joints = {number: JointState(**(state | joint))}
    return Scene("manipulation", obj.category, 0, obj.id, SCALE, 0.5, turned, number, joints)

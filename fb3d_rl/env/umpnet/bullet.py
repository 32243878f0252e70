"""UMPNet's world in PyBullet, which the extra ``umpnet`` installs: as in its own simulation, with a hand of our own.

Gravity is 0 and the time step PyBullet's 1/240 s. The hand is a carriage on three rails without any shape, so that it
touches nothing. A point-to-point constraint of limited force joins it to the link, and motors of limited force move it.
UMPNet also turns its cup along the surface; nothing depends on that, as the constraint leaves the orientation free.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fb3d_rl.camera.umpnet import BASE, TURN
from fb3d_rl.env.umpnet.scenes import Placed, bullet_order
from fb3d_rl.env.umpnet.world import GAIN, STEPS, STILL, STILLS, STROKE, Array
from fb3d_rl.errors import UserError

MOTOR_FORCE = 1500.0
"""N on each rail."""

HOLD_FORCE = 2000.0
"""N of the constraint."""

ALIGN = 10.0
"""After a pull the carriage is moved to where the point came to a halt, at a gain so many times as large."""

REST = (0.0, -2.0, 2.0)
"""Where the carriage stands at rail positions 0, m."""

_INERTIA = '<inertial><mass value="{}"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
_RAIL = (
    '<joint name="to_{0}" type="prismatic"><parent link="{1}"/><child link="{0}"/><axis xyz="{2}"/>'
    '<limit lower="-1000" upper="1000" effort="1000" velocity="1000"/></joint>'
)
HAND = (
    '<robot name="hand"><link name="base"/>'
    + "".join(
        f'<link name="{name}">{_INERTIA.format(mass)}</link>' for name, mass in (("x", 0.1), ("y", 0.1), ("z", 100))
    )
    + "".join(_RAIL.format(*rail) for rail in (("x", "base", "1 0 0"), ("y", "x", "0 1 0"), ("z", "y", "0 0 1")))
    + "</robot>"
)
"""The carriage as URDF: rails x, y, z, of which the last one carries a mass of 100 kg."""

PLANE = (
    '<robot name="ground"><link name="base"><collision><geometry><plane normal="0 0 1"/></geometry></collision>'
    "</link></robot>"
)


class Bullet:
    """See :class:`fb3d_rl.env.umpnet.world.World`; each scene has a simulation of its own.

    Raises:
        UserError: PyBullet is missing or cannot read an object.
    """

    def __init__(self, placed: Sequence[Placed]) -> None:
        try:
            import pybullet
            from pybullet_utils.bullet_client import BulletClient
        except ImportError as error:
            raise UserError(
                "umpnet.backend=pybullet needs PyBullet: pip install 'fb3d_rl[umpnet]', or "
                "take umpnet.backend=quasistatic"
            ) from error
        self.placed = placed
        self._scenes: list[_Simulated] = []
        self._folder = tempfile.TemporaryDirectory()  # PyBullet reads files only
        files = Path(self._folder.name) / "hand.urdf", Path(self._folder.name) / "plane.urdf"
        for file, text in zip(files, (HAND, PLANE), strict=True):
            file.write_text(text)
        for one in placed:
            self._scenes.append(_Simulated(BulletClient(pybullet.DIRECT), one, *map(str, files)))

    @property
    def states(self) -> list[Array]:
        """Joint states [J] (rad or m) of the scenes."""
        return [scene.state() for scene in self._scenes]

    def touch(self, index: int, link: int, point: Array) -> None:
        """See :class:`World`."""
        self._scenes[index].touch(link, point)

    def held(self, index: int) -> Array:
        """See :class:`World`."""
        scene = self._scenes[index]
        return scene.from_umpnet(scene.held())

    def pull(self, directions: Array) -> None:
        """See :class:`World`."""
        for scene, direction in zip(self._scenes, directions, strict=True):
            if direction.any():
                scene.pull(TURN.T @ direction)

    def close(self) -> None:
        """See :class:`World`."""
        for scene in self._scenes:
            scene.client.disconnect()
        self._scenes = []
        self._folder.cleanup()


class _Simulated:
    """One scene in a PyBullet client."""

    def __init__(self, client: Any, placed: Placed, hand: str, plane: str) -> None:
        self.client, self.placed = client, placed
        scene, obj = placed.scene, placed.posed.obj
        client.setGravity(0, 0, 0)
        client.loadURDF(plane)
        try:
            self.body = client.loadURDF(
                os.fspath(obj.urdf.resolve()), (*BASE[:2], scene.height), scene.orientation, useFixedBase=True,
                globalScaling=scene.scale,
            )  # fmt: skip
        except client.error as error:
            raise UserError(f"object {obj.id}: PyBullet cannot read {obj.urdf} ({error})") from error
        order = bullet_order(obj)
        names = [client.getJointInfo(self.body, k)[12].decode() for k in range(client.getNumJoints(self.body))]
        if names != [obj.links[link].name for link in order]:
            raise UserError(f"object {obj.id}: PyBullet reads other joints in {obj.urdf} than this package")
        self.number = {link: order.index(link) for link in obj.movable}  # of the joints, by link
        self.unit = {
            link: scene.scale if obj.joint_of(link).type == "prismatic" else 1.0 for link in obj.movable
        }  # rad or m in the simulation for one of a joint state
        for link, position in zip(obj.movable, placed.start, strict=True):
            joint, unit = self.number[link], self.unit[link]
            lower, upper = (unit * x for x in obj.joint_of(link).limits)
            if np.isfinite([lower, upper]).all():
                client.changeDynamics(self.body, joint, jointLowerLimit=lower, jointUpperLimit=upper)
            client.resetJointState(self.body, joint, unit * position)
        self._hand, self._link, self._local = hand, -1, (0.0, 0.0, 0.0)

    def state(self) -> Array:
        """Joint state [J]."""
        read = self.client.getJointState
        return np.array(
            [read(self.body, self.number[link])[0] / self.unit[link] for link in self.placed.posed.obj.movable]
        )

    def to_umpnet(self, point: Array) -> Array:
        """A world point [3] in UMPNet's world, m."""
        return np.asarray(TURN.T @ point * self.placed.scene.scale + BASE)

    def from_umpnet(self, point: Array) -> Array:
        """The inverse of :meth:`to_umpnet`."""
        return np.asarray(TURN @ (point - BASE) / self.placed.scene.scale)

    def touch(self, link: int, point: Array) -> None:
        """See :class:`World`."""
        client, place = self.client, self.to_umpnet(point)
        self._link = self.number[link]
        inverse = client.invertTransform(*client.getLinkState(self.body, self._link)[:2])
        self._local, turn = client.multiplyTransforms(*inverse, place.tolist(), (0, 0, 0, 1))
        self.carriage = client.loadURDF(self._hand, REST, useFixedBase=True)
        for rail in range(3):
            client.resetJointState(self.carriage, rail, place[rail] - REST[rail])
        hold = client.createConstraint(
            self.body, self._link, self.carriage, 2, client.JOINT_POINT2POINT, (0, 0, 0), self._local, (0, 0, 0), turn
        )
        client.changeConstraint(hold, maxForce=HOLD_FORCE)

    def held(self) -> Array:
        """The held point [3] in UMPNet's world."""
        frame = self.client.getLinkState(self.body, self._link)[:2]
        return np.array(self.client.multiplyTransforms(*frame, self._local, (0, 0, 0, 1))[0])

    def pull(self, direction: Array) -> None:
        """Pull for one stroke along a unit direction [3] of UMPNet's world."""
        self._move(self.held() + STROKE * direction, GAIN)
        self._move(self.held(), ALIGN * GAIN)

    def _move(self, target: Array, gain: float) -> None:
        client, rails = self.client, [0, 1, 2]
        client.setJointMotorControlArray(
            self.carriage, rails, client.POSITION_CONTROL, targetPositions=(target - REST).tolist(),
            forces=[MOTOR_FORCE] * 3, positionGains=[gain] * 3,
        )  # fmt: skip
        last, still = np.full(3, np.inf), 0
        for _ in range(STEPS):
            client.stepSimulation()
            here = np.array([state[0] for state in client.getJointStates(self.carriage, rails)])
            still += bool(np.linalg.norm(here - last) < STILL)
            last = here
            if still >= STILLS:
                return

"""What the tests of a learner and a person share: an untrained learner, and what a person does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fb3d_rl.algos.learners import new_learner
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.live.shared import SharedSession
from fb3d_rl.policies.learner import Learner
from fb3d_rl.policies.options import LearnerOptions
from fb3d_rl.rollout.run import limits_of

CAMERA = CameraOptions(resolution=64)
SAMPLES = SampleOptions(points=300, camera=CAMERA)
ENV = EnvOptions(points=300, camera=CAMERA, horizon=120)
LIMITS = limits_of(ENV)
SMALL = LearnerOptions(points=64, width=16)
ROOT = Path(__file__).parents[2]


def learner(options: LearnerOptions = SMALL) -> Learner:
    """One that has learnt nothing, and so does what the expert would not."""
    made = new_learner(options, LIMITS, 1, 3)
    assert isinstance(made, Learner)
    return made


Open: TypeAlias = Callable[..., SharedSession]


def another_point(session: SharedSession) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A point of the part that moves well, far from the expert's; with a ray from beside the camera to it."""
    moment = session.moment
    assert moment.contact is not None
    points = moment.points[moment.part & (np.linalg.norm(moment.flows["true"], axis=-1) > 0.6)]
    point = points[np.linalg.norm(points - moment.contact.point, axis=-1).argmax()]
    origin = moment.camera[:3, 3] + [0.0, 0.1, 0.2]
    return point, origin, point - origin


def goal_of(session: SharedSession, way: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """A pose off the tip's by ``way``, turned by half a radian about the vertical."""
    return session.moment.tip[:3] + np.array(way), np.array([np.cos(0.25), 0.0, 0.0, np.sin(0.25)])


def steps(session: SharedSession, count: int) -> list[str]:
    """Who made each of the next steps."""
    by = []
    for _ in range(count):
        session.step()
        assert session.trial is not None
        by.append(session.trial.by)
    return by

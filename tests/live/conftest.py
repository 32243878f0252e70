"""What the tests of the live page share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.live.shared import SharedSession
from fb3d_rl.policies.flow_policy import FlowPolicyOptions

from .shared import ENV, SAMPLES, Open, learner


@pytest.fixture
def opened(procedural_objects: dict[str, ArticulatedObject]) -> Iterator[Open]:
    """Opens sessions of the microwave, and closes them."""
    sessions = []

    def make(recorder: Any = None, acting: Any = None, env: EnvOptions = ENV) -> SharedSession:
        obj = procedural_objects["Microwave"]
        sessions.append(SharedSession(obj, SAMPLES, env, FlowPolicyOptions(), acting or learner(), recorder))
        return sessions[-1]

    yield make
    for session in sessions:
        session.close()

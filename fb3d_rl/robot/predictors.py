"""Predictors of an attempt: networks that see an object on the robot's table."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.predict.plan import plan
from fb3d_rl.robot.attempt import Observation, Predictor


def network(net: ArtFlowNet) -> Predictor:
    """The flow of a network that gets no mask; it sees the object from its front, and of the size that it knows
    (:func:`fb3d_rl.predict.plan.plan`).

    Raises:
        UserError: by the predictor: nothing is predicted to move.
    """

    def predictor(observation: Observation) -> NDArray[Any]:
        found = plan(
            observation.points, camera=observation.camera, model=net, ground=observation.table, foreground=False
        )
        return found.hypotheses[0].flow

    return predictor

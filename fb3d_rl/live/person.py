"""A person in charge of the hand while a learner acts: HG-DAgger's expert (Kelly et al. 2019)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.policies.commands import straight_to
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.flow_state import Control
from fb3d_rl.policies.hand import hand_axis
from fb3d_rl.policies.interaction import EitherGate, Gate, HumanGate, InteractivePolicy


@dataclass
class Person:
    """Whether a person is in charge, and what of.

    Attributes:
        goal: pose of the suction tip [7] in the world, p (m) and q (wxyz), to which the person drags the hand; None
            unless it is dragged.
        pointed: whether the expert drives the hand to a contact point that the person picked.
    """

    goal: Tensor | None = None
    pointed: bool = False

    @property
    def in_charge(self) -> bool:
        """Whether the person has taken over."""
        return self.pointed or self.goal is not None

    def drag(self, goal: Tensor) -> None:
        """Take over by dragging the tip towards a pose [7]; the quaternion need not be of unit length."""
        self.goal, self.pointed = torch.cat([goal[:3], normalize(goal[3:])]), False

    def point(self) -> None:
        """Take over by a contact point for which the expert is to head."""
        self.goal, self.pointed = None, True

    def release(self) -> None:
        """Hand back to the learner."""
        self.goal, self.pointed = None, False

    def takes_over(self, tensordict: TensorDictBase) -> Tensor:
        """The answer [E, 1] bool to a :class:`~fb3d_rl.policies.interaction.HumanGate`."""
        return torch.full_like(tensordict["expert", "looks_on"], self.in_charge)


class SharedPolicy(InteractivePolicy):
    """A learner acts, the expert labels, and a person takes over.

    Where the person points, the expert acts, as the person has told it to. Where the person drags, both the label
    ("expert", "action") and the executed action are the person's: straight to the pose, at the gripper's limits until
    the last bit of the way. The spin about the hand's axis is free, as in every action here.

    Args:
        expert: the flow policy with the true flow.
        acting: what acts while the person does not: the learner, or a learner with an oracle, whose gate then decides
            between the two.
        person: who takes over.
    """

    def __init__(self, expert: FlowPolicy, acting: TensorDictModuleBase, person: Person) -> None:
        gate: Gate = HumanGate(person.takes_over)
        learner: TensorDictModuleBase | None = acting
        if isinstance(acting, InteractivePolicy):
            learner, gate = acting.learner, EitherGate(gate, acting.gate)
        super().__init__(expert, learner, gate)
        self._person = person
        # The expert travels more slowly than the gripper can.
        self._control = Control(replace(expert.options, travel_speed=expert.limits.linear), expert.limits)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action", ("expert", "action") and who acted."""
        super().forward(tensordict)
        goal = self._person.goal
        if goal is not None:
            obs, pose = tensordict["observation"], goal[None].double()
            velocity = straight_to(obs["tool_pose"][:, :3].double(), pose[:, :3], self._control)
            command = self.expert.steer(obs, velocity, hand_axis(pose))
            tensordict["action"] = tensordict["expert", "action"] = command
            # The expert has no part in where the hand is by then, and no contact point that the label would be for.
            tensordict["next", "policy"] = FlowPolicy.choose_anew(tensordict["next", "policy"])
        return tensordict

"""The flow policy: approach a point against its flow, touch, hold, then pull along the current flow.

It does not know where its flow comes from. Fed the ground truth it is the expert; fed ArtFlowNet's prediction it is
FlowBot3D. Its state travels in the TensorDict under "policy". In each step it first decides the phase by what it
observes (:mod:`~fb3d_rl.policies.transitions`), then commands a tip velocity
(:mod:`~fb3d_rl.policies.commands`); the hand turns towards ``standoff`` in every phase.

======== ================================== ========================================= =================================
phase    observed                           decided                                   commanded
======== ================================== ========================================= =================================
SELECT   cloud, flow, failed points         a contact point: TRAVEL                   no motion until there is one
TRAVEL   tip, hand axis, force              on the approach line: APPROACH;           to the pre-contact point, around
                                            halted by something unseen: RETREAT       the object if need be
APPROACH tip, force, suction                held: PULL;                               along the approach line, slow from
                                            pressed too long, or missed: RETREAT      the pre-contact point on
PULL     cloud, flow, tip, suction          hold lost: RETREAT;                       along the flow at the tip; the
                                            no progress, held badly: RELEASE          hand turns as the flow does
RETREAT  tip, force                         far enough away, or halted: SELECT        away from the contact point
RELEASE  suction                            off: RETREAT;                             away across the flow, at full
                                            still held after a while: PULL            speed
======== ================================== ========================================= =================================

In any phase but PULL and RELEASE a hand that suction holds goes on to PULL. After the last allowed retry RETREAT
becomes SELECT without a choice: the hand stays. ::

    SELECT -> TRAVEL -> APPROACH -> PULL -> RELEASE
       ^         |          |        | ^       | |
       |         v          v        v +-------+ |
       +------ RETREAT <-------------+ <---------+
"""

from __future__ import annotations

from dataclasses import fields

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from fb3d_rl.geometry.transforms import alignment
from fb3d_rl.models.artflownet import artflownet_module, needs_mask, proposes_several
from fb3d_rl.policies.commands import above_ground, command
from fb3d_rl.policies.contact import Contact, best_candidate
from fb3d_rl.policies.flow_state import SELECT, TRAVEL, Control, FlowState, Observed
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, joint_velocities
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.policies.policy import Policy
from fb3d_rl.policies.transitions import advance

MASK = ("observation", "part_mask")
"""Where the mask of the part to open is read."""


class FlowPolicy(Policy):
    """Turns a flow into gripper velocities.

    Args:
        flow_key: where the flow is read: ``("privileged", "flow")`` makes the expert, ``("prediction", "flow")``
            FlowBot3D.
        limits: what an action means.
        options: speeds, gains, distances and times.
        pull_key: where the tip's velocity [E, 3] (m/s) in a pull is read; unless given, it follows from the flow.
        twist_key: where the part's motion [E, 6] is read, which a pull follows in place of the visible flow: velocity
            of the world's origin and angular velocity, of any scale; 0 where it is not known.

    Shapes: reads the contract's "observation" group and the flow [E, N, 3]; writes ``action`` [E, 8] and the next
    step's state (:class:`~fb3d_rl.policies.flow_state.FlowState`) under ``("next", "policy")``.
    """

    def __init__(
        self,
        flow_key: tuple[str, str],
        limits: VelocityLimits,
        options: FlowPolicyOptions | None = None,
        pull_key: tuple[str, str] | None = None,
        twist_key: tuple[str, str] | None = None,
    ) -> None:
        super().__init__()
        self.flow_key, self.pull_key, self.twist_key = flow_key, pull_key, twist_key
        self.limits = limits
        self.options = options or FlowPolicyOptions()
        self._control = Control(self.options, limits)
        state = [field.name for field in fields(FlowState)]
        observed = ("points", "valid", "qpos", "tool_pose", "attached", "contact_force", "camera_position")
        self.in_keys = [("observation", key) for key in (*observed, "goal_sense")] + [flow_key]
        self.in_keys += [MASK] if self.options.mask == "target" else []
        self.in_keys += [key for key in (pull_key, twist_key) if key is not None]
        self.in_keys += [("policy", key) for key in state]
        self.out_keys = ["action"] + [("next", "policy", key) for key in state]

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """The state {"policy": ...} at the start of an episode: all zeros, phase SELECT."""
        return TensorDict({"policy": FlowState.initial(batch).packed()}, batch_size=batch)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and the next policy state."""
        obs = tensordict["observation"]
        hand = hand_axis(obs["tool_pose"])
        state = FlowState.read(tensordict["policy"])
        seen = Observed(
            phase=state.phase,
            tip=obs["tool_pose"][:, :3].double(),
            hand=hand.double(),
            attached=obs["attached"],
            force=obs["contact_force"].double(),
            sense=obs["goal_sense"].double(),
            points=obs["points"],
            valid=obs["valid"],
            part=None if self.options.mask == "none" else obs["part_mask"],
            flow=tensordict[self.flow_key],
            camera=obs["camera_position"],
            pull=None if self.pull_key is None else tensordict[self.pull_key].double(),
            twist=None if self.twist_key is None else tensordict[self.twist_key].double(),
        )
        state, velocity = command(advance(state, seen, self._control), seen, self._control)
        tensordict["action"] = self.steer(obs, velocity, state.standoff)
        tensordict["next", "policy"] = state.packed()
        return tensordict

    def steer(self, obs: TensorDictBase, velocity: Tensor, axis: Tensor) -> Tensor:
        """The action [E, 8] that moves the tip at a velocity and turns the hand towards an axis, above the ground.

        Args:
            obs: the contract's "observation" group [E], of which qpos and tool_pose are read.
            velocity: [E, 3] m/s in the world, float64.
            axis: [E, 3] unit direction from the tip to the hand that is wanted, float64.
        """
        hand = hand_axis(obs["tool_pose"])
        axis = above_ground(axis, obs["tool_pose"][:, :3].double(), self.options.clearance)
        angular = self._control.gain(self.options.angular_gain) * alignment(hand.double(), axis)
        return joint_velocities(obs, hand, velocity.to(hand), angular.to(hand), self.limits)

    def choose_again(self, tensordict: TensorDictBase, where: Tensor) -> None:
        """Head for the candidate that is best by now, in environments that are on their way to a part at rest.

        The candidates are those of the first observation, when the hand hid none of them: which points are seen past
        the hand changes from step to step.

        Args:
            tensordict: the step, whose ("policy", ...) state is replaced.
            where: [E, 1] bool, the environments to do so in.
        """
        pose, state = tensordict["observation", "tool_pose"], FlowState.from_tensordict(tensordict["policy"])
        candidates = Contact.from_tensordict(state.candidates)
        best = best_candidate(candidates, pose[..., :3], hand_axis(pose), self.options.contact)
        goal = {"contact_point": best.point, "pull": best.flow, "standoff": best.standoff}
        tensordict["policy"] = state.changed(where, **goal, phase=TRAVEL, leave=0.0).packed()

    @staticmethod
    def go_to(tensordict: TensorDictBase, chosen: Contact, candidates: Contact) -> None:
        """Head for a contact point that somebody else has chosen, with a hand that holds nothing.

        Args:
            tensordict: the step, whose ("policy", ...) state is replaced.
            chosen: the contact, as :func:`~fb3d_rl.policies.contact.choose_contact` returns it ...
            candidates: ... with its candidates.
        """
        state = FlowState.read(tensordict["policy"])
        fresh = {key: torch.zeros_like(getattr(state, key)) for key in ("chosen", "idle", "leave", "came")}
        state = state.updated(**fresh, tip=tensordict["observation", "tool_pose"][..., :3].double())
        tensordict["policy"] = state.set_out(chosen, candidates).packed()

    @staticmethod
    def choose_anew(state: TensorDictBase) -> TensorDictBase:
        """The ("policy", ...) state of a hand that somebody else has moved: it chooses a contact point from what it
        sees in the next step, or goes on to pull if suction holds a part by then.
        """
        flow_state = FlowState.from_tensordict(state)
        everywhere = torch.ones_like(flow_state.phase, dtype=torch.bool)
        return flow_state.changed(everywhere, phase=SELECT, leave=0.0, idle=0, chosen=0).packed()


def expert_policy(limits: VelocityLimits, options: FlowPolicyOptions | None = None) -> FlowPolicy:
    """The flow policy fed with the ground-truth flow: the upper bound, and the oracle of DAgger."""
    return FlowPolicy(("privileged", "flow"), limits, options)


def artflownet_policy(
    net: nn.Module, limits: VelocityLimits, options: FlowPolicyOptions | None = None
) -> TensorDictModule:
    """FlowBot3D: ArtFlowNet's prediction from the cloud, then the flow policy; so with any network of the same form.

    With ``options.learn`` the prediction is corrected by touch (:class:`~fb3d_rl.policies.touch.TouchPolicy`).

    Raises:
        UserError: the options keep a mask from the policy that the network cannot do without.
    """
    from fb3d_rl.policies.touch import TouchPolicy  # imported late, as it holds a FlowPolicy

    options = options or FlowPolicyOptions()
    if needs_mask(net):
        options.require_mask("a network that was trained with the mask alone")
    module = artflownet_module(net, proposals=options.learn, masked=options.mask == "target")
    if options.learn:
        return TensorDictSequential(module, TouchPolicy(limits, options, proposes_several(net)))
    return TensorDictSequential(module, FlowPolicy(("prediction", "flow"), limits, options))

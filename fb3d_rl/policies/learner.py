"""What imitation trains: from a cloud and the state of the hand straight to velocities."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from fb3d_rl.contract import Key
from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.models.artflownet import ArtFlowNet, artflownet_module
from fb3d_rl.models.dense import initialize
from fb3d_rl.models.encoders import ENCODERS, ArtFlowNetEncoder
from fb3d_rl.models.guide import Guide, Hand, Intention, Told
from fb3d_rl.policies.flow_state import APPROACH, PHASES, TRAVEL
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, hand_velocities, joint_velocities
from fb3d_rl.policies.options import LearnerOptions
from fb3d_rl.policies.plans import PlanNetwork, executed, plan_state, trial_noise
from fb3d_rl.policies.policy import Policy

TWIST = 6
"""Tip velocity and angular velocity of the hand in the world, each as a share of the gripper's limit."""

HAND_FEATURES = 4 * 3 + 3
"""Numbers that describe the hand: its axis, its tip's velocity, the direction to the camera and its angular velocity,
all in the world; held, force, height of the tip. They lie under the key "felt"."""

HELD = 12
"""Which of them says whether the part is held."""

FORCE = 13
"""Which of them is the contact force."""

GOAL = ("contact_point", "standoff")
"""What a learner that tells the contact point keeps to while it is on its way."""

INPUTS = ("points", "features", "valid", "felt")
"""Entries of the network's input."""

LARGEST_FORCE = 50.0
"""Contact force (N) at which the network's input saturates."""

OBSERVED: tuple[Key, ...] = tuple(
    ("observation", key)
    for key in (
        "points",
        "valid",
        "part_mask",
        "qpos",
        "qvel",
        "tool_pose",
        "attached",
        "contact_force",
        "camera_position",
    )
)
"""What every learner reads of the observation."""

FLOW_KEYS: dict[str, Key | None] = {
    "none": None,
    "ground_truth": ("privileged", "flow"),
    "artflownet": ("prediction", "flow"),
}
"""Where the "+F" variants (supplement, III) read the flow: the release feeds them the ground truth."""


def hand_in(felt: Tensor) -> Hand:
    """The hand of the network's inputs "felt" [B, 1 + history, HAND_FEATURES]."""
    return Hand(felt[:, 0, :3], felt[:, 0, HELD, None], felt[..., [HELD, FORCE]].flatten(1))


class TwistNetwork(PlanNetwork):
    """An encoder and its heads.

    Args:
        options: the network.

    Shapes: the entries of :meth:`Learner.network_inputs` -> what the head reads [B, ...], and, if asked for, the
    discrepancy [B, 1].
    """

    def __init__(self, options: LearnerOptions) -> None:
        super().__init__(options, TWIST, alike=3)  # a velocity has one size, so that it turns with the scene
        outputs = self._head.inputs + int(options.discrepancy)
        inputs = 1 + 3 * (FLOW_KEYS[options.flow] is not None)
        context, width = HAND_FEATURES * (1 + options.history), options.width
        if options.guided:
            told, touch = (options.contact, options.phase), 2 * (1 + options.history)
            self.guide = Guide(inputs, context, len(PHASES), width, *told, touch)
            context += self.guide.size
        self.encoder = ENCODERS[options.encoder](inputs, context, outputs, width)

    def forward(
        self, points: Tensor, features: Tensor, valid: Tensor, felt: Tensor, intention: Intention | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """See the class; None where no discrepancy is asked for.

        With a guide the plan is for ``intention``, or for what the guide tells unless that is given.
        """
        points, context = points.masked_fill(~valid[..., None], 0.0), felt.flatten(1)
        if self.options.guided:
            meant = intention or self.intention(self.told(points, features, valid, felt), felt)
            context = torch.cat([context, self.guide.words(meant, hand_in(felt))], dim=1)
        raw = self.encoder(points, features, valid, context)
        distance = nn.functional.softplus(raw[:, -1:]) if self.options.discrepancy else None
        return raw[:, : self._head.inputs], distance

    def told(self, points: Tensor, features: Tensor, valid: Tensor, felt: Tensor) -> Told:
        """What the guide tells about contact points."""
        told: Told = self.guide(points.masked_fill(~valid[..., None], 0.0), features, valid, felt.flatten(1))
        return told

    @torch.no_grad()
    def intention(
        self, told: Told, felt: Tensor, before: tuple[Tensor, Tensor] | None = None, going: Tensor | None = None
    ) -> Intention:
        """The intention that is the likeliest.

        Args:
            told: of :meth:`told`.
            felt: of the same inputs.
            before: [B, 3] contact point and standoff of the last step, relative to the tip now. Several places are
                often about as good, and a hand that goes for now one, now another gets to none: they are kept while
                they are not doubted (:meth:`~fb3d_rl.models.guide.Told.doubts`).
            going: [B, 1] bool, whether the hand was on its way to that point; needed with ``before``.
        """
        contact, standoff = told.likeliest()
        if before is not None and going is not None:
            keeps = going & ~told.doubts(before[0])
            contact, standoff = (
                torch.where(keeps, old, new) for old, new in zip(before, (contact, standoff), strict=True)
            )
        phase = contact.new_zeros(len(contact), len(PHASES))
        if self.options.phase:
            logits = self.guide.phase_logits(told, contact, standoff, felt.flatten(1), hand_in(felt))
            phase = nn.functional.one_hot(logits.argmax(1), len(PHASES)).to(contact.dtype)
        return Intention(contact, standoff, phase)


class Learner(Policy):
    """A policy that imitates: cloud, hand and part mask -> velocities.

    The network's frame has its origin at the suction tip and the world's axes; its output is the velocity of the tip
    and the angular velocity of the hand. So it does not depend on where the scene stands, and the output turns and is
    mirrored with the scene, which training uses as augmentation. The known kinematics of the hand convert the output
    to the contract's action; the fingers stay closed, as in the supplement (II.C).

    Args:
        options: the network.
        limits: what action 1 means.
        generator: draws the first weights; None leaves them to torch's global generator.
        flow_net: an ArtFlowNet to predict the flow with, for the option flow="artflownet"; it is not trained.

    Shapes: reads the contract's observation [E, ...]; writes "action" [E, 8] and, if asked for, ("learner",
    "discrepancy") [E, 1]. Its history and its plan travel below "learner", see :meth:`initial_state`.
    """

    def __init__(
        self,
        options: LearnerOptions,
        limits: VelocityLimits,
        generator: torch.Generator | None = None,
        flow_net: ArtFlowNet | None = None,
    ) -> None:
        super().__init__()
        self.options, self.limits = options, limits
        flow = FLOW_KEYS[options.flow]
        self.flow_key = flow
        self.network = TwistNetwork(options)
        if generator is not None:
            initialize(self.network, generator)
        if isinstance(self.network.encoder, ArtFlowNetEncoder):
            self.network.encoder.publish()
            self.network.encoder.flow.requires_grad_(not options.frozen)
        if (flow_net is not None) != (options.flow == "artflownet"):
            raise ValueError('flow="artflownet" needs a flow network, and nothing else does')
        self.flow_network = None if flow_net is None else flow_net.requires_grad_(False).eval()
        self._predict = None if flow_net is None else artflownet_module(flow_net)
        given = [flow] if flow and flow_net is None else []
        episode: list[Key] = ["seed", "elapsed_steps"] if self.network.noise else []  # what noise depends on
        self.in_keys = [*OBSERVED, *given, *episode, *(("learner", key) for key in self._state())]
        self.out_keys = ["action", *(("next", "learner", key) for key in self._state())]
        if options.discrepancy:
            self.out_keys.append(("learner", "discrepancy"))
        if flow_net is not None:
            self.out_keys.append(("prediction", "flow"))

    def _state(self) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
        state: dict[str, tuple[tuple[int, ...], torch.dtype]] = {}
        if self.options.history:
            state["felt"] = ((self.options.history, HAND_FEATURES), torch.float32)
        if self.options.contact:
            state.update({key: ((3,), torch.float32) for key in GOAL}, going=((1,), torch.bool))
        state.update(plan_state(self.options, TWIST))
        return state

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """History, contact point and plan {"learner": ...}, all zeros at the start of an episode.

        "contact_point" [E, 3] (world, m) is where it goes and "standoff" [E, 3] from which side, "going" [E, 1] whether
        it does so.
        """
        state = {key: torch.zeros(*batch, *shape, dtype=dtype) for key, (shape, dtype) in self._state().items()}
        return TensorDict({"learner": state} if state else {}, batch_size=batch)

    def network_inputs(self, rows: TensorDictBase) -> TensorDict:
        """Inputs [B] of rows [B]: "points", "features", "valid" and "felt" [B, 1 + history, HAND_FEATURES]."""
        obs = rows["observation"]
        tip = obs["tool_pose"][..., :3]
        shown = self._shown(obs)
        features = [shown(obs["part_mask"])[..., None].to(tip.dtype)]
        if self.flow_key is not None:
            features.append(shown(rows[self.flow_key]))
        felt = hand_features(obs, self.limits)[:, None]
        if self.options.history:
            felt = torch.cat([felt, rows["learner", "felt"]], dim=1)
        return TensorDict(
            {
                "points": shown(obs["points"]) - tip[:, None],
                "features": torch.cat(features, dim=-1),
                "valid": shown(obs["valid"]),
                "felt": felt,
            },
            batch_size=rows.batch_size,
        )

    def _shown(self, obs: TensorDictBase) -> Callable[[Tensor], Tensor]:
        """What takes the points that the network reads from values [B, N, ...] of a cloud's points."""
        count, focus = self.options.points, self.options.focus
        if focus == "none":
            return lambda values: values[:, :count]
        if focus == "hand":
            far = (obs["points"] - obs["tool_pose"][:, None, :3]).norm(dim=-1).masked_fill(~obs["valid"], torch.inf)
        else:
            far = (~(obs["part_mask"] & obs["valid"])).to(torch.float32)
        half = far.argsort(dim=1, stable=True)[:, : count // 2]
        rest = torch.arange(count - half.shape[1], device=half.device).clamp(max=far.shape[1] - 1)
        index = torch.cat([half, rest.expand(len(half), -1)], dim=1)
        rows = torch.arange(len(index), device=index.device)[:, None]
        return lambda values: values[rows, index]

    def train(self, mode: bool = True) -> Learner:
        """As every module's, but a flow network stays as it is."""
        super().train(mode)
        if self.flow_network is not None:
            self.flow_network.eval()
        return self

    def planned(
        self, inputs: TensorDictBase, noise: Tensor | None = None, intention: Intention | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """Plan [B, chunk, 6] and discrepancy [B, 1] of :meth:`network_inputs`, from ``noise`` if the head needs it.

        With a guide the plan is for ``intention``, or for what the guide tells without that of the step before.
        """
        encoded, distance = self.network(*(inputs[key] for key in INPUTS), intention)
        return self.network.plan(encoded, noise), distance

    def _intention(self, tensordict: TensorDictBase, inputs: TensorDictBase) -> Intention:
        """What the guide tells; it keeps to its contact point while the hand is on its way. Writes the next state."""
        network, obs = self.network, tensordict["observation"]
        told = network.told(*(inputs[key] for key in INPUTS))
        if not self.options.contact:
            return network.intention(told, inputs["felt"])
        tip, before, going = obs["tool_pose"][..., :3], None, None
        if ("learner", "going") in tensordict.keys(True):  # not in labels that are read again
            before = (tensordict["learner", "contact_point"] - tip, tensordict["learner", "standoff"])
            going = tensordict["learner", "going"]
        intention = network.intention(told, inputs["felt"], before, going)
        on_its_way = ~obs["attached"]
        if self.options.phase:
            on_its_way = on_its_way & (intention.phase[:, [TRAVEL, APPROACH]].sum(1, keepdim=True) > 0)
        state = {"contact_point": intention.contact + tip, "standoff": intention.standoff, "going": on_its_way}
        for key, value in state.items():
            tensordict["next", "learner", key] = value
        return intention

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, the history, the contact point and the plan."""
        if self._predict is not None:
            self._predict(tensordict)
        inputs, obs = self.network_inputs(tensordict), tensordict["observation"]
        intention = self._intention(tensordict, inputs) if self.options.guided else None
        plan, distance = self.planned(inputs, trial_noise(tensordict, self.network.noise), intention)
        twist, state = executed(plan, tensordict.get("learner", None), self.options)
        for key, value in state.items():
            tensordict["next", "learner", key] = value
        if self.options.history:
            tensordict["next", "learner", "felt"] = inputs["felt"][:, :-1]
        if distance is not None:
            tensordict["learner", "discrepancy"] = distance
        velocity, angular = twist[:, :3] * self.limits.linear, twist[:, 3:] * self.limits.angular
        tensordict["action"] = joint_velocities(obs, hand_axis(obs["tool_pose"]), velocity, angular, self.limits)
        return tensordict


def hand_features(obs: TensorDictBase, limits: VelocityLimits) -> Tensor:
    """The features of the hand [..., HAND_FEATURES], of the contract's "observation" group."""
    hand = hand_axis(obs["tool_pose"])
    velocity, angular = hand_velocities(obs, hand, obs["qvel"])
    force = (obs["contact_force"] / LARGEST_FORCE).clamp(max=1.0)
    tip, held = obs["tool_pose"][..., :3], obs["attached"].to(force.dtype)
    camera = normalize(obs["camera_position"] - tip)
    own = [hand, velocity / limits.linear, camera, angular / limits.angular, held, force, tip[..., 2:]]
    return torch.cat(own, dim=-1)


def history_of(features: Tensor, count: int) -> Tensor:
    """The history at each step of an episode [T, count, HAND_FEATURES], the last step first, of features [T, ...]."""
    padded = torch.cat([features.new_zeros(count, features.shape[-1]), features])
    return torch.stack([padded[count - k : len(padded) - k] for k in range(1, count + 1)], dim=1)


def twist_of(obs: TensorDictBase, action: Tensor, limits: VelocityLimits) -> Tensor:
    """The twist [..., 6] that an action [..., 8] is: the learner's label of the expert's action."""
    scale = torch.tensor([limits.linear] * 3 + [limits.angular] * 3 + [0.0] * 2, dtype=action.dtype)
    velocity, angular = hand_velocities(obs, hand_axis(obs["tool_pose"]), action * scale.to(action.device))
    return torch.cat([velocity / limits.linear, angular / limits.angular], dim=-1)


INTENTION = ("contact_point", "standoff", "phase")
"""What of the expert's state a row keeps below "expert" for a learner that tells its intention."""


def intention_of(rows: TensorDictBase) -> tuple[Intention, Tensor]:
    """The expert's intention in rows [B], and where it goes to a contact point [B] bool."""
    expert, phase = rows["expert"], rows["expert", "phase"].flatten()
    contact = expert["contact_point"] - rows["observation", "tool_pose"][..., :3]
    one_hot = nn.functional.one_hot(phase, len(PHASES)).to(contact.dtype)
    return Intention(contact, expert["standoff"], one_hot), (phase == TRAVEL) | (phase == APPROACH)


def turning(rotation: Tensor, mirrored: Tensor) -> Tensor:
    """Matrices [B, 3, 3] that reflect in the plane y = 0 where ``mirrored`` [B], then turn about z by [B] rad."""
    cos, sin, flip = rotation.cos(), rotation.sin(), torch.where(mirrored, -1.0, 1.0)
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    return torch.stack([cos, -sin * flip, zero, sin, cos * flip, zero, zero, zero, one], -1).view(-1, 3, 3)


def rotated(inputs: TensorDictBase, twist: Tensor, rotation: Tensor, mirrored: Tensor) -> tuple[TensorDict, Tensor]:
    """The same situation in a scene that is reflected in the plane y = 0 where ``mirrored``, then turned about z.

    Points, flow, axes and velocities are vectors; a turning is an axial one, which a reflection also reverses.

    Args:
        inputs: :meth:`Learner.network_inputs`'s entries [B].
        twist: [B, chunk, 6].
        rotation: [B] rad.
        mirrored: [B] bool.
    """
    matrix, flip = turning(rotation, mirrored), torch.where(mirrored, -1.0, 1.0)

    def turn(vectors: Tensor) -> Tensor:  # [B, K, 3]
        return vectors @ matrix.mT

    def turn_pair(pair: Tensor) -> Tensor:  # [B, K, 6]: a velocity and a turning
        return torch.cat([turn(pair[..., :3]), turn(pair[..., 3:]) * flip[:, None, None]], dim=-1)

    features, felt = inputs["features"], inputs["felt"]
    if features.shape[-1] > 1:
        features = torch.cat([features[..., :1], turn(features[..., 1:])], dim=-1)
    felt = torch.cat([turn(felt[..., :3]), turn(felt[..., 3:6]), turn_pair(felt[..., 6:12]), felt[..., 12:]], dim=-1)
    points = turn(inputs["points"])
    result = TensorDict(
        {"points": points, "features": features, "valid": inputs["valid"], "felt": felt}, inputs.batch_size
    )
    return result, turn_pair(twist)

from __future__ import annotations

import pickle

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import euler_xyz_to_matrix, matrix_to_quaternion
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.encoders import ENCODERS
from fb3d_rl.models.heads import HEADS
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, joint_velocities
from fb3d_rl.policies.learner import (
    HAND_FEATURES,
    INPUTS,
    Learner,
    LearnerOptions,
    hand_features,
    history_of,
    intention_of,
    rotated,
    twist_of,
)
from fb3d_rl.policies.plans import executed
from fb3d_rl.training.draws import global_draws

LIMITS = VelocityLimits(linear=2.0, angular=3.0)
POINTS = 80


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene(count: int = 3, seed: int = 1) -> TensorDict:
    """Observations with nothing at 0 and nothing aligned with an axis."""
    g = generator(seed)
    angles = torch.rand(count, 3, generator=g) - 0.5
    position = torch.rand(count, 3, generator=g)
    tool = torch.cat([position + 0.1, matrix_to_quaternion(euler_xyz_to_matrix(angles))], dim=-1)
    flow = torch.randn(count, POINTS, 3, generator=g)
    observation = {
        "points": torch.rand(count, POINTS, 3, generator=g),
        "valid": torch.rand(count, POINTS, generator=g) < 0.8,
        "part_mask": torch.rand(count, POINTS, generator=g) < 0.5,
        "camera_position": torch.randn(count, 3, generator=g) * 3,
        "qpos": torch.cat([position, angles, torch.zeros(count, 2)], dim=-1),
        "qvel": torch.randn(count, 8, generator=g),
        "tool_pose": tool,
        "attached": torch.rand(count, 1, generator=g) < 0.5,
        "contact_force": 20 * torch.rand(count, 1, generator=g),
    }
    return TensorDict({"observation": observation, "privileged": {"flow": flow}}, batch_size=[count])


def learner(**options: object) -> Learner:
    small = {"points": 64, "width": 8, "history": 0, **options}
    net = ArtFlowNet(generator=generator()) if options.get("flow") == "artflownet" else None
    return Learner(LearnerOptions(**small), LIMITS, generator(), net).eval()  # type: ignore[arg-type]


def act(policy: Learner, td: TensorDict) -> TensorDict:
    return policy(td.clone().update(policy.initial_state(td.batch_size)))


@pytest.mark.parametrize("encoder", ENCODERS)
def test_the_action_depends_on_what_a_policy_should_depend_on(encoder: str) -> None:
    policy, td = learner(encoder=encoder, flow="ground_truth"), scene(1)
    action = act(policy, td)["action"]
    assert action.shape == (1, 8) and bool((action.abs() <= 1).all()) and not action[:, 6:].any()
    for key in ("part_mask", "attached"):
        other = td.clone()
        other["observation", key] = ~other["observation", key]
        assert not torch.allclose(act(policy, other)["action"], action, atol=1e-7), key
    for key in (("observation", "points"), ("observation", "qvel"), ("privileged", "flow")):
        other = td.clone()
        other[key] = other[key] * 0.7
        assert not torch.allclose(act(policy, other)["action"], action, atol=1e-7), key
    padding = ~td["observation", "valid"]
    other = td.clone()
    other["observation", "points"] = td["observation", "points"].masked_fill(padding[..., None], torch.nan)
    assert torch.allclose(act(policy, other)["action"], action, atol=1e-6), "padding counts"
    beyond = td.clone()
    beyond["observation", "points"][:, 64:] += 1.0
    assert torch.equal(act(policy, beyond)["action"], action), "points beyond options.points count"


@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_batch_is_as_its_members_and_moving_the_scene_changes_nothing(encoder: str) -> None:
    policy, td = learner(encoder=encoder), scene(3)
    together = act(policy, td)["action"]
    apart = torch.cat([act(policy, td[i : i + 1])["action"] for i in range(3)])
    assert torch.allclose(together, apart, atol=1e-5)
    shift = torch.tensor([0.7, -0.4, 0.0])  # the height above the ground is felt
    moved = td.clone()
    for key in ("points", "camera_position"):
        moved["observation", key] = moved["observation", key] + shift
    moved["observation", "qpos"][:, :3] += shift
    moved["observation", "tool_pose"][:, :3] += shift
    assert torch.allclose(act(policy, moved)["action"], together, atol=1e-4)


def test_no_privileged_key_reaches_a_learner_that_does_not_declare_it() -> None:
    for flow in ("none", "artflownet"):
        policy = learner(flow=flow)
        assert not [key for key in policy.in_keys if key[0] == "privileged"]
        td = scene(2)
        del td["privileged"]
        act(policy, td)
    declared = [key for key in learner(flow="ground_truth").in_keys if key[0] == "privileged"]
    assert declared == [("privileged", "flow")]


def test_a_predicted_flow_is_what_artflownet_says() -> None:
    policy, td = learner(flow="artflownet"), scene(2)
    net, obs = ArtFlowNet(generator=generator()).eval(), td["observation"]
    with torch.no_grad():
        expected = net(obs["points"], obs["valid"], obs["part_mask"])
    assert torch.allclose(act(policy, td)["prediction", "flow"], expected, atol=1e-6)
    policy.train()
    assert policy.flow_network is not None and not policy.flow_network.training
    assert not any(p.requires_grad for p in policy.flow_network.parameters())


def test_the_twist_of_an_action_is_the_motion_that_makes_it() -> None:
    td = scene(4)
    hand = hand_axis(td["observation", "tool_pose"])
    velocity = 0.3 * torch.randn(4, 3, generator=generator(2))
    angular = 0.3 * torch.randn(4, 3, generator=generator(3))
    angular = angular - (angular * hand).sum(-1, keepdim=True) * hand
    action = joint_velocities(td["observation"], hand, velocity, angular, LIMITS)
    twist = twist_of(td["observation"], action, LIMITS)
    assert torch.allclose(twist[:, :3] * LIMITS.linear, velocity, atol=1e-4)
    assert torch.allclose(twist[:, 3:] * LIMITS.angular, angular, atol=0.05)  # damped least squares


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_turned_situation_is_what_is_felt_in_the_turned_scene(mirrored: bool) -> None:
    policy, td, angle = learner(flow="ground_truth", history=0), scene(1), 0.6
    flip = torch.diag(torch.tensor([1.0, -1.0 if mirrored else 1.0, 1.0]))
    turn = euler_xyz_to_matrix(torch.tensor([0.0, 0.0, angle])) @ flip
    obs, other = td["observation"], td.clone()
    for key in ("points", "camera_position"):
        other["observation", key] = obs[key] @ turn.T
    other["privileged", "flow"] = td["privileged", "flow"] @ turn.T
    # The hand in the turned scene: the same axis rotated, whatever the spin about it.
    axis, tip = hand_axis(obs["tool_pose"]), obs["tool_pose"][:, :3]
    inputs, twist = policy.network_inputs(td), torch.randn(1, 1, 6, generator=generator(5))
    got, label = rotated(inputs, twist, torch.tensor([angle]), torch.tensor([mirrored]))
    sign = -1.0 if mirrored else 1.0
    felt = inputs["felt"][0, 0]
    assert torch.allclose(got["points"], (obs["points"][:, :64] - tip) @ turn.T, atol=1e-5)
    assert torch.allclose(got["features"][..., 1:], other["privileged", "flow"][:, :64], atol=1e-5)
    assert torch.equal(got["features"][..., 0], inputs["features"][..., 0])
    assert torch.allclose(got["felt"][0, 0, :3], turn @ axis[0], atol=1e-5)
    assert torch.allclose(got["felt"][0, 0, 9:12], sign * turn @ felt[9:12], atol=1e-5), "an axial vector"
    assert torch.allclose(label[0, 0, :3], turn @ twist[0, 0, :3], atol=1e-6)
    assert torch.allclose(label[0, 0, 3:], sign * turn @ twist[0, 0, 3:], atol=1e-6)
    # omega x r is the velocity of a point: it has to turn and reflect as one, which fixes omega's sign.
    arm = torch.tensor([0.2, -0.1, 0.4])
    before = torch.linalg.cross(twist[0, 0, 3:], arm)
    assert torch.allclose(torch.linalg.cross(label[0, 0, 3:], turn @ arm), turn @ before, atol=1e-5)


def test_it_remembers_what_it_felt_as_training_rows_say() -> None:
    policy, steps = learner(history=2), [scene(1, seed) for seed in range(4)]
    state, remembered = policy.initial_state(torch.Size([1])), []
    for td in steps:
        td.update(state)
        remembered.append(td["learner", "felt"].clone())
        state = policy(td)["next"].select("learner")
    felt = torch.cat([hand_features(td["observation"], LIMITS) for td in steps])
    assert torch.allclose(torch.cat(remembered), history_of(felt, 2), atol=1e-6)
    assert not remembered[0].any() and torch.allclose(remembered[3][0, 0], felt[2]) and felt.shape == (4, HAND_FEATURES)


def test_a_plan_is_executed_step_by_step_before_it_looks_again() -> None:
    policy, td = learner(chunk=4, execute=3), scene(1)
    state, twists = policy.initial_state(torch.Size([1])), []
    for seed in (1, 2, 3, 4):
        td = scene(1, seed).update(state)
        out = policy(td)
        twists.append(twist_of(td["observation"], out["action"], LIMITS)[0, :3])
        state = out["next"].select("learner")
    inputs = policy.network_inputs(scene(1, 1))
    plan = policy.planned(inputs)[0][0]
    for k in range(3):
        wanted = plan[k, :3] / max(1.0, float(plan[k, :3].detach().abs().max()))
        assert torch.allclose(twists[k], wanted, atol=0.05)
    again = policy.network_inputs(scene(1, 4))
    assert torch.allclose(twists[3], policy.planned(again)[0][0, 0, :3], atol=0.05)


def episode(count: int = 3, seed: int = 0) -> TensorDict:
    """What an environment adds to observations, which noise depends on."""
    return TensorDict(
        {"seed": torch.arange(count)[:, None] + seed, "elapsed_steps": torch.zeros(count, 1, dtype=torch.int32)},
        [count],
    )


@torch.no_grad()
def error_of(policy: Learner, inputs: TensorDict, twist: torch.Tensor) -> float:
    """Mean distance of plans from labels."""
    noise = torch.randn(len(twist), policy.network.noise, generator=generator(9))
    return float((policy.planned(inputs, noise)[0] - twist).abs().mean())


@pytest.mark.parametrize("head", HEADS)
def test_every_head_fits_labels_through_the_learners_loss(head: str) -> None:
    policy = learner(head=head, width=16).train()
    inputs, twist = policy.network_inputs(scene(8)), 0.5 * torch.randn(8, 1, 6, generator=generator(7))
    policy.network.normalize(twist[:, 0])
    loss = policy.network.loss("l2", 10.0)
    optimizer, values, before = torch.optim.Adam(policy.parameters(), lr=0.004), [], error_of(policy, inputs, twist)
    for step in range(250):
        encoded, _ = policy.network(*(inputs[key] for key in INPUTS))
        batch = {"encoded": encoded, "twist": twist, "is_pad": torch.zeros(8, 1, dtype=torch.bool)}
        with global_draws(generator(step), torch.device("cpu")):
            value = loss(TensorDict(batch, batch_size=[8]))
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        values.append(value.item())
    assert sum(values[-10:]) < sum(values[:10])
    assert error_of(policy, inputs, twist) < 0.6 * before


@pytest.mark.parametrize("head", HEADS)
def test_a_head_comes_back_from_its_weights_and_acts_the_same_with_the_same_seed(head: str) -> None:
    options: dict[str, object] = {"head": head, "chunk": 3, "normalize": True}
    policy, td = learner(**options), scene(3).update(episode(3))
    policy.network.normalize(torch.rand(20, 6, generator=generator(4)))
    action = act(policy, td)["action"]
    again = Learner(policy.options, LIMITS, generator(5)).eval()
    assert not torch.equal(act(again, td)["action"], action)
    again.network.load_state_dict(policy.network.state_dict())
    torch.rand(7)  # global draws do not count
    assert torch.equal(act(again, td)["action"], action)
    other = act(policy, td.clone().update(episode(3, seed=1)))["action"]
    assert torch.equal(other, action) != bool(policy.network.noise), "noise follows the trial's seed"
    sent = pickle.loads(pickle.dumps(again))  # as to a worker, which gets weights later on
    assert torch.equal(act(sent, td)["action"], action)
    TensorDict.from_module(Learner(policy.options, LIMITS, generator(5))).data.to_module(sent)
    assert not torch.equal(act(sent, td)["action"], action)
    alone = act(policy, td[1:2])["action"]
    assert torch.allclose(alone, action[1:2], atol=1e-5), "and not the other scenes"
    first = Learner(policy.options, LIMITS, generator(6)).network.state_dict()
    same = Learner(policy.options, LIMITS, generator(6)).network.state_dict()
    assert all(torch.equal(first[key], same[key]) for key in first), "first weights follow the generator"


def test_labels_of_any_size_are_the_same_to_a_normalized_head() -> None:
    policy = learner(head="diffusion")
    twists = torch.randn(50, 6, generator=generator(3)) * torch.tensor([0.3] * 3 + [0.1] * 3)
    policy.network.normalize(twists)
    velocity, turning = policy.network.size[:3], policy.network.size[3:]
    assert torch.allclose(velocity, twists[:, :3].square().mean().sqrt()) and velocity[0] > 2 * turning[0]
    encoded, noise = torch.zeros(1, 32), torch.randn(1, 6, generator=generator(8))
    plan = policy.network.plan(encoded, noise)
    policy.network.normalize(2 * twists)
    assert torch.allclose(policy.network.plan(encoded, noise), 2 * plan, atol=1e-6)


def test_an_ensemble_of_plans_is_their_weighted_mean() -> None:
    policy = learner(chunk=3, ensemble=0.5)
    plans = torch.randn(5, 2, 3, 6, generator=generator(1))
    state = policy.initial_state(torch.Size([2]))["learner"]
    for step in range(5):
        done, after = executed(plans[step], state, policy.options)
        reaching = [plans[made][:, step - made] for made in range(max(0, step - 2), step + 1)]
        weights = torch.exp(-0.5 * torch.arange(len(reaching)))
        expected = sum(w * p for w, p in zip(weights, reaching, strict=True)) / weights.sum()
        assert torch.allclose(done, expected, atol=1e-6), step
        assert {key: (value.shape, value.dtype) for key, value in after.items()} == {
            key: (state[key].shape, state[key].dtype) for key in after
        }
        state = TensorDict(after, batch_size=[2])


def test_a_predicted_discrepancy_is_positive_and_declared() -> None:
    policy = learner(discrepancy=True)
    assert ("learner", "discrepancy") in policy.out_keys
    assert bool((act(policy, scene(3))["learner", "discrepancy"] > 0).all())


@pytest.mark.parametrize(
    "options",
    [
        {"encoder": "cnn"},
        {"head": "x"},
        {"flow": "x"},
        {"points": 1},
        {"chunk": 2, "execute": 3},
        {"chunk": 3, "execute": 2, "ensemble": 0.1},
        {"ensemble": 0.1},
    ],
)
def test_options_that_make_no_learner_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(UserError, match=next(reversed(options))):
        LearnerOptions(**options)  # type: ignore[arg-type]


def test_half_of_the_points_are_the_nearest_or_on_the_part() -> None:
    td = scene(3)
    obs = td["observation"]
    tip, valid, part = obs["tool_pose"][:, None, :3], obs["valid"], obs["part_mask"] & obs["valid"]
    for focus in ("hand", "part"):
        policy = learner(focus=focus, flow="ground_truth", points=32)
        shown = policy.network_inputs(td)
        assert shown["points"].shape == (3, 32, 3) and bool(shown["valid"][:, :16].all())
        evenly = learner(flow="ground_truth", points=32).network_inputs(td)
        for key in ("points", "features", "valid"):
            assert torch.equal(shown[key][:, 16:], evenly[key][:, :16]), "the other half is drawn as ever"
        if focus == "hand":
            distance = (obs["points"] - tip).norm(dim=-1).masked_fill(~valid, torch.inf)
            nearest = distance.sort(dim=1).values[:, :16]
            assert torch.allclose(shown["points"][:, :16].norm(dim=-1).sort(dim=1).values, nearest)
        else:
            assert bool((part.sum(1) >= 16).all()) and bool((shown["features"][:, :16, 0] == 1).all())
        for row in range(3):  # each with its own flow
            place = (obs["points"][row] - tip[row] - shown["points"][row, 5]).norm(dim=-1).argmin()
            assert torch.equal(shown["features"][row, 5, 1:], td["privileged", "flow"][row, place])
    few = td.clone()
    few["observation", "part_mask"][:] = False
    few["observation", "part_mask"][:, 70] = few["observation", "valid"][:, 70] = True
    shown = learner(focus="part", points=32).network_inputs(few)
    assert (shown["features"][..., 0].sum(1) == 1).all(), "a part that is hardly seen is shown whatever comes first"


def test_a_guided_learner_plans_for_what_its_guide_tells() -> None:
    policy, td = learner(contact=True, phase=True), scene(3)
    inputs = policy.network_inputs(td)
    told = policy.network.intention(policy.network.told(*(inputs[key] for key in INPUTS)), inputs["felt"])
    given = [policy.network(*(inputs[key] for key in INPUTS), meant)[0] for meant in (None, told)]
    assert torch.equal(*given)
    for change in ({"contact": told.contact + 0.1}, {"standoff": -told.standoff}, {"phase": told.phase.roll(1, 1)}):
        other = policy.network(*(inputs[key] for key in INPUTS), told._replace(**change))[0]
        same = ~(other != given[0]).any(1)
        assert torch.equal(same, td["observation", "attached"].flatten() & ("phase" not in change)), change
    near = (inputs["points"] - told.contact[:, None]).norm(dim=-1).masked_fill(~inputs["valid"], torch.inf)
    assert bool((near.amin(1) < 0.06).all()), "at the points that are there"
    again = Learner(policy.options, LIMITS, generator(5)).eval()
    again.network.load_state_dict(policy.network.state_dict())
    assert torch.equal(act(again, td)["action"], act(policy, td)["action"])


def test_a_guided_learner_keeps_to_its_contact_point_until_it_holds_the_part_or_another_is_much_likelier() -> None:
    policy, td = learner(contact=True), scene(3)
    td["observation", "attached"][:] = False
    first = act(policy, td)["next", "learner"].select("contact_point", "standoff", "going")
    assert bool(first["going"].all())
    with torch.no_grad():
        policy.network.guide.network.score.weight.mul_(-0.01)  # now the least likely points, but hardly
    td["observation", "tool_pose"][:, :3] += 0.05
    fresh = act(policy, td)["next", "learner"]
    assert not torch.equal(fresh["contact_point"], first["contact_point"])
    td["learner"] = act(policy, td)["next", "learner"].update(first)
    kept = policy(td.clone())["next", "learner"]
    assert torch.allclose(kept["contact_point"], first["contact_point"], atol=1e-6), "in the world, not from the tip"
    assert torch.equal(kept["standoff"], first["standoff"])
    with torch.no_grad():
        policy.network.guide.network.score.weight.mul_(1e7)
    doubted = policy(td.clone())["next", "learner"]
    assert not torch.equal(doubted["contact_point"], first["contact_point"])
    td["observation", "attached"][0] = True
    assert policy(td.clone())["next", "learner", "going"].flatten().tolist() == [False, True, True]


def test_the_expert_s_intention_is_seen_from_the_tip() -> None:
    td = scene(4)
    place, axis = torch.rand(4, 3), torch.eye(3)[[0, 1, 2, 0]]
    phase = torch.tensor([0, 1, 2, 3])[:, None]
    td["expert"] = TensorDict({"contact_point": place, "standoff": axis, "phase": phase}, [4])
    true, goes = intention_of(td)
    assert torch.equal(true.contact, place - td["observation", "tool_pose"][:, :3]) and torch.equal(true.standoff, axis)
    assert goes.tolist() == [False, True, True, False] and true.phase.argmax(1).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("frozen", [True, False])
def test_the_published_flow_network_as_an_encoder(frozen: bool) -> None:
    policy, published = learner(encoder="artflownet", frozen=frozen).train(), ArtFlowNet.from_pretrained()
    flow = policy.network.encoder.flow
    weights = {key: value for key, value in published.state_dict().items() if "head.1" not in key}
    assert all(torch.equal(flow.state_dict()[key], weights[key]) for key in weights), "not those drawn at random"
    before = {key: value.clone() for key, value in flow.state_dict().items()}
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.01)
    policy.planned(policy.network_inputs(scene(3)))[0].square().sum().backward()
    optimizer.step()
    moved = {key for key, value in flow.state_dict().items() if not torch.equal(value, before[key])}
    assert bool(moved) != frozen and not [key for key in moved if "running" in key or "num_batches" in key]
    assert policy.network.encoder.attention.score.weight.grad.any()

"""Gates on hand-made steps with a known answer: both sides of every threshold, several environments at once."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.errors import UserError
from fb3d_rl.policies.ensemble import Ensemble
from fb3d_rl.policies.gates import (
    GATES,
    EnsembleGate,
    LazyGate,
    SafeGate,
    ThriftyGate,
    budget_threshold,
    discrepancy,
    make_gate,
)
from fb3d_rl.policies.interaction import BetaGate, EitherGate, Gate, OracleGate
from fb3d_rl.policies.options import BUDGETED

NAN = math.nan


def steps(
    true: list[float] | None = None, predicted: list[float] | None = None, variance: list[float] | None = None
) -> TensorDict:
    """One step of E environments: the actions' true distance, the predicted one, and the ensemble's variance."""
    given = {"true": true, "discrepancy": predicted, "variance": variance}
    count = max(len(values) for values in given.values() if values is not None)
    columns = {key: torch.tensor(values or [0.0] * count)[:, None] for key, values in given.items()}
    expert = torch.linspace(-0.5, 0.5, ACTION_DIM).repeat(count, 1)
    direction = torch.zeros(ACTION_DIM)
    direction[1], direction[4] = 0.6, -0.8  # of length 1
    learner = {"action": expert + columns.pop("true") * direction, **columns}
    return TensorDict({"expert": {"action": expert}, "learner": learner}, batch_size=[count])


def acts(gate: Gate, td: TensorDictBase) -> list[bool]:
    decision = gate(td)
    assert decision.shape == (len(td), 1) and decision.dtype is torch.bool
    return decision.flatten().tolist()


def play(gate: Gate, sequence: list[TensorDict]) -> list[list[bool]]:
    """Whether the expert acts, by environment, in a sequence of steps that carries the gate's state on."""
    state, decisions = gate.initial_state(sequence[0].batch_size), []
    for td in sequence:
        td.update(state)
        decisions.append(acts(gate, td))
        state = td["next"]
    return [list(column) for column in zip(*decisions, strict=True)]


def test_the_distance_is_the_norm_over_the_whole_action() -> None:
    td = steps(true=[0.0, 0.5, 2.0])
    torch.testing.assert_close(discrepancy(td), torch.tensor([[0.0], [0.5], [2.0]]))
    torch.testing.assert_close(discrepancy(torch.stack([td, td], 1))[:, 1], discrepancy(td))


def test_safe_lets_the_expert_act_beyond_tau_of_the_prediction() -> None:
    td = steps(true=[9.0, 0.0, 9.0, 0.0, 0.0], predicted=[0.3, 0.3001, 0.25, 5.0, NAN])
    assert acts(SafeGate(tau=0.3), td) == [False, True, False, True, True], "the true distance is not known to it"


def test_ensemble_lets_the_learner_act_only_where_both_rules_agree() -> None:
    gate = EnsembleGate(chi=0.125, tau=0.5)
    td = steps(true=[0.4, 0.6, 0.4, 0.6, 0.0, NAN], variance=[0.125, 0.125, 0.126, 0.126, NAN, 0.0])
    assert acts(gate, td) == [False, True, True, True, True, True]


def test_lazy_takes_over_by_the_prediction_and_keeps_acting_until_the_true_distance_is_small() -> None:
    gate = LazyGate(beta_h=0.5, beta_r=0.2)
    true = {  # two environments, step by step
        0: [0.0, 0.9, 0.3, 0.1, 0.9, 0.1, 0.0],
        1: [0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9],
    }
    predicted = {
        0: [0.5, 0.6, 0.0, 0.0, 0.4, 0.7, 0.0],
        1: [0.0, 0.1, 0.5, 0.51, 0.0, 0.0, 0.0],
    }
    sequence = [steps(true=[true[0][t], true[1][t]], predicted=[predicted[0][t], predicted[1][t]]) for t in range(7)]
    first, second = play(gate, sequence)
    # Step 2 is between the thresholds; step 3 is the expert's last one; in step 5 it takes over and hands back.
    assert first == [False, True, True, True, False, True, False]
    assert second == [False, False, False, True, True, True, True]


def test_lazy_hands_back_strictly_below_its_threshold() -> None:
    gate = LazyGate(beta_h=0.5, beta_r=0.25)
    td = steps(true=[0.25, 0.25, 0.2], predicted=[1.0, 1.0, 1.0]).update(gate.initial_state(torch.Size([3])))
    td["learner", "action"] = td["expert", "action"].clone()
    td["learner", "action"][:2, 0] += 0.25  # exactly
    gate(td)
    assert td["next", "gate", "lazy"].flatten().tolist() == [True, True, False]


def test_thrifty_takes_over_by_novelty_or_risk_and_hands_back_by_the_true_distance() -> None:
    gate = ThriftyGate(delta_h=0.5, beta_h=1.0, delta_r=0.3)
    novel = [
        steps(true=[0.9, 0.9], predicted=[0.0, 1.0], variance=[0.5, 0.5]),  # on the thresholds
        steps(true=[0.9, 0.9], predicted=[0.0, 1.1], variance=[0.6, 0.0]),  # novel; risky
        steps(true=[0.9, 0.2], predicted=[0.0, 0.0], variance=[0.0, 9.0]),  # still far; near
        steps(true=[0.2, 0.2], predicted=[0.0, 0.0], variance=[0.0, 0.0]),
        steps(true=[0.2, 0.2], predicted=[0.0, NAN], variance=[0.0, 0.0]),
    ]
    assert play(gate, novel) == [[False, True, True, True, False], [False, True, True, False, True]]


@pytest.mark.parametrize("budget", [0.0, 0.1, 0.3, 1 / 3, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("count", [1, 7, 10, 999])
def test_a_budget_is_kept_and_used_up(budget: float, count: int) -> None:
    values = torch.rand(count, 1, generator=torch.Generator().manual_seed(3))
    above = int((~(values <= budget_threshold(values, budget))).sum())
    assert above == math.floor(budget * count + 1e-9)


def test_a_budget_is_used_up_where_its_product_falls_short_of_a_whole_number() -> None:
    assert 0.29 * 100 < 29 and budget_threshold(torch.arange(100), 0.29) == 70


def test_a_budget_is_not_exceeded_where_values_are_equal() -> None:
    values = torch.tensor([1.0, 1.0, 1.0, 2.0])
    assert budget_threshold(values, 0.5) == 1.0 and budget_threshold(values, 0.0) == 2.0


def test_a_budget_that_is_none_and_steps_that_are_none() -> None:
    with pytest.raises(UserError, match="budget"):
        budget_threshold(torch.ones(3), 1.5)
    with pytest.raises(ValueError, match="no steps"):
        budget_threshold(torch.ones(0), 0.5)


def frames(count: int, generator: torch.Generator) -> TensorDict:
    return steps(*(torch.rand(count, generator=generator).tolist() for _ in range(3)))


def test_safe_spends_its_budget_on_the_steps_that_it_was_tuned_by() -> None:
    td, gate = frames(200, torch.Generator().manual_seed(0)), SafeGate()
    gate.tune(td, 0.15)
    assert sum(acts(gate, td)) == 30
    worst = td["learner", "discrepancy"].flatten().topk(30).indices
    assert gate(td).flatten()[worst].all()


def test_lazy_is_tuned_by_the_learners_steps_and_keeps_its_ratio() -> None:
    td, gate = frames(200, torch.Generator().manual_seed(0)), LazyGate(beta_h=1.0, beta_r=0.4)
    td["gate", "lazy"] = torch.arange(200)[:, None] % 2 == 1
    td["learner", "discrepancy"][1::2] = 100.0  # what the expert met says nothing about the learner's steps
    gate.tune(td, 0.2)
    learners = td[::2].clone()
    assert sum(acts(gate, learners)) == 20
    assert float(gate.beta_r) == pytest.approx(0.4 * float(gate.beta_h))


def test_the_threshold_does_not_sink_when_the_same_steps_come_again() -> None:
    gate, td = LazyGate(), frames(500, torch.Generator().manual_seed(1))
    td["gate", "lazy"] = torch.zeros(500, 1, dtype=torch.bool)
    found = []
    for _ in range(3):
        gate.tune(td, 0.1)
        found.append(float(gate.beta_h))
        td["expert", "acts"] = gate(td)
    assert len(set(found)) == 1


def test_thrifty_is_tuned_by_both_and_hands_back_at_the_mean_distance() -> None:
    td, gate = frames(200, torch.Generator().manual_seed(0)), ThriftyGate()
    td["gate", "thrifty"] = torch.zeros(200, 1, dtype=torch.bool)
    gate.tune(td, 0.1)
    for key, threshold in (("variance", gate.delta_h), ("discrepancy", gate.beta_h)):
        assert int((td["learner", key] > threshold).sum()) == 20
    assert 20 <= sum(acts(gate, td)) <= 40
    torch.testing.assert_close(gate.delta_r, discrepancy(td).mean())


def test_no_budget_is_the_learner_and_a_full_one_the_expert() -> None:
    for name in BUDGETED:
        td, gate = frames(50, torch.Generator().manual_seed(2)), make_gate(name)
        td.update(gate.initial_state(td.batch_size))
        for budget, expected in ((0.0, False), (1.0, True)):
            gate.tune(td, budget)
            assert acts(gate, td) == [expected] * 50


def test_gates_that_take_no_budget_stay_as_they_are() -> None:
    td = frames(20, torch.Generator().manual_seed(2))
    for name in sorted(set(GATES) - set(BUDGETED) - {"human"}):
        gate = make_gate(name)
        before = copy.deepcopy(gate.state_dict())
        gate.tune(td, 0.5)
        assert gate.state_dict() == before != {}, name


def test_the_oracle_leads_up_to_the_hold_and_then_the_gate_decides() -> None:
    gate = EitherGate(OracleGate(), make_gate("lazy", beta_h=0.5, beta_r=0.2))
    assert ("observation", "attached") in gate.in_keys and ("learner", "discrepancy") in gate.in_keys
    sequence = [steps(true=[0.9], predicted=[p]) for p in (0.0, 0.0, 0.6, 0.0)]
    for td, attached in zip(sequence, (False, True, True, True), strict=True):
        td["observation", "attached"] = torch.tensor([[attached]])
    assert play(gate, sequence) == [[True, False, True, True]], "the oracle's step is no taking over"


def test_either_gate_tunes_each_and_carries_each_state() -> None:
    safe, thrifty = SafeGate(), ThriftyGate()
    gate, td = EitherGate(OracleGate(), safe, thrifty), frames(100, torch.Generator().manual_seed(0))
    td.update(gate.initial_state(td.batch_size))
    gate.tune(td, 0.1)
    alone = SafeGate()
    alone.tune(td, 0.1)
    assert torch.equal(safe.tau, alone.tau) and float(thrifty.delta_h) != ThriftyGate().delta_h
    td["observation", "attached"] = torch.ones(100, 1, dtype=torch.bool)
    decision = gate(td)
    assert torch.equal(decision, safe(td) | thrifty(td)) and ("next", "gate", "thrifty") in td.keys(True)


def never(td: TensorDictBase) -> Tensor:
    return torch.zeros(*td.batch_size, 1, dtype=torch.bool)


@pytest.mark.parametrize("name", GATES)
def test_every_gate_is_made_by_name_pickled_and_updated_by_weights(name: str) -> None:
    gate = EitherGate(OracleGate(), make_gate(name, **({"takes_over": never} if name == "human" else {})))
    td = frames(30, torch.Generator().manual_seed(0))
    td["observation", "attached"] = torch.ones(30, 1, dtype=torch.bool)
    td["seed"], td["elapsed_steps"] = torch.arange(30)[:, None], torch.arange(30)[:, None]
    td.update(gate.initial_state(td.batch_size))
    there = pickle.loads(pickle.dumps(gate))
    assert torch.equal(there(td.clone()), gate(td.clone()))
    for buffer in gate.buffers():
        buffer.fill_(0.125)
    TensorDict.from_module(gate).data.clone().to_module(there)
    assert [float(buffer) for buffer in there.buffers()] == [0.125] * len(list(gate.buffers()))
    assert torch.equal(there(td.clone()), gate(td.clone()))


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("dagger", {}, "beta, safe, ensemble, lazy, thrifty, human"),
        ("safe", {"chi": 1.0}, "chi.*it has tau"),
        ("human", {}, "takes_over"),
        ("safe", {"tau": -0.1}, "tau=-0.1"),
        ("safe", {"tau": NAN}, "tau=nan"),
        ("lazy", {"beta_h": 0.2, "beta_r": 0.2}, "less than"),
        ("beta", {"beta": 1.2}, "beta=1.2"),
    ],
)
def test_what_a_user_gets_wrong_is_named(name: str, options: dict[str, float], words: str) -> None:
    with pytest.raises(UserError, match=words):
        make_gate(name, **options)


def test_options_reach_the_gate() -> None:
    gate = make_gate("beta", beta=0.25, per_step=False)
    assert isinstance(gate, BetaGate) and float(gate.beta) == 0.25 and not gate.per_step


class Member(TensorDictModuleBase):
    """Adds a shift to the observation; keeps the number of its steps; fails if it sees another member's outputs."""

    def __init__(self, shift: float, in_key: str = "qpos") -> None:
        super().__init__()
        self.in_keys = [("observation", in_key), ("learner", "count")]
        self.out_keys = ["action", ("learner", "discrepancy"), ("next", "learner", "count")]
        self.shift = torch.nn.Parameter(torch.tensor(shift))

    @staticmethod
    def initial_state(batch: torch.Size) -> TensorDict:
        return TensorDict({"learner": {"count": torch.zeros(*batch, 1, dtype=torch.int64)}}, batch_size=batch)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        assert "action" not in td.keys() and ("next", "learner", "count") not in td.keys(True)
        scale = torch.arange(1.0, ACTION_DIM + 1)
        td["action"] = td["observation", "qpos"] + self.shift * scale
        td["learner", "discrepancy"] = self.shift.expand(len(td), 1)
        td["next", "learner", "count"] = td["learner", "count"] + 1
        td["observation", "qpos"] = torch.zeros_like(td["observation", "qpos"])  # a member's own business
        return td


def test_an_ensemble_acts_by_the_mean_and_says_the_variance() -> None:
    shifts = (-1.0, 0.5, 2.0)
    ensemble = Ensemble([Member(shift) for shift in shifts])
    qpos = torch.rand(4, ACTION_DIM, generator=torch.Generator().manual_seed(0))
    td = TensorDict({"observation": {"qpos": qpos}}, batch_size=[4]).update(ensemble.initial_state(torch.Size([4])))
    given = td.clone()
    out = ensemble(td)
    scale = torch.arange(1.0, ACTION_DIM + 1)
    torch.testing.assert_close(out["action"], qpos + 0.5 * scale)
    # The population variance of (-1, 0.5, 2) is 1.5; each entry scales it by its square.
    torch.testing.assert_close(out["learner", "variance"], (1.5 * scale.square().mean()).expand(4, 1))
    torch.testing.assert_close(out["learner", "discrepancy"], torch.full((4, 1), 0.5))
    assert out["next", "learner", "count"].flatten().tolist() == [1] * 4
    assert (td.select(*given.keys(True, True)) == given).all(), "what came in stays"
    assert set(ensemble.out_keys) <= set(out.keys(True, True)) and set(ensemble.in_keys) == set(given.keys(True, True))


def test_members_that_agree_have_no_variance_and_alone_neither() -> None:
    for members in ([Member(1.0), Member(1.0)], [Member(1.0)]):
        ensemble = Ensemble(members)
        td = TensorDict({"observation": {"qpos": torch.ones(2, ACTION_DIM)}}, batch_size=[2])
        assert not ensemble(td.update(ensemble.initial_state(torch.Size([2]))))["learner", "variance"].any()


def test_an_ensemble_needs_members_of_one_kind() -> None:
    with pytest.raises(ValueError, match="at least one"):
        Ensemble([])
    with pytest.raises(ValueError, match="different keys"):
        Ensemble([Member(0.0), Member(0.0, "qvel")])

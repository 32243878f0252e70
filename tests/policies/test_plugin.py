"""A policy of the user's own: found by name, given what it declares, refused in one sentence, evaluated as all are."""

from __future__ import annotations

import json
import pickle
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.errors import UserError
from fb3d_rl.policies.digest import policy_digest
from fb3d_rl.policies.flow_policy import MASK, FlowPolicyOptions
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.plugin import Plugin, plugin_policy
from fb3d_rl.rollout.rows import read_trials

ROOT = Path(__file__).resolve().parents[2]
LIMITS = VelocityLimits(2.0, 3.0)

SOURCE = """
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from fb3d_rl.policies.flow_policy import expert_policy as expert


class Counter:
    in_keys = [("observation", "tool_pose"), ("observation", "points")]

    def initial_state(self, batch):
        return TensorDict({"mine": {"count": torch.zeros(*batch, 1)}}, batch_size=batch)

    def __call__(self, seen):
        count = seen["mine", "count"] + 1
        return TensorDict({"action": count.expand(-1, 8) / 100, "next": {"mine": {"count": count}}}, seen.batch_size)


def forgets(limits, options):
    policy = Counter()
    act = lambda seen: torch.zeros(len(seen), 8)
    act.initial_state, act.in_keys = policy.initial_state, policy.in_keys
    return act


def make(limits, options):
    return Counter()


def everything(limits, options):
    return lambda seen: torch.full((len(seen), 8), len(seen["observation"].keys()) / 100)


def module(limits, options):
    return TensorDictModule(lambda pose: pose.new_zeros(len(pose), 8), [("observation", "tool_pose")], ["action"])


def meddles(limits, options):
    def act(seen):
        seen["observation", "points"].zero_()
        return torch.zeros(len(seen), 8)
    return act


def undeclared(limits, options):
    return lambda seen: seen["privileged", "flow"][:, 0, :1].expand(-1, 8)


def declared(limits, options):
    act = undeclared(limits, options)
    act.in_keys = [("privileged", "flow"), ("privileged", "joint_axis"), "seed"]
    return act


def unknown(limits, options):
    act = undeclared(limits, options)
    act.in_keys = [("observation", "colour")]
    return act


def masked(limits, options):
    act = undeclared(limits, options)
    act.in_keys = [("observation", "part_mask")]
    return act


def taken(limits, options):
    act = everything(limits, options)
    act.initial_state = lambda batch: TensorDict({"observation": {"x": torch.zeros(*batch, 1)}}, batch)
    return act


def slow(limits, options):
    import time
    begun = []
    def act(seen):
        begun.append(0)
        time.sleep(5.0 if len(begun) > 3 else 0.0)
        return torch.zeros(len(seen), 8)
    return act


def later(limits, options):
    begun = []
    def act(seen):
        begun.append(0)
        return torch.full((len(seen), 8), torch.nan if len(begun) > 3 else 0.0)
    return act


def short(limits, options):
    return lambda seen: torch.zeros(len(seen), 7)


def nan(limits, options):
    return lambda seen: torch.full((len(seen), 8), torch.nan)


def word(limits, options):
    return lambda seen: "open it"


def nothing(limits, options):
    return lambda seen: seen


def fails(limits, options):
    raise RuntimeError("no licence\\nfound")


def ends(limits, options):
    raise SystemExit(3)


def stumbles(limits, options):
    return lambda seen: 1 / 0


def none(limits, options):
    return None


def few(limits):
    return everything(limits, None)


number = 3
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, with the user's module; its name is new each time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "my_policies.py").write_text(SOURCE)
    (tmp_path / "broken.py").write_text("import numpy\nimport no_such_library\n")
    (tmp_path / "wrong.py").write_text("def make(:\n")
    yield tmp_path
    for name in ("my_policies", "broken", "wrong"):
        sys.modules.pop(name, None)


def made(name: str, mask: Any = "target") -> Plugin:
    return plugin_policy(LIMITS, FlowPolicyOptions(mask=mask), f"my_policies:{name}", 64)


def frame() -> TensorDict:
    observation = {"points": torch.ones(2, 5, 3), "valid": torch.ones(2, 5, dtype=torch.bool)}
    observation |= {"part_mask": torch.ones(2, 5, dtype=torch.bool), "qpos": torch.zeros(2, 8)}
    observation |= {"qvel": torch.zeros(2, 8), "tool_pose": torch.zeros(2, 7), "camera_position": torch.zeros(2, 3)}
    observation |= {name: torch.zeros(2, 1) for name in ("attached", "contact_force", "goal_sense")}
    return TensorDict(
        {"observation": observation, "privileged": {"flow": torch.ones(2, 5, 3), "joint_axis": torch.ones(2, 3)}}
        | {"seed": torch.ones(2, 1), "success": torch.ones(2, 1)},
        batch_size=[2],
    )


def test_a_function_gets_the_whole_observation_and_nothing_else(folder: Path) -> None:
    torch.testing.assert_close(made("everything")(frame())["action"], torch.full((2, 8), 0.1))
    with pytest.raises(UserError, match=r"(?s)undeclared .*privileged.*it gets observation\.points, "):
        made("undeclared")
    assert MASK not in made("everything", "none").in_keys


def test_what_is_declared_is_given_and_said(folder: Path) -> None:
    policy = made("declared")
    assert policy.truths == ["flow", "joint_axis"]
    torch.testing.assert_close(policy(frame())["action"], torch.ones(2, 8))
    assert made("make").truths == []
    assert made("module").in_keys == [("observation", "tool_pose")]


def test_it_cannot_change_what_others_see(folder: Path) -> None:
    before = frame()
    made("meddles")(before)
    assert bool((before["observation", "points"] == 1).all())


def test_its_state_travels(folder: Path) -> None:
    policy = made("make")
    step: TensorDictBase = frame().update(policy.initial_state(torch.Size([2])))
    for count in (1, 2, 3):
        step = policy(step)
        torch.testing.assert_close(step["action"], torch.full((2, 8), count / 100))
        step["mine"] = step["next", "mine"]


def test_workers_make_it_anew(folder: Path) -> None:
    policy = made("everything")
    again = pickle.loads(pickle.dumps(policy))
    torch.testing.assert_close(again(frame())["action"], policy(frame())["action"])
    assert policy_digest(again) == policy_digest(policy) != policy_digest(made("make"))
    (folder / "my_policies.py").write_text(SOURCE + "\n# changed\n")
    assert policy_digest(made("everything")) != policy_digest(policy), "rows of other code are not these"


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("my_policies", "package.module:object"),
        ("../x:make", "package.module:object"),
        ("nowhere.at.all:make", "no module nowhere"),
        ("my_policies.deeper:make", "no module my_policies.deeper"),
        ("broken:make", r"broken:make cannot be imported: .*no_such_library.*\(broken\.py, line 2\)"),
        ("wrong:make", "cannot be imported: SyntaxError"),
        ("my_policies:missing", "my_policies has no missing; it has .*make"),
        ("my_policies:number", "is int"),
        ("my_policies:fails", r"fails: RuntimeError: no licence found \(my_policies\.py, line \d+\)"),
        ("my_policies:ends", "fails: SystemExit: 3"),
        ("my_policies:few", "fails: TypeError"),
        ("my_policies:none", "returns NoneType"),
        ("my_policies:stumbles", "cannot decide: ZeroDivisionError"),
        ("my_policies:short", r"action \[1, 7\]: give \[1, 8\]"),
        ("my_policies:nan", "not finite"),
        ("my_policies:word", "answers with str"),
        ("my_policies:nothing", "answers with NoneType"),
        ("my_policies:unknown", "colour.*choose from observation.points"),
        ("my_policies:taken", "'observation', which is taken"),
        ("my_policies:forgets", "next state"),
    ],
)
def test_an_error_is_one_sentence(folder: Path, target: str, words: str) -> None:
    with pytest.raises(UserError, match=words) as caught:
        plugin_policy(LIMITS, FlowPolicyOptions(), target, 64)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(f"policy.target={target}")


def test_a_mask_that_is_kept_from_it_cannot_be_declared(folder: Path) -> None:
    with pytest.raises(UserError, match=r"policy\.mask=target"):
        made("masked", "none")


def test_the_two_keys_go_together(config: Callable[..., Any]) -> None:
    for words in (["policy=plugin"], ["policy=expert", "policy.target=my_policies:make"]):
        with pytest.raises(UserError, match=r"policy\.target=package\.module:make"):
            config("evaluate", words)


SMALL = ["experiment=smoke", "assets.categories=[Box]", "evaluation.trials=2", "policy=plugin",
         "evaluation.expert=true", "data.points=128", "camera.resolution=32", "env.horizon=8",
         "collector.workers=1"]  # fmt: skip


@pytest.mark.parametrize("collector", ["direct", pytest.param("process", marks=pytest.mark.slow)])
def test_it_runs_the_same_trials_as_the_expert(folder: Path, config: Callable[..., Any], collector: str) -> None:
    words = [*SMALL, f"collector={collector}", "policy.target=my_policies:make", "evaluation.videos=1"]
    rows = run_evaluation(config("evaluate", words), folder / "run")
    assert rows == read_trials(folder / "run" / "rows.csv")
    mine, expert = ([row for row in rows if row.policy == name] for name in ("plugin", "expert"))
    assert [row.key for row in mine] == [row.key for row in expert] and len(mine) == 2
    assert {row.status for row in rows} == {"ok"} and {row.mask for row in mine} == {"none"}
    assert all(row.path_length > 0.01 for row in mine), "its growing count moves the hand in every trial"
    assert mine[0].path_length == pytest.approx(mine[1].path_length, rel=0.05), "no trial begins where the last ended"
    assert any("plugin" in path.name for path in (folder / "run" / "videos").iterdir())
    numbers = json.loads((folder / "run" / "summary.json").read_text())
    assert numbers["policy_target"] == "my_policies:make" and "privileged_inputs" not in numbers


def test_tables_say_what_reads_the_truth(folder: Path, config: Callable[..., Any]) -> None:
    words = [*SMALL, "collector=direct", "policy.target=my_policies:expert", "env.horizon=20"]
    rows = run_evaluation(config("evaluate", words), folder / "run")
    numbers = json.loads((folder / "run" / "summary.json").read_text())
    assert {row.policy for row in rows} == {"expert", "plugin_privileged"}
    assert numbers["privileged_inputs"] == ["flow"] and "plugin_privileged/n" in numbers
    lengths = [[row.path_length for row in rows if row.policy == name] for name in ("expert", "plugin_privileged")]
    assert lengths[0] == lengths[1], "behind the wrapping it is the same policy"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "failure"), [("slow", "took_too_long"), ("later", "crashed")])
def test_a_trial_that_fails_midway_costs_itself_alone(
    folder: Path, config: Callable[..., Any], name: str, failure: str
) -> None:
    words = [*SMALL, "collector=process", f"policy.target=my_policies:{name}", "evaluation.decision_seconds=1"]
    rows = [row for row in run_evaluation(config("evaluate", words), folder / "run") if row.policy == "plugin"]
    assert [row.status for row in rows] == ["error", "error"] and rows[0].failure.replace(" ", "_") == failure, rows


def test_the_example_of_the_page_runs(folder: Path) -> None:
    """It pulls towards itself what it holds, and goes to the part's points before."""
    text = (ROOT / "docs" / "library.md").read_text()
    (folder / "my_policies.py").write_text(re.search(r"```python\n(# my_policies\.py\n.*?)```", text, re.DOTALL)[1])  # type: ignore[index]
    policy, seen = made("make"), frame()
    seen["observation", "tool_pose"] = torch.tensor([[-1.0, 0, 0, 1, 0, 0, 0]] * 2)
    seen["observation", "attached"] = torch.tensor([[False], [True]])
    action = policy(seen)["action"]
    assert action[0, 0] > 0.1 and action[1, 0] < -0.1

"""DAgger on a task of ManiSkill with a scripted expert, without a renderer."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.algos import task
from fb3d_rl.algos.rounds import BUFFER
from fb3d_rl.algos.run import run_training
from fb3d_rl.algos.task import load_learner
from fb3d_rl.algos.weights import CHECKPOINT
from fb3d_rl.data import lerobot, maniskill
from fb3d_rl.data.demonstrations import DemonstrationBuffer
from fb3d_rl.env.any_task import make_task
from fb3d_rl.errors import UserError
from fb3d_rl.training.checkpoint import load_checkpoint
from fb3d_rl.training.run_log import read_rows

Config = Callable[[str, list[str]], Any]
EXAMPLES = Path(__file__).parents[1] / "examples"
PICK = ["env.task=PickCube-v1", "expert.target=pick_cube:make", "+env.task_options.control_mode=pd_ee_delta_pos"]
SMALL = [
    "algo=dagger", *PICK, "algo.rounds=2", "algo.beta.schedule=first", "data.labels=100", "algo.epochs=6",
    "algo.learner.width=8", "evaluation.trials=2", "collector=direct", "env.horizon=40",
]  # fmt: skip


SHORT = ["data.labels=60", "algo.epochs=4", "evaluation.trials=0", "algo.learner.head=act"]
"""A run of which only the labels and weights matter."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, config: Config) -> Path:
    sys.path.insert(0, str(EXAMPLES))
    return train(config, tmp_path_factory.mktemp("whole"), *SHORT)


@pytest.fixture(autouse=True)
def _examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))


def train(config: Config, out: Path, *overrides: str) -> Path:
    out.mkdir(exist_ok=True)
    run_training(config("train", [*SMALL, *overrides]), out)
    return out


def test_rounds_labels_and_the_same_bits(tmp_path: Path, config: Config) -> None:
    out = train(config, tmp_path / "one")
    buffer = DemonstrationBuffer.open(out / BUFFER)
    rows = [(info, buffer.frames(i)) for i, info in enumerate(buffer.episodes)]
    assert len(buffer) == 100 and {info.round for info, _ in rows} == {0, 1}
    for info, frames in rows:
        assert bool(frames["expert", "acts"].all()) == (info.round == 0), "beta is 1, then 0"
        differs = (frames["action"] != frames["expert", "action"]).any(-1)
        assert bool(differs.any()) == (info.round == 1), "the expert's label, whoever acted"
        assert (frames["record", "success"] == info.success).all() and (frames["record", "round"] == info.round).all()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["expert/success_rate"] == 1.0 and summary["labels"] == 100 and summary["expert_share"] == 0.5
    again = train(config, tmp_path / "again")
    assert read_rows(again / "metrics.jsonl", times=False) == read_rows(out / "metrics.jsonl", times=False)
    assert (again / "episodes.csv").read_bytes() == (out / "episodes.csv").read_bytes()
    with (out / "episodes.csv").open() as file:
        assert [row["policy"] for row in csv.DictReader(file)] == ["expert"] * 2 + ["dagger"] * 2
    learner = load_learner(out / CHECKPOINT)
    frames = buffer.frames(len(buffer.episodes) - 1)
    shown = frames.exclude("action").update(TensorDict({"learner": {"felt": frames["learner", "felt"]}}, [len(frames)]))
    acted = load_learner(again / CHECKPOINT)(shown.clone())["action"]
    assert torch.equal(learner(shown.clone())["action"], acted), "the checkpoint is the whole learner"
    maniskill.write(buffer, tmp_path / "x.h5")  # what others read
    lerobot.write(buffer, tmp_path / "lerobot", rate=20)
    for read, source in ((maniskill.read, tmp_path / "x.h5"), (lerobot.read, tmp_path / "lerobot")):
        copy = read(source, tmp_path / read.__module__)
        assert copy.episodes == buffer.episodes and len(copy) == 100
        whole = torch.arange(100)
        assert bool((copy[whole] == buffer[whole]).all()), "and they come back in every bit"


def test_an_episode_does_not_depend_on_those_before_it() -> None:
    env = make_task("PickCube-v1", "pick_cube:make", "/", "state", 0, {"control_mode": "pd_ee_delta_pos"})

    def states(seed: int) -> torch.Tensor:
        env.set_trials([seed])
        frames = env.rollout(25, lambda td: td.set("action", td["label", "action"]), break_when_any_done=True)
        return frames["observation", "state"]

    first, _, again = states(5), states(7), states(5)
    assert torch.equal(first, again)


class Stopped(Exception):
    """The process ends here."""


@pytest.mark.parametrize("save", [1, 2, 3, 5])
def test_a_run_that_is_stopped_at_any_checkpoint_goes_on_to_the_same_bits(
    tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch, whole: Path, save: int
) -> None:
    """Checkpoints are written at the start, and in each round after its labels, in its fit and at its end."""
    calls, saved = 0, task.save_checkpoint

    def stops(*args: Any, **kwargs: Any) -> None:
        nonlocal calls
        saved(*args, **kwargs)
        calls += 1
        if calls == save:
            raise Stopped

    monkeypatch.setattr(task, "save_checkpoint", stops)
    with pytest.raises(Stopped):
        train(config, tmp_path, *SHORT)
    monkeypatch.setattr(task, "save_checkpoint", saved)
    train(config, tmp_path, *SHORT, "resume=true")
    assert read_rows(tmp_path / "metrics.jsonl", times=False) == read_rows(whole / "metrics.jsonl", times=False)
    one, other = (load_checkpoint(out / CHECKPOINT)["state"]["model"] for out in (tmp_path, whole))
    assert all(torch.equal(one[key], other[key]) for key in other)
    rows, others = (DemonstrationBuffer.open(out / BUFFER) for out in (tmp_path, whole))
    assert rows.episodes == others.episodes and bool((rows[torch.arange(60)] == others[torch.arange(60)]).all())


@pytest.mark.slow
def test_it_learns_to_pick_the_cube(tmp_path: Path, config: Config) -> None:
    out = train(config, tmp_path, "data.labels=1200", "algo.rounds=3", "algo.epochs=60", "algo.learner.width=64",
                "evaluation.trials=10", "env.horizon=50")  # fmt: skip
    assert json.loads((out / "summary.json").read_text())["dagger/success_rate"] >= 0.5


@pytest.mark.slow
def test_a_head_that_plans_from_noise_acts_on_a_task(tmp_path: Path, config: Config) -> None:
    out = train(config, tmp_path, "algo.learner.head=diffusion", "algo.learner.chunk=4", "algo.learner.execute=2")
    assert "dagger/success_rate" in json.loads((out / "summary.json").read_text())


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["env.task=PickCube-v9"], "env.task=PickCube-v9 cannot be made"),
        (["expert.target=pick_cube:nothing"], "pick_cube has no nothing"),
        (["expert.target=math:sqrt"], "expert.target=math:sqrt fails: TypeError"),
        (["expert.target=builtins:id"], "expert.target=builtins:id gives no action of 4 numbers"),
        (["env.task_options.control_mode=pd_joint_pos"], "actions that are not from -1 to 1"),
    ],
)
def test_what_cannot_be_is_one_sentence(tmp_path: Path, config: Config, overrides: list[str], words: str) -> None:
    with pytest.raises(UserError, match=words):
        train(config, tmp_path, *overrides)
    assert not (tmp_path / BUFFER).exists(), "before any work"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["algo=dagger", "env.task=PickCube-v1"], "go together"),
        (["algo=dagger", "expert.target=pick_cube:make"], "go together"),
        (["algo=artflownet", *PICK], "choose algo=bc or algo=dagger"),
        (["algo=safe_dagger", *PICK], "algo.gate.name=safe is for opening parts"),
        (["algo=bc_oracle", *PICK], "leave algo.oracle=false"),
        (["algo=bc", *PICK, "algo.learner.contact=true"], "leave algo.learner.contact=false"),
        (["algo=bc", *PICK, "algo.learner.encoder=artflownet"], "has seen objects that open"),
    ],
)
def test_options_that_a_task_has_no_use_for_are_refused(config: Config, overrides: list[str], words: str) -> None:
    with pytest.raises(UserError, match=words):
        config("train", overrides)

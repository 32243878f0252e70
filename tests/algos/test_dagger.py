"""The loop of algo=bc and algo=dagger in small: rounds, labels, who acts, the same bits, and a run that is killed."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.algos import collection
from fb3d_rl.algos.learners import Labels, drawn_rows
from fb3d_rl.algos.options import SamplingOptions
from fb3d_rl.algos.rounds import BUFFER, share
from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.algos.run import run_training as run
from fb3d_rl.algos.weights import CHECKPOINT
from fb3d_rl.camera.views import View
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo
from fb3d_rl.errors import UserError
from fb3d_rl.policies.flow_state import APPROACH, TRAVEL
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.learner import twist_of
from fb3d_rl.rollout.collectors import Episode
from fb3d_rl.rollout.demonstrations import recorded_object, replay
from fb3d_rl.rollout.rows import read_trials
from fb3d_rl.training.checkpoint import load_checkpoint
from fb3d_rl.training.run_log import read_rows

Config = Callable[[str, list[str]], Any]
Train = Callable[..., Path]
ROOT = Path(__file__).parents[2]
SMALL = [
    "experiment=smoke",
    "algo=dagger",
    "algo.rounds=2",
    "algo.beta.schedule=first",
    "data.labels=90",
    "algo.epochs=0.711",
    "algo.batch_size=8",
    "algo.learner.encoder=pointnet",
    "algo.learner.width=8",
    "algo.learner.points=64",
    "algo.log_every=2",
    "algo.checkpoint_every=3",
    "algo.validate_trials=1",
    "assets.categories=[Microwave]",
    "data.points=256",
    "camera.resolution=48",
    "evaluation.trials=1",
    "env.horizon=70",
]
SMALL_EVAL = [
    item for item in SMALL if item.startswith(("assets.", "data.", "camera.", "evaluation.", "env.", "experiment="))
]
"""What of it an evaluation has, too."""


@pytest.fixture(scope="module")
def train(config: Config) -> Train:
    """Runs the small job with further overrides."""

    def trained(out: Path, *overrides: str) -> Path:
        run(config("train", [*SMALL, *overrides]), out)
        return out

    return trained


def assert_same_run(one: Path, other: Path) -> None:
    """The same log, weights, labels and trials."""
    log = read_rows(one / "metrics.jsonl", times=False)
    assert log == read_rows(other / "metrics.jsonl", times=False) and any("train/loss" in row for row in log)
    weights, others = (load_checkpoint(out / CHECKPOINT)["state"]["model"] for out in (one, other))
    assert weights.keys() == others.keys() and all(torch.equal(weights[key], others[key]) for key in weights)
    rows, others = (DemonstrationBuffer.open(out / BUFFER) for out in (one, other))
    assert rows.episodes == others.episodes and len(rows) == len(others) > 0
    assert (rows[torch.arange(len(rows))] == others[torch.arange(len(rows))]).all()
    assert (one / "rows.csv").read_bytes() == (other / "rows.csv").read_bytes()


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory, train: Train) -> Path:
    return train(tmp_path_factory.mktemp("first"))


def test_rounds_labels_and_who_acts(first: Path) -> None:
    buffer = DemonstrationBuffer.open(first / BUFFER)
    by_round: dict[int, list[torch.Tensor]] = {0: [], 1: []}
    for i, info in enumerate(buffer.episodes):
        by_round[info.round].append(buffer.frames(i)["expert", "acts"].flatten())
    acts = [torch.cat(by_round[number]) for number in (0, 1)]
    assert [len(each) for each in acts] == [45, 45], "exactly the labels that were asked for"
    assert acts[0].all() and not acts[1].any(), "beta is 1, then 0"
    log = [row for row in read_rows(first / "metrics.jsonl") if "labels" in row]
    assert [(row["round"], row["labels"], row["beta"], row["step"]) for row in log] == [
        (0, 45, 1.0, 4),
        (1, 90, 0.0, 8),
    ]
    assert all("val/success_rate" in row for row in log)
    assert [row["collect/expert_share"] for row in log] == [1, 0]
    summary = json.loads((first / "summary.json").read_text())
    assert summary["labels"] == 90 and summary["expert_share"] == 0.5
    assert [row.policy for row in read_trials(first / "rows.csv")] == ["expert", "dagger"]


def test_the_experts_share_is_of_the_labelled_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """With an oracle the expert drives to the part, which no label is asked for; the last episode is cut."""
    acts = [[1, 1, 1, 0, 0, 1], [1, 0, 0, 0, 1, 1, 1, 1]]
    labelled = [[0, 0, 0, 1, 1, 1], [0, 1, 1, 1, 1, 1, 1, 1]]
    episodes = [
        TensorDict(
            {"expert": {"acts": torch.tensor(made, dtype=torch.bool)[:, None]}, "labelled": torch.tensor(asked) > 0,
             "next": {"contact": torch.ones(len(made), 1, dtype=torch.bool)}}, [len(made)])
        for made, asked in zip(acts, labelled, strict=True)
    ]  # fmt: skip
    trials = [SimpleNamespace(object="a"), SimpleNamespace(object="a")]
    monkeypatch.setattr(collection, "draw_trials", lambda *_: trials)
    monkeypatch.setattr(collection, "episode_info", lambda *_: SimpleNamespace(success=True, round=0))
    workers = SimpleNamespace(run=lambda *_: [Episode(i, frames) for i, frames in enumerate(episodes)])
    rows = SimpleNamespace(keys=list, of=lambda frames: frames[frames["labelled"]])
    views = [SimpleNamespace(obj=SimpleNamespace(id="a", category="Oven"))]
    found = collection.collect(*cast("Any", (workers, views, None, rows, 0, 0.4, 3, 7, np.random.default_rng(0))))
    kept = torch.cat([frames["expert", "acts"] for frames, _ in found.episodes]).flatten()
    assert kept.tolist() == [0, 0, 1, 0, 0, 0, 1]
    for frames, _ in found.episodes:
        assert all(value.flatten().unique().tolist() == [pytest.approx(wanted)] for value, wanted in (
            (frames["record", "beta"], 0.4), (frames["record", "policy_version"], 3), (frames["record", "round"], 0),
            (frames["record", "success"], True)))  # fmt: skip
    assert found.numbers["collect/expert_share"] == kept.double().mean() == 2 / 7


def test_a_row_says_how_it_came_about(first: Path) -> None:
    buffer = DemonstrationBuffer.open(first / BUFFER)
    for i, info in enumerate(buffer.episodes):
        record = buffer.frames(i)["record"]
        expected = {
            "beta": 1.0 - info.round,
            "policy_version": info.round,
            "round": info.round,
            "success": info.success,
        }
        assert {key: value.unique().tolist() for key, value in record.items()} == {
            key: [value] for key, value in expected.items()
        }


def test_a_runs_labels_can_be_listed_and_run_again(first: Path) -> None:
    buffer = DemonstrationBuffer.open(first / BUFFER)
    of_learner = [info.round for info in buffer.episodes].index(1)
    film, exact = replay(buffer, of_learner, recorded_object(buffer, of_learner))
    assert exact and film.expert_acts is not None and not film.expert_acts.any()
    assert len(film.expert_acts) == len(film) - 1
    assert replay(buffer, 0, recorded_object(buffer, 0))[0].expert_acts is None, "there was no learner yet"


def test_which_labels_a_round_learns_from(tmp_path: Path) -> None:
    buffer = DemonstrationBuffer.create(tmp_path / "rows", 40)
    acts = [[True] * 4, [True, False] * 3, [False] * 5]
    for number, (made, success) in enumerate(zip(acts, (True, False, True), strict=True)):
        expert = {"acts": torch.tensor(made)[:, None], "twist": torch.full((len(made), 6), float(number))}
        frames = TensorDict({"expert": expert, "elapsed_steps": torch.arange(len(made))[:, None]}, [len(made)])
        buffer.extend(frames, EpisodeInfo("a", "Oven", 0, (), View(0.0, 0.0), round=number, success=success))

    def drawn(number: int = 2, **options: Any) -> list[int] | None:
        found = drawn_rows(buffer, SamplingOptions(**options), number)
        return None if found is None else found.tolist()

    assert drawn() is None and drawn(expert=2.0, learner=2.0) is None, "as it was: every row once"
    assert drawn(rows="recent", rounds=2) == [*range(4, 15)] and drawn(rows="recent", rounds=1) == [*range(10, 15)]
    assert drawn(rows="successes") == [0, 1, 2, 3, *range(10, 15)]
    assert drawn(rows="recent", learner=0.0) == [4, 6, 8]
    counts = torch.tensor(drawn(expert=3.0)).bincount(minlength=15)
    share = counts.double() / (15 * torch.tensor([3.0 if a else 1.0 for row in acts for a in row]) / (3 * 7 + 8))
    assert counts.sum() == 15 and counts[:4].sum() in (6, 7) and share.mean() == pytest.approx(1.0, abs=0.2)
    with pytest.raises(UserError, match=r"sampling\.rows=recent leaves no label to learn from in round 3"):
        drawn(rows="recent", rounds=1, learner=0.0)
    labels = Labels(buffer, 2, drawn_rows(buffer, SamplingOptions(rows="successes"), 2))
    rows = labels[torch.arange(len(labels))]
    assert len(labels) == 9 and rows["twist"][:, 0, 0].tolist() == [0.0] * 4 + [2.0] * 5
    assert rows["is_pad"][:, 1].tolist() == [False] * 3 + [True] + [False] * 4 + [True]


def test_a_row_holds_the_experts_label_whoever_acted(first: Path) -> None:
    buffer = DemonstrationBuffer.open(first / BUFFER)
    rows = buffer[torch.arange(len(buffer))]
    acts = rows["expert", "acts"].flatten()
    differs = (rows["action"] != rows["expert", "action"]).any(-1)
    assert not differs[acts].any() and differs[~acts].all()
    limits = VelocityLimits(**load_checkpoint(first / CHECKPOINT)["model_kwargs"]["limits"])
    expected = twist_of(rows["observation"], rows["expert", "action"], limits)
    assert torch.allclose(rows["expert", "twist"], expected, atol=1e-6)
    assert not any(key[0] == "privileged" for key in rows.keys(True, True) if isinstance(key, tuple))


def test_behaviour_cloning_is_one_round_of_the_expert(first: Path, tmp_path: Path, train: Train) -> None:
    train(tmp_path, "algo=bc", "algo.rounds=1", "data.labels=45", "evaluation.expert=false")
    cloned, dagger = DemonstrationBuffer.open(tmp_path / BUFFER), DemonstrationBuffer.open(first / BUFFER)
    index = torch.arange(45)
    assert len(cloned) == 45 and cloned[index]["expert", "acts"].all()
    # One code path: DAgger's first round is the same data, and the same fit of it.
    assert (cloned[index] == dagger[index]).all()
    fits = [[row["train/loss"] for row in read_rows(out / "metrics.jsonl") if "labels" not in row and row["round"] == 0]
            for out in (tmp_path, first)]  # fmt: skip
    assert fits[0] == fits[1] and len(fits[0]) == 2, "four steps, of which every second one is logged"
    assert [row.policy for row in read_trials(tmp_path / "rows.csv")] == ["bc"]


def test_a_checkpoint_that_does_not_fit_is_named_before_any_work(first: Path, tmp_path: Path, config: Config) -> None:
    whole = load_checkpoint(first / CHECKPOINT)
    kwargs, state = whole["model_kwargs"], whole["state"]

    def without(entries: dict[str, Any], key: str) -> dict[str, Any]:
        return {name: value for name, value in entries.items() if name != key}

    for k, change in enumerate((
        {"model_kwargs": without(kwargs, "options")},
        {"model_kwargs": kwargs | {"limits": {"speed": 1.0}}},
        {"model_kwargs": kwargs | {"options": kwargs["options"] | {"width": 16}}},
        {"state": without(state, "model")},
        {"state": state | {"model": {name: value[..., :1] for name, value in state["model"].items()}}},
    )):  # fmt: skip
        path = tmp_path / f"{k}.pt"
        torch.save(whole | change, path)
        with pytest.raises(UserError, match=f"{k}.pt holds other"):
            run_evaluation(config("evaluate", ["experiment=smoke", "policy=dagger", f"checkpoint={path}"]), tmp_path)
    shutil.copytree(first, tmp_path / "run")
    done = state["run"]
    for change in (
        {"run": without(done, "round") | {"level": 1}},
        {"run": done | {"learner": {}}},
        {"run": done | {"gate": {"other": torch.zeros(1)}}},
        {"run": done | {"round": 1, "fit": {"step": 1}}},
        {"run": done | {"rows": 10**6}},
    ):
        torch.save(whole | {"state": state | change}, tmp_path / "run" / CHECKPOINT)
        with pytest.raises(UserError, match=r"checkpoint\.pt"):
            run(config("train", [*SMALL, "resume=true"]), tmp_path / "run")
    assert len(DemonstrationBuffer.open(tmp_path / "run" / BUFFER)) == 90, "nothing is lost"


def test_evaluating_the_checkpoint_reproduces_the_runs_rows(first: Path, tmp_path: Path, config: Config) -> None:
    run_evaluation(config("evaluate", [*SMALL_EVAL, "policy=dagger", f"checkpoint={first}"]), tmp_path)
    assert (tmp_path / "rows.csv").read_bytes() == (first / "rows.csv").read_bytes()


def test_a_folder_without_weights_is_refused(tmp_path: Path, config: Config) -> None:
    for policy in ("dagger", "artflownet"):
        with pytest.raises(UserError, match=r"run holds no weights \(checkpoint\.pt or best\.safetensors\)"):
            (tmp_path / "run").mkdir(exist_ok=True)
            words = ["experiment=smoke", f"policy={policy}", f"checkpoint={tmp_path / 'run'}"]
            run_evaluation(config("evaluate", words), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_learner_acts_only_where_actions_mean_what_it_was_taught(first: Path, tmp_path: Path, config: Config) -> None:
    given = [*SMALL_EVAL, "policy=dagger", f"checkpoint={first / CHECKPOINT}"]
    for other in ("env.control_freq=10", "env.gripper.v_max=1.0"):
        with pytest.raises(UserError, match=r"v_max=2 env.gripper.w_max=3 env.control_freq=20; give the same"):
            run_evaluation(config("evaluate", [*given, other]), tmp_path)


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_run(first: Path, tmp_path: Path, train: Train) -> None:
    assert_same_run(train(tmp_path, "collector=process", "collector.workers=2"), first)


@pytest.mark.slow
def test_collection_beside_the_fit_repeats(tmp_path: Path, train: Train) -> None:
    beside = ["collector=process", "collector.workers=2", "algo.overlap=true", "algo.rounds=3"]
    assert_same_run(train(tmp_path / "one", *beside), train(tmp_path / "other", *beside))
    rounds = [row for row in read_rows(tmp_path / "one" / "metrics.jsonl") if "labels" in row]
    assert len(rounds) == 3 and "time/waited_for_training" not in rounds[-1], "nothing is collected after it"
    assert all(row["time/waited_for_training"] >= 0 for row in rounds[:-1])


def test_a_guided_run_keeps_where_the_expert_was_going(tmp_path: Path, train: Train) -> None:
    guided = ["algo.learner.contact=true", "algo.learner.phase=true", "algo.learner.focus=hand", "evaluation.trials=0",
              "algo.validate_trials=0"]  # fmt: skip
    buffer = DemonstrationBuffer.open(train(tmp_path / "one", *guided) / BUFFER)
    for i, info in enumerate(buffer.episodes):
        frames = buffer.frames(i)
        expert, tip = frames["expert"], frames["observation", "tool_pose"][:, :3]
        travels, approaches = (expert["phase"].flatten() == phase for phase in (TRAVEL, APPROACH))
        assert bool(travels[0]) and torch.allclose(expert["standoff"].norm(dim=-1), torch.ones(len(frames)))
        part = frames["observation", "points"][0][frames["observation", "part_mask"][0]]
        near = torch.cdist(expert["contact_point"][travels | approaches], part).amin(1)
        assert bool((near < 0.01).all()), "on the part"
        if info.round == 0:  # the expert acts
            ahead = ((tip - expert["contact_point"]) * expert["standoff"]).sum(-1)
            assert bool((ahead[approaches].diff() < 0.01).all()), "and comes nearer"
    again = train(tmp_path / "two", *guided, "algo.rounds=1", f"algo.demonstrations={tmp_path / 'one' / BUFFER}")
    copied = DemonstrationBuffer.open(again / BUFFER)
    assert torch.equal(copied.frames(0)["expert", "contact_point"], buffer.frames(0)["expert", "contact_point"])


def test_demonstrations_that_do_not_say_where_the_expert_goes(first: Path, tmp_path: Path, train: Train) -> None:
    with pytest.raises(UserError, match="do not say where the expert was going"):
        train(tmp_path, "algo.learner.phase=true", f"algo.demonstrations={first / BUFFER}")


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        ["algo=bc_oracle_flow", "algo.rounds=1"],
        ["algo=dagger_oracle"],
        ["algo=dagger_flow", "algo.learner.chunk=3", "algo.learner.execute=2"],
        ["algo=bc", "algo.learner.head=gaussian"],
        ["algo=dagger", "algo.learner.head=mixture", "algo.learner.encoder=dp3"],
        ["algo=dagger", "algo.learner.head=act", "algo.learner.chunk=4", "algo.learner.ensemble=0.01"],
        ["algo=bc", "algo.learner.head=diffusion", "algo.learner.chunk=4", "algo.learner.execute=2"],
        ["algo=safe_dagger", "algo.learner.head=flow_matching", "algo.learner.normalize=false"],
        ["algo=dagger", "algo.beta.schedule=constant", "algo.beta.mixing=step"],
        ["algo=safe_dagger", "algo.sampling.rows=recent", "algo.sampling.expert=2"],
        ["algo=ensemble_dagger", "algo.learner.contact=true"],
        ["algo=dagger", "algo.learner.encoder=artflownet", "algo.learner.frozen=false"],
        ["algo=lazy_dagger"],
        ["algo=thrifty_dagger"],
    ],
    ids=lambda overrides: " ".join(overrides),
)
def test_every_variant_runs(tmp_path: Path, overrides: list[str], train: Train) -> None:
    algo, *further = overrides
    train(tmp_path, algo, *further)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["labels"] == 90 and 0 < summary["expert_share"] <= 1
    assert {row.policy for row in read_trials(tmp_path / "rows.csv")} == {"expert", summary["policy"]}
    buffer = DemonstrationBuffer.open(tmp_path / BUFFER)
    assert summary["expert_share"] == pytest.approx(buffer[torch.arange(90)]["expert", "acts"].double().mean().item())
    log = [row for row in read_rows(tmp_path / "metrics.jsonl") if "labels" in row]
    new = np.diff([0, *(row["labels"] for row in log)])
    shares = [row["collect/expert_share"] for row in log]
    assert summary["expert_share"] == pytest.approx(np.average(shares, weights=new)), "the log and the summary agree"
    if "oracle" in algo:  # the learner is trained on held parts, where it acts
        rows = DemonstrationBuffer.open(tmp_path / BUFFER)
        assert rows[torch.arange(len(rows))]["observation", "attached"].all()


KILLED = {
    "collecting": "fb3d_rl.algos.dagger.collect",
    "writing rows": "fb3d_rl.data.demonstrations.DemonstrationBuffer.extend",
    "closing a round": "fb3d_rl.data.demonstrations.DemonstrationBuffer.commit",
    "writing a checkpoint": "fb3d_rl.training.checkpoint.torch.save",
    "fitting": "fb3d_rl.training.fit.batch_rows",
    "writing the log": "fb3d_rl.training.run_log.RunLog.write",
    "validating": "fb3d_rl.algos.dagger.run_trials",
    "evaluating": "fb3d_rl.algos.dagger.evaluate",
}
"""What is called in each phase of a run."""


@pytest.mark.slow
@pytest.mark.parametrize("phase", KILLED)
def test_a_run_killed_in_any_phase_goes_on_as_if_nothing_had_happened(
    first: Path, tmp_path: Path, phase: str, config: Config
) -> None:
    # In the last call to what belongs to the phase, or as near to it as can be told beforehand.
    program = f"""
import os, pkgutil, runpy, signal, sys
from unittest import mock
target, (where, name) = {KILLED[phase]!r}, {KILLED[phase]!r}.rsplit(".", 1)
owner = pkgutil.resolve_name(where)
calls, original = 0, getattr(owner, name)
def dies(*args, **kwargs):
    global calls
    calls += 1
    result = original(*args, **kwargs)  # the work is done, and nothing after it
    if calls == {{"fb3d_rl.training.fit.batch_rows": 8, "fb3d_rl.algos.dagger.evaluate": 1}}.get(target, 2):
        os.kill(os.getpid(), signal.SIGKILL)
    return result
setattr(owner, name, dies)
sys.path.insert(0, {str(ROOT / "launch")!r})
sys.argv = ["train.py", *{SMALL!r}, "hydra.run.dir={tmp_path / "run"}"]
runpy.run_path({str(ROOT / "launch" / "train.py")!r}, run_name="__main__")
"""
    killed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    run(config("train", [*SMALL, "resume=true"]), tmp_path / "run")
    assert_same_run(tmp_path / "run", first)


def test_shares_add_up() -> None:
    assert [share(10, 4, i) for i in range(4)] == [3, 3, 2, 2]

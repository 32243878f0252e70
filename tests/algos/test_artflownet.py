"""What else algo=artflownet can start from: weights of another run, and clouds that a policy met."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from fb3d_rl import contract
from fb3d_rl.algos import setup
from fb3d_rl.algos.flow_network import MET, SAMPLES, training_rows
from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.algos.run import run_training as run
from fb3d_rl.algos.weights import BEST, CHECKPOINT, load_network
from fb3d_rl.assets.catalog import Entry
from fb3d_rl.data.generate import load_samples
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation import evaluate
from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.registry import REGISTRY, trained
from fb3d_rl.training.checkpoint import load_checkpoint, save_checkpoint
from fb3d_rl.training.run_log import read_rows

Config = Callable[[str, list[str]], Any]
SMALL = [
    "experiment=smoke",
    "assets.categories=[Microwave]",
    "algo.epochs=1.0",
    "algo.batch_size=4",
    "algo.neighbors=16",
    "algo.log_every=1",
    "algo.evaluate_every=null",
    "data.points=128",
    "data.train_samples=12",
    "data.workers=0",
    "camera.resolution=48",
    "evaluation.trials=0",
    "env.horizon=40",
]


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Of a network that was never trained; its policy goes somewhere all the same."""
    path = tmp_path / "net.safetensors"
    ArtFlowNet(neighbors=16, generator=torch.Generator().manual_seed(7)).save_pretrained(path)
    return path


@pytest.mark.slow
def test_clouds_that_a_policy_met_are_trained_on(tmp_path: Path, config: Config, weights: Path) -> None:
    settings = [*SMALL, f"data.met_by={weights}", "data.met_samples=8"]
    run(config("train", settings), tmp_path / "run")
    met = load_samples(tmp_path / "run" / MET)
    contract.check(met, "sample")
    assert len(met) == 8 and (met["privileged", "flow"].norm(dim=-1).amax(-1) > 0.5).all()
    assert (met["privileged", "flow"].norm(dim=-1) > 0)[met["observation", "part_mask"]].float().mean() > 0.99
    clouds = met["observation", "points"]
    assert not torch.equal(clouds[0], clouds[1]), "the hand moves before the object"
    rows = training_rows(config("train", settings), tmp_path / "run")
    assert len(rows) == 20
    assert torch.equal(rows[torch.tensor([13, 2, 12])]["observation", "points"][0], clouds[1])
    samples = load_samples(tmp_path / "run" / SAMPLES)
    assert torch.equal(rows[torch.tensor([13, 2])]["observation", "points"][1], samples["observation", "points"][2])
    assert read_rows(tmp_path / "run" / "metrics.jsonl")[-1]["step"] == 5  # 20 rows, 4 at a time
    # The same trials give the same bits, whatever the backend.
    run(config("train", [*settings, "collector=process", "collector.workers=2"]), tmp_path / "again")
    assert torch.equal(load_samples(tmp_path / "again" / MET)["observation", "points"], clouds)


def test_training_starts_from_given_weights(tmp_path: Path, config: Config, weights: Path) -> None:
    losses = []
    for name, start in (("drawn", []), ("given", [f"algo.start_from={weights}"])):
        run(config("train", [*SMALL, *start]), tmp_path / name)
        losses.append(read_rows(tmp_path / name / "metrics.jsonl")[0]["train/loss"])
    assert losses[0] != losses[1]
    with pytest.raises(UserError, match=r"another network; give algo\.neighbors=16"):
        run(config("train", [*SMALL, f"algo.start_from={weights}", "algo.neighbors=8"]), tmp_path / "other")
    with pytest.raises(UserError, match="no weights"):
        run(config("train", [*SMALL, "algo.start_from=nowhere.safetensors"]), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_seed_of_the_fit_leaves_the_samples_alone(tmp_path: Path, config: Config) -> None:
    for name, own in (("run", []), ("same", ["algo.seed=0"]), ("other", ["algo.seed=1"])):
        run(config("train", [*SMALL, *own]), tmp_path / name)
    points = [load_samples(tmp_path / name / SAMPLES)["observation", "points"] for name in ("run", "other")]
    assert torch.equal(*points)
    first, same, other = (load_checkpoint(tmp_path / name / CHECKPOINT) for name in ("run", "same", "other"))
    weight = "network.fp1.layers.0.linear.weight"
    assert torch.equal(first["state"]["model"][weight], same["state"]["model"][weight])
    assert not torch.equal(first["state"]["model"][weight], other["state"]["model"][weight])
    assert (first["seed"], other["seed"]) == (0, 1)


def test_given_objects_have_their_share_of_the_samples() -> None:
    entries = [Entry(Path(f"/objects/{name}"), "Box", "train_train") for name in ("a", "b", *map(str, range(12)))]
    split = setup.TrainEntries(entries, [], [], frozenset(map(str, range(12))))
    assert split.drawn(None) == entries
    for share, times in ((0.5, 6), (0.75, 18), (0.01, 1)):
        drawn = split.drawn(share)
        assert [drawn.count(entry) for entry in entries] == [times] * 2 + [1] * 12
    assert setup.TrainEntries(entries, [], []).drawn(0.5) == entries  # none is procedural


def test_a_checkpoint_that_does_not_fit_is_named_before_any_work(tmp_path: Path, config: Config, weights: Path) -> None:
    """Whatever it is taken for: cut anywhere, of another version, or of other shapes."""
    net = load_network(weights)
    whole = {"step": 1, "model": net.state_dict(), "average": None}
    other = {name: value[:1] if value.ndim else value for name, value in whole["model"].items()}
    states: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
        "shapes": (net.arguments, whole | {"model": other}),
        "names": (net.arguments, whole | {"model": {"weight": torch.zeros(1)}}),
        "nothing": (net.arguments, {"step": 1}),
        "arguments": (net.arguments | {"depth": 3}, whole),
        "backbone": (net.arguments | {"backbone": "transformer"}, whole),
    }
    paths = [tmp_path / f"{name}.pt" for name in states]
    for path, (arguments, state) in zip(paths, states.values(), strict=True):
        state.setdefault("model", None)
        save_checkpoint(path, algo="artflownet", config={}, model_kwargs=arguments, state=state, seed=0)
    for suffix, content in ((".pt", paths[0].read_bytes()), (".safetensors", weights.read_bytes())):
        for size in (0, 7, 3000, len(content) // 2, len(content) - 5):
            paths.append(tmp_path / f"cut{size}{suffix}")
            paths[-1].write_bytes(content[:size])
    for path in paths:
        with pytest.raises(UserError, match=path.name) as raised:
            load_network(path)
        assert "\n" not in str(raised.value)
        for key in ("algo.start_from", "data.met_by"):
            with pytest.raises(UserError, match=path.name):
                run(config("train", [*SMALL, f"{key}={path}"]), tmp_path / "out")
        with pytest.raises(UserError, match=path.name):
            run_evaluation(
                config("evaluate", ["experiment=smoke", "policy=artflownet", f"checkpoint={path}"]), tmp_path / "out"
            )
    assert not (tmp_path / "out").exists()


def test_a_run_does_not_go_on_from_a_state_that_does_not_fit(tmp_path: Path, config: Config) -> None:
    out, settings = tmp_path / "run", [*SMALL, "data.train_samples=4", "algo.ema=0.9"]
    run(config("train", settings), out)
    content = load_checkpoint(out / CHECKPOINT)
    shutil.rmtree(out / SAMPLES)  # nothing is drawn before the mistake is found

    def other(key: str, change: Any) -> dict[str, Any]:
        return content | {"state": {**content["state"], key: change}}

    moments = copy.deepcopy(content["state"]["optimizer"])
    moments["state"][0]["exp_avg"] = torch.zeros(3)
    bad = [
        other(key, value) for key, value in (("model", {}), ("average", {}), ("optimizer", {}), ("optimizer", moments))
    ]
    bad += [content | {"state": {k: v for k, v in content["state"].items() if k != key}}
            for key in ("model", "optimizer", "options", "loss_sum")]  # fmt: skip
    for changed in bad:
        torch.save(changed, out / CHECKPOINT)
        with pytest.raises(UserError, match=r"checkpoint\.pt"):
            run(config("train", [*settings, "resume=true"]), out)
    torch.save(content, out / CHECKPOINT)
    (out / BEST).write_bytes(b"cut")
    with pytest.raises(UserError, match=r"best\.safetensors is damaged"):
        run(config("train", [*settings, "resume=true"]), out)
    assert not (out / SAMPLES).exists()


def test_a_device_that_is_not_there_is_refused_by_every_command(
    tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    commands = [(run, "train", f"algo={name}") for name in trained()]
    commands += [(run_evaluation, "evaluate", f"policy={name}") for name in REGISTRY]
    for command, name, choice in commands:
        given = ["checkpoint=nowhere.pt"] if name == "evaluate" else []
        given += ["policy.target=mine:make"] if choice == "policy=plugin" else []
        with pytest.raises(UserError, match="device=cuda, but torch finds no CUDA device"):
            command(config(name, ["experiment=smoke", "device=cuda", choice, *given]), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_flow_is_measured_on_the_device(
    tmp_path: Path, config: Config, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torch's device without memory stands for a GPU; what runs there gives no numbers."""
    seen = []

    def measured(
        net: torch.nn.Module, samples: Any, device: torch.device
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        seen.append((device, {value.device for value in net.parameters()}))
        flow = samples["privileged", "flow"]
        return flow, flow_metrics(flow, flow, samples["observation", "valid"])

    monkeypatch.setattr(evaluate, "measure_flow", measured)
    monkeypatch.setattr(setup, "choose_device", lambda name: torch.device("meta" if name == "cuda" else "cpu"))
    given = [
        "policy=artflownet",
        f"checkpoint={weights}",
        "device=cuda",
        "evaluation.trials=1",
        "env.horizon=2",
        "evaluation.clouds=0",
    ]
    rows = run_evaluation(config("evaluate", ["experiment=smoke", "assets.categories=[Box]", *given]), tmp_path / "out")
    meta = torch.device("meta")
    assert seen == [(meta, {meta})] * 2
    assert [row.status for row in rows] == ["ok"] * len(rows), "policies decide on the CPU all the same"

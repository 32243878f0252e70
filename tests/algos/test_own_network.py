"""algo.network: a network class of the user's own, trained by the same loop; its weights name it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open

from fb3d_rl.algos.run import acting, run_evaluation, run_training
from fb3d_rl.algos.weights import load_network, load_trained
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.training.checkpoint import load_checkpoint

SOURCE = '''
import torch
from torch import nn

from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import CloudNetwork


class PerPoint(CloudNetwork):
    """A network without PointNet++: each point for itself."""

    NAME, OUTPUTS = "per_point", 3

    def __init__(self, part_mask_input=True, neighbors=64, backbone="pointnet2", generator=None):
        nn.Module.__init__(self)
        self.part_mask_input = part_mask_input
        self.arguments = {"part_mask_input": part_mask_input, "neighbors": neighbors, "backbone": backbone}
        self.layers = nn.Sequential(nn.Linear(4, 32), nn.ReLU(), nn.BatchNorm1d(1), nn.Linear(32, 3))
        self.layers[2] = nn.LayerNorm(32)

    def forward(self, points, valid, part_mask=None):
        mask = valid if part_mask is None else part_mask
        flow = self.layers(torch.cat([points, mask[..., None].float()], -1))
        return flow.masked_fill(~valid[..., None], 0.0)


class Half(ArtFlowNet):
    NAME = "half"

    def forward(self, points, valid, part_mask=None, propose=False):
        return 0.5 * super().forward(points, valid, part_mask, propose)


class Nameless(CloudNetwork):
    OUTPUTS = 3


class Wide(PerPoint):
    def forward(self, points, valid, part_mask=None):
        return super().forward(points, valid, part_mask).repeat(1, 1, 2)


class Lost(PerPoint):
    def forward(self, points, valid, part_mask=None):
        return super().forward(points, valid, part_mask) / 0


class Deaf(PerPoint):
    def forward(self, points, valid, part_mask=None):
        return torch.zeros_like(points)


class Few(CloudNetwork):
    NAME, OUTPUTS = "few", 3

    def __init__(self):
        super().__init__()


class Forgetful(PerPoint):
    def __init__(self, part_mask_input=True, neighbors=64, backbone="pointnet2", generator=None, width=3):
        super().__init__(part_mask_input, neighbors, backbone, generator)
        self.further = nn.Linear(width if generator is None else 5, 1)


class OwnLoss(PerPoint):
    """Absolute errors, of a part of the points that is drawn anew in each step."""

    def __init__(self, part_mask_input=True, neighbors=64, backbone="pointnet2", generator=None):
        super().__init__(part_mask_input, neighbors, backbone, generator)
        if generator is not None:
            for weight in self.parameters():
                nn.init.normal_(weight, 0.0, 0.3, generator)

    def forward(self, points, valid, part_mask=None, target=None):
        flow = super().forward(points, valid, part_mask)
        if target is None:
            return flow.detach()
        return ((flow - target).abs().sum(2) * (torch.rand(valid.shape) < 0.5) * valid).sum() / valid.sum()


class NoScalar(PerPoint):
    def forward(self, points, valid, part_mask=None, target=None):
        return super().forward(points, valid, part_mask)


class NoGradient(OwnLoss):
    def forward(self, points, valid, part_mask=None, target=None):
        return super().forward(points, valid, part_mask, target).detach()


def function():
    pass
'''

SMALL = ["experiment=smoke", "assets.categories=[Box]", "evaluation.trials=1", "evaluation.expert=false",
         "evaluation.videos=0", "data.points=128", "camera.resolution=32", "env.horizon=5", "collector=direct",
         "data.train_samples=32", "data.workers=0", "data.eval_samples=2", "algo.batch_size=8",
         "algo.epochs=3"]  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "my_networks.py").write_text(SOURCE)
    yield tmp_path
    sys.modules.pop("my_networks", None)


def forget(folder: Path) -> None:
    """As in a new process, in another working directory."""
    sys.modules.pop("my_networks", None)
    sys.path[:] = [place for place in sys.path if place != str(folder)]


@pytest.mark.parametrize("name", ["PerPoint", "Half", "OwnLoss"])
def test_it_is_trained_saved_and_evaluated_by_its_name(
    folder: Path, config: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    target = f"my_networks:{name}"
    rows = run_training(config("train", [*SMALL, f"algo.network={target}", "algo.neighbors=8"]), folder / "run")
    kind = getattr(sys.modules["my_networks"], name)
    assert [row.policy for row in rows] == [kind.NAME]
    checkpoint = folder / "run" / "checkpoint.pt"
    assert load_checkpoint(checkpoint)["config"]["algo"]["network"] == target

    net = load_trained(folder / "run", ArtFlowNet)
    assert type(net) is kind
    cfg = config("evaluate", [word for word in SMALL if not word.startswith(("algo", "data.train"))]
                 + ["policy=artflownet", f"checkpoint={folder / 'run'}"])  # fmt: skip
    again = run_evaluation(cfg, folder / "again")
    assert [(row.policy, row.policy_digest, row.path_length) for row in again] == [
        (row.policy, row.policy_digest, row.path_length) for row in rows
    ]

    weights = folder / "net.safetensors"
    net.save_pretrained(weights, {"network": target})
    loaded = load_trained(weights, ArtFlowNet)
    cloud, valid = torch.rand(1, 50, 3), torch.ones(1, 50, dtype=torch.bool)
    torch.testing.assert_close(loaded(cloud, valid, valid), net(cloud, valid, valid), rtol=0, atol=0)

    forget(folder)
    monkeypatch.chdir("/")
    for path in (folder / "run", weights):
        with pytest.raises(UserError, match=rf"{path.name}.* holds a network of a class .*no module my_networks"):
            acting("artflownet", str(path))


def test_a_loss_of_its_own_is_fitted_and_its_draws_repeat(folder: Path, config: Callable[..., Any]) -> None:
    words = [*SMALL, "algo.network=my_networks:OwnLoss", "evaluation.trials=0", "algo.log_every=1"]
    digests = []
    for name, seed in (("first", 0), ("again", 0), ("other", 1)):
        torch.rand(7)  # wherever the global generator stands
        run_training(config("train", [*words, f"algo.seed={seed}"]), folder / name)
        digests.append(load_trained(folder / name, ArtFlowNet).digest())
        rows = [json.loads(line) for line in (folder / name / "metrics.jsonl").read_text().splitlines()]
        losses = [row["train/loss"] for row in rows if "train/loss" in row]
        assert losses[-1] < losses[0]
    assert digests[0] == digests[1] != digests[2]


def test_the_best_weights_name_the_class(folder: Path, config: Callable[..., Any]) -> None:
    words = [*SMALL, "algo.network=my_networks:PerPoint", "assets.train_count=4", "assets.validation_share=0.3"]
    run_training(config("train", [*words, "evaluation.trials=0", "algo.evaluate_every=2"]), folder / "run")
    with safe_open(folder / "run" / "best.safetensors", framework="pt") as content:
        assert content.metadata()["network"] == "my_networks:PerPoint"
    assert type(load_trained(folder / "run" / "best.safetensors", ArtFlowNet)).__name__ == "PerPoint"
    with pytest.raises(UserError, match="PerPoint, which is no ArtFlowNet"):
        load_network(folder / "run")


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("my_networks", "package.module:object"),
        ("nowhere:Net", "no module nowhere"),
        ("my_networks:Missing", "my_networks has no Missing; it has .*PerPoint"),
        ("my_networks:function", "derives from"),
        ("my_networks:nn", "derives from"),
        ("my_networks:Nameless", "has no NAME"),
        ("my_networks:Wide", r"answers with \[2, 256, 6\]"),
        ("my_networks:Lost", "not finite"),
        ("my_networks:Deaf", "no weight"),
        ("my_networks:NoScalar", "does not answer with a loss, a scalar"),
        ("my_networks:NoGradient", "depends on no weight"),
        ("my_networks:Few", "cannot be made: TypeError"),
        ("my_networks:Forgetful", "cannot be used: RuntimeError"),
    ],
)
def test_an_error_is_one_sentence_before_any_work(
    folder: Path, config: Callable[..., Any], target: str, words: str
) -> None:
    with pytest.raises(UserError, match=words) as caught:
        run_training(config("train", [*SMALL, f"algo.network={target}"]), folder / "run")
    assert "\n" not in str(caught.value)
    assert not (folder / "run" / "samples").exists() and not list((folder / "run").glob("**/*.pt"))


def test_it_is_for_artflownet_alone_and_has_one_answer(folder: Path, config: Callable[..., Any]) -> None:
    with pytest.raises(UserError, match=r"algo\.network=my_networks:PerPoint is for algo=artflownet"):
        config("train", ["algo=screwnet", "algo.network=my_networks:PerPoint"])
    with pytest.raises(UserError, match=r"algo\.hypotheses=1"):
        run_training(
            config("train", [*SMALL, "algo.network=my_networks:PerPoint", "algo.hypotheses=3"]), folder / "run"
        )

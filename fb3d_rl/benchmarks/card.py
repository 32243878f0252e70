"""How fast ArtFlowNet trains and predicts on a GPU, whether its kernels there do as plain PyTorch does, and how fast
PyTorch Geometric's layers train beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from fb3d_rl.geometry import points as ops
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.training.draws import batch_rows
from fb3d_rl.training.objective import flow_loss, flow_objective
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.state import FitState

WARM_UP, STEPS, MANY = 4, 15, 1024

CONTENDERS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("delayed", {}),
    ("delayed", {"graph": False}),
    ("delayed", {"precision": "bf16"}),
    ("pointnet2", {}),
    ("pointnet2", {"precision": "bf16"}),
)
"""Backbones and how they are trained."""


def card_speed(
    clouds: TensorDictBase, batch: int, hypotheses: int, progress: Callable[[str], None], device: str = "cuda"
) -> dict[str, Any]:
    """What the module says.

    Args:
        clouds: flow samples [S] to train on, again and again; S is at least ``batch``.
        batch: clouds of a step.
        hypotheses: flows that the network proposes for each.
        progress: called with a description of the current work.
        device: "cuda"; on a "cpu" there are neither kernels nor graphs.

    Returns:
        Agreement of the kernels (shares of equal answers) and their times (ms), losses of the same steps with and
        without a graph, clouds/s of whole training steps (augmentation, sampling, neighbours, forward, backward, Adam,
        moving average), and the time (ms) of one call for 1,024 clouds.
    """
    rows = clouds.to(device)
    progress("kernels")
    found = _kernels(rows[:batch]) if device == "cuda" else {}
    found["losses with the graph"], found["losses without"] = (
        _losses(rows, batch, hypotheses, graph) for graph in (True, False)
    )
    for backbone, more in CONTENDERS:
        name = " ".join([backbone, *(f"{key}={value}" for key, value in more.items())])
        progress(name)
        options = _options(batch, **more)
        found[f"{name}, B={batch}, clouds/s"] = _training(rows, _network(backbone, hypotheses, device), options)
    for backbone in ("delayed", "pointnet2"):
        net = _network(backbone, hypotheses, device).eval()
        many = rows[torch.arange(MANY, device=device) % len(rows)]["observation"]
        inputs = many["points"], many["valid"], many["part_mask"]
        with torch.no_grad():
            found[f"{backbone}: {MANY:,} clouds predicted, ms"] = _milliseconds(partial(net, *inputs), 3)
    try:
        found |= _beside_peer(rows[rows["observation", "valid"].all(1)], batch)
    except ImportError as error:
        found["PyTorch Geometric"] = f"not measured: {error}"
    return found


def _network(backbone: str, hypotheses: int, device: str) -> ArtFlowNet:
    generator = torch.Generator().manual_seed(0)
    return ArtFlowNet(backbone=backbone, generator=generator, hypotheses=hypotheses).to(device).train()


def _options(batch: int, **more: Any) -> FitOptions:
    usual = {"lr": 5e-4, "ema": 0.999, "clip_norm": 1.0, "rotate": False, "mirror": True, "scale": 0.1}
    return FitOptions(steps=10**6, batch_size=batch, **(usual | more))


def _steps(rows: TensorDictBase, net: ArtFlowNet, options: FitOptions) -> Iterator[float]:
    """Training steps without end; yields their losses."""
    state, objective = FitState(net, options), flow_objective(net, options)
    while True:
        chosen = batch_rows(state.step, len(rows), options).to(rows.device)
        loss = state.update(objective, rows[chosen])
        state.count(loss)
        yield loss


def _losses(rows: TensorDictBase, batch: int, hypotheses: int, graph: bool) -> list[float]:
    net = _network("delayed", hypotheses, str(rows.device))
    return [loss for loss, _ in zip(_steps(rows, net, _options(batch, graph=graph)), range(6), strict=False)]


def _training(rows: TensorDictBase, net: ArtFlowNet, options: FitOptions) -> float:
    steps = _steps(rows, net, options)
    for _ in range(WARM_UP):
        next(steps)
    seconds = _milliseconds(lambda: next(steps), STEPS) / 1e3
    return options.batch_size / seconds


def _milliseconds(call: Callable[[], object], times: int) -> float:
    """Mean time of a call after a first one, by the clock, when the GPU has done all of it."""
    wait = torch.cuda.synchronize if torch.cuda.is_available() else (lambda: None)
    call()
    wait()
    start = time.perf_counter()
    for _ in range(times):
        call()
    wait()
    return (time.perf_counter() - start) / times * 1e3


@contextmanager
def _plain() -> Iterator[None]:
    """A context without kernels."""
    before = ops.has_triton
    ops.has_triton = lambda: False  # type: ignore[assignment]
    try:
        yield
    finally:
        ops.has_triton = before


def _kernels(rows: TensorDictBase) -> dict[str, Any]:
    points, valid = rows["observation", "points"], rows["observation", "valid"]
    chosen = ops.farthest_point_sample(points, 240, valid)
    centres = ops.gather(points, chosen)
    there = torch.ones_like(valid[:, :240])
    calls: dict[str, Callable[[], Tensor]] = {
        "sampling": lambda: ops.farthest_point_sample(points, 240, valid),
        "balls": lambda: ops.ball_query(points, centres, 0.2, 64, valid)[0],
        "three nearest": lambda: ops.three_nn(centres, points, there)[0],
    }
    found: dict[str, Any] = {}
    for name, call in calls.items():
        answer = call()
        with _plain():
            expected, slow = call(), _milliseconds(call, 5)
        found[f"{name}: kernel = PyTorch"] = float((answer == expected).float().mean())
        found[f"{name}, {len(rows)} clouds, ms"] = _milliseconds(call, 5)
        found[f"{name}, {len(rows)} clouds, in PyTorch, ms"] = slow
    on_cpu = ops.farthest_point_sample(points[:64].cpu(), 240, valid[:64].cpu())
    found["sampling: kernel = CPU"] = float((chosen[:64].cpu() == on_cpu).float().mean())
    return found


def _beside_peer(full: TensorDictBase, batch: int) -> dict[str, float]:
    """Clouds/s of the same steps (loss and Adam) of PyTorch Geometric's layers and of ours.

    Clouds are full, and sampling and neighbours are ours in both: torch-cluster need not be there.
    """
    from torch_geometric.nn.unpool import knn_interpolate as interpolation

    from fb3d_rl.benchmarks import peer

    peer.fps, peer.radius = _fps, _radius
    vars(import_module(interpolation.__module__))["knn"] = _knn
    device, found = full.device, {}
    nets: dict[str, nn.Module] = {
        "PyTorch Geometric, our neighbours": peer.PeerPointNet2().to(device),
        "pointnet2, K=1, same steps": _network("pointnet2", 1, str(device)),
    }
    for name, net in nets.items():
        adam, step = torch.optim.Adam(net.train().parameters(), 1e-4), iter(range(10**9))

        def go(net: nn.Module = net, adam: torch.optim.Adam = adam, step: Iterator[int] = step) -> None:
            rows = full[(torch.arange(batch, device=device) + batch * next(step)) % len(full)]
            points, valid = rows["observation", "points"], rows["observation", "valid"]
            adam.zero_grad()
            flow = net(points, valid, rows["observation", "part_mask"])
            flow_loss(flow, rows["privileged", "flow"], valid).backward()
            adam.step()

        found[f"{name}, B={batch}, clouds/s"] = batch / _milliseconds(go, STEPS) * 1e3
    return found


def _clouds(points: Tensor, cloud: Tensor) -> Tensor:
    """Points [B N, 3] of clouds of one size -> [B, N, 3]."""
    return points.view(int(cloud[-1]) + 1, -1, 3)


def _of_clouds(index: Tensor, size: int) -> Tensor:
    """Places in clouds [B, ...] -> rows of all of them."""
    first = torch.arange(len(index), device=index.device) * size
    return index + first.view(-1, *[1] * (index.dim() - 1))


def _fps(points: Tensor, cloud: Tensor, ratio: float) -> Tensor:
    clouds = _clouds(points, cloud)
    return _of_clouds(ops.farthest_point_sample(clouds, -int(-ratio * clouds.shape[1] // 1)), clouds.shape[1]).flatten()


def _radius(
    points: Tensor, centres: Tensor, reach: float, cloud: Tensor, of: Tensor, max_num_neighbors: int
) -> tuple[Tensor, Tensor]:
    clouds = _clouds(points, cloud)
    index, mask = ops.ball_query(clouds, _clouds(centres, of), reach, max_num_neighbors)
    row = torch.arange(len(centres), device=points.device).view(*mask.shape[:2], 1).expand_as(mask)
    return row[mask], _of_clouds(index, clouds.shape[1])[mask]


def _knn(points: Tensor, fine: Tensor, k: int, batch_x: Tensor, batch_y: Tensor, **more: object) -> Tensor:
    clouds = _clouds(points, batch_x)
    index, _ = ops.three_nn(clouds, _clouds(fine, batch_y))
    row = torch.arange(len(fine), device=points.device)[:, None].expand(-1, k)
    return torch.stack([row.flatten(), _of_clouds(index, clouds.shape[1]).flatten()])

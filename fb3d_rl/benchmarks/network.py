"""How fast ArtFlowNet trains, beside PointNet++ on PyTorch Geometric and torch-cluster as FlowBot3D's release has it.

Each contender is a process of its own, so that its memory can be measured. They take turns, and the ratio of
a round is of successive times. A step is a whole training step: sampling, neighbours, forward, backward, Adam.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.children import withheld
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import BACKBONES
from fb3d_rl.scene.posed import Posed
from fb3d_rl.training.device import tune_cpu
from fb3d_rl.training.objective import flow_loss
from fb3d_rl.training.options import PRECISIONS

PEER = ("torch-geometric==2.7.0", "torch-cluster==1.6.3")
"""Later versions of PyTorch Geometric no longer call torch-cluster."""


def network_speed(
    clouds: TensorDictBase,
    batches: Sequence[int],
    rounds: int,
    peer: Path | None,
    device: str,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    """Clouds per second of each contender, their ratios to the peer and their memory.

    Args:
        clouds: flow samples, at least as many as the largest batch.
        batches: batch sizes.
        rounds: how often each contender has its turn with each batch size.
        peer: folder that :func:`install_peer` filled; None leaves the peer out.
        device: "cpu" or "cuda", of ours.
        progress: called with a description of the current work.
    """
    own = [f"{backbone} {precision}" for backbone in BACKBONES for precision in PRECISIONS]
    # The peer as it comes, and with the two settings of the process that our training makes.
    peers = [] if peer is None else ["peer", "peer tuned"]
    names = own + peers
    results: dict[str, Any] = {}
    with TemporaryDirectory() as folder:
        clouds.memmap(folder)
        for batch in batches:
            seconds: dict[str, list[float]] = {name: [] for name in names}
            memory: dict[str, int] = {}
            with _Contenders(names, Path(folder), peer, device) as contenders:
                for turn in range(rounds + 1):  # the first is to warm up
                    for name in names:
                        progress(f"B={batch}: {name}, round {turn} of {rounds}")
                        answer = contenders.step(name, batch, 1 if turn == 0 else max(1, 64 // batch))
                        memory[name] = answer["peak"]
                        if turn:
                            seconds[name].append(answer["seconds"])
            for name in names:
                results[f"{name}, B={batch}, clouds/s"] = batch / min(seconds[name])
                results[f"{name}, B={batch}, peak memory, GiB"] = memory[name] / 2**30
            for name in own:
                for other in peers:
                    pairs = zip(seconds[other], seconds[name], strict=True)
                    results[f"{name} / {other}, B={batch}"] = median(theirs / ours for theirs, ours in pairs)
    if device == "cpu":
        first = batches[0]
        products = {backbone: _products(backbone, clouds[:first]) for backbone in BACKBONES}
        ceilings = {precision: _ceiling(precision) for precision in PRECISIONS}
        for name in own:
            backbone, precision = name.split()
            needed = products[backbone] / ceilings[precision]
            taken = first / results[f"{name}, B={first}, clouds/s"]
            results[f"{name}, B={first}, share of time that its products need"] = needed / taken
    return results


def draw_clouds(objects: Sequence[ArticulatedObject], count: int, seed: int) -> TensorDictBase:
    """Flow samples [count] of the objects in turn.

    Raises:
        UserError: none of them shows a part that can be opened.
    """
    options = SampleOptions()
    posed = [Posed(obj, options.camera) for obj in objects[:count]]
    samples: list[TensorDictBase] = []
    for number in range(4 * count if posed else 0):
        sample = draw_sample(posed[number % len(posed)], options, np.random.default_rng([seed, number]))
        if sample is not None:
            samples.append(sample)
        if len(samples) == count:
            clouds: TensorDictBase = torch.stack(samples)
            return clouds
    raise UserError("too few of the objects show a part that can be opened; give others")


def install_peer(folder: Path, progress: Callable[[str], None]) -> None:
    """Put the peer's packages in a folder of their own, beside this environment's PyTorch; builds torch-cluster.

    Raises:
        UserError: they cannot be installed.
    """
    done = folder / "installed"
    if done.is_file():
        return
    progress(f"installing {' and '.join(PEER)} in {folder}; building takes about 12 minutes")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(folder), "--no-build-isolation"]
    run = subprocess.run([*pip, *PEER], capture_output=True, text=True, check=False)
    if run.returncode:
        reason = (run.stderr.strip() or "no reason given").splitlines()[-1]
        raise UserError(
            f"{' and '.join(PEER)} cannot be installed ({reason}): they need a C++ compiler and the package index"
        )
    done.touch()


class _Contenders:
    """One process for each name, which waits for its turns."""

    def __init__(self, names: Sequence[str], clouds: Path, peer: Path | None, device: str) -> None:
        self.processes: dict[str, subprocess.Popen[str]] = {}
        for name in names:
            path = os.pathsep.join(entry for entry in (*sys.path, str(peer or "")) if entry)
            with withheld():
                self.processes[name] = subprocess.Popen(
                    [sys.executable, "-m", __name__, name, str(clouds), "cpu" if name.startswith("peer") else device],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path},
                )  # fmt: skip

    def __enter__(self) -> _Contenders:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            process.kill()
            process.communicate()

    def step(self, name: str, batch: int, steps: int) -> dict[str, Any]:
        """Seconds of a step, mean over ``steps``, and the process's peak memory, bytes."""
        process = self.processes[name]
        assert process.stdin is not None and process.stdout is not None
        print(batch, steps, file=process.stdin, flush=True)
        line = process.stdout.readline()
        if not line:
            raise UserError(f"the process that measures {name!r} ended; see its message above")
        answer: dict[str, Any] = json.loads(line)
        return answer


def _products(backbone: str, clouds: TensorDictBase) -> float:
    """Floating-point operations of the matrix products in a training step."""
    net = ArtFlowNet(backbone=backbone)
    with FlopCounterMode(display=False) as counter:
        _loss(net, clouds, "fp32").backward()
    return float(counter.get_total_flops())


def _ceiling(precision: str) -> float:
    """Operations per second of products whose factors are in the cache."""
    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    left, right = torch.randn(4096, 128).to(dtype), torch.randn(128, 128).to(dtype)
    rates = []
    for _ in range(20):
        start = time.perf_counter()
        for _ in range(10):
            left @ right
        rates.append(10 * 2 * 4096 * 128 * 128 / (time.perf_counter() - start))
    return max(rates)


def _loss(net: nn.Module, clouds: TensorDictBase, precision: str) -> Tensor:
    points, valid = clouds["observation", "points"], clouds["observation", "valid"]
    with torch.autocast(points.device.type, torch.bfloat16, enabled=precision == "bf16"):
        predicted = net(points, valid, clouds["observation", "part_mask"])
    return flow_loss(predicted.float(), clouds["privileged", "flow"], valid)


def _peak_memory() -> int:
    """The most memory, bytes, that this process ever held."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def main() -> None:
    """A contender: reads lines "batch steps" and answers each."""
    name, folder, device = sys.argv[1:]
    clouds = TensorDict.load_memmap(folder).to(device)
    net: nn.Module
    if name.startswith("peer"):
        from fb3d_rl.benchmarks.peer import PeerPointNet2

        net, precision = PeerPointNet2(), "fp32"
    else:
        backbone, precision = name.split()
        net = ArtFlowNet(backbone=backbone).to(device)
    if name != "peer":
        tune_cpu()
    optimizer = torch.optim.Adam(net.parameters(), fused=name != "peer")
    for line in sys.stdin:
        batch, steps = map(int, line.split())
        start = time.perf_counter()
        for _ in range(steps):
            optimizer.zero_grad()
            _loss(net, clouds[:batch], precision).backward()
            optimizer.step()
        if device == "cuda":
            torch.cuda.synchronize()
        seconds = (time.perf_counter() - start) / steps
        print(json.dumps({"seconds": seconds, "peak": _peak_memory()}), flush=True)


if __name__ == "__main__":
    main()

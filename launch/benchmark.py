"""Measure throughput as ratios in one run on the same work; prints a table and writes JSON.

python launch/benchmark.py                        steps, labels, workers, reading, loading, a soak test, networks
python launch/benchmark.py --root DIR steps       one of them, with the PartNet-Mobility objects below DIR
python launch/benchmark.py network --peer DIR     ArtFlowNet's training against PyTorch Geometric's, installed in DIR
python launch/benchmark.py gpu --device cuda      ArtFlowNet's training and kernels on a GPU; needs no simulator
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fb3d_rl.assets.articulation import ArticulatedObject

BENCHMARKS = ("steps", "labelling", "workers", "reading", "loading", "soak", "network", "gpu")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (2: an error that the user can fix)."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", metavar="NAME", nargs="*", help=f"{', '.join(BENCHMARKS)}; all of them unless given")
    parser.add_argument("--root", help="folder of PartNet-Mobility objects; procedural ones unless given")
    parser.add_argument("--split", default="all", help="which of them: a split, a category, ids (default: all)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each comparison (default: 5)")
    parser.add_argument("--steps", type=int, default=10000, help="steps of the soak test (default: 10000)")
    parser.add_argument("--peer", type=Path, help="folder for the packages that 'network' compares with")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="of network and gpu (default: cpu)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/runs/benchmark.json"), help="JSON file to write")
    options = parser.parse_args(arguments)
    # Imported late: --help answers at once.
    from fb3d_rl.errors import exit_code

    return exit_code(lambda: run(options), interrupted="nothing was written")


def check(options: argparse.Namespace) -> None:
    """Refuse what cannot be measured.

    Raises:
        UserError: names the wrong option.
    """
    import torch

    from fb3d_rl.errors import UserError

    unknown = [name for name in options.names if name not in BENCHMARKS]
    if unknown:
        raise UserError(f"{unknown[0]} is no benchmark; choose from {', '.join(BENCHMARKS)}")
    for key in ("rounds", "steps"):
        if getattr(options, key) < 1:
            raise UserError(f"--{key} {getattr(options, key)} is too small; give 1 or more")
    if options.device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda, but torch finds no CUDA device; leave --device cpu")


def run(options: argparse.Namespace) -> None:
    """Measure, print and write."""
    from rich.console import Console
    from rich.table import Table

    from fb3d_rl.benchmarks.card import card_speed
    from fb3d_rl.benchmarks.network import draw_clouds, install_peer, network_speed
    from fb3d_rl.env.torchrl_env import require_simulator
    from fb3d_rl.evaluation.tables import number_rows
    from fb3d_rl.files import write_text
    from fb3d_rl.importer.catalog import find_objects
    from fb3d_rl.kinematics.opening import openable_links
    from fb3d_rl.training.checkpoint import git_revision

    check(options)
    names = options.names or BENCHMARKS
    if any(name not in ("network", "gpu") for name in names):
        require_simulator()
    console = Console()
    objects = [obj for obj in find_objects(options.root, options.split) if openable_links(obj)]
    by_category = list({obj.category: obj for obj in objects}.values())
    rounds = options.rounds
    results: dict[str, Any] = {}
    with console.status("starting") as status:
        for name in names:
            if name == "gpu":
                if options.device != "cuda":
                    results[name] = {"not measured": "give --device cuda"}
                    continue
                results[name] = card_speed(draw_clouds(objects, 512, options.seed), 256, 4, status.update)
            elif name == "network":
                if options.peer:
                    install_peer(options.peer, status.update)
                clouds = draw_clouds(objects, 64, options.seed)
                results[name] = network_speed(clouds, (64, 16), rounds, options.peer, options.device, status.update)
            else:
                results[name] = _simulated(name, options, objects, by_category, status.update)
    about = {
        "command": " ".join(["python", *sys.argv]),
        "seed": options.seed,
        "git_revision": git_revision(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_text(options.out, json.dumps(about | results, indent=1) + "\n")
    table = Table("benchmark", "measured", "value", box=None)
    for row in number_rows(results):
        table.add_row(*row)
    console.print(table)
    console.print(f"wrote {options.out}")


def _simulated(
    name: str,
    options: argparse.Namespace,
    objects: list[ArticulatedObject],
    by_category: list[ArticulatedObject],
    progress: Callable[[str], None],
) -> dict[str, Any]:
    """What a benchmark of the task measures."""
    from fb3d_rl.benchmarks import environment as benchmark  # late: it needs the simulator
    from fb3d_rl.data.samples import SampleOptions
    from fb3d_rl.env.options import EnvOptions
    from fb3d_rl.rollout.trials import schedule

    env, rounds = EnvOptions(), options.rounds
    if name == "steps":
        return benchmark.step_rates(by_category[:6], env, rounds, progress)
    if name == "labelling":
        return benchmark.labelling(by_category[:6], env, rounds, progress)
    if name == "workers":
        scheduled, _ = schedule([(obj, "") for obj in objects], SampleOptions(), options.seed, limit=24)
        return benchmark.worker_scaling(objects, scheduled, env, min(rounds, 3), progress)
    if name == "reading":
        if not options.root:  # the procedural objects are no longer on disk
            return {"not measured": "give --root"}
        return benchmark.reading([obj.urdf.parent for obj in objects], progress)
    if name == "loading":
        return benchmark.loading(objects, env, progress)
    return benchmark.soak(objects[:50], env, options.steps, options.seed, progress)


if __name__ == "__main__":
    interrupt.run(main)

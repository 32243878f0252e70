"""Measure throughput as ratios in one run on the same work; prints a table and writes JSON.

python launch/benchmark.py                        steps, labels, workers, reading, loading, a soak test, networks
python launch/benchmark.py --root DIR steps       one of them, with the PartNet-Mobility objects below DIR
python launch/benchmark.py network --peer DIR     ArtFlowNet's training against PyTorch Geometric's, installed in DIR
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

BENCHMARKS = ("steps", "labelling", "workers", "reading", "loading", "soak", "network")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (2: an error that the user can fix)."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", metavar="NAME", nargs="*", help=f"{', '.join(BENCHMARKS)}; all of them unless given")
    parser.add_argument("--root", help="folder of PartNet-Mobility objects; procedural ones unless given")
    parser.add_argument("--split", default="all", help="which of them: a split, a category, ids (default: all)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each comparison (default: 5)")
    parser.add_argument("--steps", type=int, default=10000, help="steps of the soak test (default: 10000)")
    parser.add_argument("--peer", type=Path, help="folder for the packages that 'network' compares with")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="of 'network' (default: cpu)")
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

    from fb3d_rl.benchmarks import environment as benchmark
    from fb3d_rl.benchmarks.network import draw_clouds, install_peer, network_speed
    from fb3d_rl.data.samples import SampleOptions
    from fb3d_rl.env.options import EnvOptions
    from fb3d_rl.evaluation.tables import number_rows
    from fb3d_rl.files import write_text
    from fb3d_rl.importer.catalog import find_objects
    from fb3d_rl.kinematics.opening import openable_links
    from fb3d_rl.rollout.trials import schedule
    from fb3d_rl.training.checkpoint import git_revision

    check(options)
    console = Console()
    objects = [obj for obj in find_objects(options.root, options.split) if openable_links(obj)]
    by_category = list({obj.category: obj for obj in objects}.values())
    env, rounds = EnvOptions(), options.rounds
    results: dict[str, Any] = {}
    with console.status("starting") as status:
        for name in options.names or BENCHMARKS:
            if name == "steps":
                results[name] = benchmark.step_rates(by_category[:6], env, rounds, status.update)
            elif name == "labelling":
                results[name] = benchmark.labelling(by_category[:6], env, rounds, status.update)
            elif name == "workers":
                scheduled, _ = schedule([(obj, "") for obj in objects], SampleOptions(), options.seed, limit=24)
                results[name] = benchmark.worker_scaling(objects, scheduled, env, min(rounds, 3), status.update)
            elif name == "reading":
                if not options.root:  # the procedural objects are no longer on disk
                    results[name] = {"not measured": "give --root"}
                    continue
                results[name] = benchmark.reading([obj.urdf.parent for obj in objects], status.update)
            elif name == "network":
                if options.peer:
                    install_peer(options.peer, status.update)
                clouds = draw_clouds(objects, 64, options.seed)
                results[name] = network_speed(clouds, (64, 16), rounds, options.peer, options.device, status.update)
            elif name == "loading":
                results[name] = benchmark.loading(objects, env, status.update)
            else:
                results[name] = benchmark.soak(objects[:50], env, options.steps, options.seed, status.update)
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


if __name__ == "__main__":
    interrupt.run(main)

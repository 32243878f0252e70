"""Write a trained ArtFlowNet for use elsewhere.

python launch/export.py RUN flow.safetensors     weights, for ArtFlowNet.from_pretrained
python launch/export.py RUN flow.pt2             a program of torch.export, which needs only PyTorch
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import argparse
import json
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (2: an error that the user can fix)."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument(
        "checkpoint", help='a run folder or checkpoint.pt of algo=artflownet, a .safetensors file, or "pretrained"'
    )
    parser.add_argument("out", type=Path, help="file to write: .safetensors or .pt2")
    parser.add_argument("--points", type=int, default=1200, help="points of a cloud, for .pt2 (default: 1200)")
    options = parser.parse_args(arguments)
    # Imported late: --help answers at once.
    from fb3d_rl.errors import exit_code

    return exit_code(lambda: run(options), interrupted="nothing was written")


def run(options: argparse.Namespace) -> None:
    """Read and write."""
    from fb3d_rl.algos.weights import NETWORK, load_network, named_network, weights_file
    from fb3d_rl.errors import UserError
    from fb3d_rl.models.export import export
    from fb3d_rl.training.checkpoint import load_checkpoint

    if options.out.suffix not in (".safetensors", ".pt2"):
        raise UserError(f"{options.out} is neither a .safetensors nor a .pt2 file; give one of them")
    weights = weights_file(options.checkpoint)
    net = load_network(weights)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    if options.out.suffix == ".pt2":
        export(net, options.out, options.points)
    else:
        about = {}
        if weights.suffix == ".pt":
            content = load_checkpoint(weights)
            about = {key: json.dumps(content[key]) for key in ("config", "seed", "step", "git_revision")}
            about |= {} if (own := content["config"].get("algo", {}).get(NETWORK)) is None else {NETWORK: own}
        elif (own := named_network(weights)) is not None:
            about = {NETWORK: own}
        net.save_pretrained(options.out, about)
    print(f"wrote {options.out}: {options.out.stat().st_size / 2**20:.1f} MiB")


if __name__ == "__main__":
    interrupt.run(main)

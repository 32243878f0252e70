"""The weights that a run keeps: its checkpoint and the best ones of validation; and how they are loaded."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open

from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.plugin import own_network
from fb3d_rl.training.checkpoint import fitting, load_checkpoint

if TYPE_CHECKING:
    from fb3d_rl.config import TrainConfig

CHECKPOINT = "checkpoint.pt"

NETWORK = "network"
"""Entry of a .safetensors file that names the class of algo.network."""

BEST = "best.safetensors"
"""The run's weights with the best validation cosine."""


def state_before(cfg: TrainConfig, out: Path) -> dict[str, Any] | None:
    """The checkpoint to resume from; None if the run does not resume, or ended before its first checkpoint."""
    path = out / CHECKPOINT
    return load_checkpoint(path, algo=cfg.algo.name) if cfg.resume and path.exists() else None


def best_cosine(path: Path) -> float:
    """Validation cosine of the weights in the file; -inf if there is none.

    Raises:
        UserError: the file is damaged.
    """
    if not path.is_file():
        return -math.inf
    try:
        with safe_open(path, framework="pt") as content:
            return float(content.metadata()["val/cosine"])
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is damaged ({type(error).__name__}): copy it anew, or delete it") from error


def weights_file(path: str | Path) -> Path:
    """The file of weights that ``path`` names: itself, or of a run folder the weights that its rows and report measure.

    These are the last ones; the best of validation stand for them where nothing else was kept.

    Raises:
        UserError: the folder holds no weights.
    """
    given = Path(path)
    if str(path) == "pretrained" or not given.is_dir():
        return given
    for name in (CHECKPOINT, BEST):
        if (given / name).is_file():
            return given / name
    raise UserError(f"{given} holds no weights ({CHECKPOINT} or {BEST}): give a run folder of launch/train.py")


def load_trained(path: str | Path, network: type[CloudNetwork]) -> CloudNetwork:
    """The network of :func:`weights_file`: of a checkpoint or a .safetensors file; or the ArtFlowNet "pretrained".

    Weights of algo.network name the class, which is imported: they are the only ones of which loading runs code.

    Raises:
        UserError: the file is missing or no such checkpoint, or the class that it names is not to be had.
    """
    path = weights_file(path)
    if path.suffix == ".safetensors" or (str(path) == "pretrained" and network is ArtFlowNet):
        if (target := named_network(path)) is not None:
            network = own_network(target, str(path))
        return network.from_pretrained(path)
    content = load_checkpoint(path, algo=network.NAME)
    if (target := content["config"].get("algo", {}).get("network")) is not None:
        network = own_network(target, str(path))
    with fitting(path):
        net = network(**content["model_kwargs"])
        net.load_state_dict(content["state"].get("average") or content["state"]["model"])
    return net.eval()


def named_network(path: Path) -> str | None:
    """The class of algo.network that a .safetensors file names; None if it names none, or is no such file."""
    try:
        with safe_open(path, framework="pt") as content:
            return (content.metadata() or {}).get(NETWORK)
    except (SafetensorError, OSError):
        return None  # whoever reads it says what is wrong


def load_network(path: str | Path) -> ArtFlowNet:
    """:func:`load_trained` of an ArtFlowNet, or of a class that derives from it.

    Raises:
        UserError: as there, or it is another network.
    """
    net = load_trained(path, ArtFlowNet)
    if not isinstance(net, ArtFlowNet):
        raise UserError(f"{path} holds a {type(net).__name__}, which is no ArtFlowNet: choose another file.")
    return net

"""Measure a flow network on held-out samples, for both targets: the part to open, and all movable parts."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, lazy_stack
from torch import nn

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.data.samples import FLOWS, SampleKind, SampleOptions
from fb3d_rl.errors import UserError
from fb3d_rl.flow.metrics import flow_metrics, hypothesis_metrics
from fb3d_rl.models.artflownet import proposes_several
from fb3d_rl.rollout.rows import FlowRow
from fb3d_rl.scene.posed import Posed

TARGETS = ("part", "all")


def held_out_samples(
    objects: Sequence[tuple[ArticulatedObject, str]],
    options: SampleOptions,
    count: int,
    seed: int,
    targets: Sequence[str] = TARGETS,
    kind: SampleKind = FLOWS,
) -> dict[str, tuple[TensorDictBase, list[tuple[ArticulatedObject, str, str]]]]:
    """Draw ``count`` samples of each object for each of ``targets`` ("part", "all"), of this ``kind``.

    Returns:
        For each target the samples [S] (contract group "sample") and for each sample its object, split and link's
        name ("*" for all movable parts). Objects that show no openable part have none.

    Raises:
        UserError: no object shows one.
    """
    drawn: dict[str, tuple[list[TensorDict], list[tuple[ArticulatedObject, str, str]]]] = {t: ([], []) for t in targets}
    for obj, split in objects:
        posed = Posed(obj, options.camera)
        if not posed.openable:
            continue
        for target in targets:
            wanted = replace(options, all_parts_share=float(target == "all"), some_parts_share=0.0, unmasked_share=0.0)
            for number in range(count):
                rng = np.random.default_rng([seed, 4, zlib.crc32(obj.id.encode()), number])
                sample = kind.draw(posed, wanted, rng)
                if sample is not None:
                    drawn[target][0].append(sample)
                    link = "*" if target == "all" else obj.links[int(sample["target"])].name
                    drawn[target][1].append((obj, split, link))
    if not any(samples for samples, _ in drawn.values()):
        raise UserError("none of the objects to evaluate on shows a part that opens; choose others or wider views")
    return {t: (lazy_stack(samples).contiguous(), about) for t, (samples, about) in drawn.items() if samples}


@torch.no_grad()
def predict(net: nn.Module, samples: TensorDictBase, device: torch.device, batch_size: int = 32) -> torch.Tensor:
    """Predicted flow [S, N, 3] of samples [S], in the network's evaluation mode."""
    return torch.cat([flow for _, flow, _, _ in _batches(net, samples, device, batch_size)])


def _batches(
    net: nn.Module, samples: TensorDictBase, device: torch.device, batch_size: int
) -> Iterator[tuple[TensorDictBase, torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Each batch with the predicted flow [B, N, 3], all proposals [B, K, N, 3] and their probabilities [B, K]."""
    training = net.training
    net.eval()
    try:
        for batch in samples.split(batch_size):
            points, valid, mask = (batch["observation", key].to(device) for key in ("points", "valid", "part_mask"))
            if proposes_several(net):
                found = net.propose(points, valid, mask)
                about = mask & valid if net.part_mask_input else valid
                predicted = net.most_probable(found, valid, mask).cpu()
                yield batch, predicted, found.flows.cpu(), found.of_clouds(about).cpu()
            else:
                flow = net(points, valid, mask).cpu()
                yield batch, flow, flow[:, None], torch.ones(len(flow), 1)
    finally:
        net.train(training)


@torch.no_grad()
def measure_flow(
    net: nn.Module, samples: TensorDictBase, device: torch.device, batch_size: int = 32
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Predicted flow [S, N, 3] of samples [S] and what it is worth, [S] each.

    The numbers are those of :func:`~fb3d_rl.flow.metrics.flow_metrics` and
    :func:`~fb3d_rl.flow.metrics.hypothesis_metrics`, nan for samples in which nothing visible moves.
    """
    flows, numbers = [], []
    for batch, flow, proposals, probabilities in _batches(net, samples, device, batch_size):
        true, valid = batch["privileged", "flow"], batch["observation", "valid"]
        further = hypothesis_metrics(flow, proposals, probabilities, true, valid)
        numbers.append(flow_metrics(flow, true, valid) | further)
        flows.append(flow)
    return torch.cat(flows), {key: torch.cat([part[key] for part in numbers]) for key in numbers[0]}


def flow_rows(
    numbers: Mapping[str, torch.Tensor], about: Sequence[tuple[ArticulatedObject, str, str]]
) -> list[FlowRow]:
    """One row for each sample's numbers of :func:`measure_flow`; samples in which nothing visible moves have none."""
    rows = []
    for i, (obj, split, link) in enumerate(about):
        values = {key: float(value[i]) for key, value in numbers.items()}
        if np.isfinite(list(values.values())).all():
            rows.append(FlowRow(object=obj.id, category=obj.category, split=split, link=link, **values))
    return rows

"""Measure a flow network on held-out samples, for both targets: the part to open, and all movable parts."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, lazy_stack
from torch import nn

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.errors import UserError
from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.rollout.rows import FlowRow
from fb3d_rl.scene.posed import Posed

TARGETS = ("part", "all")


def held_out_samples(
    objects: Sequence[tuple[ArticulatedObject, str]],
    options: SampleOptions,
    count: int,
    seed: int,
    targets: Sequence[str] = TARGETS,
) -> dict[str, tuple[TensorDictBase, list[tuple[ArticulatedObject, str, str]]]]:
    """Draw ``count`` samples of each object for each of ``targets`` ("part", "all").

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
                sample = draw_sample(posed, wanted, rng)
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
    training = net.training
    net.eval()
    keys = (("observation", "points"), ("observation", "valid"), ("observation", "part_mask"))
    parts = [net(*(batch[key].to(device) for key in keys)).cpu() for batch in samples.split(batch_size)]
    net.train(training)
    return torch.cat(parts)


def flow_rows(
    predicted: torch.Tensor, samples: TensorDictBase, about: Sequence[tuple[ArticulatedObject, str, str]]
) -> list[FlowRow]:
    """One row per sample; samples in which nothing visible moves have none."""
    numbers = flow_metrics(predicted, samples["privileged", "flow"], samples["observation", "valid"])
    rows = []
    for i, (obj, split, link) in enumerate(about):
        values = {key: float(value[i]) for key, value in numbers.items()}
        if np.isfinite(list(values.values())).all():
            rows.append(FlowRow(object=obj.id, category=obj.category, split=split, link=link, **values))
    return rows

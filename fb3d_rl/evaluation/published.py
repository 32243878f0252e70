"""What FlowBot3D and FlowBotHD report, beside what a run measured, as Markdown."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from fb3d_rl.assets.splits import UMPNET_SPLIT
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation import tables
from fb3d_rl.evaluation.intervals import Interval, Means
from fb3d_rl.evaluation.runs import Run
from fb3d_rl.evaluation.tables import FLOW, MOTION_ONLY, SUCCESS, Metric, counted, measure
from fb3d_rl.rollout.rows import FlowRow, TrialRow, policies

PUBLISHED: dict[str, Any] = json.loads(Path(__file__).with_name("published.json").read_text())

SPLITS = {"train_test": "new objects of the training categories", "test": "unseen categories"}

SLIPS = """\
Slips in the supplement's own arithmetic, which no number here is taken from: the rows of its Table V add up to 11 of
70 successes and a mean distance of .815, where 10 and .73 are printed; in Table IV a
laptop opened in 4 of 5 trials is printed as 100 %, and fridge_1 has contact in 3 of 5 trials and motion-only success
in 5 of 5: the contacts add up to 62, where 64 is printed, and the motion-only successes to 47, where 45 is printed.
Exchanged (contact in 5 of 5, success in 3 of these) both cells fit their columns."""


def paper(run: Run, variant: str) -> str:
    """The page that sets a run beside the published numbers.

    Args:
        run: an evaluation on PartNet-Mobility's train_test, test or both.
        variant: which of the published networks its own is compared with: "mask" (of what moves), "no_mask" or
            "no_mask_vpa" (viewpoint augmentation).

    Raises:
        UserError: the run measured neither split.
    """
    if not {*(row.split for row in run.rows), *(row.split for row in run.flow_all_parts)} & set(SPLITS):
        raise UserError(
            f"{run.path} measured none of {', '.join(SPLITS)}: evaluate on assets=partnet_mobility assets.split="
            "[train_test,test]"
        )
    facts = run.summary
    lines = [
        "# Beside what is published",
        "",
        f"Ours: `{facts.get('command', 'unknown command')}`, seed {facts.get('seed')}, revision "
        f"{str(facts.get('git_revision'))[:7]}, {facts.get('machine', 'unknown machine')}. In brackets 95 % intervals "
        f"(an object is the unit), n the number of objects. Bold: the better mean. {tables.trainings(facts)}".rstrip(),
        *_flow(run.flow_all_parts, variant),
        *_success(run.rows),
        "",
        "## What differs",
        "",
        *_differences(run),
        "",
        SLIPS,
    ]
    return "\n".join(lines) + "\n"


def _flow(rows: Sequence[FlowRow], variant: str) -> Iterator[str]:
    source, splits = PUBLISHED["flow"], _split_sizes()
    for split, meaning in SPLITS.items():
        ours = [row for row in rows if row.split == split]
        if not ours:
            continue
        theirs: dict[str, list[float]] = source["values"][split][variant]
        yield from ("", f"## Flow, {split}: {meaning}", "", f"Published: {source['source']}. {source['note']}", "")
        yield "| | n | n published | " + " | ".join(f"{metric.label} | published" for metric in FLOW) + " |"
        yield "| --- |" + " --- |" * (2 + 2 * len(FLOW))
        for category in sorted({*theirs} - {"instance mean", "class mean"}):
            own = [row for row in ours if row.category == category]
            cells = [_flow_cells(own, metric, theirs[category][i], "instance") for i, metric in enumerate(FLOW)]
            yield _row(category, _objects(own), splits[split, category], cells)
        for mean in ("instance", "class"):
            cells = [_flow_cells(ours, metric, theirs[f"{mean} mean"][i], mean) for i, metric in enumerate(FLOW)]
            total = sum(size for (of, _), size in splits.items() if of == split)
            yield _row(f"**{mean} mean**", _objects(ours), total, cells)


def _flow_cells(rows: Sequence[FlowRow], metric: Metric, theirs: float, mean: str) -> str:
    """Ours with its interval, and theirs."""
    if not rows:
        return f"– | {theirs:.3f}"
    value, interval = _of(measure(rows, metric), mean)
    assert value is not None
    better = value > theirs if metric.key == "flow/cosine" else value < theirs
    own, other = f"{value:.3f}", f"{theirs:.3f}"
    own, other = (f"**{own}**", other) if better else (own, f"**{other}**")
    ends = f" ({interval[0]:.2f} to {interval[1]:.2f})" if interval else ""
    return f"{own}{ends} | {other}"


def _success(rows: Sequence[TrialRow]) -> Iterator[str]:
    rows = [row for row in rows if row.split in SPLITS]
    if not rows:
        return
    source = PUBLISHED["success"]
    yield from ("", "## Opening: share of trials that succeed", "", f"Published: {source['source']}. {source['note']}")
    yield from (
        "",
        "The last two columns count as FlowBotHD does, only trials that made contact, and are to be set beside each "
        "other; the measure here is all trials, where no contact is a failure. Test's categories are new to a network "
        "that was trained on train_train only; FlowBotHD trained on them. An instance mean is over objects for ours, "
        "over trials for FlowBotHD's.",
    )
    yield from ("", "| | n | class mean | instance mean | with contact | class mean | instance mean |")
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    splits = {row.split: [row.split] for row in rows}
    parts = {"all": [*splits], **splits} if len(splits) > 1 else splits
    for policy in policies(rows):
        for name, held in parts.items():
            of_part = [row for row in rows if row.policy == policy and row.split in held]
            every, touched = measure(of_part, SUCCESS), measure(of_part, MOTION_ONLY)
            yield (
                f"| {policy}: {name} | {_objects(of_part)}, {len(of_part)} trials | {_percent(every, 'class')} | "
                f"{_percent(every, 'instance')} | {counted(of_part, MOTION_ONLY)} trials | "
                f"{_percent(touched, 'class')} | {_percent(touched, 'instance')} |"
            )
    for name, values in source["values"].items():
        for categories, (class_, instance) in {"all": values[:2], "test's categories": values[2:]}.items():
            yield f"| published: {name}: {categories} | | | | | {100 * class_:.1f} % | {100 * instance:.1f} % |"


def _percent(found: Means, mean: str) -> str:
    value, interval = _of(found, mean)
    if value is None:
        return "–"
    return f"{100 * value:.1f} %" + (f" ({SUCCESS.show_interval(interval)})" if interval else "")


def _of(found: Means, mean: str) -> tuple[float | None, Interval | None]:
    """The "instance" or "class" mean with its interval."""
    return (found.class_, found.class_ci95) if mean == "class" else (found.instance, found.instance_ci95)


def _differences(run: Run) -> Iterator[str]:
    sizes = Counter(split for split, _ in _split_sizes().elements())
    measured = {split: _objects([row for row in run.flow_all_parts if row.split == split]) for split in SPLITS}
    counted = ", ".join(f"{measured[split]} of {sizes[split]} in {split}" for split in SPLITS if measured[split])
    if counted:
        yield f"- Objects: ours are those of UMPNet's lists that were at hand, {counted}; published: all that loaded."
    gravity = "on" if run.settings.get("env.gravity") == "True" else "off"
    steps, rate = (run.settings.get(f"env.{key}", "?") for key in ("horizon", "control_freq"))
    yield (
        "- Simulator: ours is ManiSkill3 on SAPIEN, with a velocity-controlled gripper and a spring as suction, "
        f"gravity {gravity}, {steps} control steps at {rate} Hz; doors, boxes, tables, phones and buckets start 20 % "
        "open. FlowBotHD's is PyBullet with 30 decisions and everything closed: rows beside each other, no contest."
    )
    yield (
        "- Contact: here suction held the part, there the gripper touched the object. Parts that no view shows are not "
        "scheduled here; there their trials are left out."
    )
    yield "- A trial that crashes counts as a failure here, without contact."


def _split_sizes() -> Counter[tuple[str, str]]:
    """Number of objects of each category and split in UMPNet's lists."""
    listed = json.loads(UMPNET_SPLIT.read_text())
    return Counter(
        {
            (split, category): len(ids[part])
            for split, kind, part in (("train_test", "train", "test"), ("test", "test", "test"))
            for category, ids in listed[kind].items()
        }
    )


def _objects(rows: Sequence[Any]) -> int:
    return len({(row.category, row.object) for row in rows})


def _row(name: str, own: int, published: int, cells: Sequence[str]) -> str:
    return f"| {name} | {own} | {published} | " + " | ".join(cells) + " |"

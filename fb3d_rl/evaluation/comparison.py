"""Several runs as one comparison: groups of seeds, repeated baselines counted once, paired differences.

Definitions
    A *group* is runs whose configurations are equal but for the seed. A second run of a group's seed is left out
    if its rows are equal, and starts a group of its own if they are not.
    An *entry* is one row of the comparison: a policy with its trials of all seeds. The policy that a run is about
    is an entry of its group. Other policies of a run (the expert, a given ArtFlowNet) are repeated by many runs:
    they are one entry with those of another group if both have trials in common and every one of these ended alike;
    else they are an entry of their own under the name of their group.
    Two rows are of the same *trial* if their keys are equal, which are digests of the object's content, part, start,
    goal, view and what suction may hold (:func:`fb3d_rl.rollout.trials.trial_key`). Rows of earlier versions have no
    key: they are of the same trial if object, part, seeds and the runs' settings of all that enters a key are the same.

Intervals
    As in :mod:`fb3d_rl.evaluation.intervals`: an object is the unit, with all its trials, those of all seeds, since
    several seeds on the same objects are no more objects. Differences are taken trial by trial between policies that
    ran the same trials, and objects are the unit likewise.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fb3d_rl.evaluation import tables
from fb3d_rl.evaluation.intervals import Means
from fb3d_rl.evaluation.runs import Run, labels
from fb3d_rl.evaluation.tables import CONTACT, DECISION, DISTANCE, SUCCESS, Metric
from fb3d_rl.rollout.rows import TrialRow, policies

METHOD = (
    ("Interval", "95 %, with an object as the unit: its trials, over all seeds, count as one. It is for the mean over "
     "other objects with the same trained networks; the range over seeds shows how the mean varies with training."),
    ("Seeds", "of the runs of a row. Runs of launch/train.py are trainings of their own; those of "
     "launch/evaluate.py share the training of their checkpoint."),
    ("Range over seeds", "the lowest and the highest seed's instance mean."),
    ("Repeats", "runs repeat the expert and other baselines. Trials that ended alike in all runs count once; "
     "a policy whose repeats differ has several rows."),
    ("Difference", "between two policies on the trials that both ran (same object, part, start, goal, view and "
     "suction), trial by trial, as a mean over objects; its interval has objects as the unit likewise. Where all are "
     "tied, it bounds the share of other objects that could differ."),
    ("Labels", "steps labelled by the expert that the policy learned from, mean over seeds; expert steps: share of "
     "those steps that the expert also made."),
)  # fmt: skip
"""Definitions of a comparison's numbers: (term, meaning)."""

BASELINES = ("expert", "bc")
"""Policies that the others are compared with."""

DIFFERENCES = (SUCCESS, CONTACT, DISTANCE)

_NOT_COMPARED = ("seed", "resume")
_MAX_KEYS = 3
"""Settings in a label; runs that differ in more are named by their folders."""

TrialKey = tuple[int | None, str, int]
"""Run seed, the trial's key, and a count of the rows that have the same before this one."""

_DECIDE_TRIALS = ("assets.", "camera.", "data.points", "evaluation.start", "evaluation.goal", "env.suction.hold")
"""Settings that decide what a trial is, beside its seed."""
_WHICH_TRIALS = ("assets.split", "assets.eval_split", "assets.root", "assets.split_file", "assets.train_count")
"""Of these, settings that only choose among trials."""


@dataclass(frozen=True)
class Group:
    """Runs that differ only in the seed.

    Attributes:
        label: for people, unique.
        policy: the policy that the runs are about.
        runs: one for each seed.
        settings: their configuration without the seed.
        names: names of the runs' folders, those of left-out repeats included.
    """

    label: str
    policy: str
    runs: list[Run]
    settings: Mapping[str, str]
    names: list[str]


@dataclass(frozen=True)
class Entry:
    """A row of the comparison.

    Attributes:
        label: for people, unique.
        policy: the policy's name in the rows.
        own: the runs of the first group are about this policy.
        groups: the groups whose runs have these trials.
        rows: the trials, each once.
    """

    label: str
    policy: str
    own: bool
    groups: list[Group]
    rows: dict[TrialKey, TrialRow]

    @property
    def seeds(self) -> list[int | None]:
        """Seeds of the runs, in order."""
        return sorted({key[0] for key in self.rows}, key=lambda seed: -1 if seed is None else seed)

    def of_seed(self, seed: int | None) -> list[TrialRow]:
        """The trials of one seed."""
        return [row for key, row in self.rows.items() if key[0] == seed]

    def seed_range(self, metric: Metric) -> tuple[float, float] | None:
        """Lowest and highest instance mean of a seed; None for a single seed."""
        found = [tables.measure(self.of_seed(seed), metric).instance for seed in self.seeds]
        known = [value for value in found if value is not None]
        return (min(known), max(known)) if len(found) > 1 and known else None

    def facts(self, key: str) -> list[float | None]:
        """What the summaries of the runs that made the policy say, of each seed."""
        return [run.summary.get(key) for run in self.groups[0].runs] if self.own else []

    @property
    def labels(self) -> float | None:
        """Labels used, mean over seeds."""
        return _mean(self.facts("labels"))

    @property
    def decision_times(self) -> list[float | None]:
        """Wall time of a decision, ms: the median of each of the first group's runs."""
        return [run.summary.get(f"{self.policy}/{DECISION.key}") for run in self.groups[0].runs]

    @property
    def decision_ms(self) -> float | None:
        """Wall time of a decision, ms, mean over seeds."""
        return _mean(self.decision_times)

    @property
    def expert_share(self) -> float | None:
        """Share of the labelled steps that the expert also made, mean over seeds."""
        return _mean(self.facts("expert_share"))


@dataclass(frozen=True)
class Difference:
    """An entry's mean minus a baseline's, on the trials of both.

    Attributes:
        entry: the one.
        baseline: the other.
        metric: what is compared.
        means: of the differences.
        n: trials that both ran.
    """

    entry: Entry
    baseline: Entry
    metric: Metric
    means: Means
    n: int


@dataclass(frozen=True)
class Comparison:
    """What :func:`compare` finds; ``numbers`` is a :func:`fb3d_rl.evaluation.tables.summary` by entries' labels."""

    groups: list[Group]
    entries: list[Entry]
    differences: list[Difference]
    numbers: dict[str, Any]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def compare(runs: Sequence[Run]) -> Comparison:
    """Group, merge and pair the trials of ``runs``, as this module's docstring defines it.

    Raises:
        UserError: a run is given twice or its config.yaml cannot be read.
    """
    groups = _groups(runs)
    entries = _entries(groups)
    rows = [replace(row, policy=entry.label) for entry in entries for row in entry.rows.values()]
    facts: dict[str, Any] = {"policy": entries[0].label} if entries else {}
    facts |= {f"{entry.label}/{DECISION.key}": entry.decision_ms for entry in entries}
    return Comparison(groups, entries, _differences(entries), tables.summary(rows, [], facts))


# -------------------------------------------------------------------------------------------------------- grouping


def _groups(runs: Sequence[Run]) -> list[Group]:
    names = dict(zip((run.path for run in runs), labels([run.path for run in runs]), strict=True))
    found: list[tuple[dict[str, str], list[Run], list[str]]] = []
    for run in runs:
        settings = {key: value for key, value in run.settings.items() if key not in _NOT_COMPARED}
        for others, members, folders in found:
            same = next((other for other in members if other.seed == run.seed), None)
            fits = same is None or (same.rows == run.rows and same.flow == run.flow)
            # Without a configuration other settings may differ, too.
            if settings and others == settings and fits:
                members += [run] if same is None else []
                folders.append(names[run.path])
                break
        else:
            found.append((settings, [run], [names[run.path]]))
    policies_ = [_about(members[0], settings, folders[0]) for settings, members, folders in found]
    titles = _labels(policies_, [settings for settings, _, _ in found], [folders[0] for _, _, folders in found])
    return [
        Group(label, policy, sorted(members, key=lambda run: -1 if run.seed is None else run.seed), settings, folders)
        for label, policy, (settings, members, folders) in zip(titles, policies_, found, strict=True)
    ]


def _about(run: Run, settings: Mapping[str, str], folder: str) -> str:
    """The policy that a run is about, or the best name for a run without trials."""
    found = run.summary.get("policy") or settings.get("algo.name") or settings.get("policy.name") or folder
    return str(found)


def _labels(names: Sequence[str], settings: Sequence[Mapping[str, str]], folders: Sequence[str]) -> list[str]:
    """Each group's policy, where several share it with the settings in which they differ, "algo.lr" as "lr"."""
    out = []
    for name, own, folder in zip(names, settings, folders, strict=True):
        peers = [other for other, policy in zip(settings, names, strict=True) if policy == name]
        keys = [key for key in sorted({k for p in peers for k in p}) if len({p.get(key) for p in peers}) > 1]
        alike = sum(peer == own for peer in peers) > 1
        if len(peers) == 1:
            out.append(name)
        elif len(keys) > _MAX_KEYS or alike:
            out.append(folder if folder.startswith(name) else f"{name} · {folder}")
        else:
            ends = Counter(map(_end, keys))
            short = ((_end(key) if ends[_end(key)] == 1 else key, own.get(key, "unset")) for key in keys)
            out.append(f"{name} · " + ", ".join(f"{key}={value}" for key, value in short))
    return out


def _end(key: str) -> str:
    return key.rpartition(".")[2]


# --------------------------------------------------------------------------------------------------------- merging


def _entries(groups: Sequence[Group]) -> list[Entry]:
    found: list[tuple[str, bool, list[Group], dict[TrialKey, TrialRow]]] = []
    parts = [(policy, group) for group in groups for policy in policies(row for run in group.runs for row in run.rows)]
    # What a run is about comes first: a baseline may turn out to be the policy that another run trained.
    for policy, group in sorted(parts, key=lambda part: part[0] != part[1].policy):
        rows = _keyed(group, policy)
        own = policy == group.policy
        for known, _, members, merged in found:
            if not own and known == policy and _repeats(rows, merged):
                members.append(group)
                merged.update(rows)
                break
        else:
            found.append((policy, own, [group], rows))
    count = Counter(policy for policy, *_ in found)
    entries = []
    for policy, own, members, rows in found:
        apart = f"{policy} (in {members[0].label})" if count[policy] > 1 else policy
        entries.append(Entry(members[0].label if own else apart, policy, own, members, rows))
    first = {"expert": 0, "artflownet": 1}
    place = {id(group): i for i, group in enumerate(groups)}
    return sorted(entries, key=lambda entry: (first.get(entry.policy, 2), place[id(entry.groups[0])], not entry.own))


def _keyed(group: Group, policy: str) -> dict[TrialKey, TrialRow]:
    keyed: dict[TrialKey, TrialRow] = {}
    for run in group.runs:
        times: Counter[str] = Counter()
        for row in run.rows:
            if row.policy == policy:
                key = row.key or _key_without(row, run)
                keyed[(run.seed, key, times[key])] = row
                times[key] += 1
    return keyed


def _key_without(row: TrialRow, run: Run) -> str:
    """The trial of a row that was written without a key, by the run's settings; its own where these are not known."""
    decisive = {
        key: value
        for key, value in run.settings.items()
        if key.startswith(_DECIDE_TRIALS) and not key.startswith(_WHICH_TRIALS)
    }
    settings = sorted(decisive.items()) if decisive else str(run.path)
    return str((row.split, row.category, row.object, row.link, row.seed, row.repeat, settings))


def _repeats(rows: Mapping[TrialKey, TrialRow], others: Mapping[TrialKey, TrialRow]) -> bool:
    """Whether two tables have trials in common and all of these ended alike."""
    common = rows.keys() & others.keys()
    return bool(common) and all(_outcome(rows[key]) == _outcome(others[key]) for key in common)


def _outcome(row: TrialRow) -> tuple[object, ...]:
    return (row.status, row.contact, row.success, row.normalized_distance, row.steps, row.attach_step)


# --------------------------------------------------------------------------------------------------------- pairing


def _differences(entries: Sequence[Entry]) -> list[Difference]:
    found = []
    for name in reversed(BASELINES):
        for entry in entries:
            # The expert beside BC is BC beside the expert.
            if entry.policy == name or (entry.policy in BASELINES and name != "expert"):
                continue
            for baseline in _nearest(entry, [other for other in entries if other.policy == name]):
                pairs = [(row, baseline.rows[key]) for key, row in entry.rows.items() if key in baseline.rows]
                found += [
                    Difference(entry, baseline, metric, tables.difference(pairs, metric), len(pairs))
                    for metric in DIFFERENCES
                ]
    return found


def _nearest(entry: Entry, baselines: Sequence[Entry]) -> list[Entry]:
    """Of those with trials in common, the baselines whose configuration is the nearest to the entry's."""

    def distance(baseline: Entry) -> int:
        return min(
            sum(a.settings.get(key) != b.settings.get(key) for key in {*a.settings, *b.settings})
            for a in entry.groups
            for b in baseline.groups
        )

    known = {id(b): distance(b) for b in baselines if entry.rows.keys() & b.rows.keys()}
    return [b for b in baselines if known.get(id(b), math.inf) == min(known.values(), default=-1)]


def by_pair(comparison: Comparison) -> list[list[Difference]]:
    """The differences of each pair of entries, one for each of :data:`DIFFERENCES`."""
    width = len(DIFFERENCES)
    return [comparison.differences[i : i + width] for i in range(0, len(comparison.differences), width)]

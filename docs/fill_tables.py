"""Fill the tables of results in README.md, docs/ and results/ from the summaries below results/.

python docs/fill_tables.py             writes the tables anew
python docs/fill_tables.py --check     only says which pages are not current; exit code 1 if any

A page names a table between two comments, ``<!-- table: NAME -->`` and ``<!-- /table -->``; all else on the page is
written by hand. A test runs the check.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from robot_results import robot, robot_ablation  # a file beside this one

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted(RESULTS.glob("**/*.md")))
MARK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- /table -->)", re.DOTALL)
FLOW = ("flow/cosine", "flow/rmse", "flow/magnitude_error")

Lines = list[str]


@dataclass(frozen=True)
class Row:
    """A line of a table: its label, the folder of the run and the policy whose numbers it shows."""

    label: str
    folder: str
    policy: str


Cell = Callable[[Row], str]


@cache
def summary(folder: str) -> dict[str, Any]:
    """The summary of a folder below results/."""
    found: dict[str, Any] = json.loads((RESULTS / folder / "summary.json").read_text())
    return found


def percent(value: float, decimals: int = 0) -> str:
    """A share in percent; one that is not whole never reads 100 %."""
    return f"{100 * value:.{1 if 0.995 <= value < 1 else decimals}f} %"


def plain(value: float, decimals: int = 3) -> str:
    """A number of at most 1 in size, without its leading zero."""
    return f"{value:.{decimals}f}".replace("0.", ".", 1).replace("-", "−")


def share(metric: str, below: str = ".", split: str = "", interval: bool = True, decimals: int = 0) -> Cell:
    """A column of a share of trials: the mean over objects, with its 95 % interval.

    Args:
        metric: key of the summary, without the policy's name.
        below: the folder below results/ that holds the runs.
        split: the split it is limited to; "" for all trials.
        interval: whether the interval is shown.
        decimals: of the percentage.
    """

    def cell(row: Row) -> str:
        numbers = summary(f"{below}/{row.folder}")
        numbers = numbers["by_split"][split] if split else numbers
        low, high = numbers[f"{row.policy}/{metric}_ci95"]
        text = percent(numbers[f"{row.policy}/{metric}"], decimals)
        return f"{text} ({100 * low:.0f}–{100 * high:.0f})" if interval else text

    return cell


def distance(below: str = ".") -> Cell:
    """A column of the normalized distance."""
    return lambda row: f"{summary(f'{below}/{row.folder}')[f'{row.policy}/normalized_distance']:.2f}"


def labels(below: str) -> Cell:
    """A column of the labels that a learner had; empty where there is none."""

    def cell(row: Row) -> str:
        count = summary(f"{below}/{row.folder}").get("labels") if row.policy == row.folder else None
        return f"{count:,}" if count else ""

    return cell


def flow(key: str) -> Cell:
    """A column of a flow metric of the run's network; empty for other policies."""
    return lambda row: _flow_interval(summary(row.folder), key) if row.policy == "artflownet" else ""


def table(header: Sequence[str], body: Sequence[Sequence[str]]) -> Lines:
    """A table in Markdown."""
    return [re.sub(r"\|  (?=\|)", "| ", f"| {' | '.join(line)} |") for line in (header, ["---"] * len(header), *body)]


def trials(rows: Sequence[Row], columns: Mapping[str, Cell]) -> Lines:
    """A table with a line for each policy."""
    return table(["", *columns], [[row.label, *(cell(row) for cell in columns.values())] for row in rows])


IMITATION = (
    Row("expert", "dagger", "expert"),
    Row("ArtFlowNet", "artflownet", "artflownet"),
    Row("BC", "bc", "bc"),
    Row("BC + F", "bc_flow", "bc_flow"),
    Row("DAgger E2E", "dagger", "dagger"),
    Row("DAgger E2E + F", "dagger_flow", "dagger_flow"),
    Row("DAgger Oracle", "dagger_oracle", "dagger_oracle"),
    Row("DAgger Oracle + F", "dagger_oracle_flow", "dagger_oracle_flow"),
)
"""The supplement's comparison; a run of each algorithm below one folder, which a column names."""

POLICIES = (
    Row("expert (true flow)", "expert", "expert"),
    Row("ArtFlowNet, published weights", "artflownet_published", "artflownet"),
    Row("ArtFlowNet, published weights, no part mask", "artflownet_published_unmasked", "artflownet"),
    Row("ArtFlowNet", "artflownet", "artflownet"),
    Row("FlowBot++, a look in every step", "flowbotpp_1", "flowbotpp"),
    Row("FlowBot++, a look in 3 steps", "flowbotpp_3", "flowbotpp"),
    Row("FlowBot++, a look in 10 steps", "flowbotpp_10", "flowbotpp"),
    Row("FlowBot++, one look for each hold", "flowbotpp_open", "flowbotpp"),
    Row("UMP-DI (told where to touch)", "ump_di", "ump_di"),
    Row("screw parameters", "screwnet", "screwnet"),
    Row("surface normal", "normal", "normal"),
    Row("random", "random", "random"),
    Row("BC", "bc", "bc"),
    Row("BC + F (told the true flow)", "bc_flow", "bc_flow"),
    Row("DAgger E2E", "dagger", "dagger"),
    Row("DAgger E2E, contact point and phase", "dagger_told", "dagger"),
    Row("DAgger E2E, contact point, phase, published ArtFlowNet's flow", "dagger_predicted", "dagger_artflow"),
    Row("DAgger E2E + F", "dagger_flow", "dagger_flow"),
    Row("DAgger Oracle (driven to the contact point)", "dagger_oracle", "dagger_oracle"),
    Row("DAgger Oracle + published ArtFlowNet's flow", "dagger_oracle_predicted", "dagger_oracle_artflow"),
    Row("DAgger Oracle + F", "dagger_oracle_flow", "dagger_oracle_flow"),
)
"""results/comparison."""


TWO = (Row("expert (true flow)", "", "expert"), Row("ArtFlowNet", "", "artflownet"))
"""Both policies of one run, whose folder the columns name."""


HEADLINE = ("expert", "artflownet_published", "artflownet", "flowbotpp_10", "screwnet", "bc", "bc_flow", "dagger",
            "dagger_told", "dagger_predicted", "dagger_flow", "dagger_oracle", "dagger_oracle_flow")  # fmt: skip
"""Folders of those of POLICIES that the first page shows."""


def headline() -> Lines:
    """The comparison's four test sets side by side, with the number of trials and objects of each."""
    sets = {
        "real objects of known kinds": "train_test",
        "real objects of new kinds": "test",
        "procedural objects of known kinds": "procedural_train_test",
        "procedural objects of new kinds": "procedural_test",
    }
    columns = {}
    for name, split in sets.items():
        numbers = summary("comparison/expert")["by_split"][split]
        header = f"{name}: {numbers['n']} trials on {numbers['n_objects']}"
        columns[header] = share("success_rate", "comparison", split)
    return trials([row for row in POLICIES if row.folder in HEADLINE], columns)


def imitation() -> Lines:
    """Held-out procedural objects."""
    below = "imitation"
    return trials(IMITATION, {
        "contact": share("contact_rate", below),
        "success": share("success_rate", below),
        "success once it holds the part": share("motion_only_success_rate", below, interval=False),
        "normalized distance": distance(below),
    })  # fmt: skip


def imitation_unseen() -> Lines:
    """Categories that were never trained on."""
    below = "imitation_unseen"
    return trials(IMITATION, {
        "success, seen categories": share("success_rate", below, "train_test"),
        "contact, unseen ones": share("contact_rate", below, "test"),
        "success, unseen ones": share("success_rate", below, "test"),
        "once it holds the part": share("motion_only_success_rate", below, "test", interval=False),
    })  # fmt: skip


def imitation_partnet_mobility() -> Lines:
    """Real objects; the labels that each learner had stand beside."""
    below = "imitation_partnet_mobility"
    return trials(IMITATION, {
        "labels": labels(below),
        "contact": share("contact_rate", below),
        "success": share("success_rate", below),
        "success, class mean": share("success_rate_class_mean", below, interval=False),
        "success once it holds the part": share("motion_only_success_rate", below, interval=False),
        "normalized distance": distance(below),
    })  # fmt: skip


GUIDED = (
    ("default", "plain"),
    ("`focus=part`", "part"),
    ("`contact=true phase=true focus=part`", "guided_part"),
)
"""Options of algo.learner and the folders of their runs, which end with a seed."""


def imitation_contact() -> Lines:
    """What helps a learner with few labels to get to the part; a line for each option and seed."""
    below = "imitation_contact"
    rows = [
        Row(f"{label}, seed {seed}", f"{name}_{seed}", "dagger")
        for label, name in GUIDED
        for seed in (0, 1)
        if (RESULTS / below / f"{name}_{seed}").is_dir()
    ]
    return trials(rows, {
        "trials": lambda row: str(summary(f"{below}/{row.folder}")["n"]),
        "contact, seen categories": share("contact_rate", below, "train_test"),
        "contact, unseen ones": share("contact_rate", below, "test"),
        "contact": share("contact_rate", below),
        "success": share("success_rate", below),
    })  # fmt: skip


TOLD = ("dagger", "dagger_told", "dagger_predicted", "dagger_oracle", "dagger_oracle_predicted")
"""Folders of those of POLICIES that show what a learner has to be told."""


def imitation_told() -> Lines:
    """What brings a learner to the parts of real objects, and what opens them."""
    below = "comparison"
    return trials([row for row in POLICIES if row.folder in TOLD], {
        "contact, known kinds": share("contact_rate", below, "train_test"),
        "contact, new kinds": share("contact_rate", below, "test"),
        "success, known kinds": share("success_rate", below, "train_test"),
        "success, new kinds": share("success_rate", below, "test"),
    })  # fmt: skip


def comparison() -> Lines:
    """Every policy on the same trials, by split."""
    below = "comparison"
    return trials(POLICIES, {
        "real, train_test": share("success_rate", below, "train_test"),
        "real, test": share("success_rate", below, "test"),
        "procedural, seen families": share("success_rate", below, "procedural_train_test"),
        "procedural, unseen families": share("success_rate", below, "procedural_test"),
        "contact, all": share("contact_rate", below, interval=False),
    })  # fmt: skip


def procedural() -> Lines:
    """What ``make train`` measures."""
    rows = [replace(row, folder="procedural") for row in TWO]
    return trials(rows, {
        "contact": share("contact_rate"),
        "success": share("success_rate"),
        "normalized distance": distance(),
        "flow cosine": flow("flow/cosine"),
        "RMSE": flow("flow/rmse"),
        "magnitude error": flow("flow/magnitude_error"),
    })  # fmt: skip


def partnet_mobility() -> Lines:
    """Real objects, trained on the real objects of train_train."""
    rows = [replace(row, folder="partnet_mobility") for row in TWO]
    return trials(rows, {
        "contact": share("contact_rate", decimals=1),
        "success": share("success_rate", decimals=1),
        "success, class mean": share("success_rate_class_mean", interval=False, decimals=1),
        "normalized distance": distance(),
    })  # fmt: skip


def touch() -> Lines:
    """The same weights with a policy that learns from its pulls and with one that does not."""
    rows = [
        Row("real, train_test and test", "real", "artflownet"),
        Row("real, in none of UMPNet's lists", "extra", "artflownet"),
        Row("procedural doors that look alike", "doors", "artflownet"),
    ]
    columns: dict[str, Cell] = {
        "objects, trials": lambda row: "{n_objects}, {n}".format(**summary(f"touch/with/{row.folder}")),
    }
    for below, name in (("touch/without", "as predicted"), ("touch/with", "with touch")):
        columns[name] = share("success_rate", below)
        columns[f"{name}, class mean"] = share("success_rate_class_mean", below, interval=False)
    return trials(rows, columns)


def _flow_interval(numbers: dict[str, Any], key: str, decimals: int = 2) -> str:
    low, high = (plain(end, 2) for end in numbers[key + "_ci95"])
    return f"{plain(numbers[key], decimals)} ({low}–{high})"


def _two_means(numbers: dict[str, Any], key: str) -> str:
    return f"{plain(numbers[key])} / {plain(numbers[key + '_class_mean'])}"


def flow_published() -> Lines:
    """Flow on real objects beside what FlowBot3D's release reports; the better of the same target in bold."""
    published = json.loads((ROOT / "fb3d_rl/evaluation/published.json").read_text())["flow"]["values"]
    numbers, body = summary("partnet_mobility"), []
    for split, name in {"train_test": "train_test", "test": "test (unseen)"}.items():
        own, every = numbers["by_split"][split], numbers["flow_all_parts"]["by_split"][split]
        means = (published[split]["mask"][f"{mean} mean"] for mean in ("instance", "class"))
        ours, theirs = [], []
        for key, instance, class_ in zip(FLOW, *means, strict=True):
            wins = (every[key] > instance) == (key == "flow/cosine")
            ours.append(_bold(_two_means(every, key), wins))
            theirs.append(_bold(f"{plain(instance)} / {plain(class_)}", not wins))
        body.append([f"{name}: ours, the part to open", *(_two_means(own, key) for key in FLOW)])
        body.append([f"{name}: ours, all movable parts", *ours])
        body.append([f"{name}: published, all movable parts", *theirs])
    return table(["flow, part to open given by a mask", "cosine", "RMSE", "magnitude error"], body)


def _bold(text: str, bold: bool) -> str:
    return f"**{text}**" if bold else text


TRANSFER = {
    "94 real objects": "partnet_mobility",
    "1,260 procedural ones, no real one": "transfer_procedural",
    "94 real and 126 procedural ones": "transfer_mixed",
}
"""What the same network was trained on."""


def transfer() -> Lines:
    """The flow of the part to open on the same real objects."""
    body = []
    for name, folder in TRANSFER.items():
        numbers = summary(folder)
        splits = [_two_means(numbers["by_split"][split], "flow/cosine") for split in ("train_test", "test")]
        body.append([name, *(_flow_interval(numbers, key, 3) for key in FLOW), *splits])
    return table(["trained on", "cosine", "RMSE", "magnitude error", "cosine, train_test", "cosine, test"], body)


def transfer_categories() -> Lines:
    """The same by category: means over the objects of each."""
    runs = [summary(folder)["by_category"] for folder in TRANSFER.values()]
    objects = category_sizes()
    body = [
        [name, str(objects[name]), *(f"{run[name]['flow/cosine']:.2f}" for run in runs)] for name in sorted(runs[0])
    ]
    return table(["category", "objects", "trained on real ones", "on procedural ones", "on both"], body)


def category_sizes() -> dict[str, int]:
    """Held-out real objects of each category, as the rows of the flow tell."""
    with (RESULTS / "partnet_mobility" / "flow_rows.csv").open(newline="") as file:
        found = {(row["category"], row["object"]) for row in csv.DictReader(file)}
    return {name: sum(category == name for category, _ in found) for name, _ in found}


EDITION = {
    "seed 0, published": "second_edition/seed0",
    "the same without the mask": "second_edition/unmasked",
    "seed 1": "second_edition/seed1",
    "seed 2": "second_edition/seed2",
}
"""Runs of the published network and of the same training from other seeds."""


def pretrained() -> Lines:
    """The published network on held-out real objects, by split."""
    body = []
    for name, folder in EDITION.items():
        if not (RESULTS / folder / "summary.json").is_file():  # not yet measured
            continue
        row = Row(name, folder, "artflownet")
        for split in ("train_test", "test"):
            numbers = summary(folder)["by_split"][split]
            sizes = f"{numbers['n_objects']} objects, {numbers['n']} trials"
            means = _two_means(numbers, "artflownet/success_rate")
            flows = (_flow_interval(numbers, key, 3) for key in FLOW)
            body.append([name, split, sizes, *flows, share("success_rate", split=split)(row), means])
    head = ["weights", "split", "", "cosine", "RMSE", "magnitude error", "success", "over objects / categories"]
    return table(head, body)


ABLATION = {
    "first edition: `pointnet2`, 57,600 clouds, one answer; as predicted": (
        "touch/without/real",
        "touch/without/doors",
    ),
    "with touch": ("touch/with/real", "touch/with/doors"),
    "`delayed`, 200,000 clouds of nearly the same objects; with touch": ("ablation/clouds", "ablation/clouds_doors"),
    "mechanisms, look-alike doors, 68 real objects of other kinds; four answers; 200,000 clouds; with touch": (
        "ablation/answers",
        "ablation/answers_doors",
    ),
    "second edition: the same with 1.3 million clouds; with touch": ("second_edition/seed0", "second_edition/doors"),
    "second edition, as predicted": ("ablation/without_touch", "ablation/without_touch_doors"),
}
"""What was added, one by one, and the runs on real objects and on look-alike doors."""


def ablation() -> Lines:
    """Success on real objects and on look-alike doors after each addition."""
    body = []
    for name, (real, doors) in ABLATION.items():
        if not (RESULTS / real / "summary.json").is_file():  # not yet measured
            continue
        numbers = summary(real)
        several = numbers.get("flow/best_cosine", 0.0) > numbers["flow/cosine"] + 1e-6
        body.append([
            name,
            _two_means(numbers, "flow/cosine"),
            _two_means(numbers, "flow/best_cosine") if several else "",
            share("success_rate")(Row(name, real, "artflownet")),
            percent(numbers["artflownet/success_rate_class_mean"]),
            share("success_rate")(Row(name, doors, "artflownet")) if (RESULTS / doors).is_dir() else "",
        ])  # fmt: skip
    return table(["", "flow cosine", "best answer", "opened", "opened, class mean", "look-alike doors"], body)


ANSWERS = (
    Row("one answer", "comparison/artflownet", "artflownet"),
    Row("four answers, winner takes all", "ablation/four_answers", "artflownet"),
    Row("flow matching, eight draws", "ablation/flow_matching", "flow_matching"),
)
"""The same encoder and clouds with other heads."""


def answers() -> Lines:
    """Several answers by winner takes all and by flow matching, on real objects of new kinds."""

    def number(key: str) -> Cell:
        return lambda row: plain(summary(row.folder)["by_split"]["test"][key])

    return trials(ANSWERS, {
        "flow cosine": number("flow/cosine"),
        "either sense": number("flow/axis_cosine"),
        "best answer": number("flow/best_cosine"),
        "RMSE": number("flow/rmse"),
        "trials": lambda row: str(summary(row.folder)["by_split"]["test"][f"{row.policy}/n"]),
        "opened": share("success_rate", split="test"),
    })  # fmt: skip


def _logged(name: str) -> list[dict[str, float]]:
    """The rows of a training's log that hold a validation."""
    rows = [json.loads(line) for line in (RESULTS / "learning_curve" / f"{name}.jsonl").read_text().splitlines()]
    return [row for row in rows if "val/cosine" in row]


def learning_curve() -> Lines:
    """Flow after so many clouds of the first edition's data, as the training's log has it."""
    body = []
    for row in _logged("delayed"):
        cells = [
            f"{plain(row[f'val/{split}/cosine'])}, {plain(row[f'val/{split}/rmse'])}"
            for split in ("train_train", "train_test", "test")
        ]
        body.append([f"{32 * int(row['step']):,}", *cells])
    return table(["clouds", "validation", "train_test", "test"], body)


def learning_curve_seeds() -> Lines:
    """Validation of the second edition's three trainings, with the learning rate."""
    runs = [_logged(f"gpu/seed{seed}") for seed in range(3)]
    body = [
        [f"{256 * int(rows[0]['step']):,}", *(f"{plain(r['val/cosine'])}, {plain(r['val/rmse'])}" for r in rows)]
        for rows in zip(*runs, strict=True)
        if int(rows[0]["step"]) % 800 == 0 or rows[0]["step"] >= 4000
    ]
    return table(["clouds", "seed 0", "seed 1", "seed 2"], body)


TABLES: dict[str, Callable[[], Lines]] = {
    function.__name__: function
    for function in (
        headline, imitation, imitation_unseen, imitation_partnet_mobility, imitation_contact, imitation_told,
        comparison, procedural, partnet_mobility,
        flow_published, transfer, transfer_categories, pretrained, touch, ablation, answers, learning_curve,
        learning_curve_seeds, robot, robot_ablation,
    )
}  # fmt: skip


def filled(text: str) -> str:
    """A page with its tables as the results are now."""
    return MARK.sub(lambda found: "\n".join([found[1], *TABLES[found[2]](), "", found[3]]), text)


def main() -> int:
    """Fill or check the pages."""
    parser = argparse.ArgumentParser(description="Fill the tables of results in README.md, docs/ and results/.")
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page is not current")
    options = parser.parse_args()
    old = [page for page in PAGES if filled(page.read_text()) != page.read_text()]
    for page in old:
        print(f"{'not current' if options.check else 'wrote'}: {page.relative_to(ROOT)}")
        if not options.check:
            page.write_text(filled(page.read_text()))
    return 1 if old and options.check else 0


if __name__ == "__main__":
    raise SystemExit(main())

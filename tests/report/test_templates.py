"""Templates hold all HTML, and nothing from outside becomes HTML."""

from __future__ import annotations

import ast
import json
import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PIL import Image

from fb3d_rl import report
from fb3d_rl.evaluation.runs import read_run
from fb3d_rl.evaluation.tables import summary
from fb3d_rl.report import page
from fb3d_rl.report.gallery import films
from fb3d_rl.report.page import (
    Block,
    Cards,
    Cell,
    Choice,
    Facts,
    Figure,
    Film,
    Gallery,
    Grid,
    Heading,
    Legend,
    Note,
    Picker,
    Row,
    Section,
    Shown,
    Source,
    Table,
    Titled,
    Viewer,
)
from fb3d_rl.report.run_page import write_report
from fb3d_rl.rollout.rows import FlowRow, TrialRow, film_name, write_flow, write_trials

PACKAGE = Path(report.__file__).parent
EVIL = "'\"></script></pre><script>alert(1)</script>{{ 7 * 7 }}&amp;"
ROW = TrialRow(
    0,
    EVIL,
    EVIL,
    EVIL,
    EVIL,
    EVIL,
    EVIL,
    "revolute",
    0,
    status="error",
    error=EVIL,
    failure=EVIL,
)


class Parsed(HTMLParser):
    """Texts, attributes and elements of a page, and what scripts hold."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.values: list[str] = []
        self.names: set[str] = set()
        self.elements: Counter[str] = Counter()
        self.scripts: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements[tag] += 1
        self.names |= {name for name, _ in attrs}
        self.values += [value or "" for _, value in attrs]

    def handle_data(self, data: str) -> None:
        (self.scripts if self.cdata_elem == "script" else self.texts).append(data)


def cloud(title: str) -> dict[str, object]:
    return {"title": title, "rest": [[0.0]] * 3, "part": [[0.0]] * 3}


SHOWN = Shown(ROW, EVIL, "#000", None, 1)
BLOCKS: list[tuple[Block, int]] = [
    (Heading(EVIL), 1),
    (Note(EVIL), 1),
    (Source(EVIL), 1),
    (Facts([(EVIL, EVIL), ("command", EVIL)], ("command",)), 3),
    (Cards([(EVIL, EVIL, [EVIL, EVIL])]), 4),
    (Legend([(EVIL, "#000")]), 1),
    (Figure("one", {"data": [], "layout": {"title": EVIL}}), 0),
    (Viewer([cloud(EVIL)]), 0),
    (Table([[Cell(EVIL), Cell(EVIL, color="#000")]], [[Row([Cell(EVIL, EVIL), Cell(EVIL, color="#000")])]]), 5),
    (Picker(EVIL), 0),  # it stands in an attribute
    (Titled(EVIL, Heading(EVIL)), 2),
    (Grid([Heading(EVIL)]), 1),
    (Choice(EVIL, [(EVIL, Heading(EVIL)), (EVIL, Note(EVIL))]), 5),
    (Gallery([SHOWN], {0: Film(b"", False)}, 3, [("policy", EVIL, [("policy", {EVIL: 1})])]), 15),
]


@pytest.mark.parametrize(("block", "count"), BLOCKS, ids=lambda value: type(value).__name__)
def test_no_text_of_a_block_becomes_html(block: Block, count: int, tmp_path: Path) -> None:
    tame = write(tmp_path / "tame.html", [])
    found = write(tmp_path / "page.html", [block])
    assert sum(text.count(EVIL) for text in found.texts) == count + 4, "window, heading, link and section say it too"
    inside = [script for script in found.scripts if "alert(1)" in script]
    assert len(inside) == isinstance(block, Figure | Viewer)
    assert all(EVIL in json.dumps(json.loads(script), ensure_ascii=False).replace('\\"', '"') for script in inside)
    own = {"Figure": 3, "Viewer": 4, "Picker": 1}.get(type(block).__name__, 0)  # its data, plotly.js, and what draws it
    assert found.elements["script"] == tame.elements["script"] + own
    assert not any(name.startswith("on") for name in found.names)


def write(path: Path, blocks: list[Block]) -> Parsed:
    page.write(path, EVIL, EVIL, [], [Section(EVIL, blocks)])
    return Parsed(path.read_text("utf-8"))


def test_every_kind_of_block_is_tried() -> None:
    assert {type(block) for block, _ in BLOCKS} == {*get_args(Block)}


def test_a_section_without_blocks_has_no_title_and_no_link(tmp_path: Path) -> None:
    page.write(tmp_path / "page.html", "title", "heading", [], [Section("gone", []), Section("kept", [Note("here")])])
    content = (tmp_path / "page.html").read_text("utf-8")
    assert "gone" not in content and 'href="#kept"' in content and '<section id="kept">' in content


def test_nothing_that_a_run_folder_holds_becomes_html(tmp_path: Path) -> None:
    run = tmp_path / "<i>run"
    (run / "videos").mkdir(parents=True)
    write_trials(run / "rows.csv", [ROW])
    flow = [FlowRow(EVIL, EVIL, EVIL, EVIL, 0.8, 0.2, 0.1)]
    write_flow(run / "flow_rows.csv", flow)
    keys = ("command", "policy", "checkpoint", "split", "seed", "git_revision", "machine", "device", "started")
    facts = {key: EVIL for key in keys} | {"lost_geometry": {EVIL: [EVIL]}}
    (run / "summary.json").write_text(json.dumps(summary([ROW], flow, facts)))
    (run / "config.yaml").write_text(json.dumps({EVIL: EVIL}))
    log = [{"step": step, f"{EVIL}/{EVIL}": 1.0} for step in range(3)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
    np.savez(
        run / "clouds.npz", points=np.eye(3)[None], valid=np.ones((1, 3), bool), part_mask=np.ones((1, 3), bool),
        flow_true=np.eye(3)[None], flow_predicted=np.eye(3)[None], title=np.array([EVIL]),
    )  # fmt: skip
    Image.new("RGB", (64, 32)).save(run / "videos" / f"{film_name(ROW)}.png")
    assert films(read_run(run))
    found = Parsed(write_report(run).read_text("utf-8"))
    figures = found.values.count("application/json")
    assert figures >= 4 and found.elements["script"] == figures + 4, "plotly.js and three of the page's own"
    assert not any(script.strip() == "alert(1)" for script in found.scripts)
    assert not found.elements["i"] and sum(text.count("<i>run") for text in found.texts) == 2
    assert not any("49" in text and "alert" in text for text in found.texts), "no text is a template"
    labels = [script for script in found.scripts if "data" in script[:9] and "alert" in script]
    assert labels and not any("<script" in script or "\\u003cscript" in script for script in labels), (
        "plotly.js takes tags in labels for its own"
    )


def test_no_module_writes_html() -> None:
    found = []
    for path in sorted(PACKAGE.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                tags = re.findall(r"</?[a-z][^>]*>?", node.value, re.IGNORECASE)
                # plotly.js has these in labels.
                found += [(path.name, tag) for tag in tags if tag not in ("<br>", "<extra>", "</extra>")]
    assert not found


def test_templates_trust_only_what_the_package_holds() -> None:
    trusted = set()
    for path in sorted((PACKAGE / "templates").iterdir()):
        content = path.read_text("utf-8")
        assert "autoescape" not in content
        trusted |= set(re.findall(r"([^\s({]+(?:\([^)]*\))?)\s*\|\s*safe", content))
    assert trusted == {
        'web("page.css")', 'web("tools.js")', 'web("figures.js")', 'web("viewer.js")', 'web("picker.js")',
        "plotly_js()", '"<br>"',
    }  # fmt: skip

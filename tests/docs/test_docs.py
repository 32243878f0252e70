"""The documents: links lead somewhere, tables follow from the results, examples run."""

from __future__ import annotations

import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.kinematics.opening import openable_links, opening_range
from fb3d_rl.procedural import shapes
from fb3d_rl.procedural.spec import ObjectSpec, Part, write_object

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.glob("*.md")), *sorted((ROOT / "results").glob("**/*.md"))]
sys.path.insert(0, str(DOCS))  # as for `python docs/fill_tables.py`
TABLES = runpy.run_path(str(DOCS / "fill_tables.py"))
NOTEBOOK: dict[str, Any] = json.loads((DOCS / "tutorial.ipynb").read_text())


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def anchors(page: Path) -> set[str]:
    """What links to a page's headings are called, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        assert place.exists() and place.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(place), target


def test_the_readme_is_short_and_names_every_page() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    for page in DOCS.glob("*.md"):
        assert page.name == "index.md" or f"(docs/{page.name})" in text, page.name


def test_every_page_is_in_the_menu() -> None:
    pages = {page.name for page in DOCS.glob("*.md")} | {"tutorial.md"}  # made of the notebook
    assert set(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]) == pages


@pytest.mark.parametrize("page", TABLES["PAGES"], ids=named)
def test_tables_are_those_of_the_results(page: Path) -> None:
    """python docs/fill_tables.py writes them."""
    assert TABLES["filled"](page.read_text()) == page.read_text()


def test_every_table_is_shown_and_a_wrong_cell_is_noticed() -> None:
    texts = [page.read_text() for page in TABLES["PAGES"]]
    shown = [found[1] for text in texts for found in TABLES["MARK"].findall(text)]
    assert sorted(shown) == sorted(TABLES["TABLES"])
    readme = (ROOT / "README.md").read_text()
    assert TABLES["filled"](readme.replace("15 % (5–38)", "90 % (5–38)")) == readme
    assert readme.count("15 % (5–38)") == 1


def test_shares_read_100_percent_only_if_they_are() -> None:
    shown = [TABLES["percent"](value) for value in (1.0, 0.996, 0.9949, 0.5, 0.0)]
    assert shown == ["100 %", "99.6 %", "99 %", "50 %", "0 %"]


def test_the_example_of_a_family_opens(tmp_path: Path) -> None:
    (code,) = re.findall(
        r"^    ```python\n(.*?)^    ```", (DOCS / "architecture.md").read_text(), re.DOTALL | re.MULTILINE
    )
    scope: dict[str, Any] = {**vars(shapes), "ObjectSpec": ObjectSpec, "Part": Part}
    exec(re.sub(r"^    ", "", code, flags=re.MULTILINE), scope)  # noqa: S102
    write_object(scope["cupboard"](np.random.default_rng(0)).normalised(), tmp_path, "cupboard")
    obj = load_object(tmp_path)
    (link,) = openable_links(obj)
    closed, opened = opening_range(obj)
    assert obj.links[link].semantic == "rotation_door" and closed == [0.0] and opened == [1.6]


def test_the_notebook_has_no_outputs() -> None:
    cells = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 4 and all(not cell["outputs"] and cell["execution_count"] is None for cell in cells)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("MPLBACKEND", "agg")
    notebook = nbformat.read(DOCS / "tutorial.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=500, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert "Results on held-out objects" in str(notebook.cells[-2].outputs)


def test_versions_and_licence_agree() -> None:
    tomllib = pytest.importorskip("tomllib")  # from Python 3.11 on
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (
        citation["version"] == project["version"] and f"## {project['version']}" in (ROOT / "CHANGELOG.md").read_text()
    )
    assert citation["license"] == project["license"] == "MIT"
    assert (ROOT / "LICENSE").read_text().startswith("MIT License") and project["license-files"] == ["LICENSE"]

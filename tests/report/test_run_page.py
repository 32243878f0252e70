from __future__ import annotations

import base64
import io
import json
import re
import runpy
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from PIL import Image

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.comparison import compare
from fb3d_rl.evaluation.runs import read_run
from fb3d_rl.evaluation.tables import summary
from fb3d_rl.report import gallery
from fb3d_rl.report.comparison_page import write_comparison
from fb3d_rl.report.run_page import write_report
from fb3d_rl.rollout.rows import FlowRow, TrialRow, film_name, write_flow, write_trials

ROOT = Path(__file__).parents[2]
EVIL = "<script>alert(1)</script>"


def fill(run: Path) -> list[TrialRow]:
    """A small run folder with every file; one object, category and error try to inject a script."""
    run.mkdir(parents=True)
    rows = [
        TrialRow(
            trial=i,
            policy=policy,
            object=EVIL if i == 0 else f"object-{i}",
            category=EVIL if i == 0 else "Oven",
            split="test",
            link=f"link_{i}",
            semantic="door",
            joint_type="revolute",
            seed=1000 + i,
            status="error" if i == 1 else "ok",
            error=EVIL if i == 1 else "",
            contact=i > 2,
            success=i > 4,
            normalized_distance=0.05 if i > 4 else 1.0,
            failure="" if i > 4 else f"reason {policy} {i}",
        )
        for i in range(7)
        for policy in ("expert", "artflownet")
    ]
    flow = [FlowRow(row.object, row.category, row.split, row.link, 0.8, 0.2, 0.1) for row in rows]
    write_trials(run / "rows.csv", rows)
    write_flow(run / "flow_rows.csv", flow)
    lost = {"object-3": ["2 visuals of base: <box> in place of a mesh", EVIL]}
    facts = {"seed": 5, "git_revision": "cafe01", "command": f"train {EVIL}", "lost_geometry": lost}
    numbers = summary(rows, flow, facts)
    (run / "summary.json").write_text(json.dumps(numbers))
    (run / "config.yaml").write_text(f"name: {EVIL}\n")
    log = [{"step": i, "train/loss": 1 / (i + 1), "val/cosine": float("nan") if i == 3 else 0.5} for i in range(9)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in log) + '{"step": 9, "tra')
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 50, 3)).astype(np.float32)
    valid = np.ones((3, 50), dtype=bool)
    valid[1, 40:] = False
    valid[2] = False
    predicted = points.copy()
    predicted[0, 0] = np.nan
    np.savez(
        run / "clouds.npz",
        points=points,
        valid=valid,
        part_mask=points[..., 0] > 0,
        flow_true=points * (points[..., :1] > 0),
        flow_predicted=predicted,
        title=np.array(["first", EVIL, "nothing visible"]),
    )
    return rows


def test_a_policy_without_a_mask_shows_what_it_opened_of_what_it_held(tmp_path: Path) -> None:
    rows = fill(tmp_path / "masked")
    run = tmp_path / "run"
    run.mkdir()
    blind = [replace(row, mask="none", held_opened=row.trial > 3) for row in rows if row.policy == "artflownet"]
    for folder, content in ((tmp_path / "masked", rows), (run, blind)):
        write_trials(folder / "rows.csv", content)
        (folder / "summary.json").write_text(json.dumps(summary(content, [])))
        text = write_report(folder, tmp_path / "page.html").read_text()
        assert ("Opened what it held" in text) == (folder == run)


def test_a_network_that_proposes_several_flows_shows_what_they_are_worth(tmp_path: Path) -> None:
    row = FlowRow("1", "Box", "test", "link_0", 0.5, 0.2, 0.1, axis_cosine=0.9, best_cosine=0.8, hit=0.0)
    for probability in (1.0, 0.6):
        write_flow(tmp_path / "flow_rows.csv", [replace(row, probability=probability)])
        write_trials(tmp_path / "rows.csv", [])
        text = write_report(tmp_path, tmp_path / "page.html").read_text()
        assert ("Several proposed flows" in text) == (probability < 1.0)


class Page(HTMLParser):
    """Collects what a browser would see."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.feed(path.read_text("utf-8"))
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data: str) -> None:
        if self.cdata_elem == "script":
            self.scripts[-1] += data
        elif self.cdata_elem is None:
            self.text.append(data)

    def json_of(self, key: str, value: str) -> dict[str, object]:
        attributes = [attrs for tag, attrs in self.tags if tag == "script"]
        found: dict[str, object] = json.loads(
            self.scripts[next(i for i, attrs in enumerate(attributes) if attrs.get(key) == value)]
        )
        return found


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "first"
    fill(run)
    write_report(run)
    return run


@pytest.fixture(scope="module")
def page(run: Path) -> Page:
    return Page(run / "report.html")


def test_every_failed_trial_is_listed(page: Page) -> None:
    shown = " ".join(page.text)
    for i in range(7):
        for policy in ("expert", "artflownet"):
            assert (f"reason {policy} {i}" in shown) == (i <= 4)


def test_strings_from_outside_are_shown_not_run(page: Page) -> None:
    scripts = [script for script in page.scripts if script.strip() == "alert(1)"]
    assert not scripts
    # Facts, category table, object, error and configuration all show the string literally.
    assert sum(EVIL in piece for piece in page.text) >= 5
    figure = json.dumps(page.json_of("data-figure", "success"))
    assert "&lt;script&gt;" in figure and "<script>" not in figure


def test_nothing_is_loaded_from_elsewhere(run: Path, page: Page) -> None:
    for tag, attrs in page.tags:
        assert not {"src", "data", "action"} & set(attrs), (tag, attrs)
        assert (attrs.get("href") or "#").startswith("#"), (tag, attrs)
        assert tag not in ("link", "iframe", "img", "base", "object", "embed")
    policy = next(a["content"] for t, a in page.tags if t == "meta" and "http-equiv" in a)
    assert policy is not None and "default-src 'none'" in policy and "http" not in policy
    css = re.search(r"<style>(.*?)</style>", (run / "report.html").read_text("utf-8"), re.DOTALL)
    assert css is not None and "url(" not in css[1] and "@import" not in css[1]
    assert sum(len(script) > 1_000_000 for script in page.scripts) == 1  # plotly.js, once


def test_numbers_and_facts_are_on_the_page(page: Page) -> None:
    shown = " ".join(page.text)
    for word in (
        "cafe01",
        "0.80",
        "29 %",
        "artflownet",
        "expert",
        "class mean",
        "instance mean",
        "One training (one seed)",
    ):
        assert word in shown, word
    assert "One training (one seed)" in shown


def test_lost_geometry_is_on_the_page(page: Page) -> None:
    content = " ".join(page.text)
    assert "Geometry left out while reading" in content and "2 visuals of base: <box> in place of a mesh" in content


def test_the_viewer_holds_the_visible_clouds(page: Page) -> None:
    clouds = page.json_of("id", "clouds")["clouds"]
    assert isinstance(clouds, list)
    assert [cloud["title"] for cloud in clouds] == ["first", EVIL]
    assert [len(c["rest"][0]) + len(c["part"][0]) for c in clouds] == [50, 40]
    for cloud in clouds:
        for arrow in cloud["true"]["vector"]:
            assert np.linalg.norm(arrow) > 0


def test_missing_files_leave_no_empty_sections(tmp_path: Path) -> None:
    run = tmp_path / "run"
    fill(run)
    titles = {
        "rows.csv": "Trials",
        "clouds.npz": "True and predicted flow",
        "metrics.jsonl": "Training",
        "config.yaml": "Configuration",
        "summary.json": None,
        "flow_rows.csv": "Results",
    }
    names = list(titles)
    for k, name in enumerate(names[:-1]):
        (run / name).unlink()
        html = write_report(run).read_text("utf-8")
        for gone in names[: k + 1]:
            assert f"<h2>{titles[gone]}</h2>" not in html
        for kept in names[k + 1 :]:
            assert titles[kept] is None or f"<h2>{titles[kept]}</h2>" in html


def test_without_a_summary_it_is_computed_from_the_rows(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "run"
    rows = fill(other)
    (other / "summary.json").unlink()
    numbers = " ".join(Page(write_report(other)).text)
    assert f"{len(rows) // 2} trials on 7 objects, 1 crashed" in numbers


def test_films_stand_inside_the_page_while_they_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    rows = [row for row in fill(run) if row.trial in (3, 4, 5)]
    (run / "videos").mkdir()
    for row in rows:
        (run / "videos" / f"{film_name(row)}.mp4").write_bytes(film_name(row).encode() * 20)
        noise = np.random.default_rng(row.trial).integers(0, 255, (60, 400, 3), dtype=np.uint8)
        Image.fromarray(noise).save(run / "videos" / f"{film_name(row)}.png")
    names = [film_name(row) for row in rows]
    monkeypatch.setattr(gallery, "VIDEO_BYTES", 20 * (len(names[0]) + len(names[1])) + 10)
    monkeypatch.setattr(gallery, "STRIP_BYTES", 200_000)
    page = Page(write_report(run))
    sources = [attrs["src"] or "" for tag, attrs in page.tags if tag == "video"]
    held = [base64.b64decode(source.removeprefix("data:video/mp4;base64,")) for source in sources]
    assert held == [name.encode() * 20 for name in names[:2]]
    strips = [attrs["src"] or "" for tag, attrs in page.tags if tag == "img"]
    assert 0 < len(strips) < 4 and sum(map(len, strips)) < 4 / 3 * 200_000 + 100
    for strip in strips:
        with Image.open(io.BytesIO(base64.b64decode(strip.removeprefix("data:image/webp;base64,")))) as picture:
            assert picture.size == (1200, 180)
    shown = " ".join(page.text)
    assert "Oven object-3" in shown and f"{4 - len(strips)} more" in shown
    films = {attrs["id"]: attrs for tag, attrs in page.tags if tag == "figure"}
    links = [attrs["href"] for tag, attrs in page.tags if tag == "a" and (attrs["href"] or "").startswith("#film-")]
    assert links == [f"#{name}" for name in films] and len(films) == 2 + len(strips)


def test_a_film_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    rows = fill(tmp_path / "run")
    (tmp_path / "run" / "videos").mkdir()
    (tmp_path / "run" / "videos" / f"{film_name(rows[-1])}.png").write_bytes(b"nonsense")
    with pytest.raises(UserError, match="videos"):
        write_report(tmp_path / "run")


def test_writing_twice_gives_the_same_bytes(run: Path, tmp_path: Path) -> None:
    assert write_report(run, tmp_path / "again.html").read_bytes() == (run / "report.html").read_bytes()


def test_comparison_names_every_run_and_policy(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "a" / "first"
    fill(other)
    (other / "config.yaml").write_text("name: other\n")
    found = compare([read_run(run), read_run(other)])
    compared = Page(write_comparison(found, tmp_path / "out" / "comparison.html"))
    shown = " ".join(compared.text)
    for label in (f"{run.parent.name}/first", "a/first", "artflownet · name=other"):
        assert label in shown
    assert "0.80" in shown, "the flow's cosine"
    figure = json.dumps(compared.json_of("data-figure", "success_rate"))
    assert "&lt;script&gt;a<br>" in figure and "<script" not in figure
    with pytest.raises(UserError, match="twice"):
        compare([read_run(run), read_run(run)])


def test_command_line(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main = runpy.run_path(str(ROOT / "launch" / "report.py"))["main"]
    assert main([str(run), "--out", str(tmp_path / "report.html")]) == 0
    assert (tmp_path / "report.html").read_bytes() == (run / "report.html").read_bytes()
    assert "instance mean" in capsys.readouterr().out
    fill(tmp_path / "second")
    assert main([str(run), str(tmp_path / "second"), "--out", str(tmp_path / "both.html")]) == 0
    assert (tmp_path / "both.html").is_file()


def test_bad_input_ends_with_one_sentence_and_exit_code_2(
    launch: Callable[..., CompletedProcess[str]], tmp_path: Path
) -> None:
    done = launch("report.py", str(tmp_path), cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "not a run folder" in done.stderr


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", "{"),
        ("summary.json", "[]"),
        ("metrics.jsonl", "nonsense\n"),
        ("clouds.npz", "nonsense"),
        ("clouds.npz", ""),
        ("rows.csv", "nonsense"),
    ],
)
def test_unreadable_files_are_named(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=rf"{re.escape(str(tmp_path / name))}(:| is|, line)"):
        write_report(tmp_path)

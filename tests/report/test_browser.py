"""The pages in a real browser: no error, figures and 3D scenes are drawn, and what can be clicked does what it says."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fb3d_rl.evaluation.comparison import compare
from fb3d_rl.evaluation.runs import read_run
from fb3d_rl.report.comparison_page import write_comparison
from fb3d_rl.report.run_page import write_report
from fb3d_rl.rollout.rows import FlowRow, TrialRow, film_name, write_flow, write_trials

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.alone]

LAPTOP, PHONE = (1366, 768), (390, 844)
ENDS = ("", "lost hold", "stuck", "never touched the part", "crashed")
CATEGORIES = ("Box", "Door", "Oven")


def write_run(run: Path, policy: str, seed: int = 0) -> Path:
    """A run whose trials end in all of :data:`ENDS`, some of them filmed, with a log and clouds."""
    run.mkdir(parents=True)
    rows = []
    for i in range(20):
        for name in ("expert", policy):
            failure = "" if name == "expert" else ENDS[i % len(ENDS)]
            crashed = failure == "crashed"
            rows.append(
                TrialRow(
                    trial=i, policy=name, object=str(100 + i), category=CATEGORIES[i % 3], split="test", link="link_0",
                    semantic="lid", joint_type="revolute", seed=i, status="error" if crashed else "ok",
                    error="Boom: <b>1</b>" if crashed else "", steps=150 if failure else 30 + i,
                    contact=failure not in ENDS[3:], success=not failure,
                    normalized_distance=1.0 if failure else 0.05, failure=failure, key=f"trial {i} of {seed}",
                )
            )  # fmt: skip
    write_trials(run / "rows.csv", rows)
    write_flow(run / "flow_rows.csv", [FlowRow(r.object, r.category, r.split, r.link, 0.8, 0.2, 0.1) for r in rows])
    (run / "config.yaml").write_text(f"policy: {{name: {policy}}}\nseed: {seed}\n")
    log = [f'{{"step": {k}, "train/loss": {1 / (k + 1)}, "collect/crashed": 0}}\n' for k in range(9)]
    (run / "metrics.jsonl").write_text("".join(log))
    (run / "videos").mkdir()
    for row in rows[:4]:
        Image.new("RGB", (1600, 240), "white").save(run / "videos" / f"{film_name(row)}.png")
    points = np.random.default_rng(0).normal(size=(2, 200, 3)).astype(np.float32)
    np.savez(
        run / "clouds.npz", points=points, valid=np.ones((2, 200), dtype=bool), part_mask=points[..., 0] > 0,
        flow_true=points * (points[..., :1] > 0), flow_predicted=points, title=np.array(["first", "second"]),
    )  # fmt: skip
    return run


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(write_run(tmp_path_factory.mktemp("run") / "run", "artflownet"))


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("runs")
    runs = [read_run(write_run(root / policy, policy)) for policy in ("artflownet", "bc", "dagger")]
    return write_comparison(compare(runs), root / "comparison.html")


Open = Callable[..., Any]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    path = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
    if path is None:
        pytest.skip("there is no Chromium")
    # WebGL in software.
    flags = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=flags)
        yield browser
        browser.close()


@pytest.fixture
def visit(browser: Any) -> Iterator[Open]:
    """Opens a page; in the end, none may have logged an error or asked for anything but itself."""
    wrong: list[str] = []
    contexts = []

    def opened(path: Path, size: tuple[int, int] = LAPTOP, scheme: str = "light") -> Any:
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(60_000)
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: wrong.append(request.url) if request.url.startswith("http") else None)
        page.goto(path.as_uri())
        return page

    yield opened
    for context in contexts:
        context.close()
    assert not wrong


def rgb(page: Any, selector: str, name: str) -> tuple[int, ...]:
    value = page.locator(selector).first.evaluate("(node, name) => getComputedStyle(node)[name]", name)
    return tuple(map(int, re.findall(r"\d+", value)[:3]))


@pytest.mark.parametrize("size", [LAPTOP, PHONE])
def test_every_figure_is_drawn_and_nothing_is_wider_than_the_screen(
    report: Path, comparison: Path, visit: Open, size: tuple[int, int]
) -> None:
    for path in (report, comparison):
        page = visit(path, size)
        names = page.eval_on_selector_all("script[data-figure]", "nodes => nodes.map(node => node.dataset.figure)")
        assert len(names) > 3
        shown = 0
        for name in names:
            drawn = page.locator(f"#{name} .main-svg")
            drawn.first.wait_for(state="attached")
            box = page.locator(f"#{name}").bounding_box()
            assert box is None or box["width"] <= size[0], name  # None: of a policy that is not chosen
            shown += box is not None
        assert shown > 3
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]


@pytest.mark.parametrize("size", [LAPTOP, PHONE])
def test_both_clouds_are_drawn_and_change_with_the_choice(report: Path, visit: Open, size: tuple[int, int]) -> None:
    page = visit(report, size)
    page.wait_for_function("document.querySelectorAll('#viewer canvas').length > 0")
    box = page.locator("#viewer").bounding_box()
    page.wait_for_timeout(500)

    def halves() -> list[bytes]:
        picture = Image.open(io.BytesIO(page.locator("#viewer").screenshot())).convert("RGB")
        w, h = picture.size
        half = (w // 2, h) if size == LAPTOP else (w, h // 2)
        edges = ((0, 0, *half), (w - half[0], h - half[1], w, h))
        return [np.asarray(picture.crop(edge)).tobytes() for edge in edges]

    assert box["width"] <= size[0] and box["height"] <= 0.75 * size[1]
    before = halves()
    for half, shade in zip(before, ((47, 158, 119), (224, 120, 47)), strict=True):
        pixels = np.frombuffer(half, dtype=np.uint8).reshape(-1, 3).astype(int)
        arrows = (np.abs(pixels - shade).max(1) < 40).mean()
        assert arrows > 0.002, "flow is drawn in its own colour"
    page.locator("#cloud-next").click()
    assert page.locator("#cloud-choice").evaluate("list => list.selectedOptions[0].text") == "second"
    page.wait_for_timeout(500)
    assert all(a != b for a, b in zip(before, halves(), strict=True))


def test_a_table_sorts_by_mouse_and_keyboard_and_keeps_its_means(report: Path, visit: Open) -> None:
    page = visit(report)
    table = page.locator("#numbers-by-category table")
    heads = table.locator("th:has-text('success')")
    success = heads.last

    def column() -> list[str]:
        found: list[str] = table.evaluate("table => [...table.tBodies[0].rows].map(row => row.cells[0].textContent)")
        return found

    means = table.evaluate("table => [...table.tBodies[1].rows].map(row => row.cells[0].textContent)")
    assert column() == list(CATEGORIES) and means == ["class mean", "instance mean"]
    shares = {"Box": 2 / 7, "Door": 1 / 7, "Oven": 1 / 6}
    assert success.get_attribute("aria-sort") == "none"
    success.locator("button").click()
    assert success.get_attribute("aria-sort") == "ascending"
    assert column() == sorted(CATEGORIES, key=lambda name: round(shares[name], 2))
    success.locator("button").press("Enter")
    assert success.get_attribute("aria-sort") == "descending"
    assert column() == sorted(CATEGORIES, key=lambda name: -round(shares[name], 2))
    first = table.locator("th button").first
    first.click()
    assert (success.get_attribute("aria-sort"), column()) == ("none", list(CATEGORIES))
    first.press("Space")
    assert column() == list(CATEGORIES)[::-1]
    assert table.evaluate("table => [...table.tBodies[1].rows].map(row => row.cells[0].textContent)") == means


def test_numbers_sort_by_value_and_missing_ones_come_last(comparison: Path, visit: Open) -> None:
    page = visit(comparison)
    # Cells as the pages write them: signs, thousands, percent, ranges, nothing.
    shown = ["+5", "\N{MINUS SIGN}12", "5,030", "\N{EN DASH}", "58 %", "7\N{EN DASH}9"]
    page.locator("#results table").evaluate(
        """(table, shown) => {
          [...table.tBodies[0].rows].forEach(row => row.remove());
          const copy = table.cloneNode(true);
          copy.id = 'copy';
          for (const text of shown) copy.tBodies[0].insertRow().insertCell().textContent = text;
          copy.tHead.querySelectorAll('th').forEach((th, i) => i ? th.remove() : th.replaceChildren('n'));
          document.body.append(copy);
        }""",
        shown,
    )
    page.evaluate("sortable(document.getElementById('copy'))")
    page.locator("#copy button").click()
    column = "[...document.getElementById('copy').tBodies[0].rows].map(row => row.textContent)"
    expected = ["\N{MINUS SIGN}12", "+5", "7\N{EN DASH}9", "58 %", "5,030", "\N{EN DASH}"]
    assert page.evaluate(column) == expected
    page.locator("#copy button").click()
    assert page.evaluate(column) == [*expected[-2::-1], expected[-1]]


def test_filters_hold_for_films_and_list(report: Path, comparison: Path, visit: Open) -> None:
    page = visit(report)
    rows, films = page.locator("#trials tbody tr:visible"), page.locator("#trials figure:visible")
    count = page.locator("#trials output")
    assert (rows.count(), films.count(), count.inner_text()) == (40, 4, "40 trials")
    page.get_by_label("outcome").select_option("success:failed")
    assert (rows.count(), films.count(), count.inner_text()) == (16, 1, "16 of 40 trials")
    page.get_by_label("outcome").select_option("reason:crashed")
    assert rows.count() == 4 and all("Boom: <b>1</b>" in text for text in rows.all_inner_texts())
    page.get_by_label("category").select_option("category:Door")
    page.get_by_label("outcome").select_option("")
    page.get_by_label("policy").select_option("policy:artflownet")
    assert (rows.count(), films.count()) == (7, 1)
    assert all("Door" in text and "artflownet" in text for text in rows.all_inner_texts())
    page = visit(comparison)
    assert page.locator("#trials figure").count() == 2 + 3 * 2, "the expert's films stand there once"


def test_the_choice_of_a_policy_shows_its_flow_chart(comparison: Path, visit: Open) -> None:
    page = visit(comparison)
    charts = page.locator("#how-trials-ended .chosen")
    assert charts.count() == 4 and [charts.nth(i).is_visible() for i in range(4)] == [True, False, False, False]
    page.locator(".choice select").select_option("expert")
    assert [charts.nth(i).is_visible() for i in range(4)] == [False, False, False, True]
    page.wait_for_timeout(300)
    chart, panel = charts.nth(3).locator(".main-svg").first.bounding_box(), charts.nth(3).bounding_box()
    assert 0.9 * panel["width"] < chart["width"] <= panel["width"]
    assert "success 20" in charts.nth(3).inner_text()


def test_the_dark_scheme_recolours_page_and_figures(report: Path, visit: Open) -> None:
    page = visit(report)
    ink = "#success .xtick text"
    page.locator(ink).first.wait_for()
    light = rgb(page, "body", "backgroundColor"), rgb(page, ink, "fill")
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(500)
    dark = rgb(page, "body", "backgroundColor"), rgb(page, ink, "fill")
    assert min(light[0]) > 200 > 100 > max(light[1]) and max(dark[0]) < 60 and min(dark[1]) > 180
    opened = visit(report, scheme="dark")
    opened.locator(ink).first.wait_for()
    assert rgb(opened, ink, "fill") == dark[1]


def test_the_command_is_copied(tmp_path: Path, visit: Open) -> None:
    run = write_run(tmp_path / "run", "artflownet")
    command = "python launch/train.py 'a=<b>' c=[d,e]"
    (run / "summary.json").write_text('{"by_category": {}, "command": "' + command + '"}')
    page = visit(write_report(run))
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_label("copy Command").click()
    page.get_by_text("copied").wait_for()
    assert page.evaluate("navigator.clipboard.readText()") == command


def test_a_curve_of_zeros_starts_at_zero(report: Path, visit: Open) -> None:
    page = visit(report)
    panel = page.locator("#training [id^=training-]", has_text="crashed")
    low, high = panel.evaluate("node => node.layout.yaxis.range")
    assert -0.1 < low <= 0 < high

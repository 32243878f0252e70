"""The contact sheet of objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.procedural import generate
from fb3d_rl.report.preview import AXIS, COLUMNS, SIZE, picture, write_sheet

WIDTH, HEIGHT = SIZE


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> list[ArticulatedObject]:
    root = tmp_path_factory.mktemp("objects")
    return [load_object(root / name) for name in generate(root, ["Laptop", "WashingMachine"], 2, seed=0)]


def test_an_object_is_drawn_closed_and_open_with_its_axis(objects: list[ArticulatedObject]) -> None:
    for obj in (objects[0], objects[-1]):
        image = picture(obj)
        assert image.shape == (HEIGHT, 2 * WIDTH, 3) and image.dtype == np.uint8
        closed, opened = image[:, :WIDTH].astype(int), image[:, WIDTH:].astype(int)
        assert (np.abs(closed - opened).max(-1) > 40).mean() > 0.05, "the part has moved"
        red = np.abs(image - 255 * np.array(AXIS)).max(-1) < 60
        assert red[:, :WIDTH].sum() > 10 and red[:, WIDTH:].sum() > 10
        assert not red[[0, -1]].any() and not red[:, [0, -1]].any(), "the arrow is in the picture as a whole"


def test_a_sheet_has_all_pictures_by_category(objects: list[ArticulatedObject], tmp_path: Path) -> None:
    shades = [np.full((HEIGHT, 2 * WIDTH, 3), 40 * (k + 1), dtype=np.uint8) for k in range(4)]
    write_sheet(objects, tmp_path / "sheet.png", "Objects", shades)
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    for shade in shades:
        rows, columns = np.nonzero((sheet == shade[0, 0]).all(-1))
        assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == (HEIGHT, 2 * WIDTH)
    tops = [np.nonzero((sheet == shade[0, 0]).all(-1))[0].min() for shade in shades]
    assert tops[0] == tops[1] < tops[2] == tops[3], "a row for each category"

    write_sheet(objects[::2], tmp_path / "few.png", "Objects", shades[:2])
    assert Image.open(tmp_path / "few.png").height < Image.open(tmp_path / "sheet.png").height
    assert COLUMNS > 1


def test_a_page_loads_nothing_and_shows_names_literally(objects: list[ArticulatedObject], tmp_path: Path) -> None:
    shades = [np.zeros((HEIGHT, 2 * WIDTH, 3), dtype=np.uint8)] * 4
    write_sheet(objects, tmp_path / "sheet.html", "<Objects>", shades)
    text = (tmp_path / "sheet.html").read_text()
    assert text.count("<img") == 4 and text.count("data:image/webp;base64,") == 4
    assert "<h2>Laptop</h2>" in text and "&lt;Objects&gt;" in text and "<Objects>" not in text
    assert "http://" not in text and "https://" not in text
    assert list(tmp_path.iterdir()) == [tmp_path / "sheet.html"]

"""Films as people see them: captions on pictures, and moments side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from fb3d_rl.drawing.bodies import TARGET
from fb3d_rl.drawing.signs import FAINT, FREE, HOLDING, INK, TRACK, font, hex_color

CAPTION = 40
"""Height (pixels) of the caption below a film's picture."""

Picture = NDArray[np.uint8]


def captioned(picture: Picture, title: str, state: str, opened: float, holding: bool) -> Image.Image:
    """A film's picture [H, W, 3] with a caption below it, [H + CAPTION, W, 3].

    Args:
        picture: it.
        title: said at its top.
        state: said below it.
        opened: how far the part is open, 0 to 1, for a bar.
        holding: whether the cup holds it.
    """
    height, width = picture.shape[:2]
    small, usual = font(12), font(13)
    middle = height + CAPTION // 2 + 2
    image = Image.new("RGB", (width, height + CAPTION), "white")
    image.paste(Image.fromarray(picture))
    draw = ImageDraw.Draw(image)
    draw.text((10, 8), title, FAINT, small)
    draw.rectangle((0, height, width, height + 3), TRACK)
    draw.rectangle((0, height, round(width * opened), height + 3), hex_color(TARGET))
    draw.text((10, middle), state, INK, usual, anchor="lm")
    word = "holding" if holding else "not holding"
    draw.text((width - 10, middle), word, INK, usual, anchor="rm")
    x = width - 24 - draw.textlength(word, usual)
    draw.ellipse((x - 5, middle - 5, x + 5, middle + 5), hex_color(HOLDING if holding else FREE))
    return image


class Still(NamedTuple):
    """A moment of a film: its name, what is said of it, and its picture, twice as large as it is shown."""

    name: str
    state: str
    picture: Picture


def filmstrip(stills: Sequence[Still], title: str, width: int) -> Image.Image:
    """Moments side by side in a picture of that ``width`` (pixels), with a caption below each."""
    gap, line = width // 130, width // 70
    side = still_width(len(stills), width)
    tall = stills[0].picture.shape[0] // 2
    bold, usual = font(width // 100, bold=True), font(width // 114)
    top = round(1.4 * line)
    image = Image.new("RGB", (width, top + tall + 3 * line), "white")
    draw = ImageDraw.Draw(image)
    draw.text((0, 0), title, FAINT, usual)
    for place, still in enumerate(stills):
        left, below = place * (side + gap), top + tall + line // 3
        image.paste(Image.fromarray(still.picture).resize((side, tall), Image.Resampling.BOX), (left, top))
        draw.text((left, below), still.name, INK, bold)
        draw.text((left, below + round(1.1 * line)), still.state, FAINT, usual)
    return image


def still_width(count: int, width: int) -> int:
    """Width (pixels) of each of ``count`` moments in a filmstrip of that ``width``."""
    return (width - width // 130 * (count - 1)) // count

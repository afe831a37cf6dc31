"""Scenes as pixels: anti-aliased pictures for people, sheets and films of them.

Pixels for agents are elsewhere: these pictures are drawn on the host and are not meant to be fast.
"""

import io
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO

import numpy as np
import resvg_py
from jaxtyping import Int
from PIL import Image

from levelproof.levelgen.level import Level
from levelproof.levelgen.pictures.scene import scene_of
from levelproof.levelgen.pictures.shapes import Scene, font
from levelproof.levelgen.pictures.style import PAPER, PIXELS
from levelproof.levelgen.pictures.svg import svg_of
from levelproof.levelgen.pictures.words import Caption
from levelproof.physics.types import State


def draw(
    level: Level,
    state: State,
    index: int = 0,
    action: Int[np.ndarray, "6"] | None = None,
    caption: Caption | None = None,
    pixels: int = PIXELS,
) -> Image.Image:
    """A picture of one level in a state, for people.

    Args:
        level: the level, or many of them (level axis last).
        state: bodies where they are, one lane for each of the levels; `level.state` for the start.
        index: the lane to draw.
        action: multi-discrete, one entry a binding: shown as pressed keys, flames and arrows; None: not shown.
        caption: words above the world.
        pixels: width of the picture; its height follows.
    """
    return rasterised(scene_of(level, state, index, action, caption), pixels)


def rasterised(scene: Scene, pixels: int = PIXELS) -> Image.Image:
    """A scene as a picture that is `pixels` wide."""
    return picture_of(svg_of([scene], [1.0], pixels))


def picture_of(drawing: str) -> Image.Image:
    """An SVG drawing as a picture of its size, in the letters of all pictures."""
    png = resvg_py.svg_to_bytes(svg_string=drawing, skip_system_fonts=True, font_files=[_letters().name])
    return Image.open(io.BytesIO(png)).convert("RGB")


@cache
def _letters() -> IO[bytes]:
    """The letters as a file, because resvg reads no others; it lasts as long as the process."""
    file = NamedTemporaryFile(suffix=".ttf")  # noqa: SIM115
    file.write(font().font_bytes)
    file.flush()
    return file


def sheet(pictures: Sequence[Image.Image], columns: int) -> Image.Image:
    """Pictures of one size side by side, row after row."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    page = Image.new("RGB", (width * min(columns, len(pictures)), height * rows), PAPER)
    for number, picture in enumerate(pictures):
        page.paste(picture, (width * (number % columns), height * (number // columns)))
    return page


def write_gif(pictures: Iterable[Image.Image], path: Path, seconds: Sequence[float] | float) -> None:
    """A film that repeats; `seconds` a picture is rounded to the format's hundredths.

    One palette serves all pictures, so that flat colours do not flicker from picture to picture.
    """
    frames = list(pictures)
    step = max(1, len(frames) // 8)
    palette = sheet(frames[::step], columns=3).quantize(128, Image.Quantize.MEDIANCUT)
    reduced = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    each = [seconds] * len(frames) if isinstance(seconds, int | float) else seconds
    duration = [10 * round(100 * value) for value in each]
    reduced[0].save(path, "GIF", save_all=True, append_images=reduced[1:], duration=duration, loop=0, optimize=False)


def write_png(picture: Image.Image, path: Path) -> None:
    picture.save(path, "PNG", optimize=True)

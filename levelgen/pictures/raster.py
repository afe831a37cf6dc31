"""Scenes as pixels: anti-aliased pictures for people, contact sheets and films.

They are drawn on the host and need not be fast; `levelgen.task.observe.pixels` draws pixels for agents.
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
    """Draw one level in a state, for people.

    Args:
        level: one level, or many (level axis last).
        state: state of each level's bodies; `level.state` for the start.
        index: the lane to draw.
        action: multi-discrete, one entry per binding: shown as pressed keys, flames and arrows; None: not shown.
        caption: text above the world.
        pixels: width of the picture; its height follows.
    """
    return rasterise(scene_of(level, state, index, action, caption), pixels)


def rasterise(scene: Scene, pixels: int = PIXELS) -> Image.Image:
    """Rasterise a scene to a picture that is `pixels` wide."""
    return picture_of(svg_of([scene], [1.0], pixels))


def picture_of(drawing: str) -> Image.Image:
    """Rasterise an SVG drawing at its own size, with the font of all pictures."""
    png = resvg_py.svg_to_bytes(svg_string=drawing, skip_system_fonts=True, font_files=[_font_file().name])
    return Image.open(io.BytesIO(png)).convert("RGB")


@cache
def _font_file() -> IO[bytes]:
    """Write the font to a temporary file, since resvg reads fonts only from files; it lasts as long as the process."""
    file = NamedTemporaryFile(suffix=".ttf")  # noqa: SIM115
    file.write(font().font_bytes)
    file.flush()
    return file


def sheet(pictures: Sequence[Image.Image], columns: int) -> Image.Image:
    """Arrange pictures of one size in rows of `columns`."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    page = Image.new("RGB", (width * min(columns, len(pictures)), height * rows), PAPER)
    for i, picture in enumerate(pictures):
        page.paste(picture, (width * (i % columns), height * (i // columns)))
    return page


def write_gif(pictures: Iterable[Image.Image], path: Path, seconds: Sequence[float] | float) -> None:
    """Write a looping film; `seconds` per picture are rounded to the format's hundredths.

    All pictures share one palette, so that flat colours do not flicker.
    """
    frames = list(pictures)
    step = max(1, len(frames) // 8)
    palette = sheet(frames[::step], columns=3).quantize(128, Image.Quantize.MEDIANCUT)
    reduced = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    lengths = [seconds] * len(frames) if isinstance(seconds, int | float) else seconds
    duration = [10 * round(100 * value) for value in lengths]
    reduced[0].save(path, "GIF", save_all=True, append_images=reduced[1:], duration=duration, loop=0, optimize=False)


def write_png(picture: Image.Image, path: Path) -> None:
    picture.save(path, "PNG", optimize=True)

"""Scenes as pixels: anti-aliased pictures for people, sheets and films of them.

Pixels for agents are elsewhere: these pictures are drawn on the host and are not meant to be fast.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Int
from PIL import Image, ImageDraw

from levelgen.level import WORLD_SIDE, Level
from levelgen.pictures.scene import scene_of
from levelgen.pictures.shapes import (
    Disc,
    Line,
    Part,
    Point,
    Polygon,
    Rectangle,
    Scene,
    Shape,
    Text,
    font,
    placed,
)
from levelgen.pictures.style import (
    BORDER,
    EDGE,
    HATCH_PITCH,
    HATCH_WIDTH,
    PAPER,
    Colour,
)
from levelgen.pictures.words import Caption
from physics.types import State

SUPERSAMPLING = 4  # drawn this much larger, then averaged
PIXELS = 480  # width of a picture


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
    canvas = _Canvas(scene, pixels)
    for part in scene.parts:
        for shape in part.shapes:
            canvas.draw(shape, part)
    return canvas.finish()


class _Canvas:
    """Drawing in metres, y upwards, on a picture that `finish` shrinks to its size."""

    def __init__(self, scene: Scene, pixels: int) -> None:
        self.scale = SUPERSAMPLING * pixels / (WORLD_SIDE + 2 * BORDER)
        self.top = scene.top
        height = round(pixels * (scene.top + scene.footer) / (WORLD_SIDE + 2 * BORDER))
        self.image = Image.new("RGB", (SUPERSAMPLING * pixels, SUPERSAMPLING * height), PAPER)
        self.pen = ImageDraw.Draw(self.image)

    def finish(self) -> Image.Image:
        width, height = self.image.size
        return self.image.resize((width // SUPERSAMPLING, height // SUPERSAMPLING), Image.Resampling.BOX)

    def draw(self, shape: Shape, part: Part) -> None:
        match shape:
            case Polygon():
                self._polygon(shape, part)
            case Disc():
                self._disc(shape, part)
            case Line(points, colour, width):
                self._line(self._at(points, part), colour, width)
            case Rectangle(low, high, fill, corner):
                (left, bottom), (right, top) = self._at((low, high), part)
                self.pen.rounded_rectangle([left, top, right, bottom], corner * self.scale, fill)
            case Text(position, words, colour, size, ends):
                anchor = "rm" if ends else "lm"
                self.pen.text(self._at((position,), part)[0], words, colour, font(round(size * self.scale)), anchor)

    def _at(self, points: Sequence[Point], part: Part) -> list[Point]:
        """Pixels of a part's points."""
        x, y = placed(points, part).T
        return list(zip(((x + BORDER) * self.scale).tolist(), ((self.top - y) * self.scale).tolist(), strict=True))

    def _line(self, points: Sequence[Point], colour: Colour, width: float) -> None:
        self.pen.line(points, colour, max(1, round(width * self.scale)), joint="curve")

    def _polygon(self, shape: Polygon, part: Part) -> None:
        corners = self._at(shape.points, part)
        self.pen.polygon(corners, shape.fill)
        if shape.edge is None:
            return
        if shape.hatched:
            self._hatch(lambda pen: pen.polygon(corners, 255), shape.edge)
        self._line([*corners, *corners[:2]], shape.edge, shape.width)

    def _disc(self, shape: Disc, part: Part) -> None:
        (x, y), r = self._at((shape.centre,), part)[0], shape.radius * self.scale
        box = [(x - r, y - r), (x + r, y + r)]
        self.pen.ellipse(box, shape.fill)
        if shape.hatched:
            self._hatch(lambda pen: pen.ellipse(box, 255), shape.edge)
        self.pen.ellipse(box, None, shape.edge, max(1, round(EDGE * self.scale)))

    def _hatch(self, shape: Callable[[ImageDraw.ImageDraw], None], colour: Colour) -> None:
        mask = Image.new("L", self.image.size)
        shape(ImageDraw.Draw(mask))
        box = mask.getbbox()
        if box:
            lines = _hatching(self.image.size, HATCH_PITCH * self.scale, max(1, round(HATCH_WIDTH * self.scale)))
            mask = Image.composite(mask.crop(box), Image.new("L", mask.crop(box).size), lines.crop(box))
            self.image.paste(colour, box, mask)


@cache
def _hatching(size: tuple[int, int], pitch: float, width: int) -> Image.Image:
    """Diagonal lines all over a picture, as a mask: where x + y is a multiple of the pitch."""
    lines = Image.new("L", size)
    pen = ImageDraw.Draw(lines)
    for number in range(int((size[0] + size[1]) / pitch) + 1):
        pen.line([(number * pitch - size[1], size[1]), (number * pitch, 0)], 255, width)
    return lines


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

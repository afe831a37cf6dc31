"""Pictures for people: one lane of a level and its state as an anti-aliased image, and films of them.

Bodies are filled by role (grey plain, green, blue, red); bodies that cannot move are darker and hatched. A ring is
a revolute joint, a crossed square a fixed one. A motor's ring has the colour of its binding and an arrow while it
runs, a thruster is a nozzle with a flame while it fires; the row below shows the live entries of the action,
M1 to M4 for motors and T1, T2 for thrusters.
Pixels for agents are elsewhere: these pictures are drawn on the host and are not meant to be fast.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Int
from PIL import Image, ImageDraw, ImageFont

from levelgen.level import MOTOR_BINDINGS, WORLD_SIDE, Level, Role
from physics.types import FIXED_POLYGONS, State

Colour = tuple[int, int, int]
Point = tuple[float, float]
Host = np.ndarray | jax.Array  # levels and states that were read or computed
Place = Point | Sequence[float] | Host  # one point, m
Points = Sequence[Place] | Host

SUPERSAMPLING = 4  # drawn this much larger, then averaged
BORDER = 0.08  # m of the walls and the ceiling that shows
HEADER, FOOTER = 0.36, 0.30  # m of picture above and below the world
PIXELS = 480  # width of a picture

SKY: Colour = (247, 247, 243)
GRID: Colour = (234, 235, 230)
INK: Colour = (38, 44, 52)
PAPER: Colour = (255, 255, 255)
MUTED: Colour = (128, 135, 144)
FIXED_PLAIN: Colour = (98, 105, 115)
ROLE_COLOUR: dict[Role, Colour] = {
    Role.PLAIN: (168, 175, 184),
    Role.GREEN: (62, 176, 92),
    Role.BLUE: (58, 124, 220),
    Role.RED: (224, 78, 66),
}
BINDING_COLOUR: tuple[Colour, ...] = (  # of the action's entries: four motors, two thrusters
    (245, 184, 22),
    (206, 66, 196),
    (26, 184, 186),
    (245, 124, 40),
    (126, 87, 226),
    (240, 96, 140),
)
FLAMES: tuple[tuple[float, Colour], ...] = ((1.0, (245, 124, 40)), (0.6, (255, 214, 92)))  # length, colour


@dataclass(frozen=True)
class Caption:
    """The words above the world."""

    title: str = ""  # left
    clock: str = ""  # right
    outcome: str = ""  # a badge in the middle
    good: bool = True  # colour of the badge


def draw(
    level: Level,
    state: State,
    index: int = 0,
    action: Int[np.ndarray, "6"] | None = None,
    caption: Caption | None = None,
    pixels: int = PIXELS,
) -> Image.Image:
    """Lane `index` of a level in a state, under an action (one multi-discrete entry a binding; None: none shown)."""
    level, state = jax.tree.map(lambda x: _lane(x, index), (level, state))
    canvas = _Canvas(pixels, FOOTER if action is not None else 0.0)
    _draw_room(canvas)
    order = np.argsort(np.asarray(level.model.inverse_mass) != 0, kind="stable")  # what cannot move lies behind
    for body in order:
        if level.model.active[body]:
            _draw_body(canvas, level, state, int(body))
    for thruster in np.flatnonzero(level.model.thruster_active):
        _draw_thruster(canvas, level, state, int(thruster), action)
    for joint in np.flatnonzero(level.model.joint_active):
        _draw_joint(canvas, level, state, int(joint), action)
    _draw_caption(canvas, caption or Caption())
    if action is not None:
        _draw_action(canvas, level, action)
    return canvas.finish()


def _lane(values: Host, index: int) -> np.ndarray:
    values = np.asarray(values)
    return values[..., index if values.shape[-1] > 1 else 0]


class _Canvas:
    """Drawing in metres, y upwards, on a picture that `finish` shrinks to its size."""

    def __init__(self, pixels: int, footer: float) -> None:
        self.footer, self.pixels = footer, pixels
        self.scale = SUPERSAMPLING * pixels / (WORLD_SIDE + 2 * BORDER)
        self.top = WORLD_SIDE + BORDER + HEADER
        height = round(pixels * (self.top + footer) / (WORLD_SIDE + 2 * BORDER))
        self.image = Image.new("RGB", (SUPERSAMPLING * pixels, SUPERSAMPLING * height), PAPER)
        self.pen = ImageDraw.Draw(self.image)

    def finish(self) -> Image.Image:
        width, height = self.image.size
        return self.image.resize((width // SUPERSAMPLING, height // SUPERSAMPLING), Image.Resampling.BOX)

    def at(self, point: Place) -> Point:
        return ((float(point[0]) + BORDER) * self.scale, (self.top - float(point[1])) * self.scale)

    def box(self, centre: Place, radius: float) -> list[Point]:
        x, y = self.at(centre)
        r = radius * self.scale
        return [(x - r, y - r), (x + r, y + r)]

    def rectangle(self, low: Point, high: Point, fill: Colour) -> None:
        (left, bottom), (right, top) = self.at(low), self.at(high)
        self.pen.rectangle([left, top, right, bottom], fill)

    def line(self, points: Points, colour: Colour, width: float) -> None:
        pixels = max(1, round(width * self.scale))
        self.pen.line([self.at(point) for point in points], colour, pixels, joint="curve")

    def polygon(self, points: Points, fill: Colour, edge: Colour, hatched: bool) -> None:
        corners = [self.at(point) for point in points]
        self.pen.polygon(corners, fill)
        if hatched:
            self._hatch(lambda pen: pen.polygon(corners, 255), edge)
        self.line([*points, points[0], points[1]], edge, 0.022)

    def disc(self, centre: Place, radius: float, fill: Colour, edge: Colour, hatched: bool = False) -> None:
        box = self.box(centre, radius)
        self.pen.ellipse(box, fill)
        if hatched:
            self._hatch(lambda pen: pen.ellipse(box, 255), edge)
        self.pen.ellipse(box, None, edge, max(1, round(0.022 * self.scale)))

    def _hatch(self, shape: Callable[[ImageDraw.ImageDraw], None], colour: Colour) -> None:
        mask = Image.new("L", self.image.size)
        shape(ImageDraw.Draw(mask))
        box = mask.getbbox()
        if box:
            lines = _hatching(self.image.size, round(0.1 * self.scale), max(1, round(0.018 * self.scale)))
            mask = Image.composite(mask.crop(box), Image.new("L", mask.crop(box).size), lines.crop(box))
            self.image.paste(colour, box, mask)

    def text(self, point: Point, words: str, colour: Colour, anchor: str, height: float) -> None:
        self.pen.text(self.at(point), words, colour, _font(round(height * self.scale)), anchor)

    def text_width(self, words: str, height: float) -> float:
        return self.pen.textlength(words, _font(round(height * self.scale))) / self.scale


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


@cache
def _hatching(size: tuple[int, int], pitch: int, width: int) -> Image.Image:
    """Diagonal lines all over a picture, as a mask."""
    lines = Image.new("L", size)
    pen = ImageDraw.Draw(lines)
    for start in range(-size[1], size[0], pitch):
        pen.line([(start, size[1]), (start + size[1], 0)], 255, width)
    return lines


def _shade(colour: Colour, factor: float) -> Colour:
    red, green, blue = (round(part * factor) for part in colour)
    return red, green, blue


def _turn(vector: Host, angle: float) -> np.ndarray:
    """Rotate vectors (..., 2) by an angle in radians."""
    vector, cos, sin = np.asarray(vector), np.cos(angle), np.sin(angle)
    return np.stack([vector[..., 0] * cos - vector[..., 1] * sin, vector[..., 0] * sin + vector[..., 1] * cos], -1)


def _draw_room(canvas: _Canvas) -> None:
    """Walls, then the air with a grid of metres."""
    canvas.rectangle((-BORDER, 0), (WORLD_SIDE + BORDER, WORLD_SIDE + BORDER), FIXED_PLAIN)
    canvas.rectangle((0, 0), (WORLD_SIDE, WORLD_SIDE), SKY)
    for metre in range(1, int(WORLD_SIDE)):
        canvas.line([(metre, 0), (metre, WORLD_SIDE)], GRID, 0.01)
        canvas.line([(0, metre), (WORLD_SIDE, metre)], GRID, 0.01)


def _body_colours(level: Level, body: int) -> tuple[Colour, Colour, bool]:
    """Fill, edge, and whether it is hatched because it cannot move."""
    role, fixed = Role(int(level.role[body])), level.model.inverse_mass[body] == 0
    fill = ROLE_COLOUR[role]
    if fixed:
        fill = FIXED_PLAIN if role == Role.PLAIN else _shade(fill, 0.72)
    return fill, _shade(fill, 0.62), bool(fixed)


def _draw_body(canvas: _Canvas, level: Level, state: State, body: int) -> None:
    fill, edge, fixed = _body_colours(level, body)
    centre, angle, polygons = state.position[body], float(state.rotation[body]), level.size.polygons
    if body >= polygons:
        radius = float(level.model.radius[body - polygons])
        canvas.disc(centre, radius, fill, edge, fixed)
        canvas.line([centre, centre + _turn(np.array([radius, 0.0]), angle)], edge, 0.022)
        return
    corners = level.model.vertices[body][: level.model.n_vertices[body]]
    points = np.clip(centre + _turn(corners, angle), -BORDER, None if body >= FIXED_POLYGONS else WORLD_SIDE + BORDER)
    points[:, 1] = np.maximum(points[:, 1], 0.0)
    canvas.polygon(points, fill, edge, fixed)


def _attachment(state: State, body: int, anchor: Host) -> np.ndarray:
    """A point of a body's frame in the world."""
    return np.asarray(state.position[body]) + _turn(anchor, float(state.rotation[body]))


def _motor_turn(level: Level, joint: int, action: np.ndarray | None) -> int:
    """1: the motor turns body b counterclockwise against body a, -1: clockwise, 0: it is off."""
    if action is None or not level.model.motor_on[joint] or level.model.joint_fixed[joint]:
        return 0
    choice = 1 if level.motor_auto[joint] else int(action[level.motor_binding[joint]])
    return (0, 1, -1)[choice]


def _draw_joint(canvas: _Canvas, level: Level, state: State, joint: int, action: np.ndarray | None) -> None:
    model = level.model
    centre = _attachment(state, int(model.joint_a[joint]), model.joint_anchor_a[joint])
    if model.joint_fixed[joint]:
        half = 0.065
        corners = centre + half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        canvas.polygon(corners, PAPER, INK, False)
        canvas.line([corners[0], corners[2]], INK, 0.022)
        canvas.line([corners[1], corners[3]], INK, 0.022)
        return
    motor = bool(model.motor_on[joint])
    colour = BINDING_COLOUR[int(level.motor_binding[joint])] if motor else PAPER
    canvas.disc(centre, 0.085 if motor else 0.07, colour, INK)
    canvas.disc(centre, 0.025, INK if level.motor_auto[joint] and motor else PAPER, INK)
    if turn := _motor_turn(level, joint, action):
        _draw_turn(canvas, centre, turn, colour)


def _draw_turn(canvas: _Canvas, centre: np.ndarray, turn: int, colour: Colour) -> None:
    """Three quarters of a circle around a joint, with an arrow head at its end."""
    radius, angles = 0.17, np.linspace(0.25 * np.pi, 1.75 * np.pi, 25)
    arc = centre + radius * np.stack([np.cos(angles), np.sin(angles)], -1)[::turn]
    along = turn * _turn((arc[-1] - centre) / radius, np.pi / 2)
    outward = (arc[-1] - centre) / radius
    head = [arc[-1] + 0.12 * along, arc[-1] + 0.07 * outward, arc[-1] - 0.07 * outward]
    for ink, extra in ((INK, 0.022), (colour, 0.0)):
        canvas.line(arc, ink, 0.035 + extra)
    canvas.pen.polygon([canvas.at(point) for point in head], colour)
    canvas.line([*head, head[0], head[1]], INK, 0.014)


def _draw_thruster(canvas: _Canvas, level: Level, state: State, thruster: int, action: np.ndarray | None) -> None:
    """The nozzle opens against the force on the body, which is along the thruster's rotation."""
    model, binding = level.model, MOTOR_BINDINGS + int(level.thruster_binding[thruster])
    body = int(model.thruster_body[thruster])
    place = _attachment(state, body, model.thruster_position[thruster])
    angle = float(model.thruster_rotation[thruster] + state.rotation[body])

    def points(shape: Sequence[Point]) -> np.ndarray:
        return place + _turn(np.array(shape), angle)

    if action is not None and action[binding]:
        for length, colour in FLAMES:
            half = 0.075 * (0.5 + length / 2)
            flame = points([(-0.1, half), (-0.1 - 0.16 * length, half * 0.8), (-0.1 - 0.34 * length, 0)])
            mirrored = points([(-0.1 - 0.16 * length, -half * 0.8), (-0.1, -half)])
            canvas.pen.polygon([canvas.at(point) for point in [*flame, *mirrored]], colour)
    canvas.polygon(
        points([(0.06, 0.045), (0.06, -0.045), (-0.12, -0.1), (-0.12, 0.1)]), BINDING_COLOUR[binding], INK, False
    )


def _draw_caption(canvas: _Canvas, caption: Caption) -> None:
    middle, height = WORLD_SIDE + BORDER + HEADER / 2, 0.155
    canvas.text((0.04, middle), caption.title, INK, "lm", height)
    canvas.text((WORLD_SIDE - 0.04, middle), caption.clock, MUTED, "rm", height)
    if caption.outcome:
        left = 0.04 + canvas.text_width(caption.title, height) + 0.2
        width = canvas.text_width(caption.outcome, height)
        colour = ROLE_COLOUR[Role.GREEN] if caption.good else ROLE_COLOUR[Role.RED]
        box = [*canvas.at((left - 0.09, middle + 0.12)), *canvas.at((left + width + 0.09, middle - 0.12))]
        canvas.pen.rounded_rectangle(box, 0.1 * canvas.scale, colour)
        canvas.text((left, middle), caption.outcome, PAPER, "lm", height)


def live_entries(level: Level) -> list[int]:
    """Action entries of ONE level (no lane axis) that some motor or thruster obeys."""
    model = level.model
    motor = model.joint_active & ~model.joint_fixed & model.motor_on & ~level.motor_auto
    motors = {int(binding) for binding in level.motor_binding[motor]}
    thrusters = {MOTOR_BINDINGS + int(binding) for binding in level.thruster_binding[model.thruster_active]}
    return sorted(motors | thrusters)


def _draw_action(canvas: _Canvas, level: Level, action: np.ndarray) -> None:
    """A key for each live entry, lit in its binding's colour while it is used."""
    middle, left, height = -FOOTER / 2, 0.04, 0.14
    for entry in live_entries(level):
        is_motor = entry < MOTOR_BINDINGS
        name = f"M{entry + 1}" if is_motor else f"T{entry - MOTOR_BINDINGS + 1}"
        state = ("off", "forward" if is_motor else "on", "back")[int(action[entry])]
        lit = int(action[entry]) != 0
        canvas.disc((left + 0.07, middle), 0.07, BINDING_COLOUR[entry] if lit else PAPER, BINDING_COLOUR[entry])
        canvas.text((left + 0.2, middle), f"{name} {state}", INK if lit else MUTED, "lm", height)
        left += 0.2 + canvas.text_width(f"{name} forward", height) + 0.06


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

"""What a picture for people shows: one lane of a level and its state as shapes, described once for every renderer.

Bodies are filled by role (grey plain, green, blue, red); bodies that cannot move are darker and hatched. A ring is
a revolute joint, a crossed square a fixed one. A motor's ring has the colour of its binding and an arrow while it
runs, a thruster is a nozzle with a flame while it fires; the row below shows the live entries of the action,
M1 to M4 for motors and T1, T2 for thrusters.

`raster.py` makes pixels of a scene and `svg.py` makes vectors. All scenes of a level have the same parts in the same
order, so a film is what its parts do. Lengths are metres, y is upwards, angles are radians.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import jax
import numpy as np
from jaxtyping import Int
from PIL import ImageFont

from levelgen.level import MOTOR_BINDINGS, WORLD_SIDE, Level, Role
from physics.types import State

Colour = tuple[int, int, int]
Point = tuple[float, float]
Points = tuple[Point, ...]
Host = np.ndarray | jax.Array  # levels and states that were read or computed

BORDER = 0.08  # m of the walls and the ceiling that shows
HEADER, FOOTER = 0.36, 0.30  # m of picture above and below the world
EDGE = 0.022  # m, width of the line around a shape
HATCH_PITCH, HATCH_WIDTH = 0.1, 0.018  # m; measured along x

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
NOZZLE: Points = ((0.06, 0.045), (0.06, -0.045), (-0.12, -0.1), (-0.12, 0.1))
CAPTION_SIZE, KEY_SIZE = 0.155, 0.14  # m, of letters
ELLIPSIS = "…"


@dataclass(frozen=True)
class Polygon:
    """A filled polygon, with a line around it if it has an edge."""

    points: Points
    fill: Colour
    edge: Colour | None = None
    width: float = EDGE
    hatched: bool = False  # in the colour of its edge


@dataclass(frozen=True)
class Disc:
    """A filled circle; its edge lies within the radius."""

    centre: Point
    radius: float
    fill: Colour
    edge: Colour
    hatched: bool = False


@dataclass(frozen=True)
class Line:
    """Straight from point to point."""

    points: Points
    colour: Colour
    width: float


@dataclass(frozen=True)
class Rectangle:
    """An upright rectangle without an edge."""

    low: Point
    high: Point
    fill: Colour
    corner: float = 0.0  # radius of its corners


@dataclass(frozen=True)
class Text:
    """Words that begin or end at a position, half of their height above it."""

    position: Point
    words: str
    colour: Colour
    size: float
    ends: bool = False  # at the position; otherwise they begin there


Shape = Polygon | Disc | Line | Rectangle | Text


@dataclass(frozen=True)
class Part:
    """Shapes that move together, in a frame of their own. No shapes: the part does not show now."""

    shapes: tuple[Shape, ...]
    position: Point = (0.0, 0.0)
    angle: float = 0.0  # of parts without rectangles and words


@dataclass(frozen=True)
class Scene:
    """What is drawn, the last part on top."""

    parts: tuple[Part, ...]
    title: str
    footer: float  # m of picture below the world

    @property
    def top(self) -> float:
        """Height of the picture's upper edge above the world's lower one, m."""
        return WORLD_SIDE + BORDER + HEADER


@dataclass(frozen=True)
class Caption:
    """The words above the world."""

    title: str = ""  # left; shortened to what there is room for
    clock: str = ""  # right
    outcome: str = ""  # a badge in the middle
    good: bool = True  # colour of the badge


def scene_of(
    level: Level,
    state: State,
    index: int = 0,
    action: Int[np.ndarray, "6"] | None = None,
    caption: Caption | None = None,
) -> Scene:
    """Lane `index` of a level in a state, under an action (one multi-discrete entry a binding; None: none shown)."""
    level, state = jax.tree.map(lambda x: _lane(x, index), (level, state))
    order = np.argsort(np.asarray(level.model.inverse_mass) != 0, kind="stable")  # what cannot move lies behind
    parts = [Part(_room())]
    parts += [_body(level, state, int(body)) for body in order if level.model.active[body]]
    for thruster in np.flatnonzero(level.model.thruster_active):
        parts += _thruster(level, state, int(thruster), action)
    for joint in np.flatnonzero(level.model.joint_active):
        parts += _joint(level, state, int(joint), action)
    footer = FOOTER if action is not None else 0.0
    parts += [Part(_paper(footer)), *_caption(caption or Caption())]
    if action is not None:
        parts += _keys(level, action)
    return Scene(tuple(parts), _printable(caption.title) if caption else "", footer)


def turned(points: Sequence[Point] | Host, angle: float) -> np.ndarray:
    """Points (..., 2) turned about the origin by an angle in radians."""
    points, cos, sin = np.asarray(points), np.cos(angle), np.sin(angle)
    return np.stack([points[..., 0] * cos - points[..., 1] * sin, points[..., 0] * sin + points[..., 1] * cos], -1)


def placed(points: Sequence[Point], part: Part) -> np.ndarray:
    """Points (point, 2) of a part's frame, in the world."""
    return turned(points, part.angle) + np.asarray(part.position)


def live_entries(level: Level) -> list[int]:
    """Action entries of ONE level (no lane axis) that some motor or thruster obeys."""
    model = level.model
    motor = model.joint_active & ~model.joint_fixed & model.motor_on & ~level.motor_auto
    motors = {int(binding) for binding in level.motor_binding[motor]}
    thrusters = {MOTOR_BINDINGS + int(binding) for binding in level.thruster_binding[model.thruster_active]}
    return sorted(motors | thrusters)


@cache
def font(pixels: int) -> ImageFont.FreeTypeFont:
    """The letters of all pictures."""
    letters = ImageFont.load_default(pixels)
    assert isinstance(letters, ImageFont.FreeTypeFont)  # Pillow's own is one
    return letters


def text_width(words: str, size: float) -> float:
    """Of words in letters of a size, m."""
    return font(100).getlength(words) * size / 100


def text_drop(size: float) -> float:
    """How far the middle of letters of a size is above the line that they stand on, m."""
    ascent, descent = font(100).getmetrics()
    return (ascent - descent) / 2 * size / 100


def _lane(values: Host, index: int) -> np.ndarray:
    values = np.asarray(values)
    return values[..., index if values.shape[-1] > 1 else 0]


def _points(values: Sequence[Point] | Host) -> Points:
    return tuple((float(x), float(y)) for x, y in np.asarray(values))


def _point(values: Host) -> Point:
    return float(values[0]), float(values[1])


def _shade(colour: Colour, factor: float) -> Colour:
    red, green, blue = (round(part * factor) for part in colour)
    return red, green, blue


def _room() -> tuple[Shape, ...]:
    """Walls, then the air with a grid of metres."""
    side = WORLD_SIDE
    shapes: list[Shape] = [
        Rectangle((-BORDER, 0), (side + BORDER, side + BORDER), FIXED_PLAIN),
        Rectangle((0, 0), (side, side), SKY),
    ]
    for metre in range(1, int(side)):
        shapes += [Line(((metre, 0), (metre, side)), GRID, 0.01), Line(((0, metre), (side, metre)), GRID, 0.01)]
    return tuple(shapes)


def _paper(footer: float) -> tuple[Shape, ...]:
    """What hides all that leaves the world upwards or downwards."""
    top, right = WORLD_SIDE + BORDER, WORLD_SIDE + BORDER
    above = Rectangle((-BORDER, top), (right, top + HEADER), PAPER)
    return (above, Rectangle((-BORDER, -footer), (right, 0), PAPER)) if footer else (above,)


def _body_colours(level: Level, body: int) -> tuple[Colour, Colour, bool]:
    """Fill, edge, and whether it is hatched because it cannot move."""
    role, fixed = Role(int(level.role[body])), level.model.inverse_mass[body] == 0
    fill = ROLE_COLOUR[role]
    if fixed:
        fill = FIXED_PLAIN if role == Role.PLAIN else _shade(fill, 0.72)
    return fill, _shade(fill, 0.62), bool(fixed)


def _body(level: Level, state: State, body: int) -> Part:
    fill, edge, fixed = _body_colours(level, body)
    circle = body - level.size.polygons
    if circle >= 0:
        radius = float(level.model.radius[circle])
        shapes = (Disc((0.0, 0.0), radius, fill, edge, fixed), Line(((0.0, 0.0), (radius, 0.0)), edge, EDGE))
    else:
        corners = level.model.vertices[body][: level.model.n_vertices[body]]
        shapes = (Polygon(_points(corners), fill, edge, hatched=fixed),)
    return Part(shapes, _point(state.position[body]), float(state.rotation[body]))


def _attachment(state: State, body: int, anchor: Host) -> Point:
    """A point of a body's frame in the world."""
    return _point(np.asarray(state.position[body]) + turned(anchor, float(state.rotation[body])))


def _motor_turn(level: Level, joint: int, action: np.ndarray | None) -> int:
    """1: the motor turns body b counterclockwise against body a, -1: clockwise, 0: it is off."""
    if action is None or not level.model.motor_on[joint] or level.model.joint_fixed[joint]:
        return 0
    choice = 1 if level.motor_auto[joint] else int(action[level.motor_binding[joint]])
    return (0, 1, -1)[choice]


def _joint(level: Level, state: State, joint: int, action: np.ndarray | None) -> list[Part]:
    """The joint, and the arrow of its motor."""
    model = level.model
    position = _attachment(state, int(model.joint_a[joint]), model.joint_anchor_a[joint])
    if model.joint_fixed[joint]:
        a, b, c, d = corners = _points(0.065 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]))
        return [Part((Polygon(corners, PAPER, INK), Line((a, c), INK, EDGE), Line((b, d), INK, EDGE)), position)]
    motor = bool(model.motor_on[joint])
    colour = BINDING_COLOUR[int(level.motor_binding[joint])] if motor else PAPER
    ring = Disc((0.0, 0.0), 0.085 if motor else 0.07, colour, INK)
    axle = Disc((0.0, 0.0), 0.025, INK if level.motor_auto[joint] and motor else PAPER, INK)
    return [Part((ring, axle), position), Part(_arrow(_motor_turn(level, joint, action), colour), position)]


def _arrow(turn: int, colour: Colour) -> tuple[Shape, ...]:
    """Three quarters of a circle around a joint, with an arrow head at its end."""
    if not turn:
        return ()
    radius, angles = 0.17, np.linspace(0.25 * np.pi, 1.75 * np.pi, 25)
    arc = radius * np.stack([np.cos(angles), np.sin(angles)], -1)[::turn]
    outward = arc[-1] / radius
    along = turn * turned(outward, np.pi / 2)
    head = _points([arc[-1] + 0.12 * along, arc[-1] + 0.07 * outward, arc[-1] - 0.07 * outward])
    around, inner = Line(_points(arc), INK, 0.035 + EDGE), Line(_points(arc), colour, 0.035)
    return around, inner, Polygon(head, colour, INK, 0.014)


def _thruster(level: Level, state: State, thruster: int, action: np.ndarray | None) -> list[Part]:
    """The flame and the nozzle, which opens against the force on the body: that is along the thruster's rotation."""
    model, binding = level.model, MOTOR_BINDINGS + int(level.thruster_binding[thruster])
    body = int(model.thruster_body[thruster])
    position = _attachment(state, body, model.thruster_position[thruster])
    angle = float(model.thruster_rotation[thruster] + state.rotation[body])
    flame = _flame() if action is not None and action[binding] else ()
    return [Part(flame, position, angle), Part((Polygon(NOZZLE, BINDING_COLOUR[binding], INK),), position, angle)]


@cache
def _flame() -> tuple[Shape, ...]:
    def tongue(length: float, colour: Colour) -> Polygon:
        half = 0.075 * (0.5 + length / 2)
        waist, tip = -0.1 - 0.16 * length, -0.1 - 0.34 * length
        return Polygon(((-0.1, half), (waist, half * 0.8), (tip, 0.0), (waist, -half * 0.8), (-0.1, -half)), colour)

    return tuple(tongue(*flame) for flame in FLAMES)


def _caption(caption: Caption) -> list[Part]:
    """Title, badge and clock, each a part."""
    middle, left, right, size = WORLD_SIDE + BORDER + HEADER / 2, 0.04, WORLD_SIDE - 0.04, CAPTION_SIZE
    title, clock, outcome = (_printable(words) for words in (caption.title, caption.clock, caption.outcome))
    badge = text_width(outcome, size) + 0.3 if outcome else 0.0
    title = _fitted(title, right - left - badge - text_width(clock, size) - 0.1, size)
    shapes: tuple[Shape, ...] = ()
    if outcome:
        start = left + (text_width(title, size) + 0.2 if title else 0.09)
        end = start + text_width(outcome, size)
        colour = ROLE_COLOUR[Role.GREEN] if caption.good else ROLE_COLOUR[Role.RED]
        box = Rectangle((start - 0.09, middle - 0.12), (end + 0.09, middle + 0.12), colour, corner=0.1)
        shapes = (box, Text((start, middle), outcome, PAPER, size))
    of = lambda words, *rest: (Text(*rest),) if words else ()
    return [
        Part(of(title, (left, middle), title, INK, size)),
        Part(of(clock, (right, middle), clock, MUTED, size, True)),
        Part(shapes),
    ]


def _printable(words: str) -> str:
    """Names of files may hold anything."""
    return "".join(letter if letter.isprintable() else "?" for letter in words)


def _fitted(words: str, room: float, size: float) -> str:
    """As much of the words' beginning as there is room for, m."""
    if text_width(words, size) <= room:
        return words
    while words and text_width(words + ELLIPSIS, size) > room:
        words = words[:-1]
    return words.rstrip() + ELLIPSIS


def _keys(level: Level, action: np.ndarray) -> list[Part]:
    """A key for each live entry, lit in its binding's colour while it is used."""
    middle, left, parts = -FOOTER / 2, 0.04, []
    for entry in live_entries(level):
        is_motor = entry < MOTOR_BINDINGS
        name = f"M{entry + 1}" if is_motor else f"T{entry - MOTOR_BINDINGS + 1}"
        state = ("off", "forward" if is_motor else "on", "back")[int(action[entry])]
        lit, colour = int(action[entry]) != 0, BINDING_COLOUR[entry]
        key = Disc((left + 0.07, middle), 0.07, colour if lit else PAPER, colour)
        parts.append(Part((key, Text((left + 0.2, middle), f"{name} {state}", INK if lit else MUTED, KEY_SIZE))))
        left += 0.2 + text_width(f"{name} forward", KEY_SIZE) + 0.06
    return parts

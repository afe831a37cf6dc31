"""125x125 pixels for agents, drawn from the state of ONE environment (map with `jax.vmap`).

A picture is a stack of shapes, the last one on top. All are convex, so a shape covers one interval of every column:
its ends are computed once per column, and each pixel only compares its height with them.
Facts: `kinetix.render.renderer_pixels` 3.0.2 at its downscale of 4. Thrusters are drawn differently, in its colours.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from levelproof.levelgen.level import WORLD_SIDE, Level, Role
from levelproof.levelgen.task.observe.flat import GRAVITY_UNIT
from levelproof.physics.types import FIXED_POLYGONS, State

PIXELS_PER_METRE = 25
SIDE = int(WORLD_SIDE * PIXELS_PER_METRE)  # pixels
PATCH = 2 * PIXELS_PER_METRE  # side of the square around a body's centre; the body is drawn only inside it
BORDER = 2 * PIXELS_PER_METRE  # invisible margin; patches are shifted to lie within it
THRUSTER_SIDE = 4.0  # pixels
BITS = 9  # per channel of a packed colour

RGB = tuple[float, float, float]
BACKGROUND: RGB = (255, 255, 255)
FIXED: RGB = (80, 80, 80)
SPOKE: RGB = (0, 0, 0)  # from a circle's centre to its rim
ROLE_COLOUR: dict[Role, RGB] = {
    Role.PLAIN: (160, 160, 160),
    Role.GREEN: (0, 204, 0),
    Role.BLUE: (0, 102, 204),
    Role.RED: (255, 102, 102),
}
FIXED_SHADE = 0.5  # times the role's colour, for bodies that cannot move
NO_MOTOR: RGB = (255, 255, 255)
BINDING_COLOUR: tuple[RGB, ...] = ((255, 255, 0), (255, 0, 255), (0, 255, 255), (255, 153, 51))
# Rectangles of a thruster: (from, to) along its axis and across it, in sides from its middle; brightness; whether it
# has the binding's colour
THRUSTER = (
    ((-0.5, -0.2), (-0.12, 0.12), 0.6, True),
    ((-0.2, 0.06), (-0.34, 0.34), 0.8, True),
    ((0.06, 0.5), (-0.4, 0.4), 0.3, False),
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PixelsObservation:
    """The pixel observation."""

    image: Float[Array, "x y 3"]  # y upwards; red, green, blue from 0 to 1
    global_info: Float[Array, "1"]  # gravity / 10


class Coverage(NamedTuple):
    """The interval that a shape covers in each column, in pixels, and its colour."""

    low: Float[Array, " x"]
    high: Float[Array, " x"]
    colour: Int[Array, ""]  # as `_packed` makes it


def pixels(level: Level, state: State) -> PixelsObservation:
    """Draw a state; neither level nor state has a lane axis."""
    height = jnp.arange(SIDE, dtype=jnp.float32)
    # The barriers make XLA store intervals and image, which it would recompute for every pixel and colour.
    low, high, colour = jax.lax.optimization_barrier(jax.tree.map(lambda *x: jnp.stack(x), *_shapes(level, state)))
    image = jnp.full((SIDE, SIDE), _packed(np.array(BACKGROUND)))
    for shape in range(len(low)):
        covered = (low[shape][:, None] <= height) & (height <= high[shape][:, None])
        image = jnp.where(covered, colour[shape], image)
    image = jax.lax.optimization_barrier(image)
    parts = jnp.stack([image >> 2 * BITS, image >> BITS, image], axis=-1) & (2**BITS - 1)
    return PixelsObservation(parts / jnp.float32(2 * 255), level.model.gravity[1:] / GRAVITY_UNIT)


def _shapes(level: Level, state: State) -> list[Coverage]:
    """Return all shapes, from the floor (bottom) to the thrusters (top)."""
    model, size = level.model, level.size
    centre = state.position * PIXELS_PER_METRE
    colours = _role_colour(level.role, model.inverse_mass == 0)
    floor = centre[0] + model.vertices[0] * PIXELS_PER_METRE  # the floor's rotation is not drawn
    floor_colour = _role_colour(level.role[0], jnp.array(True))
    shapes = [Coverage(*_polygon(floor), floor_colour)]
    for body in range(FIXED_POLYGONS, size.polygons):
        corners = centre[body] + _turn(model.vertices[body] * PIXELS_PER_METRE, state.rotation[body])
        interval = _meet(_polygon(corners), _patch(centre[body]))
        shapes.append(_if(model.active[body], Coverage(*interval, colours[body])))
    for circle in range(size.circles):
        body = size.polygons + circle
        disc = _meet(_disc(centre[body], model.radius[circle] * PIXELS_PER_METRE), _patch(centre[body]))
        spoke = _meet(disc, _spoke(centre[body], state.rotation[body]))
        shapes.append(_if(model.active[body], Coverage(*disc, colours[body])))
        shapes.append(_if(model.active[body], Coverage(*spoke, _packed(np.array(SPOKE)))))
    binding_colours = jnp.array(BINDING_COLOUR)
    for joint in range(size.joints):
        shapes.append(_joint(level, state, joint, binding_colours))
    for thruster in range(size.thrusters):
        shapes += _thruster(level, state, thruster, binding_colours)
    return shapes


def _joint(level: Level, state: State, joint: int, colours: Float[Array, "binding 3"]) -> Coverage:
    """Return a joint's single pixel."""
    model, body = level.model, level.model.joint_a[joint]
    driven = model.motor_on[joint] & ~model.joint_fixed[joint]
    colour = jnp.where(driven, colours[level.motor_binding[joint]], jnp.array(NO_MOTOR))
    x, y = jnp.round(_on_body(state, body, model.joint_anchor_a[joint]))
    column = jnp.arange(SIDE) == x
    return _if(
        model.joint_active[joint],
        Coverage(jnp.where(column, y, jnp.inf), jnp.where(column, y, -jnp.inf), _packed(colour)),
    )


def _thruster(level: Level, state: State, thruster: int, colours: Float[Array, "binding 3"]) -> list[Coverage]:
    """Return the three rectangles along a thruster's axis."""
    model, body = level.model, level.model.thruster_body[thruster]
    centre = jnp.round(_on_body(state, body, model.thruster_position[thruster]))
    angle = model.thruster_rotation[thruster] + state.rotation[body]
    tint = colours[level.thruster_binding[thruster]]
    shapes = []
    for along, across, brightness, tinted in THRUSTER:
        # Clockwise, as polygons are
        corners = np.array([(along[0], across[0]), (along[0], across[1]), (along[1], across[1]), (along[1], across[0])])
        interval = _polygon(centre + _turn(jnp.asarray(corners * THRUSTER_SIDE, jnp.float32), angle))
        colour = brightness * (tint if tinted else jnp.array(BACKGROUND))
        shapes.append(_if(model.thruster_active[thruster], Coverage(*interval, _packed(colour))))
    return shapes


Interval = tuple[Float[Array, " x"], Float[Array, " x"]]


def _polygon(corners: Float[Array, "corner 2"]) -> Interval:
    """Return the interval of a clockwise polygon: right of every side. A side of length 0 excludes everything."""
    ends = jnp.roll(corners, -1, axis=0)
    dx, dy = corners[:, 1] - ends[:, 1], ends[:, 0] - corners[:, 0]
    bound = corners[:, 0] * dx + corners[:, 1] * dy
    return _columns(dx, dy, jnp.where((dx == 0) & (dy == 0), -jnp.inf, bound))


def _spoke(centre: Float[Array, "2"], angle: Float[Array, ""]) -> Interval:
    """Return the interval of a ray from the centre, two pixels wide."""
    back = jnp.array([jnp.sin(angle), -jnp.cos(angle)])
    side = jnp.array([-back[1], back[0]])
    normals = jnp.stack([back, side, -side])
    bound = jnp.matmul(normals, centre, precision="highest")  # whatever `jax_default_matmul_precision` is
    return _columns(normals[:, 0], normals[:, 1], bound + jnp.array([0.0, 1.0, 1.0]))


def _columns(dx: Float[Array, " plane"], dy: Float[Array, " plane"], bound: Float[Array, " plane"]) -> Interval:
    """Return, for each column, the interval inside all half-planes x * dx + y * dy <= bound; in pixels."""
    x = jnp.arange(SIDE, dtype=jnp.float32)[:, None]
    room = bound - x * dx  # y * dy <= room
    edge = room / jnp.where(dy == 0, 1.0, dy)
    low = jnp.where(dy < 0, edge, -jnp.inf).max(1)
    high = jnp.where(dy > 0, edge, jnp.inf)
    high = jnp.where((dy == 0) & (room < 0), -jnp.inf, high).min(1)
    return low, high


def _disc(centre: Float[Array, "2"], radius: Float[Array, ""]) -> Interval:
    x = jnp.arange(SIDE, dtype=jnp.float32)
    left = radius**2 - (x - centre[0]) ** 2
    half = jnp.where(left >= 0, jnp.sqrt(jnp.maximum(left, 0.0)), -jnp.inf)
    return centre[1] - half, centre[1] + half


def _patch(centre: Float[Array, "2"]) -> Interval:
    """Return the interval of the square in which a body is drawn."""
    start = jnp.clip(jnp.trunc(centre + BORDER - PATCH / 2), 0, SIDE + 2 * BORDER - PATCH) - BORDER
    x = jnp.arange(SIDE)
    inside = (start[0] <= x) & (x < start[0] + PATCH)
    return jnp.where(inside, start[1], jnp.inf), jnp.where(inside, start[1] + PATCH - 1, -jnp.inf)


def _meet(one: Interval, other: Interval) -> Interval:
    return jnp.maximum(one[0], other[0]), jnp.minimum(one[1], other[1])


def _if(shown: Array, shape: Coverage) -> Coverage:
    return shape._replace(low=jnp.where(shown, shape.low, jnp.inf))


def _role_colour(role: Int[Array, " *body"], fixed: Array) -> Int[Array, " *body"]:
    colours = np.array([ROLE_COLOUR[Role(number)] for number in range(len(Role))], np.float32)
    fixed_colours = np.concatenate([[FIXED], FIXED_SHADE * colours[1:]])
    return jnp.where(fixed, _packed(fixed_colours)[role], _packed(colours)[role])


def _packed(colour: Any) -> Int[Array, " *colours"]:
    """Pack (..., 3) channels up to 255 into one integer each, in units of 1/2 so that FIXED_SHADE stays exact."""
    red, green, blue = jnp.moveaxis((2 * jnp.asarray(colour, jnp.float32)).astype(jnp.int32), -1, 0)
    return (red << 2 * BITS) | (green << BITS) | blue


def _on_body(state: State, body: Int[Array, ""], anchor: Float[Array, "2"]) -> Float[Array, "2"]:
    """Transform a point from a body's frame to pixels."""
    return PIXELS_PER_METRE * (state.position[body] + _turn(anchor, state.rotation[body]))


def _turn(vector: Float[Array, "*point 2"], angle: Float[Array, ""]) -> Float[Array, "*point 2"]:
    cos, sin, x, y = jnp.cos(angle), jnp.sin(angle), vector[..., 0], vector[..., 1]
    return jnp.stack([x * cos - y * sin, x * sin + y * cos], -1)

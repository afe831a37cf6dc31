"""Arms: bodies held by one joint to something immovable. What acts on nothing but arms acts within their reach.

docs/labels.md has the argument and what it rests on; every doubt makes `Arms.known` False.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from levelgen.level import Level, Role
from physics.pairs import Pairs, pairs_of
from physics.trigonometry import cos_sin
from physics.types import MAX_VERTICES, Model, Params, State
from physics.vector import Vec, rows, vec

# How far arms fly was measured for arms like these
MAX_LENGTH = 1.0  # m, from the joint to the arm's centre; nor is the joint outside of a disc around the arm
MAX_MOTOR = 3.0  # of Params.motor_speed and of Params.motor_power
MAX_PUSH = 4.0  # of Params.thruster_power, for each kg: all thrusters of an arm together
MAX_GRAVITY = 10.0  # m/s^2
MAX_TURN = 6.3  # rad that a fixed joint or a limit is off at the start
MIN_RADIUS = 0.05  # m; joints of bodies of a few millimetres break
SPREAD = (1.0, 8.0)  # mass x (squared distance of the farthest corner) / inertia, lowest and highest
MAX_GAP = 0.01  # m, between the ends of the joint at the start
# The centre of such an arm never comes farther from its pivot than its length, SWING times that, and MARGIN. Turning
# at 50 rad/s, the most that is kept from step to step, takes it 0.3 lengths off in 1/60 s; a step's own pushes add.
SWING = 0.75
MARGIN = 0.25  # m

Ends = Bool[Array, "joint body lane"]


class Arms(NamedTuple):
    """What acts in a level, where it is arms and nothing else."""

    known: Bool[Array, " lane"]  # it is; and no arm can touch anything immovable but what holds it
    body: Bool[Array, "body lane"]  # the arms
    pivot: Vec  # [body, lane], where its joint holds it, m
    reach: Float[Array, "body lane"]  # m from the pivot that nothing of an arm ever leaves
    bystander: Bool[Array, "body lane"]  # bodies that may move and are no arms
    mixing: Bool[Array, "contact lane"]  # contacts of bystanders that would share solver batches with an arm's


def rigid(model: Model) -> Bool[Array, "body lane"]:
    """Bodies that no impulse moves."""
    return (model.inverse_mass == 0) & (model.inverse_inertia == 0)


def still(level: Level, params: Params) -> Bool[Array, "body lane"]:
    """Bodies that stay where they are, whatever happens."""
    state = level.state
    rests = (state.velocity == 0).all(1) & (state.angular_velocity == 0)
    return rigid(level.model) & rests & (jnp.abs(state.position) <= params.max_position).all(1)


def ends(level: Level) -> tuple[Ends, Ends]:
    """Bodies a and b of each joint that holds, one-hot: it is active, and so are both bodies."""
    model, number = level.model, jnp.arange(level.size.bodies)[:, None]
    a, b = ((index[:, None] == number) & model.active for index in (model.joint_a, model.joint_b))
    holds = (model.joint_active & a.any(1) & b.any(1))[:, None]
    return a & holds, b & holds


def carried(level: Level) -> Bool[Array, "thruster body lane"]:
    """The body of each thruster that pushes, one-hot."""
    model, number = level.model, jnp.arange(level.size.bodies)[:, None]
    pushes = (model.thruster_active & (model.thruster_power != 0))[:, None]
    return pushes & model.active & (model.thruster_body[:, None] == number)


def driven(level: Level) -> Bool[Array, "body lane"]:
    """Bodies whose velocity an action can change: ends of a joint whose motor obeys, carriers of a thruster."""
    model, (a, b) = level.model, ends(level)
    obeys = ~model.joint_fixed & model.motor_on & ~level.motor_auto & (model.motor_power != 0)
    return (((a | b) & obeys[:, None]).any(0) | carried(level).any(0)) & ~rigid(model)


def find_arms(level: Level, params: Params) -> Arms:
    """The driven bodies as arms."""
    model, (a, b) = level.model, ends(level)
    body, base = driven(level), still(level, params) & level.model.active
    arm_a, arm_b = a & body & (b & base).any(1)[:, None], b & body & (a & base).any(1)[:, None]
    one_joint = (a.sum(0) + b.sum(0) == 1) & (arm_a | arm_b).any(0)

    point_a, point_b = (
        joint_point(level.state, *end) for end in ((a, model.joint_anchor_a), (b, model.joint_anchor_b))
    )
    pick = lambda x, y: (jnp.where(arm_a, x[:, None], 0) + jnp.where(arm_b, y[:, None], 0)).sum(0)
    of_arm = lambda on_a, on_b: Vec(pick(on_a.x, on_b.x), pick(on_a.y, on_b.y))
    tip, pivot = of_arm(point_a, point_b), of_arm(point_b, point_a)
    length, radius = (tip - vec(level.state.position)).norm(), radii(model)
    near = (length <= MAX_LENGTH) & (length <= radius + MAX_GAP) & ((tip - pivot).norm() <= MAX_GAP)
    usual = one_joint & near & as_measured(level, a, b, radius)
    reach = (1 + SWING) * length + radius + MARGIN

    held = ((arm_a[:, :, None] & b[:, None]) | (arm_b[:, :, None] & a[:, None])).any(0)  # [arm, base, lane]
    clear = still_distance(level, pivot) > reach[:, None]
    collides = model.collides | model.collides.swapaxes(0, 1)
    alone = (clear | ~base[None] | (held & ~collides)).all(1)
    between = (pivot.map(lambda x: x[:, None]) - pivot.map(lambda x: x[None])).norm()
    same = jnp.eye(len(body), dtype=bool)[..., None]
    apart = (between > reach[:, None] + reach[None]) | ~(body[:, None] & body[None]) | same
    return Arms(
        known=body.any(0) & ((usual & alone) | ~body).all(0) & apart.all((0, 1)) & as_published(level, params),
        body=body,
        pivot=pivot,
        reach=reach,
        bystander=model.active & ~still(level, params) & ~body,
        mixing=mixing(level, body, held),
    )


def joint_point(state: State, end: Ends, anchor: Float[Array, "joint 2 lane"]) -> Vec:
    """Where a joint holds its bodies `end`, [joint, lane], m."""
    pick = lambda x: jnp.where(end, x, 0.0).sum(1)
    angle, centre = pick(state.rotation), vec(state.position).map(pick)
    return vec(anchor).rotate(*cos_sin(angle)) + centre


def radii(model: Model) -> Float[Array, "body lane"]:
    """Distance of each body's farthest point from its centre, m."""
    used = (jnp.arange(MAX_VERTICES)[:, None] < 3) | (model.n_vertices[:, None] != 3)  # as `physics.manifold` has it
    return jnp.concatenate([jnp.where(used, vec(model.vertices).norm(), 0.0).max(1), model.radius])


def as_measured(level: Level, a: Ends, b: Ends, radius: Float[Array, "body lane"]) -> Bool[Array, "body lane"]:
    """Whether a body, as an arm, is like those that were measured: at rest, of no goal, no stronger."""
    model, state = level.model, level.state
    rests = (state.velocity == 0).all(1) & (state.angular_velocity == 0)
    spread = jnp.square(radius) * model.inverse_inertia / jnp.where(model.inverse_mass == 0, 1.0, model.inverse_mass)
    solid = (radius >= MIN_RADIUS) & (model.inverse_mass > 0) & (spread >= SPREAD[0]) & (spread <= SPREAD[1])
    pushes = carried(level)
    power = jnp.where(pushes, jnp.abs(model.thruster_power)[:, None], 0.0).sum(0) * model.inverse_mass
    outside = (pushes & (vec(model.thruster_position).norm()[:, None] > radius + MAX_GAP)).any(0)
    remembers = (level.state.joint_impulse != 0).any(1) | (level.state.joint_angular_impulse != 0)
    strong = jnp.maximum(jnp.abs(model.motor_speed), jnp.abs(model.motor_power)) > MAX_MOTOR
    turned = jnp.abs(turn(level, a, b)) > MAX_TURN
    odd = ((a | b) & (remembers | turned | (model.motor_on & strong))[:, None]).any(0)
    return rests & solid & (power <= MAX_PUSH) & ~outside & ~odd & (level.role == Role.PLAIN)


def turn(level: Level, a: Ends, b: Ends) -> Float[Array, "joint lane"]:
    """How far each joint that holds is from an angle that it may have, rad, as `physics.joint` has it."""
    model, of = level.model, lambda end: jnp.where(end, level.state.rotation, 0.0).sum(1)
    angle = of(b) - of(a) - model.joint_rotation
    beyond = angle - jnp.clip(angle, model.joint_min, model.joint_max)
    return jnp.where(model.joint_fixed, angle, jnp.where(model.joint_limited, beyond, 0.0))


def as_published(level: Level, params: Params) -> Bool[Array, " lane"]:
    """Whether the engine's constants are those that were measured."""
    gravity = vec(level.model.gravity[None]).norm()[0]
    same = params in (Params(faithful_padding=False), Params(faithful_padding=True))
    return (gravity <= MAX_GRAVITY) & same


def still_distance(level: Level, point: Vec) -> Float[Array, "body body lane"]:
    """[i, j]: a distance that point i has at least from body j, as body j starts, m; negative inside."""
    model, state, polygons = level.model, level.state, level.size.polygons
    cos, sin = cos_sin(state.rotation)
    centre = vec(state.position)
    offset = Vec(*(p[:, None] - c[None] for p, c in zip(point, centre, strict=True)))  # [i, j, lane]
    local = offset.map(lambda x: x[:, :polygons]).unrotate(cos[:polygons], sin[:polygons])
    triangle = model.n_vertices == 3
    last = lambda x: jnp.where(triangle, x[:, 0], x[:, 3])[:, None]  # of a triangle, its first again
    corners = vec(model.vertices).map(lambda x: jnp.concatenate([x[:, :3], last(x)], 1))
    edge = corners.map(lambda x: jnp.roll(x, -1, 1)) - corners
    length = edge.norm()
    outward = Vec(-edge.y, edge.x).scale(1 / jnp.where(length == 0, 1.0, length))
    support = outward.map(lambda x: x[:, :, None]).dot(corners.map(lambda x: x[:, None])).max(2)  # [j, face, lane]
    from_face = local.map(lambda x: x[:, :, None]).dot(outward) - support  # [i, j, face, lane]
    from_face = jnp.where(length > 0, from_face, -jnp.inf)
    from_circle = offset.map(lambda x: x[:, polygons:]).norm() - model.radius
    return jnp.concatenate([from_face.max(2), from_circle], 1)


def mixing(
    level: Level, body: Bool[Array, "body lane"], held: Bool[Array, "body body lane"]
) -> Bool[Array, "contact lane"]:
    """Contacts without an arm, of a kind that has several solver batches and has pairs of an arm and its base.

    How many pairs of a kind touch decides in which batch each is solved.
    """
    model, pairs, masks = level.model, pairs_of(level.size), {}
    together = held | held.swapaxes(0, 1)
    for name in Pairs.__dataclass_fields__:
        pair = getattr(pairs, name)
        of = lambda x, p=pair: x[jnp.array(p.a, int), jnp.array(p.b, int)]
        pushes = of(model.collides) & ~(rows(rigid(model), pair.a) & rows(rigid(model), pair.b))
        without = ~(rows(body, pair.a) | rows(body, pair.b))
        masks[name] = pushes & without & of(together).any(0) & (pair.batches > 1)
    return jnp.concatenate([masks["polygon"], masks["polygon"], masks["circle_polygon"], masks["circle"]])


def within_reach(arms: Arms, model: Model, state: State) -> Bool[Array, " lane"]:
    """Whether a bystander is where an arm might come to."""
    gap = Vec(*(x[:, None] - p[None] for x, p in zip(vec(state.position), arms.pivot, strict=True))).norm()
    near = ~(gap > radii(model)[:, None] + arms.reach[None])
    return (near & arms.bystander[:, None] & arms.body[None]).any((0, 1))

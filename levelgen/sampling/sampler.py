"""Random levels from level ids, in the order of the reference's sampler.

The order is that of `kinetix.environment.ued.distributions.sample_kinetix_level` 3.0.2: the floor's role; a green and
a blue body, not both fixed; a third body, joined if a motor must act; a thruster if one must act; more bodies and
thrusters while there is room; green and blue swapped at random; the rows of every kind shuffled. moves.py has the
draws of each step, distribution.py every number.

Three things are arranged differently, without effect on the distribution. All random numbers of a level are drawn at
once (draws.py). The reference branches on what to add; here every body's turn computes a free and a connected proposal
and selects one (`Plan`). The forced thruster is added after all bodies, but to one that existed when the reference
adds it. Distributions other than the default may also turn the floor green or leave out kinds of actuators.
"""

from dataclasses import replace
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int
from numpy.typing import ArrayLike

from levelproof.levelgen.identity.keys import Stream, key_for, level_id_array
from levelproof.levelgen.level import Level, Role, name_of, size_of
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.draws import at, draw_uniforms, pick
from levelproof.levelgen.sampling.moves import ThrusterDraws, add_thruster, propose_connected, propose_free
from levelproof.levelgen.sampling.overlap import WorldCircles, count_contacts
from levelproof.levelgen.sampling.proposal import BodyDraws, Flag, Lane, Proposal, corners_in_world, insert
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.sampling.shuffle import OrderDraws, shuffle, shuffled_rows
from levelproof.physics.bounds import require_32_bits
from levelproof.physics.types import FIXED_POLYGONS, Size

CHUNK = 256  # levels per call of the compiled program, which is padded to this
GOAL_BODIES = 2  # green and blue come first
DEFAULT = Distribution()


class Filling(IntEnum):
    """What to add at a body's turn after green, blue and the third body."""

    CONNECTED = 0
    FREE = 1
    NOTHING = 2


class LevelDraws(NamedTuple):
    """Random numbers drawn once per level, each [lane]."""

    floor: Lane
    first_moves: Lane
    control: Lane
    swap: Lane


class FillingDraws(NamedTuple):
    """Random number of one body's turn, [lane]."""

    kind: Lane


class Plan(NamedTuple):
    """What to add at each body's turn, each [turn, lane]."""

    add: Flag
    connect: Flag
    revolute: Flag  # the joint must be revolute
    may_be_fixed: Flag


def sample_levels(level_ids: ArrayLike, size: Size | str, distribution: Distribution = DEFAULT) -> Level:
    """Sample the levels with these ids: float32 and int32 arrays in SI units, level axis last.

    A level depends only on its id, the size, `SAMPLER_VERSION` and the distribution: one compiled program samples any
    number of ids in chunks of CHUNK. So call this outside `jax.jit`.

    Args:
        level_ids: integers from 0 to MAX_LEVEL_ID, in any order.
        size: capacity of a level: the name of one of SIZES such as "s", four numbers as in "8-8-8-4", or a Size.
        distribution: the distribution of random levels.

    Raises:
        ValueError: the size's name is unknown, or it has no room for the scenery, a green and a blue body; an id is
            not 0 .. MAX_LEVEL_ID; or `jax_enable_x64` is on.
    """
    require_32_bits()
    size = size_of(size)
    check_size(size)
    ids = level_id_array(level_ids)
    padded = np.resize(ids, (max(1, -(-len(ids) // CHUNK)), CHUNK))
    chunks = [sample_chunk(chunk, size, distribution) for chunk in padded]
    return jax.device_put(jax.tree.map(lambda *parts: np.concatenate(parts, -1)[..., : len(ids)], *chunks))


def check_size(size: Size) -> None:
    """Raise ValueError if no level of this size can have a goal."""
    if size.polygons < FIXED_POLYGONS or size.bodies < FIXED_POLYGONS + GOAL_BODIES or min(size) < 0:
        raise ValueError(
            f"size is {name_of(size)}: {size.polygons} polygons and {size.circles} circles leave no room for the "
            f"{FIXED_POLYGONS} polygons of the scenery, a green and a blue body"
        )


@partial(jax.jit, static_argnames=("size", "distribution"))
def sample_chunk(level_ids: Int[Array, " lane"], size: Size, distribution: Distribution) -> Level:
    """Sample one chunk of levels."""
    keys = jax.vmap(lambda level_id: key_for(level_id, Stream.LEVEL))(level_ids)
    once, kinds, bodies, thrusters, order = draw_uniforms(keys, draw_layout(size, distribution))
    level = set_floor(empty_level(size, len(level_ids)), once.floor, distribution)
    motor, thruster = draw_control(once.control, size, distribution)
    plan = plan_bodies(level, once.first_moves, motor, kinds, distribution)
    level, active = add_bodies(level, plan, bodies, distribution)
    level = add_thrusters(level, thruster, active[min(GOAL_BODIES, len(active) - 1)], thrusters, distribution)
    return shuffle(swap_roles(level, once.swap < distribution.swap_chance), order)


def draw_layout(size: Size, dist: Distribution) -> list[tuple[type, tuple[int, ...]]]:
    """Return the type and shape of all random numbers of a level."""
    proposals = 1 if size.bodies <= dist.small_world else dist.proposals
    return [
        (LevelDraws, ()),
        (FillingDraws, (turns(size),)),
        (BodyDraws, (turns(size), proposals)),
        (ThrusterDraws, (size.thrusters,)),
        (OrderDraws, (sum(shuffled_rows(size)),)),
    ]


def turns(size: Size) -> int:
    """Return the number of bodies that the sampler tries to add: one for every row."""
    return size.bodies - FIXED_POLYGONS


def set_floor(level: Level, u: Lane, dist: Distribution) -> Level:
    """Draw the floor's role."""
    chances = [0.0, dist.floor_green_chance, dist.floor_blue_chance, dist.floor_red_chance]
    chances[Role.PLAIN] = 1 - sum(chances)
    return replace(level, role=level.role.at[0].set(pick(jnp.array(chances)[:, None], u)))


def control_weights(size: Size, dist: Distribution) -> dict[tuple[bool, bool], float]:
    """Return the weights of (motor required, thruster required), without those that the size has no room for."""
    weights = {
        (False, True): dist.thruster_only_weight,
        (True, False): dist.motor_only_weight,
        (True, True): dist.motor_and_thruster_weight,
    }
    room = (size.joints > 0 and turns(size) > GOAL_BODIES, size.thrusters > 0)
    return {kind: weight for kind, weight in weights.items() if weight and np.all(np.array(room) >= kind)}


def draw_control(u: Lane, size: Size, dist: Distribution) -> tuple[Flag, Flag]:
    """Draw whether a motor and a thruster are required; neither if the size has no room for what the weights allow."""
    kinds = control_weights(size, dist) or {(False, False): 1.0}
    upper = np.cumsum(list(kinds.values()), dtype=np.float32)[:, None]
    motor, thruster = jnp.array(list(kinds))[(u * upper[-1] >= upper[:-1]).sum(0)].T
    return motor, thruster


def plan_bodies(level: Level, first_moves: Lane, motor: Flag, fillings: FillingDraws, dist: Distribution) -> Plan:
    """Plan two free bodies, one of them movable; a third, joined if a motor is required; then random ones."""
    turn = jnp.arange(len(fillings.kind))[:, None]
    weights = jnp.array([dist.connected_weight, dist.free_weight, dist.empty_weight])[:, None]
    kind = jax.vmap(lambda u: pick(weights, u))(fillings.kind)
    later = turn > GOAL_BODIES
    # If the floor is green or blue, the first body becomes the other goal and must move, since the floor cannot
    first = (first_moves < 0.5) | (level.role[0] == Role.GREEN) | (level.role[0] == Role.BLUE)
    must_move = jnp.where(turn == 0, first, (turn == 1) & ~first) | (level.size.bodies <= dist.small_world)
    return Plan(
        add=~later | (kind != Filling.NOTHING),
        connect=jnp.where(later, kind == Filling.CONNECTED, (turn == GOAL_BODIES) & motor),
        revolute=jnp.broadcast_to(turn == GOAL_BODIES, kind.shape),
        may_be_fixed=~must_move,
    )


def add_bodies(
    level: Level, plan: Plan, draws: BodyDraws, dist: Distribution
) -> tuple[Level, Bool[Array, "turn body lane"]]:
    """Add the planned bodies; draws are [turn, proposal, lane]. Also return the active bodies after each turn."""

    def turn(level: Level, now: tuple[Plan, BodyDraws]) -> tuple[Level, Bool[Array, "body lane"]]:
        plan, d = now
        added = insert(level, propose(level, plan, d, dist))
        return added, added.model.active

    return jax.lax.scan(turn, level, (plan, draws))


def propose(level: Level, plan: Plan, draws: BodyDraws, dist: Distribution) -> Proposal:
    """Return the proposal with the fewest contacts, the first of equals. Draws are [proposal, lane]."""

    def one(d: BodyDraws) -> Proposal:
        connected = propose_connected(level, d, plan.revolute, dist)
        free = propose_free(level, d, plan.may_be_fixed, connected.joint, dist)
        p: Proposal = jax.tree.map(lambda a, b: jnp.where(plan.connect, a, b), connected, free)
        return p._replace(possible=p.possible & plan.add, joined=p.joined & plan.connect & plan.add)

    def score(p: Proposal) -> Lane:
        body = WorldCircles(p.position.map(lambda x: x[None]), p.shape.radius[None])
        contacts = count_contacts(level.model, level.state, corners_in_world(p), body, p.shape.is_polygon)
        return contacts + jnp.where(p.hidden, dist.hidden_penalty, 0.0)

    proposals = jax.vmap(one)(draws)
    if len(draws.role) == 1:
        return jax.tree.map(lambda x: x[0], proposals)
    scores = jax.vmap(score)(proposals)
    best = jnp.arange(len(scores))[:, None] == jnp.argmin(scores, 0)
    return jax.tree.map(lambda x: at(x, best), proposals)


def add_thrusters(
    level: Level, forced: Flag, early: Bool[Array, "body lane"], draws: ThrusterDraws, dist: Distribution
) -> Level:
    """Add the first thruster, if forced, to one of the `early` bodies, then others at random. Draws are [turn, lane].

    `early` are the bodies that exist when the reference adds its forced thruster: green, blue and the third.
    """
    count = level.size.thrusters
    if not count:
        return level
    wanted = jnp.where(jnp.arange(count)[:, None] == 0, forced, draws.wanted < dist.extra_thruster_chance)

    def turn(level: Level, now: tuple[ThrusterDraws, Flag, Array]) -> tuple[Level, None]:
        d, wanted, index = now
        candidates = jnp.where(index == 0, early, level.model.active)
        return add_thruster(level, d, wanted, candidates, dist), None

    return jax.lax.scan(turn, level, (draws, wanted, jnp.arange(count)))[0]


def swap_roles(level: Level, wanted: Flag) -> Level:
    """Swap green and blue where wanted, unless the floor has a role."""
    swapped = jnp.where(level.role == Role.GREEN, Role.BLUE, jnp.where(level.role == Role.BLUE, Role.GREEN, level.role))
    return replace(level, role=jnp.where(wanted & (level.role[0] == Role.PLAIN), swapped, level.role))

"""Random levels: from level ids, in the order of the reference's sampler.

The floor's role; a green and a blue body; a third body or a thruster or both, so that something can act; more
bodies and thrusters while there is room; green and blue swapped at random; the rows of every kind shuffled. What is
drawn at each step is in moves.py, every number in distribution.py.
Facts: `kinetix.environment.ued.distributions.sample_kinetix_level` 3.0.2.
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
from levelproof.levelgen.sampling.draws import at, deal, pick
from levelproof.levelgen.sampling.moves import ThrusterDraws, add_thruster, propose_connected, propose_free
from levelproof.levelgen.sampling.overlap import WorldCircles, count_contacts
from levelproof.levelgen.sampling.proposal import BodyDraws, Flag, Lane, Proposal, corners_in_world, insert
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.sampling.shuffle import OrderDraws, shuffle, shuffled_rows
from levelproof.physics.bounds import require_32_bits
from levelproof.physics.types import FIXED_POLYGONS, Size

CHUNK = 256  # levels sampled by one call of the compiled program, however many are asked for
GOAL_BODIES = 2  # green and blue come first
DEFAULT = Distribution()


class Filling(IntEnum):
    """What a row is filled with that green, blue and the third body have left."""

    CONNECTED = 0
    FREE = 1
    NOTHING = 2


class LevelDraws(NamedTuple):
    """Decisions taken once a level, each [lane]."""

    floor: Lane
    first_moves: Lane
    control: Lane
    swap: Lane


class FillingDraws(NamedTuple):
    kind: Lane


class Plan(NamedTuple):
    """What to do at each body's turn, each [turn, lane]."""

    add: Flag
    connect: Flag
    revolute: Flag  # the joint must turn
    may_be_fixed: Flag


def sample_levels(level_ids: ArrayLike, size: Size | str, distribution: Distribution = DEFAULT) -> Level:
    """The levels with these ids, as float32 and int32 arrays in SI units, level axis last.

    A level depends on its id, the size, `SAMPLER_VERSION` and the distribution alone: whatever the number
    of ids, they go through one compiled program in chunks of CHUNK. So call it outside `jax.jit`.

    Args:
        level_ids: whole numbers from 0 to MAX_LEVEL_ID, in any order.
        size: room in a level: the name of one of SIZES such as "s", four numbers as in "8-8-8-4", or a Size.
        distribution: what random levels are like.

    Raises:
        ValueError: there is no size of this name, or it has no room for the scenery, a green and a blue body; an id is
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
    """Raises ValueError where no level of this size can have a goal."""
    if size.polygons < FIXED_POLYGONS or size.bodies < FIXED_POLYGONS + GOAL_BODIES or min(size) < 0:
        raise ValueError(
            f"size is {name_of(size)}: {size.polygons} polygons and {size.circles} circles leave no room for the "
            f"{FIXED_POLYGONS} polygons of the scenery, a green and a blue body"
        )


@partial(jax.jit, static_argnames=("size", "distribution"))
def sample_chunk(level_ids: Int[Array, " lane"], size: Size, distribution: Distribution) -> Level:
    """One chunk of levels."""
    keys = jax.vmap(lambda level_id: key_for(level_id, Stream.LEVEL))(level_ids)
    once, kinds, bodies, thrusters, order = deal(keys, hands(size, distribution))
    level = set_floor(empty_level(size, len(level_ids)), once.floor, distribution)
    motor, thruster = draw_control(once.control, size, distribution)
    plan = plan_bodies(level, once.first_moves, motor, kinds, distribution)
    level, active = add_bodies(level, plan, bodies, distribution)
    level = add_thrusters(level, thruster, active[min(GOAL_BODIES, len(active) - 1)], thrusters, distribution)
    return shuffle(swap_roles(level, once.swap < distribution.swap_chance), order)


def hands(size: Size, dist: Distribution) -> list[tuple[type, tuple[int, ...]]]:
    """The random numbers that a level takes."""
    proposals = 1 if size.bodies <= dist.small_world else dist.proposals
    return [
        (LevelDraws, ()),
        (FillingDraws, (turns(size),)),
        (BodyDraws, (turns(size), proposals)),
        (ThrusterDraws, (size.thrusters,)),
        (OrderDraws, (sum(shuffled_rows(size)),)),
    ]


def turns(size: Size) -> int:
    """Bodies the sampler tries to add: one for every row."""
    return size.bodies - FIXED_POLYGONS


def set_floor(level: Level, u: Lane, dist: Distribution) -> Level:
    chances = [0.0, dist.floor_green_chance, dist.floor_blue_chance, dist.floor_red_chance]
    chances[Role.PLAIN] = 1 - sum(chances)
    return replace(level, role=level.role.at[0].set(pick(jnp.array(chances)[:, None], u)))


def control_weights(size: Size, dist: Distribution) -> dict[tuple[bool, bool], float]:
    """The weight of a motor, of a thruster and of both having to be there, as far as the size has room for them."""
    weights = {
        (False, True): dist.thruster_only_weight,
        (True, False): dist.motor_only_weight,
        (True, True): dist.motor_and_thruster_weight,
    }
    room = (size.joints > 0 and turns(size) > GOAL_BODIES, size.thrusters > 0)
    return {kind: weight for kind, weight in weights.items() if weight and np.all(np.array(room) >= kind)}


def draw_control(u: Lane, size: Size, dist: Distribution) -> tuple[Flag, Flag]:
    """Whether there must be a motor and a thruster; neither where the size has no room for what the weights allow."""
    kinds = control_weights(size, dist) or {(False, False): 1.0}
    upper = np.cumsum(list(kinds.values()), dtype=np.float32)[:, None]
    motor, thruster = jnp.array(list(kinds))[(u * upper[-1] >= upper[:-1]).sum(0)].T
    return motor, thruster


def plan_bodies(level: Level, first_moves: Lane, motor: Flag, fillings: FillingDraws, dist: Distribution) -> Plan:
    """Two free bodies, of which one can move; a third, joined where a motor must be; then what comes."""
    turn = jnp.arange(len(fillings.kind))[:, None]
    weights = jnp.array([dist.connected_weight, dist.free_weight, dist.empty_weight])[:, None]
    kind = jax.vmap(lambda u: pick(weights, u))(fillings.kind)
    later = turn > GOAL_BODIES
    # A floor that is a goal cannot move: then the first body, which becomes the other goal, must
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
    """Draws are [turn, proposal, lane]. Also returns which bodies there were after each turn."""

    def turn(level: Level, now: tuple[Plan, BodyDraws]) -> tuple[Level, Bool[Array, "body lane"]]:
        plan, d = now
        added = insert(level, propose(level, plan, d, dist))
        return added, added.model.active

    return jax.lax.scan(turn, level, (plan, draws))


def propose(level: Level, plan: Plan, draws: BodyDraws, dist: Distribution) -> Proposal:
    """The proposal that touches least, the first of equals. Draws are [proposal, lane]."""

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
    """The first, if forced, on one of the `early` bodies, then others by chance. Draws are [turn, lane]."""
    count = level.size.thrusters
    if not count:
        return level
    wanted = jnp.where(jnp.arange(count)[:, None] == 0, forced, draws.wanted < dist.extra_thruster_chance)

    def turn(level: Level, now: tuple[ThrusterDraws, Flag, Array]) -> tuple[Level, None]:
        d, wanted, number = now
        candidates = jnp.where(number == 0, early, level.model.active)
        return add_thruster(level, d, wanted, candidates, dist), None

    return jax.lax.scan(turn, level, (draws, wanted, jnp.arange(count)))[0]


def swap_roles(level: Level, wanted: Flag) -> Level:
    """Green and blue exchanged, unless the floor has a role."""
    swapped = jnp.where(level.role == Role.GREEN, Role.BLUE, jnp.where(level.role == Role.BLUE, Role.GREEN, level.role))
    return replace(level, role=jnp.where(wanted & (level.role[0] == Role.PLAIN), swapped, level.role))

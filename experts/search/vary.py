"""Variations: evolution of whole trajectories until one reaches the goal.

Each level keeps the few trajectories that brought green and blue nearest to each other, at first those to the nearest
states in its archive. A lane plays a variation of one of them from the level's start: stretches are resampled or
shifted in time. If a variation comes nearer than a kept trajectory, it replaces that one; then the lane plays another.
Go-Explore resamples all actions after the state it returns to; a variation keeps the actions after a change, so it can
correct an aim.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt16, UInt32

from levelproof.experts.search.archive import Archive
from levelproof.experts.search.config import NEAREST, SearchConfig, StopLimits
from levelproof.experts.search.edit import Draws, Edit, below, draw, edited, some_of, stretch
from levelproof.experts.search.explore import NEARER, patient, with_success
from levelproof.experts.search.near import FAR, gap
from levelproof.experts.search.play import CODES, Arena, Walk, act, arena, decode, fresh_walk, most_steps
from levelproof.experts.search.rows import from_rows, to_rows
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.programs import jit_quickly, jit_sooner
from levelproof.levelgen.task.rules import TaskParams

BEYOND = 16  # env steps played beyond the step at which the varied trajectory was nearest
CHANGES = 2  # maximum number of changes in a variation
LESS_PATIENT = 4  # divides the patience of Go-Explore: variations succeed sooner (docs/tried/cells.md)
MAX_MOVED = 8  # env steps, maximum shift in time


class Approaches(NamedTuple):
    """Trajectories of each level, the nearest to the goal first."""

    code: UInt16[Array, "level kept step"]  # codes of the actions from the level's start
    gap: Float[Array, "level kept"]  # m, smallest gap between green and blue
    steps: Int[Array, "level kept"]  # env steps until that gap


class Episodes(NamedTuple):
    """Episodes of lanes."""

    so_far: Approaches  # one trajectory per lane instead of the kept ones: all its actions, its smallest gap so far
    state: Float[Array, "level lane word"]  # the whole state (`experts.search.rows`)
    timestep: Int[Array, "level lane"]
    most: Int[Array, "level lane"]  # env steps after which the episode is over
    over: Bool[Array, "level lane"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Varying:
    """State of the variations, level axis first, except in `levels`."""

    levels: Level  # lane axis last
    level_ids: Int[Array, " level"]  # seeds of all randomness
    nearest: Approaches
    episodes: Episodes
    env_steps: Int[Array, " level"]  # of all lanes
    gap: Float[Array, " level"]  # m, smallest gap between green and blue so far
    closed: Int[Array, " level"]  # env steps when the gap last shrank
    code: UInt16[Array, "level step"]  # codes of the success's actions
    length: Int[Array, " level"]  # of the success, env steps; 0: none


@jit_sooner()
def nearest_of(archive: Archive) -> Approaches:
    """Return the trajectories to the archived states nearest to the goal; each repeats its last action to the end."""
    entry = archive.entry
    distance = jnp.where(archive.used & ~jnp.isnan(entry.distance), entry.distance, FAR)
    step = jnp.minimum(jnp.arange(entry.code.shape[-1]), jnp.maximum(entry.steps - 1, 0)[..., None])
    return first_of(Approaches(jnp.take_along_axis(entry.code, step, axis=-1), distance, entry.steps))


@jit_quickly(static_argnames=("config",))
def begin(
    levels: Level,
    level_ids: Int[Array, " level"],
    nearest: Approaches,
    config: SearchConfig,
) -> Varying:
    """Start variations from these trajectories.

    Args:
        levels: the levels, lane axis last.
        level_ids: their ids, the seeds of all randomness.
        nearest: the nearest trajectories of each level.
        config: settings of the search.
    """
    count, steps = len(level_ids), nearest.code.shape[-1]
    state = jnp.zeros((count, config.lanes, to_rows(levels.state).shape[-1]), jnp.float32)  # of no episode yet
    none, of_lane = jnp.zeros(count, jnp.int32), jnp.zeros((count, config.lanes), jnp.int32)
    so_far = Approaches(
        jnp.zeros((*of_lane.shape, steps), jnp.uint16), jnp.full(of_lane.shape, FAR, jnp.float32), of_lane
    )
    episodes = Episodes(so_far, state, of_lane, of_lane, jnp.ones(of_lane.shape, bool))
    code = jnp.zeros((count, steps), jnp.uint16)
    return Varying(levels, level_ids, nearest, episodes, none, nearest.gap[:, 0], none, code, none)


def vary(varying: Varying, config: SearchConfig, rules: TaskParams) -> Varying:
    """Vary for `config.rounds` rounds; donates `varying`. Levels that are done stay unchanged."""
    return vary_rounds(varying, config.ends, config.endless, rules)


@jit_sooner(static_argnames=("config", "rules"), donate_argnames="varying")
def vary_rounds(varying: Varying, ends: StopLimits, config: SearchConfig, rules: TaskParams) -> Varying:
    ring = arena(varying.levels, config.lanes, (1.0,))
    step = lambda varying, _: (vary_round(varying, ring, ends, config, rules), None)
    return jax.lax.scan(step, varying, length=config.rounds)[0]


def vary_round(varying: Varying, ring: Arena, ends: StopLimits, config: SearchConfig, rules: TaskParams) -> Varying:
    """Give lanes whose episodes are over new ones, then play all lanes; `ring` has the levels' lanes."""
    active = under_way(varying, ends)
    stays = lambda new, old: jnp.where(active.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    episodes = varying.episodes
    tried = episodes.so_far._replace(gap=jnp.where(episodes.over, episodes.so_far.gap, FAR))
    nearest = jax.tree.map(stays, first_of(jax.tree.map(together, varying.nearest, tried)), varying.nearest)

    bits = draw(Draws.VARY, varying.level_ids, varying.env_steps, 3 + 5 * CHANGES, config.lanes)
    episodes = renewed(episodes, nearest, bits, ring, rules)
    walk, so_far = played(episodes, ring, config, rules)
    by_level = lambda x: x.reshape(*episodes.over.shape, *x.shape[1:])
    state, timestep = by_level(to_rows(walk.state)), by_level(walk.timestep)
    over = by_level(walk.ended) | (timestep >= episodes.most)
    code = so_far.code.reshape(-1, so_far.code.shape[-1])
    code, length = with_success(varying.code, varying.length, walk, code, active)

    env_steps = varying.env_steps + jnp.where(active, config.steps_per_round, 0)
    closer = active & (nearest.gap[:, 0] < NEARER * varying.gap)
    return Varying(
        levels=varying.levels,
        level_ids=varying.level_ids,
        nearest=nearest,
        episodes=Episodes(so_far, state, timestep, episodes.most, over),
        env_steps=env_steps,
        gap=jnp.where(closer, nearest.gap[:, 0], varying.gap),
        closed=jnp.where(closer, env_steps, varying.closed),
        code=code,
        length=length,
    )


def under_way(varying: Varying, ends: StopLimits) -> Bool[Array, " level"]:
    """Return for which levels variations continue: no success, env steps left, and lately nearer to the goal."""
    going = (varying.length == 0) & (varying.env_steps < ends.variations)
    less = -(-ends.patience // LESS_PATIENT)  # rounded up, because 0 means no limit
    return going & patient(varying.env_steps - varying.closed, varying.gap, less, ends)


def together(one: Array, other: Array) -> Array:
    """Concatenate along the second axis, within each level."""
    return jnp.concatenate([one, other], axis=1)


def first_of(some: Approaches) -> Approaches:
    """Return NEAREST trajectories, those with the least gaps; of equal gaps only the first, if enough others exist."""
    order = jnp.argsort(some.gap, axis=-1)
    gaps = jnp.take_along_axis(some.gap, order, axis=-1)
    again = jnp.pad(gaps[:, 1:] == gaps[:, :-1], [(0, 0), (1, 0)])
    gaps = jnp.where(again, FAR, gaps)
    first = jnp.argsort(gaps, axis=-1)[:, :NEAREST]
    pick = lambda x, order: jax.vmap(lambda x, order: x[order])(x, order)
    kept = jax.tree.map(lambda x: pick(x, pick(order, first)), some)
    return kept._replace(gap=pick(gaps, first))


def renewed(
    episodes: Episodes, nearest: Approaches, bits: UInt32[Array, "level draw lane"], ring: Arena, rules: TaskParams
) -> Episodes:
    """Replace episodes that are over with variations of the nearest trajectories; of two draws the nearer is varied."""
    parent = below(bits[:, :2], nearest.gap.shape[1]).min(1)
    code, steps = (jax.vmap(lambda x, at: x[at])(x, parent) for x in (nearest.code, nearest.steps))
    live = ring.live.T.reshape(*parent.shape, ACTIONS)
    by_lane = jax.vmap(changed, (0, 0, -1, 0))
    code, none = jax.vmap(by_lane)(code, steps, bits[:, 2:], live), jnp.zeros_like(steps)
    so_far = Approaches(code, jnp.full(steps.shape, FAR, jnp.float32), none)
    start = to_rows(ring.lanes.state).reshape(episodes.state.shape)
    most = jnp.minimum(steps + BEYOND, most_steps(rules))
    fresh = Episodes(so_far, start, none, most, jnp.zeros_like(episodes.over))
    renew = lambda new, old: jnp.where(episodes.over.reshape(*steps.shape, *[1] * (old.ndim - 2)), new, old)
    return jax.tree.map(renew, fresh, episodes)


def played(episodes: Episodes, ring: Arena, config: SearchConfig, rules: TaskParams) -> tuple[Walk, Approaches]:
    """Play all lanes for a round; return them and how near they have come."""
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    code, least, steps = (flat(x) for x in episodes.so_far)
    lane, last = jnp.arange(len(code)), code.shape[1] - 1

    def one(now: tuple[Walk, Array, Array], _: None) -> tuple[tuple[Walk, Array, Array], None]:
        before, least, steps = now
        action = decode(code[lane, jnp.minimum(before.timestep, last)])
        walk = act(ring, before, action, rules)
        apart = gap(ring.goals, walk.state)
        nearer = ~before.ended & (apart < least)
        return (walk, jnp.where(nearer, apart, least), jnp.where(nearer, walk.timestep, steps)), None

    walk = fresh_walk(ring.lanes)._replace(
        state=from_rows(flat(episodes.state), ring.lanes.state), timestep=flat(episodes.timestep)
    )
    walk, least, steps = jax.lax.scan(one, (walk, least, steps), length=config.segments * config.segment)[0]
    shape = episodes.over.shape
    return walk, Approaches(episodes.so_far.code, least.reshape(shape), steps.reshape(shape))


def changed(
    code: UInt16[Array, " step"], steps: Int[Array, ""], bits: UInt32[Array, " draw"], live: Bool[Array, "6"]
) -> UInt16[Array, " step"]:
    """Apply the first change, and each further one if its bit of the first random number is set."""
    last = len(code) - 1
    for number, change in enumerate(bits[1:].reshape(CHANGES, 5)):
        more = edited(code, last, change_of(steps, change, live))
        code = jnp.where((bits[0] >> (number - 1)) & 1 == 1, more, code) if number else more
    return code


def change_of(steps: Int[Array, ""], bits: UInt32[Array, "5"], live: Bool[Array, "6"]) -> Edit:
    """Resample live entries for a stretch in half of cases; else play the rest of the trajectory sooner or later."""
    length, kind = jnp.maximum(steps, 1), bits[4] & 3
    first, some = below(bits[0], length), stretch(bits[1], length)
    by = jnp.minimum(some, 1 + below(bits[4] >> 2, MAX_MOVED))
    sooner = jnp.select([kind == 2, kind == 3], [by, -by], 0)
    resampled = jnp.where(kind < 2, some, 0)
    return Edit(0, 0, first, sooner, first, resampled, some_of(live, bits[2]), (bits[3] % CODES).astype(jnp.int32))

"""Go-Explore of some levels side by side. Each round, every lane returns to an archived state of its level, plays some
segments from there, and archives the state after each segment.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt16, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.archive import Archive, ReachedStates, choose, insert, new_archive, visit
from levelproof.experts.search.cells import features
from levelproof.experts.search.config import SearchConfig, StopLimits
from levelproof.experts.search.near import FAR, gap, goals_of
from levelproof.experts.search.play import CODES, Arena, Walk, arena, best_lane, decode, most_steps, play
from levelproof.experts.search.rows import from_rows, to_rows
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.programs import jit_sooner, jit_stored
from levelproof.levelgen.task.rules import TaskParams

LEAST_PATIENCE = 0.25  # share of the patience that is left however wide the gap is
NEARER = 0.98  # the gap must shrink to this share of the smallest so far to count as progress


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Search:
    """State of the search, level axis first, except in `levels`."""

    levels: Level  # lane axis last
    level_ids: Int[Array, " level"]  # seeds of all randomness
    archive: Archive
    env_steps: Int[Array, " level"]  # of all lanes
    grew: Int[Array, " level"]  # env steps when the last cell entered the archive
    gap: Float[Array, " level"]  # m, smallest gap between green and blue so far
    closed: Int[Array, " level"]  # env steps when the gap last shrank
    code: UInt16[Array, "level step"]  # codes of the success's actions
    length: Int[Array, " level"]  # of the success, env steps; 0: none


class RoundDraws(NamedTuple):
    """Random draws of one level's round."""

    choice: Float[Array, "3 lane"]  # uniform, to choose an archive entry
    new_action: Bool[Array, " lane"]  # whether a lane starts with a new action instead of the entry's last one
    code: UInt16[Array, " lane"]  # code of that action
    bits: UInt32[Array, "segment time 6 lane"]  # bits for the actions that follow


@jit_sooner(static_argnames=("config", "rules"))
def begin(levels: Level, level_ids: Int[Array, " level"], config: SearchConfig, rules: TaskParams) -> Search:
    """Start a search: archives contain the levels' first states alone.

    Args:
        levels: the levels, lane axis last.
        level_ids: their ids, the seeds of all randomness.
        config: settings of the search.
        rules: the task's rules.
    """
    count, room = len(level_ids), -(-most_steps(rules) // config.segment) * config.segment
    one = lambda x: x[:, None]
    start = ReachedStates(
        one(features(levels, levels.state, config)),
        one(to_rows(levels.state)),
        jnp.zeros((count, 1, room), jnp.uint16),
        jnp.zeros((count, 1), jnp.int32),
        one(gap(goals_of(levels), levels.state)),
    )
    none, code = jnp.zeros(count, jnp.int32), jnp.zeros((count, room), jnp.uint16)
    apart = jnp.nan_to_num(start.distance[:, 0], nan=FAR)  # NaN: the world is broken from its start
    return Search(levels, level_ids, new_archive(start, config), none, none, apart, none, code, none)


def explore(search: Search, config: SearchConfig, rules: TaskParams) -> Search:
    """Search for `config.rounds` rounds; donates `search`. Levels that are done stay unchanged."""
    return explore_rounds(search, config.ends, config.endless, rules)


@jit_stored(static_argnames=("config", "rules"), donate_argnames="search")
def explore_rounds(search: Search, ends: StopLimits, config: SearchConfig, rules: TaskParams) -> Search:
    ring = arena(search.levels, config.lanes, config.resample)
    step = lambda search, _: (explore_round(search, ring, ends, config, rules), None)
    return jax.lax.scan(step, search, length=config.rounds)[0]


def explore_round(search: Search, ring: Arena, ends: StopLimits, config: SearchConfig, rules: TaskParams) -> Search:
    """Search for one round; `ring` has the levels' lanes."""
    active = under_way(search, ends)
    chance = jax.vmap(partial(draw, config=config))(search.level_ids, search.env_steps)
    bits = jnp.moveaxis(chance.bits, 0, 3).reshape(config.segments, config.segment, ACTIONS, -1)
    chosen = choose(search.archive, chance.choice, config)
    walk, code = back_to(search, chosen)
    drawn = jnp.where(ring.live, decode(chance.code.reshape(-1)), 0)
    walk = walk._replace(action=jnp.where(chance.new_action.reshape(-1), drawn, walk.action))

    def one(carry: tuple[Archive, Walk, Array, Array], bits: Array) -> tuple[tuple, None]:
        archive, walk, code, least = carry
        before = walk.timestep
        walk, played = play(ring, walk, bits, rules)
        code = written(code, played, before // config.segment)
        states, valid = reached_by(walk, code, ring, config)
        archive = insert(archive, states, valid & active[:, None], config)
        least = jnp.minimum(least, jnp.where(valid, states.distance, jnp.inf).min(-1))
        return (archive, walk, code, least), None

    carry = visit(search.archive, chosen, active), walk, code, search.gap
    archive, walk, code, least = jax.lax.scan(one, carry, bits)[0]
    closer = active & (least < NEARER * search.gap)

    env_steps = search.env_steps + jnp.where(active, config.steps_per_round, 0)
    code, length = with_success(search.code, search.length, walk, code, active)
    return Search(
        levels=search.levels,
        level_ids=search.level_ids,
        archive=archive,
        env_steps=env_steps,
        grew=jnp.where(archive.cells > search.archive.cells, env_steps, search.grew),
        gap=jnp.where(closer, least, search.gap),
        closed=jnp.where(closer, env_steps, search.closed),
        code=code,
        length=length,
    )


def under_way(search: Search, ends: StopLimits) -> Bool[Array, " level"]:
    """Mark the levels whose search continues.

    These have no success, have env steps left, are not at a rung with too few cells, and have lately come nearer to
    the goal. A level with few cells is hopeless: its episodes end at once, or its actuators move little. And the
    longer the gap has not shrunk, the less a search finds (docs/tried/variations.md).
    """
    going = (search.length == 0) & (search.env_steps < ends.env_steps)
    at_rung = (search.env_steps[:, None] == ends.rungs).any(-1)
    least = -(-search.env_steps // jnp.maximum(ends.per_cell, 1))  # rounded up, without overflow of 32 bits
    few = at_rung & (search.archive.cells < least) & (ends.per_cell > 0)
    return going & ~few & patient(search.env_steps - search.closed, search.gap, ends.patience, ends)


def patient(
    waited: Int[Array, " level"], gap: Float[Array, " level"], patience: Int[Array, ""], ends: StopLimits
) -> Bool[Array, " level"]:
    """Return whether levels continue after `waited` env steps without progress; always if `patience` is 0.

    A level leaves sooner the wider its smallest gap so far, because then it is less likely to be solved
    (docs/tried/patience.md).
    """
    falls = ends.patience_gap > 0
    share = jnp.where(falls, jnp.clip(ends.patience_gap / gap, LEAST_PATIENCE, 1.0), 1.0)  # a gap of 0: 1
    return (waited < patience * share) | (patience == 0)


def draw(level_id: Int[Array, ""], env_steps: Int[Array, ""], config: SearchConfig) -> RoundDraws:
    """Draw all random numbers of one level's round."""
    one, other = jax.random.split(jax.random.fold_in(key_for(level_id, Stream.SEARCH), env_steps))
    uniform = jax.random.uniform(one, (5, config.lanes))
    bits = jax.random.bits(other, (config.segments, config.segment, ACTIONS, config.lanes))
    return RoundDraws(uniform[:3], uniform[3] < config.new_action, (uniform[4] * CODES).astype(jnp.uint16), bits)


def back_to(search: Search, chosen: Int[Array, "level lane"]) -> tuple[Walk, UInt16[Array, "lane step"]]:
    """Return every lane to the state of its chosen entry, with the actions that lead there."""
    level, entry = jnp.arange(len(chosen))[:, None], search.archive.entry
    by_lane = lambda x: x[level, chosen].reshape(chosen.size, *x.shape[2:])
    code, steps = by_lane(entry.code), by_lane(entry.steps)
    last = jnp.where(steps > 0, code[jnp.arange(len(code)), jnp.maximum(steps - 1, 0)], 0)
    none = jnp.zeros(len(steps), jnp.int32)
    return Walk(
        from_rows(by_lane(entry.state), search.levels.state), decode(last), steps, none, none.astype(bool)
    ), code


def written(
    code: UInt16[Array, "lane step"], played: UInt16[Array, "time lane"], segment: Int[Array, " lane"]
) -> UInt16[Array, "lane step"]:
    """Write the played actions into each lane's segment of this index."""
    segments = code.reshape(len(code), -1, len(played))
    now = jnp.arange(segments.shape[1]) == segment[:, None]
    return jnp.where(now[:, :, None], played.T[:, None], segments).reshape(code.shape)


def reached_by(
    walk: Walk, code: UInt16[Array, "lane step"], ring: Arena, config: SearchConfig
) -> tuple[ReachedStates, Bool[Array, "level lane"]]:
    """Return the states of lanes, by level, and which of their episodes continue."""
    by_level = lambda x: x.reshape(-1, config.lanes, *x.shape[1:])
    states = ReachedStates(
        feature=features(ring.lanes, walk.state, config),
        state=to_rows(walk.state),
        code=code,
        steps=walk.timestep,
        distance=gap(ring.goals, walk.state),
    )
    return jax.tree.map(by_level, states), by_level(~walk.ended)


def with_success(
    code: UInt16[Array, "level step"],
    length: Int[Array, " level"],
    walk: Walk,
    played: UInt16[Array, "lane step"],
    active: Bool[Array, " level"],
) -> tuple[UInt16[Array, "level step"], Int[Array, " level"]]:
    """Take the shortest success among each level's lanes, if there is one; return codes and lengths."""
    steps = jnp.where(walk.reached > 0, walk.reached, RECORD_STEPS + 1).reshape(len(active), -1)
    won = active & (steps.min(-1) <= RECORD_STEPS)
    return best_lane(won, jnp.argmin(steps, axis=-1), (played.reshape(*steps.shape, -1), steps), (code, length))

"""The search of some levels side by side. Each round, every lane returns to a state of its level's archive, plays
some segments from there, and after each puts what it came to into the archive.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt16, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.archive import Archive, ReachedStates, choose, insert, new_archive, visit
from levelproof.experts.search.cells import features
from levelproof.experts.search.config import SearchConfig, StopLimits
from levelproof.experts.search.near import FAR, gap, goals_of
from levelproof.experts.search.play import CODES, Arena, Walk, arena, decode, most_steps, play
from levelproof.experts.search.rows import from_rows, to_rows
from levelproof.experts.witness.success import Success
from levelproof.levelgen.identity.keys import Stream, key_for
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task.rules import TaskParams

NEARER = 0.98  # of the least gap: what shrinks it less does not count


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Search:
    """Levels under search. The level axis is first, but for the levels themselves."""

    levels: Level  # lane axis last
    key: Key[Array, " level"]  # of the search's random stream
    archive: Archive
    env_steps: Int[Array, " level"]  # of all lanes
    grew: Int[Array, " level"]  # env steps when the last cell entered the archive
    gap: Float[Array, " level"]  # m, the least one of green and blue so far
    closed: Int[Array, " level"]  # env steps when it last shrank
    code: UInt16[Array, "level step"]  # actions of the success, each as one number
    length: Int[Array, " level"]  # of the success, env steps; 0: there is none


class RoundDraws(NamedTuple):
    """Random numbers of one level's round."""

    choice: Float[Array, "3 lane"]  # of an entry of the archive
    anew: Bool[Array, " lane"]  # whether a lane starts with an action of its own, not with the last one of the entry
    code: UInt16[Array, " lane"]  # which
    bits: UInt32[Array, "stretch time 6 lane"]  # what it does then


@partial(jax.jit, static_argnames=("config", "rules"))
def begin(levels: Level, level_ids: Int[Array, " level"], config: SearchConfig, rules: TaskParams) -> Search:
    """Levels of which nothing but the start is known.

    Args:
        levels: lane axis last.
        level_ids: their ids, the seeds of all randomness.
        config: how they are searched.
        rules: of the task.
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
    key = jax.vmap(lambda level_id: key_for(level_id, Stream.SEARCH))(level_ids)
    none, code = jnp.zeros(count, jnp.int32), jnp.zeros((count, room), jnp.uint16)
    apart = jnp.nan_to_num(start.distance[:, 0], nan=FAR)  # of a world that is broken from the start
    return Search(levels, key, new_archive(start, config), none, none, apart, none, code, none)


def explore(search: Search, config: SearchConfig, rules: TaskParams) -> Search:
    """`config.rounds` rounds, after which `search` is used up. Levels that have a success, or have had their env steps,
    stay as they are."""
    return _explore(search, config.ends, config.endless, rules)


@partial(jax.jit, static_argnames=("config", "rules"), donate_argnames="search")
def _explore(search: Search, ends: StopLimits, config: SearchConfig, rules: TaskParams) -> Search:
    ring = arena(search.levels, config.lanes, config.redrawn)
    step = lambda search, _: (explore_round(search, ring, ends, config, rules), None)
    return jax.lax.scan(step, search, length=config.rounds)[0]


def explore_round(search: Search, ring: Arena, ends: StopLimits, config: SearchConfig, rules: TaskParams) -> Search:
    """One round; `ring` has the levels' lanes."""
    active = under_way(search, ends)
    chance = jax.vmap(partial(draw, config=config))(search.key, search.env_steps)
    bits = jnp.moveaxis(chance.bits, 0, 3).reshape(config.stretch, config.segment, ACTIONS, -1)
    chosen = choose(search.archive, chance.choice, config)
    walk, code = back_to(search, chosen)
    drawn = jnp.where(ring.live, decode(chance.code.reshape(-1)), 0)
    walk = walk._replace(action=jnp.where(chance.anew.reshape(-1), drawn, walk.action))

    def one(carry: tuple[Archive, Walk, Array, Array], bits: Array) -> tuple[tuple, None]:
        archive, walk, code, least = carry
        before = walk.timestep
        walk, played = play(ring, walk, bits, rules)
        code = written(code, played, before // config.segment)
        come, valid = reached_by(walk, code, ring, config)
        archive = insert(archive, come, valid & active[:, None], config)
        least = jnp.minimum(least, jnp.where(valid, come.distance, jnp.inf).min(-1))
        return (archive, walk, code, least), None

    carry = visit(search.archive, chosen, active), walk, code, search.gap
    archive, walk, code, least = jax.lax.scan(one, carry, bits)[0]
    closer = active & (least < NEARER * search.gap)

    env_steps = search.env_steps + jnp.where(active, config.steps_per_round, 0)
    code, length = with_success(search.code, search.length, walk, code, active, rules)
    return Search(
        levels=search.levels,
        key=search.key,
        archive=archive,
        env_steps=env_steps,
        grew=jnp.where(archive.cells > search.archive.cells, env_steps, search.grew),
        gap=jnp.where(closer, least, search.gap),
        closed=jnp.where(closer, env_steps, search.closed),
        code=code,
        length=length,
    )


def under_way(search: Search, ends: StopLimits) -> Bool[Array, " level"]:
    """Levels without a success that have env steps left, are not at a rung with too few cells, and have lately come
    nearer to the goal.

    Where next to nothing is reached, nothing will be: the world ends at once, or what acts moves little in it. And the
    longer green and blue have come no nearer to each other, the less a search finds (docs/tried/variations.md).
    """
    going = (search.length == 0) & (search.env_steps < ends.env_steps)
    at_rung = (search.env_steps[:, None] == ends.rungs).any(-1)
    least = -(-search.env_steps // jnp.maximum(ends.per_cell, 1))  # rounded up; nothing here outgrows 32 bits
    few = at_rung & (search.archive.cells < least) & (ends.per_cell > 0)
    return going & ~few & patient(search.env_steps - search.closed, ends.patience)


def patient(waited: Int[Array, " level"], patience: Int[Array, ""]) -> Bool[Array, " level"]:
    """Whether levels go on that have come no nearer to the goal for so many env steps; always where patience is 0."""
    return (waited < patience) | (patience == 0)


def draw(key: Key[Array, ""], env_steps: Int[Array, ""], config: SearchConfig) -> RoundDraws:
    """All the chance in one level's round."""
    one, other = jax.random.split(jax.random.fold_in(key, env_steps))
    uniform = jax.random.uniform(one, (5, config.lanes))
    bits = jax.random.bits(other, (config.stretch, config.segment, ACTIONS, config.lanes))
    return RoundDraws(uniform[:3], uniform[3] < config.anew, (uniform[4] * CODES).astype(jnp.uint16), bits)


def back_to(search: Search, chosen: Int[Array, "level lane"]) -> tuple[Walk, UInt16[Array, "lane step"]]:
    """Every lane in the state of the entry it has chosen, and the actions that lead there."""
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
    """The actions with these in the lane's segment of this number."""
    segments = code.reshape(len(code), -1, len(played))
    now = jnp.arange(segments.shape[1]) == segment[:, None]
    return jnp.where(now[:, :, None], played.T[:, None], segments).reshape(code.shape)


def reached_by(
    walk: Walk, code: UInt16[Array, "lane step"], ring: Arena, config: SearchConfig
) -> tuple[ReachedStates, Bool[Array, "level lane"]]:
    """Where lanes are, by level, and which of them may go on."""
    by_level = lambda x: x.reshape(-1, config.lanes, *x.shape[1:])
    come = ReachedStates(
        feature=features(ring.lanes, walk.state, config),
        state=to_rows(walk.state),
        code=code,
        steps=walk.timestep,
        distance=gap(ring.goals, walk.state),
    )
    return jax.tree.map(by_level, come), by_level(~walk.ended)


def with_success(
    code: UInt16[Array, "level step"],
    length: Int[Array, " level"],
    walk: Walk,
    played: UInt16[Array, "lane step"],
    active: Bool[Array, " level"],
    rules: TaskParams,
) -> tuple[UInt16[Array, "level step"], Int[Array, " level"]]:
    """Actions of each level's success, and their number: the shortest one of its lanes, where one is in time."""
    in_time = (walk.reached > 0) & (walk.reached <= most_steps(rules))
    steps = jnp.where(in_time, walk.reached, RECORD_STEPS + 1).reshape(len(active), -1)
    level, lane = jnp.arange(len(active)), jnp.argmin(steps, axis=-1)
    won = active & (steps[level, lane] <= RECORD_STEPS)
    best = played.reshape(*steps.shape, -1)[level, lane]
    return jnp.where(won[:, None], best, code), jnp.where(won, steps[level, lane], length)


def success_of(code: UInt16[Array, "level step"], length: Int[Array, " level"]) -> Success:
    """What was found, level first."""
    code = jnp.pad(code, [(0, 0), (0, max(0, RECORD_STEPS - code.shape[1]))])[:, :RECORD_STEPS]
    action = decode(jnp.where(jnp.arange(RECORD_STEPS) < length[:, None], code, 0))
    return Success(jnp.moveaxis(action, 0, -1).astype(jnp.int8), length)

"""Random play at nearly the speed of bare physics: no reward, no goal distance, no observation.

Episodes end, and reach the goal, exactly as in `levelgen.task.rules.advance`.
"""

import math
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt16, UInt32

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.search.near import Goals, goals_of
from levelproof.experts.witness.success import Success
from levelproof.levelgen.batching import repeat
from levelproof.levelgen.level import ACTIONS, Level, Role
from levelproof.levelgen.task.actions import CHOICES, action_mask, controls
from levelproof.levelgen.task.rules import TaskParams, has_nan, has_roles
from levelproof.physics.pairs import pairs_of
from levelproof.physics.step import step
from levelproof.physics.types import State

CODES = math.prod(CHOICES)  # number of actions
UNROLLED = 8  # maximum physics steps per env step that the program unrolls; more run in a loop
T = TypeVar("T")


def _without() -> UInt16[np.ndarray, "entries code"]:
    """Tabulate each action with some entries set to 0: those whose bit is set in the first index."""
    entry, code = np.array(np.unravel_index(np.arange(CODES), CHOICES)), np.empty((1 << ACTIONS, CODES), np.uint16)
    for entries in range(1 << ACTIONS):
        zero = (entries >> np.arange(ACTIONS)) & 1 == 1
        code[entries] = np.ravel_multi_index(tuple(np.where(zero[:, None], 0, entry)), CHOICES)
    return code


WITHOUT = _without()


class Arena(NamedTuple):
    """Constants of lanes that play."""

    lanes: Level  # each level in neighbouring lanes
    live: Bool[Array, "6 lane"]  # entries of an action that can have an effect
    blue: Bool[Array, "contact lane"]  # contacts that reach the goal
    red: Bool[Array, "contact lane"]  # contacts that end the episode without success
    goals: Goals  # pairs of bodies whose gap measures the distance to the goal
    resample: Float[Array, " lane"]  # probability of resampling an entry of the action, per env step


class Walk(NamedTuple):
    """Episodes of lanes. One that has ended is still simulated, without effect."""

    state: State
    action: Int[Array, "6 lane"]  # last action
    timestep: Int[Array, " lane"]  # env steps since the level's start
    reached: Int[Array, " lane"]  # env steps until the goal; 0: not reached
    ended: Bool[Array, " lane"]  # whether the episode is over


def most_steps(rules: TaskParams) -> int:
    """Return the env steps within which the goal must be reached: the length of an episode or of a record."""
    return min(RECORD_STEPS, rules.max_timesteps)


def arena(levels: Level, lanes: int, resample: tuple[float, ...]) -> Arena:
    """Spread each level over `lanes` neighbouring lanes, an equal share for each probability in `resample`."""
    count = levels.role.shape[-1]
    spread = repeat(levels, lanes)
    chance = jnp.tile(jnp.repeat(jnp.array(resample, jnp.float32), lanes // len(resample)), count)
    touching = contacts(spread, Role.BLUE), contacts(spread, Role.RED)
    return Arena(spread, action_mask(spread), *touching, goals_of(spread), chance)


def contacts(level: Level, second: Role) -> Bool[Array, "contact lane"]:
    """Return which contacts join green and this role, as `levelgen.task.rules.touches` counts them."""
    pairs = pairs_of(level.size)
    joins = lambda pair: has_roles(level, pair.a, pair.b, Role.GREEN, second)
    polygon = joins(pairs.polygon)
    return jnp.concatenate([polygon, jnp.zeros_like(polygon), joins(pairs.circle_polygon), joins(pairs.circle)])


def fresh_walk(lanes: Level) -> Walk:
    """Start every lane at its level's first state."""
    zeros = jnp.zeros(lanes.state.rotation.shape[-1], jnp.int32)
    return Walk(lanes.state, jnp.zeros((ACTIONS, len(zeros)), jnp.int32), zeros, zeros, zeros.astype(bool))


def play(
    arena: Arena, walk: Walk, bits: UInt32[Array, "time 6 lane"], rules: TaskParams
) -> tuple[Walk, UInt16[Array, "time lane"]]:
    """Play an env step per row of random bits; return the walk and the codes of its actions."""

    def one(walk: Walk, bits: UInt32[Array, "6 lane"]) -> tuple[Walk, UInt16[Array, " lane"]]:
        action = persistent(walk.action, bits, arena)
        return act(arena, walk, action, rules), encode(action)

    return jax.lax.scan(one, walk, bits)


def persistent(action: Int[Array, "6 lane"], bits: UInt32[Array, "6 lane"], arena: Arena) -> Int[Array, "6 lane"]:
    """Resample some entries of the action; one random number per entry decides both whether and to which choice."""
    choices = jnp.array(CHOICES, jnp.float32)[:, None]
    uniform = (bits >> 8).astype(jnp.float32) * 2.0**-24
    drawn = jnp.minimum(uniform / arena.resample * choices, choices - 1).astype(jnp.int32)
    return jnp.where((uniform < arena.resample) & arena.live, drawn, action)


def act(arena: Arena, walk: Walk, action: Int[Array, "6 lane"], rules: TaskParams) -> Walk:
    """Advance all lanes by one env step."""
    state, reached, ended, timestep = walk.state, walk.reached, walk.ended, walk.timestep + 1
    driven = controls(arena.lanes, action)

    def frame(_: Any, now: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
        state, reached, ended = now
        state = step(arena.lanes.model, state, *driven, rules.physics, with_contacts=False)[0]
        fail = (arena.red & state.contact_active).any(0)
        goal = (arena.blue & state.contact_active).any(0) & ~fail
        return state, jnp.where(goal & ~ended, timestep, reached), ended | fail | goal

    now = state, reached, ended
    if rules.frame_skip <= UNROLLED:
        for i in range(rules.frame_skip):
            now = frame(i, now)
    else:
        now = jax.lax.fori_loop(0, rules.frame_skip, frame, now)
    state, reached, ended = now
    ended = ended | (timestep >= most_steps(rules)) | has_nan(state)
    return Walk(state, action, timestep, reached, ended)


def encode(action: Int[Array, "6 *lane"]) -> UInt16[Array, "*lane"]:
    """Encode an action as an integer below CODES."""
    code = jnp.zeros(action.shape[1:], jnp.int32)
    for entry, choices in zip(action, CHOICES, strict=True):
        code = code * choices + entry
    return code.astype(jnp.uint16)


def decode(code: UInt16[Array, "*lane"]) -> Int[Array, "6 *lane"]:
    """Decode an action."""
    entries, rest = [], code.astype(jnp.int32)
    for choices in reversed(CHOICES):
        rest, entry = jnp.divmod(rest, choices)
        entries.append(entry)
    return jnp.stack(entries[::-1])


def code_of(success: Success) -> UInt16[Array, "level 256"]:
    """Encode the actions of successes."""
    return encode(jnp.moveaxis(success.action, -1, 0))


def success_of(code: UInt16[Array, "level step"], length: Int[Array, " level"]) -> Success:
    """Decode successes, level first."""
    code = jnp.pad(code, [(0, 0), (0, max(0, RECORD_STEPS - code.shape[1]))])[:, :RECORD_STEPS]
    action = decode(jnp.where(jnp.arange(RECORD_STEPS) < length[:, None], code, 0))
    return Success(jnp.moveaxis(action, 0, -1).astype(jnp.int8), length)


def best_lane(better: Bool[Array, " level"], lane: Int[Array, " level"], new: T, old: T) -> T:
    """Replace each level's old results by those of one lane in `new`, [level, lane, ...], where `better`."""
    take = lambda new, old: jnp.where(better.reshape(-1, *[1] * (old.ndim - 1)), new[jnp.arange(len(lane)), lane], old)
    return jax.tree.map(take, new, old)

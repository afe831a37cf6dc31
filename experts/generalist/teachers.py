"""Teachers of one policy for all levels: they play on from any state, and only an attempt that replays is a label.

A level's expert is asked first. If it does not reach the goal from a state in the env steps that its episode has left,
a short search follows: variations of the level's witness, sticky random actions, and further attempts of the learner.
All start in exactly that state, impulses included. The shortest success is replayed from there before it counts.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, Key

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.evaluation import Moment, Player, evenly, play_sampled, play_sticky
from levelproof.experts.imitation import to_motion
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.experts.policy import Params, forward, network_of, sample
from levelproof.levelgen.batching import blocks, repeat, take
from levelproof.levelgen.level import ACTIONS, Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.observe.flat import state_features
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.physics.bounds import require

AT_ONCE = 64  # states that teachers are asked about side by side
MAX_SHIFT = 16  # env steps by which a variation of a witness may run ahead or behind
MAX_NOISE = 0.2  # largest probability that a variation of a witness draws an entry evenly


@dataclass(frozen=True)
class TeachersConfig:
    """How often each teacher tries to reach the goal from a state (0: it is not asked), and noise of demonstrations."""

    expert: int = 4  # attempts of the level's expert from a state, if the split kept experts; 0: it is not asked
    witness: int = 16  # attempts of a search from a state that vary the level's witness
    random: int = 32  # attempts of a search from a state by sticky random actions
    learner: int = 4  # attempts of a search from a state by the learner itself
    sticky: float = 0.5  # share of demonstrations in which the action executed last sometimes replaces the expert's
    perturbed: float = 0.5  # share of demonstrations that start with perturbed velocities, drawn independently

    def __post_init__(self) -> None:
        require(self, ("sticky", "perturbed"), 0, 1)
        require(self, ("expert", "witness", "random", "learner"), 0, 4096)
        if not (self.expert or self.searches):
            raise ValueError("expert, witness, random and learner are all 0: let at least one of them teach")

    @property
    def searches(self) -> bool:
        """Whether a search follows where there is no expert, or where it fails."""
        return bool(self.witness + self.random + self.learner)


class Teacher(IntEnum):
    """Whose attempt labels a state."""

    NONE = 0  # no attempt reached the goal: no label
    EXPERT = 1
    WITNESS = 2
    RANDOM = 3
    LEARNER = 4


class Asked(NamedTuple):
    """States of the learner's episodes, one per lane, for teachers to label."""

    level: Level
    now: TaskState
    witness: Int8[Array | np.ndarray, "256 6 lane"]  # actions of the level's witness; the last one is repeated


class Found(NamedTuple):
    """The shortest of a teacher's attempts from each state that reached the goal."""

    action: Int8[Array | np.ndarray, "256 6 state"]  # from the state on; meaningless after `length`
    length: Int[Array | np.ndarray, " state"]  # env steps; 0: none reached the goal


class Labels(NamedTuple):
    """What teachers do in the states that they were asked about, or demonstrate, on the host.

    An answer replays to the goal. A demonstration has what its expert chose, whether or not that was executed.
    """

    teacher: Int[np.ndarray, " state"]  # Teacher
    length: Int[np.ndarray, " state"]  # env steps from the state to the goal; 0: no label
    action: Int8[Array | np.ndarray, "256 6 state"]  # from the state on
    motion: Float[np.ndarray, "256 state column"]  # of the states on the way (`experts.imitation.Transitions`)
    env_steps: int  # that the teachers played


class Recalled(NamedTuple):
    """A witness to vary, in equally many lanes per state."""

    action: Int8[Array, "256 6 state"]
    shift: Int[Array, " lane"]  # env steps by which the lane runs ahead
    noise: Float[Array, " lane"]  # probability that an entry is drawn evenly


class _Trying(NamedTuple):
    """Attempts under way; `best` is the first attempt of each state that reached the goal."""

    step: Int[Array, ""]
    now: TaskState
    previous: Int[Array, "6 lane"]
    ended: Bool[Array, " lane"]
    best: Int[Array, " state"]
    length: Int[Array, " state"]
    action: Int8[Array, "256 6 lane"]
    env_steps: Int[Array, " state"]


@lru_cache(maxsize=4)
def play_expert(config: ExpertConfig) -> Player:
    """Return the player that samples from experts of single levels; its parameters are one expert's per state."""

    def act(params: Params, moment: Moment) -> Int[Array, "6 lane"]:
        network = network_of(moment.level.size, config)
        lanes, states = moment.uniform.shape[-1], len(jax.tree.leaves(params)[0])
        constant = network.constant(jax.tree.map(lambda x: x[..., :: lanes // states], moment.level))
        moving = state_features(moment.level, moment.now.state).reshape(-1, states, lanes // states)
        logits = lambda *one: forward(network, *one)[0]
        each = jax.vmap(logits, in_axes=(0, -1, 1), out_axes=1)(params, constant, moving)
        return sample(each.reshape(-1, lanes), moment.uniform)

    return act


def play_varied(params: Recalled, moment: Moment) -> Int[Array, "6 lane"]:
    """Take the witness's action at the episode's env step, shifted by `shift`; draw entries evenly with `noise`."""
    lanes, states = moment.uniform.shape[-1], params.action.shape[-1]
    step = jnp.clip(moment.now.timestep + params.shift, 0, RECORD_STEPS - 1)
    recalled = params.action[step, :, jnp.arange(lanes) // (lanes // states)].T.astype(jnp.int32)
    drawn = evenly(moment.uniform / jnp.maximum(params.noise, jnp.finfo(jnp.float32).tiny))
    return jnp.where(moment.uniform < params.noise, drawn, recalled)


def recalled(witness: Int8[Array | np.ndarray, "256 6 state"], attempts: int) -> Recalled:
    """Return variations of witnesses: the first attempt is unchanged, others are ever noisier, some shifted."""
    number = np.tile(np.arange(attempts), witness.shape[-1])
    spread = (number // 2 * 7) % (2 * MAX_SHIFT + 1) - MAX_SHIFT
    shift = np.where(number % 2, spread, 0)
    noise = MAX_NOISE * number / attempts
    return Recalled(witness, shift.astype(np.int32), noise.astype(np.float32))  # pyright: ignore[reportArgumentType]


@partial(jax.jit, static_argnames=("player", "attempts", "rules"))
def attempt_from(
    player: Player, params: Any, level: Level, now: TaskState, keys: Key[Array, " state"], attempts: int,
    rules: TaskParams,
) -> tuple[Found, Int[Array, " state"]]:  # fmt: skip
    """Play `attempts` continuations of each state, until one reaches the goal or the episode runs out of env steps.

    Args:
        player: chooses actions.
        params: the player's parameters.
        level: the level of each state.
        now: the states.
        keys: one per state; consumed.
        attempts: lanes of a state, which are neighbours.
        rules: the task's rules.

    Returns:
        The shortest success from each state, and the env steps of its attempts.
    """
    states = len(keys)
    level, now = repeat((level, now), attempts)
    live, none = action_mask(level), jnp.zeros(states, jnp.int32)
    lanes = states * attempts
    by_state = lambda x: x.reshape(states, attempts)

    def uniform(number: Array) -> Float[Array, "6 lane"]:
        draw = lambda key: jax.random.uniform(jax.random.fold_in(key, number), (ACTIONS, attempts))
        return jax.vmap(draw, out_axes=1)(keys).reshape(ACTIONS, lanes)

    def act(trying: _Trying) -> _Trying:
        moment = Moment(level, trying.now, trying.previous, uniform(trying.step))
        action = jnp.where(live, player(params, moment), 0)
        after, result = task.advance(level, trying.now, action, rules)
        goal = by_state(result.goal & ~trying.ended)
        first = goal.any(1) & (trying.length == 0)
        over = result.done | (after.timestep >= RECORD_STEPS) | jnp.repeat(first, attempts)
        return _Trying(
            trying.step + 1,
            after,
            action,
            trying.ended | over,
            jnp.where(first, jnp.argmax(goal, 1), trying.best),
            jnp.where(first, trying.step + 1, trying.length),
            jax.lax.dynamic_update_index_in_dim(trying.action, action.astype(jnp.int8), trying.step, 0),
            trying.env_steps + by_state(~trying.ended).sum(1),
        )

    taken = jnp.zeros((RECORD_STEPS, ACTIONS, lanes), jnp.int8)
    previous = jnp.where(live, evenly(uniform(jnp.int32(RECORD_STEPS))), 0)  # sticky actions repeat none of the learner
    begun = _Trying(
        jnp.int32(0), now, previous, now.timestep >= RECORD_STEPS, none, none, taken, none
    )  # fmt: skip
    end = jax.lax.while_loop(lambda trying: ~trying.ended.all() & (trying.step < RECORD_STEPS), act, begun)
    best = jnp.arange(states) * attempts + end.best
    return Found(end.action[..., best], end.length), end.env_steps


@partial(jax.jit, static_argnames=("contacts", "rules"))
def replay_from(
    level: Level, now: TaskState, found: Found, contacts: bool, rules: TaskParams
) -> tuple[Bool[Array, " state"], Float[Array, "256 state column"]]:
    """Replay successes from their states.

    Args:
        level: the level of each state.
        now: the states.
        found: the successes.
        contacts: whether to return contacts, too.
        rules: the task's rules.

    Returns:
        Whether the goal is reached in env step `length` and the episode does not end before, and what moves before
        each action.
    """

    def act(carry: tuple[TaskState, Array], step: tuple[Array, Array]) -> tuple[tuple[TaskState, Array], Array]:
        (now, right), (action, number) = carry, step
        after, result = task.advance(level, now, action.astype(jnp.int32), rules)
        last = number == found.length - 1
        agrees = (number >= found.length) | ((result.done == last) & (result.goal == last))
        return (after, right & agrees), to_motion(now.state, contacts)

    given = jnp.asarray(found.action), jnp.arange(RECORD_STEPS)
    (_, right), motion = jax.lax.scan(act, (now, jnp.asarray(found.length) > 0), given)
    return right, motion


class KnownExperts(NamedTuple):
    """Experts of single levels."""

    config: ExpertConfig | None  # their settings; None: there are none
    params: Any  # expert axis first, on the host
    expert: Int[np.ndarray, " level"]  # row of each level's expert; -1: none

    def of(self, levels: Int[np.ndarray, " state"]) -> "KnownExperts":
        """Return the experts of states in these levels."""
        return self._replace(expert=self.expert[levels])


def no_experts(levels: int) -> KnownExperts:
    """Return a `KnownExperts` without an expert for any of `levels` levels."""
    return KnownExperts(None, None, np.full(levels, -1))


def label_states(
    asked: Asked, known: KnownExperts, learner: Any, network: NetworkConfig, config: TeachersConfig,
    key: Key[Array, ""], rules: TaskParams,
) -> Labels:  # fmt: skip
    """Ask the teachers about states: the experts first, a search where they fail; keep what replays to the goal.

    Args:
        asked: the states, on the host.
        known: the experts of these states' levels.
        learner: parameters of the learner.
        network: the learner's network.
        config: how often each teacher tries.
        key: consumed.
        rules: the task's rules.
    """
    teacher, env_steps = np.zeros(len(known.expert), np.int32), 0
    best = Found(np.zeros(asked.witness.shape, np.int8), np.zeros(len(teacher), np.int32))
    asks = {
        Teacher.EXPERT: (known.config and play_expert(known.config), config.expert),
        Teacher.WITNESS: (play_varied, config.witness),
        Teacher.RANDOM: (play_sticky, config.random),
        Teacher.LEARNER: (play_sampled(network), config.learner),
    }
    for number, (player, attempts) in asks.items():
        usable = np.flatnonzero(known.expert >= 0 if number == Teacher.EXPERT else teacher != Teacher.EXPERT)
        if not player or not attempts:
            continue
        keys = jax.random.split(jax.random.fold_in(key, number), len(teacher))
        for block in blocks(len(usable), AT_ONCE):
            states, own = usable[block], len(np.unique(block))  # `own`: without padding
            now = take(asked, states)
            params = _params_of(number, now, known, learner, states, attempts)
            new, played = jax.device_get(
                attempt_from(player, params, now.level, now.now, keys[states], attempts, rules)
            )
            old = best.length[states]
            better = (new.length > 0) & ((old == 0) | (new.length < old))
            teacher[states[better]], env_steps = number, env_steps + int(played[:own].sum())
            best.length[states[better]], best.action[..., states[better]] = new.length[better], new.action[..., better]
    return _proven(asked, teacher, best, env_steps, network.reads_contacts, rules)


def _params_of(
    teacher: Teacher, asked: Asked, known: KnownExperts, learner: Any, states: Int[np.ndarray, " state"], attempts: int
) -> Any:
    """Return the parameters of a teacher's player in some states."""
    match teacher:
        case Teacher.EXPERT:
            return jax.tree.map(lambda x: x[known.expert[states]], known.params)
        case Teacher.WITNESS:
            return recalled(asked.witness, attempts)
        case Teacher.LEARNER:
            return learner
    return None


def _proven(
    asked: Asked, teacher: Int[np.ndarray, " state"], best: Found, env_steps: int, contacts: bool, rules: TaskParams
) -> Labels:
    """Replay successes from their states; those that do not reach the goal again label nothing."""
    right, motion = [], []
    for block in blocks(len(teacher), AT_ONCE):
        of_block = jax.device_get(replay_from(*take((asked.level, asked.now, best), block), contacts, rules))
        right.append(of_block[0])
        motion.append(of_block[1])
    count = len(teacher)
    reaches = np.concatenate(right)[:count]
    keep = lambda x: np.where(reaches, x, 0)
    return Labels(keep(teacher), keep(best.length), best.action, np.concatenate(motion, 1)[:, :count], env_steps)

"""Teachers of one policy for all levels, which play on from any state.

Only an attempt whose replay reaches the goal becomes a label.

A level's expert is asked first. If it does not reach the goal from a state in the env steps that its episode has left,
a short search follows: variations of the level's witness, sticky random actions, and further attempts of the learner.
All start in exactly that state, impulses included. The shortest success is replayed from there before it counts.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, Key

from levelproof.experts.config import RECORD_STEPS, ExpertConfig
from levelproof.experts.evaluation import play_sampled, play_sticky
from levelproof.experts.generalist.attempts import Found, attempt_from, play_expert, play_varied, recalled
from levelproof.experts.imitation import to_motion
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.levelgen.batching import blocks, take
from levelproof.levelgen.level import Level
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.physics.bounds import require

AT_ONCE = 64  # states that teachers are asked about side by side


@dataclass(frozen=True)
class TeachersConfig:
    """How often each teacher tries to reach the goal from a state (0: it is not asked), and noise of demonstrations."""

    expert: int = 4  # attempts per state by the level's expert, if the split kept experts; 0: it is not asked
    witness: int = 16  # attempts per state that vary the level's witness, unless the expert reaches the goal
    random: int = 32  # attempts per state by sticky random actions, unless the expert reaches the goal
    learner: int = 4  # attempts per state by the learner itself, unless the expert reaches the goal
    sticky: float = 0.5  # share of demonstrations in which the action executed last sometimes replaces the expert's
    perturbed: float = 0.5  # share of demonstrations that start with perturbed velocities, drawn independently

    def __post_init__(self) -> None:
        require(self, ("sticky", "perturbed"), 0, 1)
        require(self, ("expert", "witness", "random", "learner"), 0, 4096)
        if not (self.expert or self.searches):
            raise ValueError("expert, witness, random and learner are all 0: let at least one of them teach")

    @property
    def searches(self) -> bool:
        """Whether a search follows if there is no expert or it fails."""
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


class Labels(NamedTuple):
    """What teachers do in the states that they were asked about, or demonstrate, on the host.

    An answer replays to the goal. A demonstration has what its expert chose, whether or not that was executed.
    """

    teacher: Int[np.ndarray, " state"]  # Teacher
    length: Int[np.ndarray, " state"]  # env steps from the state to the goal; 0: no label
    action: Int8[Array | np.ndarray, "256 6 state"]  # from the state on
    motion: Float[np.ndarray, "256 state column"]  # of the states on the way (`experts.imitation.Transitions`)
    env_steps: int  # that the teachers played


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
    """Ask the teachers about states: the experts first, a search if they fail; keep what replays to the goal.

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
        if not player or not attempts:
            continue
        usable = np.flatnonzero(known.expert >= 0 if number == Teacher.EXPERT else teacher != Teacher.EXPERT)
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

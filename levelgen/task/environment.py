"""One environment with the interface of gymnax and of the reference, played on our levels.

`env.reset(key, params)` and `env.step(key, state, action, params)` are functions of ONE environment, to be mapped
with `jax.vmap`; the mapped axis becomes the engine's lanes (`levelgen.vmapped`). A step that ends an episode
resets: to a level drawn from `params.levels`, or to `override_reset_state`.

The level that a reset draws depends on its key, the episode's number and a tag of its own. So callers that pass one
key to `reset`, `step` and the sampling of actions, or the same key to every step, still meet every level through
automatic resets. Calls of `reset` with equal keys start the same level.
Facts: `kinetix.environment.env` and `spaces` 3.0.2.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.levelgen.level import ACTIONS, Level, on_device
from levelproof.levelgen.sampling.sampler import Sampler
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import (
    CHOICES,
    DISCRETE_ACTIONS,
    Controls,
    continuous_controls,
    controls,
    discrete_controls,
)
from levelproof.levelgen.task.fresh import renewed
from levelproof.levelgen.task.observe.entities import padded_shape
from levelproof.levelgen.task.observe.flat import LIMIT, feature_count
from levelproof.levelgen.task.observe.kinds import ObservationType, observe
from levelproof.levelgen.task.observe.pixels import SIDE
from levelproof.levelgen.task.rules import TaskParams, TaskState
from levelproof.levelgen.task.spaces import Box, Dict, Discrete, MultiDiscrete, Space
from levelproof.levelgen.vmapped import single
from levelproof.physics.bounds import require_32_bits
from levelproof.physics.types import Size

LEVEL_DRAW = 0x6C76_0000  # folded, with the number of the episode, into the key that chooses a level


class ActionType(StrEnum):
    """How an action is written (`levelgen.task.actions`)."""

    DISCRETE = "discrete"
    MULTI_DISCRETE = "multi_discrete"
    CONTINUOUS = "continuous"


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EnvParams:
    """Parameters: what resets draw levels from.

    Levels (level axis last; not empty) may change without recompiling. A Sampler makes a new level for every reset.
    """

    levels: Level | Sampler


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EnvState:
    """One environment, without an axis of lanes: its level, and the episode under way."""

    level: Level  # with the present state of its world
    timestep: Int[Array, ""]  # env steps taken in this episode
    last_distance: Float[Array, ""]  # m, between green and blue, summed over pairs; NO_DISTANCE at the start
    level_index: Int[Array, ""]  # into `params.levels`, or a Sampler's level id, or into the levels of `starts`
    episode: Int[Array, ""]  # automatic resets since `reset`; an override state brings its own count

    @property
    def now(self) -> TaskState:
        return TaskState(self.level.state, self.timestep, self.last_distance)

    def with_task_state(self, now: TaskState) -> "EnvState":
        """Return this episode with another task state."""
        return replace(self, level=replace(self.level, state=now.state), timestep=now.timestep,
                       last_distance=now.last_distance)  # fmt: skip

    @staticmethod
    def start(
        level: Level, level_index: Int[Array, " lane"] | int = 0, episode: Int[Array, " lane"] | int = 0
    ) -> "EnvState":
        """Start an episode."""
        now = task.reset(level)
        count = lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.int32), now.timestep.shape)
        return EnvState(level, now.timestep, now.last_distance, count(level_index), count(episode))


def info_of(result: task.StepResult, end: task.StepEnd, level_index: Int[Array, "..."]) -> dict[str, Any]:
    """Return the entries of `info` that `Environment.step` describes, but for the final observation."""
    return {
        "GoalR": result.goal,
        "distance": end.distance,
        "terminated": end.terminated,
        "truncated": result.done & ~end.terminated,
        "level_index": level_index,
    }


Step = tuple[Any, EnvState, Float[Array, ""], Bool[Array, ""], dict[str, Array]]
CONTROLS: dict[ActionType, Callable[[Level, Array], Controls]] = {
    ActionType.DISCRETE: discrete_controls,
    ActionType.MULTI_DISCRETE: controls,
    ActionType.CONTINUOUS: continuous_controls,
}


def make(
    levels: Level | Sampler,
    action_type: str = ActionType.MULTI_DISCRETE,
    observation_type: str = ObservationType.SYMBOLIC_FLAT,
    rules: TaskParams = task.DEFAULT_RULES,
    auto_reset: bool = True,
    final_observation: bool = False,
) -> tuple["Environment", EnvParams]:
    """Make an environment; return it with its default parameters.

    Args:
        levels: levels from which resets draw uniformly, level axis last; or a Sampler, from which every reset draws a
            new level.
        action_type: one of ActionType.
        observation_type: one of ObservationType.
        rules: rules of the task.
        auto_reset: whether a step that ends an episode returns the first state of the next one.
        final_observation: whether to add `info["final_observation"]`, the observation before an automatic reset.

    Raises:
        ValueError: a type is unknown, there is no level, its axes are not those of levels, or `jax_enable_x64` is on.
    """
    require_32_bits()
    for kinds, name in (ActionType, action_type), (ObservationType, observation_type):
        if name not in [*kinds]:
            raise ValueError(f"there is no {kinds.__name__} {name!r}: choose one of {', '.join(kinds)}")
    if isinstance(levels, Level):
        levels = on_device(levels)
    elif not isinstance(levels, Sampler):
        raise ValueError(
            f"levels are of type {type(levels).__name__}: give a Level or a Sampler; of a level file, give file.level, "
            "and rules=file.rules"
        )
    env = Environment(
        levels, ActionType(action_type), ObservationType(observation_type), rules, auto_reset, final_observation
    )
    return env, env.default_params


def starts(levels: Level) -> EnvState:
    """Return the first state of every level, level axis FIRST, for `vmap` and `override_reset_state`.

    Each state's `level_index` is its level's index in `levels`. Raises ValueError as `make`.
    """
    states = EnvState.start(on_device(levels), jnp.arange(len(levels), dtype=jnp.int32))
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), states)


@dataclass(frozen=True)
class Interface:
    """What decides an environment's steps, but for its levels.

    Equal by value, so environments that differ in their levels share compiled programs, and no program keeps levels
    in memory.
    """

    action_type: ActionType
    observation_type: ObservationType
    rules: TaskParams
    final_observation: bool

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Key[Array, ""], params: EnvParams, override: EnvState | None) -> tuple[Any, EnvState]:
        """See `Environment.reset`."""
        levels, index, override = self._restart(key, params, override, 0)
        return single(self._reset_lanes)(levels, index, (override, jnp.asarray(index)))

    @partial(jax.jit, static_argnums=0)
    def step(
        self, key: Key[Array, ""], state: EnvState, action: Array, params: EnvParams, override: EnvState | None
    ) -> Step:
        """See `Environment.step`."""
        self._check(action)
        table, index, override = self._restart(key, params, override, state.episode + 1)
        return single(self._step_lanes)(table, index, (override, jnp.asarray(index), *_detached(state, action)))

    @partial(jax.jit, static_argnums=0)
    def step_env(self, state: EnvState, action: Array) -> Step:
        """See `Environment.step_env`."""
        self._check(action)
        return single(self._step_lanes)((), 0, (None, None, *_detached(state, action)))

    def _check(self, action: Array) -> None:
        """Raise ValueError if the action's shape does not fit the action type."""
        if (shape := jnp.shape(action)) != (wanted := () if self.action_type == ActionType.DISCRETE else (ACTIONS,)):
            raise ValueError(
                f"an action has shape {shape}, but must be {wanted} for action_type={str(self.action_type)!r}"
            )

    def _restart(
        self, key: Key[Array, ""], params: EnvParams, override: EnvState | None, episode: Int[Array, ""] | int
    ) -> tuple[Any, Array | int, Any]:
        """Return a reset's (levels to draw from, index of the drawn one, state that replaces both, if any)."""
        if override is not None:
            return (), 0, override
        levels = params.levels
        if isinstance(levels, Sampler):
            return levels, levels.draw_id(_level_key(key, episode)), None
        return on_device(levels), _draw_level(key, episode, len(levels)), None

    def _reset_lanes(
        self, levels: Any, row: Int[Array, " lane"], inputs: tuple[EnvState | None, Array]
    ) -> tuple[Any, EnvState]:
        override, index = inputs
        state = _first_state(levels, row, index, 0, override)
        return self.observe(state), state

    def _step_lanes(self, levels: Any, row: Int[Array, " lane"], inputs: tuple[Any, Any, EnvState, Array]) -> Step:
        """Take one env step in every lane; reset if there are levels or an override state.

        Args:
            levels: as `_restart` returns them; () for no reset.
            row: of the level to reset to. If the caller maps over `params`, `levels` holds the levels of all lanes.
            inputs: (override state or None, index that `_restart` returned, state, action).
        """
        override, index, state, action = inputs
        driven = CONTROLS[self.action_type](state.level, action)
        now, result, closing, _ = task.advance_driven(state.level, state.now, driven, self.rules)
        after = state.with_task_state(now)
        info = info_of(result, closing, state.level_index)
        if self.final_observation:
            info["final_observation"] = self.observe(after)
        if override is None and isinstance(levels, Sampler):
            begin = lambda ids: EnvState.start(levels.lanes(ids), ids)
            after = replace(renewed(result.done, index, begin, after), episode=state.episode + result.done)
        elif override is not None or isinstance(levels, Level):
            restart = _first_state(levels, row, index, state.episode + 1, override)
            after = jax.tree.map(lambda fresh, x: jnp.where(result.done, fresh, x), restart, after)
        return self.observe(after), after, result.reward, result.done, info

    def observe(self, state: EnvState) -> Any:
        """Return the observation of each lane."""
        return observe(self.observation_type, state.level, state.level.state)


@dataclass(frozen=True, eq=False)
class Environment:
    """An environment, created by `make`. Equal only to itself, so it can be a static argument."""

    levels: Level | Sampler
    action_type: ActionType
    observation_type: ObservationType
    rules: TaskParams
    auto_reset: bool
    final_observation: bool = False
    level_ids: Int[np.ndarray, " level"] | None = None  # of `levels`, if they come from a split

    @property
    def default_params(self) -> EnvParams:
        return EnvParams(self.levels)

    @property
    def _interface(self) -> "Interface":
        return Interface(self.action_type, self.observation_type, self.rules, self.final_observation)

    @property
    def size(self) -> Size:
        return self.levels.size

    @property
    def name(self) -> str:
        return "levelproof"

    @property
    def num_actions(self) -> int:
        """Number of discrete actions, or of entries of an action."""
        return DISCRETE_ACTIONS if self.action_type == ActionType.DISCRETE else ACTIONS

    def reset(
        self, key: Key[Array, ""], params: EnvParams | None = None, override_reset_state: EnvState | None = None
    ) -> tuple[Any, EnvState]:
        """Start an episode, in `override_reset_state` if given: return its observation and state."""
        return self._interface.reset(key, params or self.default_params, override_reset_state)

    def step(
        self,
        key: Key[Array, ""],
        state: EnvState,
        action: Array,
        params: EnvParams | None = None,
        override_reset_state: EnvState | None = None,
    ) -> Step:
        """Take one env step: return observation, state, reward, done, info.

        If the episode ended and the environment resets itself, the observation and the state are those of the
        next episode's start; reward and info are always those of the step. `override_reset_state` is
        not read if the environment does not reset itself.

        Entries of `info`:
            GoalR: whether green touched blue.
            distance: between green and blue at the end of the step, summed over pairs, m.
            terminated: whether the task ended the episode; the value of the next state is then 0.
            truncated: whether the time limit ended it; a value function bootstraps from the final observation.
            level_index: index of the step's level in `params.levels`, or its id (as `EnvState.level_index`).
            final_observation: observation at the end of the step, before any reset; only if `make` enabled it.
        """
        if not self.auto_reset:
            return self.step_env(key, state, action, params)
        return self._interface.step(key, state, action, params or self.default_params, override_reset_state)

    def step_env(self, key: Key[Array, ""], state: EnvState, action: Array, params: EnvParams | None = None) -> Step:
        """Take one env step without reset."""
        del key, params  # env steps are deterministic
        return self._interface.step_env(state, action)

    def reset_env(self, key: Key[Array, ""], params: EnvParams | None = None) -> tuple[Any, EnvState]:
        return self.reset(key, params)

    def get_obs(self, state: EnvState) -> Any:
        """Return the observation of a state."""
        return single(lambda table, index, state: self._interface.observe(state))((), 0, state)

    def action_space(self, params: EnvParams | None = None) -> Space:
        del params
        spaces: dict[ActionType, Space] = {
            ActionType.DISCRETE: Discrete(DISCRETE_ACTIONS),
            ActionType.MULTI_DISCRETE: MultiDiscrete(CHOICES),
            ActionType.CONTINUOUS: Box(-1.0, 1.0, (ACTIONS,)),
        }
        return spaces[self.action_type]

    def observation_space(self, params: EnvParams | None = None) -> Space:
        del params
        if self.observation_type == ObservationType.SYMBOLIC_FLAT:
            return Box(-LIMIT, LIMIT, (feature_count(self.size),))
        if self.observation_type == ObservationType.SYMBOLIC_FLAT_PADDED:
            return Box(-LIMIT, LIMIT, padded_shape(self.size))
        if self.observation_type == ObservationType.PIXELS:
            return Dict({"image": Box(0.0, 1.0, (SIDE, SIDE, 3)), "global_info": Box(-jnp.inf, jnp.inf, (1,))})
        return _space_of_entities(jax.eval_shape(lambda: self.reset(jax.random.key(0))[0]), self.size)


def _detached(*inputs: Any) -> Any:
    """Stop gradients: the world is not differentiable."""
    return jax.tree.map(jax.lax.stop_gradient, inputs)


def _draw_level(key: Key[Array, ""], episode: Int[Array, ""] | int, count: int) -> Int[Array, ""] | int:
    """Draw the index of an episode's level, from a key that nothing else uses (see the module's docstring)."""
    if count == 1:
        return 0
    return (jax.random.bits(_level_key(key, episode)) % count).astype(jnp.int32)  # uneven by less than count / 2**32


def _level_key(key: Key[Array, ""], episode: Int[Array, ""] | int) -> Key[Array, ""]:
    return jax.random.fold_in(key, LEVEL_DRAW + episode)


def _first_state(
    levels: Any,
    row: Int[Array, " lane"],
    index: Int[Array, " lane"],
    episode: Int[Array, " lane"] | int,
    override: EnvState | None,
) -> EnvState:
    """Start an episode of the level in `row`, which the episode's own `params.levels` has at `index`."""
    if override is not None:
        return override
    if isinstance(levels, Sampler):
        return EnvState.start(levels.lanes(index), index, episode)
    return EnvState.start(jax.tree.map(lambda x: x[..., row], levels), index, episode)


def _space_of_entities(observation: Any, size: Size) -> Dict:
    """Return the space of an EntityObservation: masks are bools, indices below the body count, the rest unbounded."""

    def space(x: jax.ShapeDtypeStruct) -> Box:
        bounds = {"b": (0, 1), "i": (0, size.bodies - 1)}.get(x.dtype.kind, (-jnp.inf, jnp.inf))
        return Box(*bounds, x.shape, x.dtype)

    return Dict({name: space(x) for name, x in vars(observation).items()})

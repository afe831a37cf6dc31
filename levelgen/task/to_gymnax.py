"""The environment as an instance of gymnax's own class, with its spaces. Needs gymnax installed.

Before version 1.0, gymnax's `step` returns (observation, state, reward, done, info); since then, (observation, state,
reward, terminated, truncated, info). The environment here returns what the installed version does.
"""

from dataclasses import replace
from importlib import import_module
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from levelproof.levelgen.task.environment import Environment, EnvParams, EnvState
from levelproof.levelgen.task.spaces import Dict, Discrete, MultiDiscrete, Space


class _Methods:
    """What gymnax's class requires of an environment; the class itself is known only once gymnax is imported."""

    def __init__(self, inner: Environment, splits_done: bool) -> None:
        self._inner, self._splits_done = inner, splits_done

    @property
    def default_params(self) -> EnvParams:
        return self._inner.default_params

    @property
    def name(self) -> str:
        return self._inner.name

    @property
    def num_actions(self) -> int:
        return self._inner.num_actions

    def reset(self, key: Key[Array, ""], params: EnvParams | None = None, override_reset_state=None) -> tuple:
        return self._inner.reset(key, params, override_reset_state)

    def step(
        self, key: Key[Array, ""], state: EnvState, action: Any, params: EnvParams | None = None,
        override_reset_state: EnvState | None = None,
    ) -> tuple:  # fmt: skip
        *before, done, info = self._inner.step(key, state, _array(action), params, override_reset_state)
        ends = (info["terminated"], info["truncated"]) if self._splits_done else (done,)
        return *before, *ends, info

    def reset_env(self, key: Key[Array, ""], params: EnvParams | None = None) -> tuple:
        return self._inner.reset_env(key, params)

    def step_env(self, key: Key[Array, ""], state: EnvState, action: Any, params: EnvParams | None = None) -> tuple:
        """Take one env step without reset; as in gymnax, the fourth result is `terminated` (before 1.0: `done`)."""
        *before, done, info = self._inner.step_env(key, state, _array(action), params)
        return *before, info["terminated"] if self._splits_done else done, info

    def get_obs(self, state: EnvState, params: EnvParams | None = None, key: Key[Array, ""] | None = None) -> Any:
        return self._inner.get_obs(state)

    def is_truncated(self, state: EnvState, params: EnvParams | None = None) -> Bool[Array, ""]:
        return state.timestep >= self._inner.rules.max_timesteps

    def action_space(self, params: EnvParams | None = None) -> Any:
        return _converted(self._inner.action_space(params))

    def observation_space(self, params: EnvParams | None = None) -> Any:
        return _converted(self._inner.observation_space(params))


def to_gymnax(env: Environment) -> Any:
    """Wrap an environment in gymnax's own classes, for code that checks for them.

    The result is a `gymnax.environments.environment.Environment`. Its parameters are those of `levelproof.make`;
    `reset` and `step` accept `override_reset_state`, too. Actions of six entries are a gymnax `Tuple`; `step`
    takes them as a tuple or as an array. A state alone does not show whether its episode has ended, so there is no
    `is_terminal` and no `discount`: use the results of `step` and `info`.

    Raises:
        ImportError: gymnax is not installed.
    """
    base = import_module("gymnax.environments.environment").Environment
    splits_done = hasattr(base, "is_truncated")  # since 1.0
    inner = replace(env, final_observation=True) if splits_done else env  # 1.0 always has it in info
    return type("GymnaxEnvironment", (_Methods, base), {})(inner, splits_done)


def _array(action: Any) -> Array:
    return jnp.stack(action) if isinstance(action, tuple) else action


def _converted(space: Space) -> Any:
    spaces: Any = import_module("gymnax.environments.spaces")
    if isinstance(space, Dict):
        return spaces.Dict({name: _converted(one) for name, one in space.spaces.items()})
    if isinstance(space, MultiDiscrete):
        return spaces.Tuple([spaces.Discrete(int(n)) for n in space.number_of_dims_per_distribution])
    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    box = spaces.Box(space.low, space.high, space.shape, space.dtype)
    box.sample = space.sample  # gymnax's own returns NaN if there are no bounds
    return box

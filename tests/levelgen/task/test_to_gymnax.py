"""The environment in gymnax's own classes, of whichever version is installed."""

from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.environment import ActionType, make, starts
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.levelgen.task.to_gymnax import to_gymnax

pytestmark = pytest.mark.slow

gymnax = pytest.importorskip("gymnax")
base = pytest.importorskip("gymnax.environments.environment")
spaces = pytest.importorskip("gymnax.environments.spaces")

SPLITS_DONE = int(version("gymnax").partition(".")[0]) >= 1
COUNT = 24


def test_wrapper_steps_as_the_installed_gymnax_does() -> None:
    levels = sample_levels(np.arange(COUNT), "s")
    env, params = make(levels, ActionType.DISCRETE, rules=task.TaskParams(max_timesteps=1), final_observation=True)
    wrapped = to_gymnax(env)
    assert isinstance(wrapped, base.Environment)
    keys, own = jax.random.split(jax.random.key(0), COUNT), starts(levels)
    action = jax.vmap(wrapped.action_space(params).sample)(keys)
    observed, state, reward, *ends, info = jax.jit(jax.vmap(wrapped.step, (0, 0, 0, None)))(keys, own, action, params)
    expected = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, own, action, params)
    jax.tree.map(np.testing.assert_array_equal, (observed, state, reward), expected[:3])
    assert len(ends) == 1 + SPLITS_DONE
    np.testing.assert_array_equal(sum(ends), expected[3])
    np.testing.assert_array_equal(wrapped.is_truncated(own), np.zeros(COUNT))
    if SPLITS_DONE:
        names = set(jax.eval_shape(base.Environment.step, DoneAtOnce(), keys[0], jnp.zeros(()), 0)[5])
        assert names == {"terminated", "truncated", "final_observation"}  # the entries that gymnax itself adds
        assert names <= set(info)


class DoneAtOnce(base.Environment):  # pyright: ignore[reportGeneralTypeIssues, reportUntypedBaseClass]
    """A gymnax environment whose episodes last one step, written like gymnax's own."""

    def reset_env(self, key, params):
        return jnp.zeros(2), jnp.zeros(())

    def step_env(self, key, state, action, params):
        return jnp.ones(2), state, jnp.float32(1), jnp.bool_(True), {}

    def is_truncated(self, state, params):
        return jnp.bool_(False)


@pytest.mark.parametrize(
    ("action_type", "kind"),
    [(ActionType.DISCRETE, "Discrete"), (ActionType.MULTI_DISCRETE, "Tuple"), (ActionType.CONTINUOUS, "Box")],
)
def test_wrapper_spaces_are_gymnaxs(action_type: str, kind: str) -> None:
    env, params = make(sample_levels(np.arange(COUNT), "s"), action_type, ObservationType.PIXELS)
    wrapped = to_gymnax(env)
    space = wrapped.action_space(params)
    assert type(space) is getattr(spaces, kind)
    action = space.sample(jax.random.key(1))
    assert space.contains(action)
    _, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    jax.eval_shape(wrapped.step, jax.random.key(0), state, action, params)
    observation_space = wrapped.observation_space(params)
    assert type(observation_space) is spaces.Dict
    assert all(np.isfinite(x).all() for x in observation_space.sample(jax.random.key(0)).values())

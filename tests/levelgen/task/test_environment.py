"""The environment for users of gymnax: single, mapped, mapped twice or around loops, always the same world."""

import gc
import weakref
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from levelproof.levelgen.files.level_file import LevelFile
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.environment import (
    ActionType,
    Environment,
    EnvParams,
    EnvState,
    Interface,
    ObservationType,
    make,
    starts,
)
from levelproof.levelgen.task.observe.flat import symbolic_flat
from levelproof.levelgen.task.spaces import Box, Dict, Discrete, MultiDiscrete
from levelproof.physics.types import Size
from tests.trees import assert_same, lanes_last

LEVELS, STEPS = 24, 12


@pytest.fixture(scope="module")
def levels() -> Level:
    return sample_levels(np.arange(LEVELS), SIZES["s"])


@pytest.fixture(scope="module")
def made(levels: Level) -> tuple[Environment, EnvParams]:
    return make(levels)


@pytest.fixture(scope="module")
def keys() -> jax.Array:
    return jax.random.split(jax.random.key(3), LEVELS)


@pytest.fixture(scope="module")
def actions() -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.array(CHOICES), (STEPS, LEVELS, 6)).astype(np.int32)


def lane(tree, index: int):
    return jax.tree.map(lambda x: x[..., index], tree)


def play(env: Environment, params: EnvParams, state: EnvState, keys: jax.Array, actions):
    """Take mapped steps in a loop: return (state, (observations, rewards, ends))."""

    def step(state, inputs):
        number, action = inputs
        each = jax.vmap(lambda key: jax.random.fold_in(key, number))(keys)
        observed, state, reward, done, _ = jax.vmap(env.step, (0, 0, 0, None))(each, state, action, params)
        return state, (observed, reward, done)

    return jax.jit(lambda: jax.lax.scan(step, state, (jnp.arange(STEPS), jnp.asarray(actions))))()


def test_mapped_step_equals_the_tasks_step(levels: Level, keys, actions) -> None:
    env, params = make(levels, auto_reset=False)
    state, (observed, reward, done) = play(env, params, starts(levels), keys, actions)
    world, advance = task.reset(levels), jax.jit(lambda world, action: task.advance(levels, world, action, env.rules))
    for step in range(STEPS):
        world, outcome = advance(world, jnp.asarray(actions[step].T))
        np.testing.assert_array_equal(reward[step], outcome.reward)
        np.testing.assert_array_equal(done[step], outcome.done)
    assert_same(lanes_last(state.now), world)
    np.testing.assert_allclose(observed[-1].T, jax.jit(symbolic_flat)(levels, world.state), rtol=1e-6)


@pytest.mark.campaign
def test_single_environment_equals_a_lane_of_many(levels: Level, made, keys, actions) -> None:
    env, params = made
    many = jax.vmap(env.step, (0, 0, 0, None))(keys, starts(levels), actions[0], params)
    one = env.step(keys[5], jax.tree.map(lambda x: x[5], starts(levels)), actions[0, 5], params)
    assert_same(jax.tree.map(lambda x: x[5], many[1:]), one[1:])
    np.testing.assert_allclose(many[0][5], one[0], rtol=1e-6)


@pytest.mark.campaign
def test_mapping_twice_equals_mapping_once(levels: Level, made, keys, actions) -> None:
    env, params = made
    fold = lambda tree: jax.tree.map(lambda x: x.reshape(4, 6, *x.shape[1:]), tree)
    given = (keys, starts(levels), jnp.asarray(actions[0]))
    once = jax.vmap(env.step, (0, 0, 0, None))(*given, params)
    inner = jax.vmap(env.step, (0, 0, 0, None))
    across = jax.vmap(inner, (1, 1, 1, None), 1)(*fold(given), params)
    assert_same(fold(once[1:]), across[1:])
    same = jnp.broadcast_to(actions[0, 0], actions[0].shape)
    alone = jax.vmap(env.step, (0, 0, 0, None))(*given[:2], same, params)
    shared = jax.vmap(jax.vmap(env.step, (0, 0, None, None)), (0, 0, None, None))(
        *fold(given[:2]), actions[0, 0], params
    )
    assert_same(fold(alone[1:]), shared[1:])


@pytest.mark.campaign
def test_mapped_loop_equals_a_loop_of_mapped_steps(levels: Level, made, keys, actions) -> None:
    env, params = made

    def episode(key, state, actions):
        def step(state, inputs):
            number, action = inputs
            observed, state, reward, done, _ = env.step(jax.random.fold_in(key, number), state, action, params)
            return state, (observed, reward, done)

        return jax.lax.scan(step, state, (jnp.arange(STEPS), actions))

    state, (_, reward, done) = jax.jit(jax.vmap(episode, (0, 0, 1)))(keys, starts(levels), jnp.asarray(actions))
    looped, (_, rewards, ends) = play(env, params, starts(levels), keys, actions)
    assert_same(state.now, looped.now)
    assert_same((reward.T, done.T), (rewards, ends))


@pytest.mark.campaign
def test_mapped_parameters_may_have_different_levels(levels: Level, made, keys) -> None:
    """Mapping over the parameters too: each environment draws from its own levels."""
    env, _ = made
    groups = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], 4, 6), -2, 0), EnvParams(env.levels))
    _, state = jax.vmap(env.reset)(keys[:4], groups)
    for group in range(4):
        _, one = env.reset(keys[group], jax.tree.map(lambda x, group=group: x[group], groups))
        assert_same(jax.tree.map(lambda x, group=group: x[group], state), one)


def test_resets_draw_from_all_levels(levels: Level, made) -> None:
    env, params = made
    _, state = jax.jit(jax.vmap(env.reset, (0, None)))(jax.random.split(jax.random.key(0), 300), params)
    start = np.asarray(levels.state.position.reshape(-1, LEVELS).T)
    drawn = (np.asarray(state.now.state.position.reshape(300, -1))[:, None] == start).all(-1)
    assert (drawn.sum(1) == 1).all()
    assert drawn.any(0).all()


@pytest.mark.slow
def test_reusing_one_key_still_meets_every_level(levels: Level) -> None:
    """For code that never splits its keys: each goes to reset, to the sampling of actions and to every step."""
    eleven = jax.tree.map(lambda x: x[..., :11], levels)  # as many as there are discrete actions
    env, params = make(eleven, ActionType.DISCRETE, rules=task.TaskParams(max_timesteps=1))
    keys = jax.random.split(jax.random.PRNGKey(0), 256)
    state = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)[1]
    action = jax.vmap(env.action_space(params).sample)(keys)
    step, drawn = jax.jit(jax.vmap(env.step, (0, 0, 0, None))), [action, state.level_index]
    for episode in range(1, 4):
        _, state, _, done, info = step(keys, state, action, params)
        assert done.all()
        np.testing.assert_array_equal(info["level_index"], drawn[-1])
        assert (np.asarray(state.episode) == episode).all()
        drawn.append(state.level_index)
    drawn = np.array(drawn)
    assert all(set(row.tolist()) == set(range(11)) for row in drawn)
    same = (drawn[:, None] == drawn).mean(-1)[np.triu_indices(len(drawn), 1)]
    assert (same < 0.2).all(), same  # 1 in 11 by chance


def test_step_resets_after_the_end(levels: Level, keys) -> None:
    env, params = make(levels, rules=task.TaskParams(max_timesteps=1))
    stop, own = jnp.zeros((LEVELS, 6), jnp.int32), starts(levels)
    observed, state, _, done, info = jax.jit(jax.vmap(env.step, (0, 0, 0, None, 0)))(keys, own, stop, params, own)
    assert done.all()
    assert set(info) == {"GoalR", "distance", "terminated", "truncated", "level_index"}
    assert info["truncated"].sum() > LEVELS / 2  # the rest reached the goal or failed in that step
    np.testing.assert_array_equal(info["level_index"], np.arange(LEVELS))
    assert (np.asarray(info["distance"]) > 0).all()
    assert_same(state, own)  # the given state and its observation
    np.testing.assert_array_equal(observed, jax.jit(jax.vmap(env.get_obs))(own))
    _, drawn, _, done, _ = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, own, stop, params)
    assert done.all()
    assert (np.asarray(drawn.now.timestep) == 0).all()
    assert not np.array_equal(drawn.level.model.inverse_mass, own.level.model.inverse_mass)  # other levels


def test_info_reports_the_end_and_the_last_observation(levels: Level, keys, actions) -> None:
    """An environment without reset, played alongside, shows how an episode ended and its last observation."""
    limit = 8
    env, params = make(levels, rules=task.TaskParams(max_timesteps=limit), final_observation=True)
    bare, _ = make(levels, rules=env.rules, auto_reset=False)
    step, alone = (jax.jit(jax.vmap(e.step, (0, 0, 0, None))) for e in (env, bare))
    state, ends = starts(levels), np.zeros(2, int)
    for number in range(2 * limit):
        played = np.asarray(state.level_index)
        observed, final, reward, done, _ = alone(keys, state, actions[number % STEPS], params)
        observed_next, after, reward_next, done_next, info = step(keys, state, actions[number % STEPS], params)
        assert_same((reward, done), (reward_next, done_next))
        assert_same(info["final_observation"], observed)
        assert_same(info["level_index"], played)
        assert_same(info["terminated"] | info["truncated"], done)
        assert not (info["terminated"] & info["truncated"]).any()
        assert not (np.asarray(info["truncated"]) & (np.asarray(final.timestep) < limit)).any()
        assert not (np.asarray(info["GoalR"]) & ~np.asarray(info["terminated"])).any()
        start = np.asarray(levels.state.position)[..., np.asarray(after.level_index)]
        fresh = np.asarray(done)
        np.testing.assert_array_equal(np.moveaxis(np.asarray(after.level.state.position), 0, -1)[..., fresh],
                                      start[..., fresh])  # fmt: skip
        assert_same(observed_next[~fresh], observed[~fresh])
        ends += np.asarray(info["terminated"]).sum(), np.asarray(info["truncated"]).sum()
        state = after
    assert (ends > 0).all(), ends


def test_parameters_default_to_those_of_make(levels: Level, made) -> None:
    env, params = made
    assert_same(env.reset(jax.random.key(1)), env.reset(jax.random.key(1), params))


@pytest.mark.campaign
def test_resets_with_one_level_return_that_level(levels: Level, made) -> None:
    first = EnvParams(jax.tree.map(lambda x: x[..., :1], made[0].levels))
    assert_same(made[0].reset(jax.random.key(1), first)[1], EnvState.start(lane(levels, 0)))


MORE = (ObservationType.PIXELS, ObservationType.SYMBOLIC_ENTITY)
OBSERVATIONS = [pytest.param(kind, marks=pytest.mark.campaign if kind in MORE else ()) for kind in ObservationType]


@pytest.mark.parametrize("observation_type", OBSERVATIONS)
def test_observations_lie_in_their_space(levels: Level, observation_type: str) -> None:
    env, params = make(levels, observation_type=observation_type)
    observed, state = env.reset(jax.random.key(0), params)
    space = env.observation_space(params)
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)
    if isinstance(space, Dict):
        assert space.contains(observed)
        observed = vars(observed)
        assert {name: (x.shape, x.dtype) for name, x in space.spaces.items()} == shapes(observed)
    else:
        assert (space.shape, space.dtype) == shapes(observed)
    assert space.contains(observed)
    assert shapes(space.sample(jax.random.key(1))) == shapes(observed)
    assert shapes(jax.eval_shape(env.get_obs, state)) == shapes(env.reset(jax.random.key(0), params)[0])


@pytest.mark.parametrize("action_type", list(ActionType))
def test_sampled_actions_lie_in_their_space(levels: Level, keys, action_type: str) -> None:
    env, params = make(levels, action_type)
    space = env.action_space(params)
    action = jax.vmap(space.sample)(keys)
    assert jax.vmap(space.contains)(action).all()
    kind = {"discrete": Discrete, "multi_discrete": MultiDiscrete, "continuous": Box}[action_type]
    assert isinstance(space, kind)


@pytest.mark.campaign  # other tests use each type; the README's Python uses discrete ones
@pytest.mark.parametrize("action_type", list(ActionType))
def test_environment_takes_every_action_type(levels: Level, keys, action_type: str) -> None:
    env, params = make(levels, action_type)
    action = jax.vmap(env.action_space(params).sample)(keys)
    _, state, _, _, _ = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, starts(levels), action, params)
    assert np.isfinite(state.now.state.position).all()


def test_spaces_reject_foreign_elements() -> None:
    assert not Discrete(11).contains(11)
    assert not MultiDiscrete(CHOICES).contains(jnp.array([0, 0, 0, 0, 2, 0]))
    assert not Box(-1.0, 1.0, (6,)).contains(jnp.full(6, 1.1))


def test_spaces_without_bounds_sample_finite_elements(levels: Level) -> None:
    env, params = make(levels, observation_type=ObservationType.PIXELS)
    for space in env.observation_space(params), Box(0.0, jnp.inf, (50,)), Box(-jnp.inf, np.array([0.0, 9.0]), (2,)):
        drawn = jax.jit(space.sample)(jax.random.key(0))
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(drawn))
        assert space.contains(drawn)


def test_make_refuses_unknown_types(levels: Level) -> None:
    with pytest.raises(ValueError, match="no ObservationType 'symbols': choose one of symbolic_flat"):
        make(levels, observation_type="symbols")
    with pytest.raises(ValueError, match="no ActionType 'Discrete': choose one of discrete"):
        make(levels, action_type="Discrete")


def test_step_refuses_an_action_of_another_type(levels: Level) -> None:
    for kind, wrong in ("multi_discrete", ()), ("discrete", (6,)), ("continuous", (11,)):
        env, params = make(levels, kind)
        _, state = jax.eval_shape(env.reset, jax.random.key(0), params)
        for step in env.step, env.step_env:
            with pytest.raises(ValueError, match=rf"an action has shape .*, but must be .* for action_type='{kind}'"):
                jax.eval_shape(step, jax.random.key(0), state, jnp.zeros(wrong), params)
            action = env.action_space(params).sample(jax.random.key(0))
            other = action.astype(int if kind == "continuous" else float)
            with pytest.raises(TypeError, match=rf"actions are {other.dtype}, but must be .* for this action_type"):
                jax.eval_shape(step, jax.random.key(0), state, other, params)


def test_make_refuses_no_levels(levels: Level) -> None:
    with pytest.raises(ValueError, match="give at least one level, level axis last"):
        make(jax.tree.map(lambda x: x[..., :0], levels))


@pytest.mark.slow
def test_equal_settings_share_programs_which_keep_no_levels(levels: Level) -> None:
    made = []
    for some in levels[:4], levels[4:8]:
        env, params = make(some)
        _, state = env.reset(jax.random.key(0))
        assert (np.asarray(state.level.role)[:, None] == some.role).all(0).any()
        env.step(jax.random.key(1), state, jnp.zeros(6, int))
        made.append((weakref.ref(env), weakref.ref(params.levels.role), Interface.step._cache_size()))
    del env, params, state
    gc.collect()
    assert [(env(), role()) for env, role, _ in made] == [(None, None)] * 2
    assert made[0][2] == made[1][2]


def test_levels_of_other_axes_and_types_are_refused(levels: Level) -> None:
    one, first = jax.tree.map(lambda x: x[..., 0], levels), jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), levels)
    uneven = replace(levels, density=levels.density[:, :3])
    for wrong in one, first, uneven:
        for takes in make, starts:
            with pytest.raises(
                ValueError, match=r"levels.role has shape .* last axes have lengths [\d, ]+, which must"
            ):
                takes(wrong)
    with pytest.raises(ValueError, match=r"of a level file, give file\.level, and rules=file\.rules"):
        make(LevelFile(levels, task.DEFAULT_RULES))  # pyright: ignore[reportArgumentType]


def test_levels_that_share_an_array_are_drawn_and_started_like_others(levels: Level) -> None:
    env, params = make(levels)
    shared = replace(levels, state=replace(levels.state, rotation=levels.state.rotation[:, :1]))
    _, states = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(0), 64), replace(params, levels=shared))
    assert len(set(np.asarray(states.level_index).tolist())) > 1
    assert starts(shared).level_index.shape == (len(levels),)


def test_environment_refuses_64_bit_mode(levels: Level) -> None:
    with jax.enable_x64(True):
        for what in (lambda: make(levels), lambda: sample_levels(np.arange(2), SIZES["s"])):
            with pytest.raises(ValueError, match="jax_enable_x64 is on"):
                what()


@pytest.mark.slow
@pytest.mark.parametrize(
    "size",
    [
        Size(6, 0, 1, 0),
        *(pytest.param(size, marks=pytest.mark.campaign) for size in (Size(4, 2, 0, 1), Size(6, 0, 0, 1))),
    ],
)
def test_environment_works_for_sizes_without_some_kinds(size: Size) -> None:
    env, params = make(sample_levels(np.arange(3), size))
    keys = jax.random.split(jax.random.key(0), 3)
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    observed, state, reward, done, _ = jax.vmap(env.step, (0, 0, 0, None))(keys, state, jnp.ones((3, 6), int), params)
    assert observed.shape == (3, *env.observation_space(params).shape)
    assert reward.shape == done.shape == (3,)
    assert np.isfinite(state.now.state.position).all()


@pytest.mark.slow
def test_gradients_do_not_flow_through_the_world(levels: Level) -> None:
    env, params = make(levels, ActionType.CONTINUOUS)
    _, state = env.reset(jax.random.key(0), params)

    def reward(strength):
        observed, _, reward, _, _ = env.step(jax.random.key(1), state, strength * jnp.ones(6), params)
        return reward + observed.sum() + strength

    assert jax.grad(reward)(0.5) == 1

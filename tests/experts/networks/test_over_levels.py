"""Networks for all levels: any size, any order of entities, and the same bits after saving."""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import levelproof
from levelproof.experts.networks.attention import ActuatorHead, obeying
from levelproof.experts.networks.over_levels import NetworkConfig, PolicyKind, initial_policy, policy_logits
from levelproof.experts.networks.saved import CONFIG, WEIGHTS, Policy
from levelproof.levelgen.level import SIZES, Level, size_of
from levelproof.levelgen.task.actions import CHOICES, MOTOR_CHOICES, action_mask
from levelproof.levelgen.task.rules import reset
from tests.experts.networks.weights import random_weights
from tests.quick import jit_once

pytestmark = pytest.mark.slow

COUNT = 16


@cache
def policy_of(kind: PolicyKind, size: str = "s") -> Policy:
    """Return a policy with random weights in every layer, so that no logit is close to 0."""
    network = NetworkConfig(kind, width=16, depth=1)
    params = random_weights(lambda: initial_policy(jax.random.key(0), network, SIZES[size]), 0.2)
    return Policy(network, params, SIZES[size] if kind is PolicyKind.FLAT else None, {"made": "for a test"})


@partial(jit_once, static_argnums=1)
def logits_of(params: Any, network: NetworkConfig, level: Level) -> jax.Array:
    return policy_logits(params, network, level, level.state)


def shuffled(level: Level) -> Level:
    """Reverse the order of movable polygons, circles, joints and thrusters."""
    size, model = level.size, level.model
    polygons = np.r_[0:4, np.arange(4, size.polygons)[::-1]]
    bodies = np.r_[polygons, np.arange(size.polygons, size.bodies)[::-1]]
    new = np.argsort(bodies)  # new index of each body
    of_body = ("active", "inverse_mass", "inverse_inertia", "friction", "restitution", "collision_mode")
    changed = {name: getattr(model, name)[bodies] for name in of_body}
    changed |= {name: getattr(model, name)[polygons] for name in ("vertices", "n_vertices")}
    changed |= {"radius": model.radius[::-1], "collides": model.collides[bodies][:, bodies]}
    for name in vars(model):
        if name.startswith(("joint_", "motor_", "thruster_")):
            x = np.asarray(getattr(model, name))
            changed[name] = (new[x] if name in ("joint_a", "joint_b", "thruster_body") else x)[::-1]
    moving = {
        name: getattr(level.state, name)[bodies] for name in ("position", "rotation", "velocity", "angular_velocity")
    }
    of_task = {name: getattr(level, name)[::-1] for name in ("motor_binding", "motor_auto", "thruster_binding")}
    of_task |= {name: getattr(level, name)[bodies] for name in ("role", "density")}
    return replace(level, model=replace(model, **changed), state=replace(level.state, **moving), **of_task)


@pytest.mark.parametrize("kind", [PolicyKind.ATTENTION, PolicyKind.INVARIANT, PolicyKind.TRANSFORMER])
def test_order_of_entities_does_not_matter(kind: PolicyKind) -> None:
    levels, policy = levelproof.sample_levels(np.arange(COUNT), "m"), policy_of(kind)
    other = shuffled(jax.tree.map(np.asarray, levels))
    logits = np.asarray(logits_of(policy.params, policy.network, levels))
    assert np.abs(logits).max() > 0.1
    np.testing.assert_allclose(logits_of(policy.params, policy.network, other), logits, atol=2e-4)


@pytest.mark.parametrize("size", ["s", "8-0-1-0"])
def test_attention_plays_any_size_and_idle_entries_are_zero(size: str) -> None:
    levels, policy = levelproof.sample_levels(np.arange(COUNT), size), policy_of(PolicyKind.ATTENTION)
    episode = reset(levels)
    both = jit_once(lambda key: (policy.sample(key, levels, episode), policy.most_probable(levels, levels.state)))
    for action in both(jax.random.key(0)):
        assert action.shape == (6, COUNT)
        assert not np.asarray(action)[~np.asarray(action_mask(levels))].any()


@pytest.mark.parametrize("kind", sorted(set(PolicyKind) - {PolicyKind.FLAT}))
def test_parameters_do_not_depend_on_the_size(kind: PolicyKind) -> None:
    """Also where a size has no entity of some kinds, so that policies trained there load, and play elsewhere."""
    network = NetworkConfig(kind, width=16, depth=1)
    bare = size_of("7-0-2-0")
    of = lambda size: jax.eval_shape(lambda: initial_policy(jax.random.key(0), network, size))
    assert of(bare) == of(SIZES["m"])
    levels = levelproof.sample_levels(np.arange(2), bare)
    params = jit_once(initial_policy, static_argnums=(1, 2))(jax.random.key(0), network, SIZES["m"])
    assert np.isfinite(logits_of(params, network, levels)).all()


def test_an_actuator_has_logits_of_its_own_token() -> None:
    tokens = np.random.default_rng(0).normal(size=(8, 3, COUNT)).astype(np.float32)
    head, summary = ActuatorHead(8, MOTOR_CHOICES), np.ones((8, COUNT), np.float32)
    params = head.init(jax.random.key(0), tokens, summary)
    changed = tokens.copy()
    changed[:, 1] += 1
    both = [np.asarray(head.apply(params, each, summary)) for each in (tokens, changed)]
    differs = np.abs(both[0] - both[1]).max((0, 2)) > 1e-6
    assert differs.tolist() == [False, True, False]


def test_an_entry_has_the_sum_of_the_logits_of_what_obeys_it() -> None:
    levels, policy = levelproof.sample_levels(np.arange(COUNT), "m"), policy_of(PolicyKind.ATTENTION)
    entries = np.split(np.asarray(logits_of(policy.params, policy.network, levels)), np.cumsum(CHOICES)[:-1])
    moves = np.array([np.abs(entry).max(0) > 0 for entry in entries])
    np.testing.assert_array_equal(moves, action_mask(levels))
    bound, logits = np.zeros((3, 2, 1), np.float32), np.arange(6, dtype=np.float32).reshape(2, 3, 1)
    bound[[0, 1, 2], [1, 0, 1]] = 1  # the first and last actuator obey entry 1, the other entry 0
    assert obeying(bound, logits)[:, 0].tolist() == [1, 4, 0 + 2, 3 + 5]


def test_transformer_has_the_shape_of_the_reference() -> None:
    """The count is the reference's published 786,000 parameters less its value head, of five layers and an output."""
    network = NetworkConfig(PolicyKind.TRANSFORMER, width=128, depth=2, heads=8)
    shapes = jax.eval_shape(lambda: initial_policy(jax.random.key(0), network, SIZES["m"]))
    value_head = 5 * (128 * 128 + 128) + 129
    assert sum(x.size for x in jax.tree.leaves(shapes)) == 786_369 - value_head
    with pytest.raises(ValueError, match="multiple of 4"):
        NetworkConfig(PolicyKind.TRANSFORMER, heads=6)


def test_transformer_reads_which_bodies_touch() -> None:
    levels, policy = levelproof.sample_levels(np.arange(COUNT), "s"), policy_of(PolicyKind.TRANSFORMER)
    apart = replace(levels.state, contact_active=np.zeros_like(levels.state.contact_active))
    touching = replace(levels.state, contact_active=np.ones_like(levels.state.contact_active))
    both = [np.asarray(jax.jit(policy.logits)(levels, state)) for state in (apart, touching)]
    assert np.abs(both[0] - both[1]).max() > 1e-3


def test_pixel_policy_sees_where_bodies_are_and_not_how_they_move() -> None:
    levels, policy = levelproof.sample_levels(np.arange(COUNT), "s"), policy_of(PolicyKind.PIXELS)
    logits = np.asarray(jax.jit(policy.logits)(levels, levels.state))
    faster = replace(levels.state, velocity=levels.state.velocity + 1)
    np.testing.assert_array_equal(jax.jit(policy.logits)(levels, faster), logits)
    moved = replace(levels.state, position=levels.state.position.at[4:, 0].add(0.5))
    assert (np.abs(np.asarray(jax.jit(policy.logits)(levels, moved)) - logits).max(0) > 1e-4).all()


def test_logits_differ_between_levels_and_states_of_a_lane_do_not_touch_others() -> None:
    levels, policy = levelproof.sample_levels(np.arange(COUNT), "s"), policy_of(PolicyKind.ATTENTION)
    alone, among = (logits_of(policy.params, policy.network, some) for some in (levels[[3] * COUNT], levels))
    assert np.ptp(among, axis=1).max() > 1e-2
    np.testing.assert_allclose(among[:, [3] * COUNT], alone, atol=1e-5)


@pytest.mark.parametrize("kind", list(PolicyKind))
def test_saved_policy_gives_the_same_bits(kind: PolicyKind, tmp_path: Path) -> None:
    levels, policy = levelproof.sample_levels(np.arange(COUNT), "s"), policy_of(kind)
    levelproof.save_policy(tmp_path, policy)
    loaded = levelproof.load_policy(tmp_path)
    assert (loaded.network, loaded.size, loaded.origin) == (policy.network, policy.size, policy.origin)
    assert loaded.observation_type == policy.observation_type
    both = [logits_of(each.params, each.network, levels) for each in (loaded, policy)]
    np.testing.assert_array_equal(*both)


def test_unusable_policies_are_refused(tmp_path: Path) -> None:
    policy = policy_of(PolicyKind.FLAT)
    levelproof.save_policy(tmp_path, policy)
    levels = levelproof.sample_levels(np.arange(2), "m")
    with pytest.raises(levelproof.PolicyError, match="size s only, not m"):
        policy.logits(levels, levels.state)
    config = (tmp_path / CONFIG).read_text()
    changes = [('"width": 16', '"width": 17', "damaged"), ('"origin"', '"other"', "damaged")]
    changes += [('"depth": 1', f'"depth": {10**9}', "cannot be made here: its depth is 1000000000: it must be between")]
    for old, new, words in changes:
        assert old in config
        (tmp_path / CONFIG).write_text(config.replace(old, new))
        with pytest.raises(levelproof.PolicyError, match=words):
            levelproof.load_policy(tmp_path)
    (tmp_path / WEIGHTS).unlink()
    with pytest.raises(levelproof.PolicyError, match="no policy"):
        levelproof.load_policy(tmp_path)


def test_saving_leaves_alone_what_a_link_in_the_folder_points_to(tmp_path: Path) -> None:
    (tmp_path / "profile").write_text("mine")
    (tmp_path / "policy").mkdir()
    for name in (WEIGHTS, CONFIG):
        (tmp_path / f"policy/{name}.tmp").symlink_to(tmp_path / "profile")
        (tmp_path / "policy" / name).symlink_to(tmp_path / "profile")
    levelproof.save_policy(tmp_path / "policy", policy_of(PolicyKind.FLAT))
    assert (tmp_path / "profile").read_text() == "mine"
    assert levelproof.load_policy(tmp_path / "policy").size is not None

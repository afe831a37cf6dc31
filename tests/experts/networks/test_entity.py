"""The entity network equals the plain formula on unfolded entities, and ignores their order."""

from dataclasses import replace
from functools import cache, partial
from typing import Any, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.typing import VariableDict as Params
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.experts.networks.entity import EntityNetwork
from levelproof.experts.policy import forward, initial
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.observe.entities import EntityObservation, entities
from levelproof.levelgen.task.observe.flat import BODY_ROWS, LIMIT, UNSEEN_WALLS, state_features
from levelproof.physics.types import FIXED_POLYGONS, State
from tests.experts.networks.weights import random_weights
from tests.quick import jit_once

pytestmark = pytest.mark.slow

LEVELS = 6
NAMES = ["s", *(pytest.param(name, marks=pytest.mark.campaign) for name in "ml")]
FROM_TANH = 1e-5  # float32, sums of a few hundred terms


def reordered(level: Level, rng: np.random.Generator) -> Level:
    """Permute movable polygons, circles, joints and thrusters, each among themselves."""
    size, m = level.size, level.model
    scenery = np.arange(FIXED_POLYGONS)
    polygon = np.concatenate([scenery, rng.permutation(np.arange(FIXED_POLYGONS, size.polygons))])
    circle, joint, thruster = (rng.permutation(count) for count in size[1:])
    order = {"body": np.concatenate([polygon, circle + size.polygons]), "polygon": polygon, "circle": circle}
    order |= {"joint": joint, "thruster": thruster}
    place = np.argsort(order["body"]).astype(np.int32)
    ends = {name: place[getattr(m, name)] for name in ("joint_a", "joint_b", "thruster_body")}

    def permuted(arrays: Any) -> Any:
        hints = get_type_hints(type(arrays))
        named = {name: hint.dim_str.split()[0] for name, hint in hints.items() if hasattr(hint, "dim_str")}
        chosen = {name: getattr(arrays, name)[order[axis]] for name, axis in named.items() if axis in order}
        return replace(arrays, **chosen)

    model = permuted(replace(m, **ends))
    model = replace(model, collides=model.collides[:, order["body"]])
    return permuted(replace(level, model=model, state=permuted(level.state)))


@cache
def network_of(name: str) -> tuple[EntityNetwork, Params]:
    network = EntityNetwork(SIZES[name], width=8, depth=2, encoding=12)
    return network, weights_of(network)


def weights_of(network: EntityNetwork) -> Params:
    level = empty_level(network.size, 1)
    constant = lambda: jax.tree.map(lambda x: x[..., 0], network.constant(level))
    return random_weights(lambda: initial(jax.random.key(0), network, constant()), 0.3)


def moved(state: State, rng: np.random.Generator) -> State:
    """Levels with other positions and velocities of movable bodies."""

    def change(x):
        shift = rng.normal(size=x.shape).astype(np.float32)
        shift[:FIXED_POLYGONS] = 0
        return x + shift

    fields = ("position", "rotation", "velocity", "angular_velocity")
    return jax.tree.map(jnp.asarray, State(**vars(state) | {name: change(getattr(state, name)) for name in fields}))


@partial(jit_once, static_argnums=0)
def outputs(network: EntityNetwork, params: Params, level: Level, state: State) -> jax.Array:
    """Logits and value per lane; every lane is a level of its own."""

    def one(constant, moving):
        logits, value = forward(network, params, constant, moving[:, None])
        return jnp.concatenate([logits[:, 0], value])

    return jax.vmap(one, in_axes=-1, out_axes=-1)(network.constant(level), state_features(level, state))


def plain(params: Params, seen: EntityObservation, lane: int) -> np.ndarray:
    """Plain formula in one lane: every entity's whole row through its encoder, the mean of active ones, two layers."""
    clipped = lambda x: np.clip(np.asarray(x, np.float64)[..., lane], -LIMIT, LIMIT)
    polygons, circles, joints, thrusters = map(clipped, (seen.polygons, seen.circles, seen.joints, seen.thrusters))
    bodies, gravity = np.concatenate([polygons[:, :BODY_ROWS], circles[:, :BODY_ROWS]]), polygons[0, -1:]
    from_b = len(joints) // 2  # the first half of the joints is seen from body b
    at = np.asarray(seen.joint_indexes)[:from_b, :, lane], np.asarray(seen.thruster_indexes)[:, lane]
    rows_of_joints = [[*row, *bodies[b], *bodies[a], *gravity] for row, (b, a) in zip(joints, at[0], strict=False)]
    rows_of_thrusters = [[*row, *bodies[k], *gravity] for row, k in zip(thrusters, at[1], strict=True)]
    tables = {
        "polygons": (np.delete(polygons, UNSEEN_WALLS, 0), np.delete(seen.polygon_mask[:, lane], UNSEEN_WALLS)),
        "circles": (circles, seen.circle_mask[:, lane]),
        "joints": (rows_of_joints, seen.joint_mask[:from_b, lane]),
        "thrusters": (rows_of_thrusters, seen.thruster_mask[:, lane]),
    }
    results = []
    for name in ("policy", "value"):
        p = jax.tree.map(np.asarray, params["params"][name])
        means = []
        for kind, (table, active) in tables.items():
            encoded = np.tanh(np.asarray(table) @ p[kind]["kernel"].T + p[kind]["bias"])[np.asarray(active, bool)]
            means.append(encoded.mean(0) if len(encoded) else np.zeros(encoded.shape[1]))
        x = np.tanh(p["Dense_0"]["kernel"] @ np.concatenate(means) + p["Dense_0"]["bias"])
        results.append(p["Dense_1"]["kernel"] @ x + p["Dense_1"]["bias"])
    return np.concatenate(results)


@pytest.mark.parametrize("name", NAMES)
def test_entity_network_equals_the_plain_formula(name: str) -> None:
    network, params = network_of(name)
    level = jax.tree.map(jnp.asarray, sample_levels(jnp.arange(LEVELS), network.size))
    state = moved(level.state, np.random.default_rng(0))
    ours, seen = np.asarray(outputs(network, params, level, state)), jit_once(entities)(level, state)
    for lane in range(LEVELS):
        np.testing.assert_allclose(ours[:, lane], plain(params, seen, lane), atol=FROM_TANH)
    assert np.ptp(ours, axis=1).min() > 1e-3  # levels differ


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_entity_network_ignores_the_order_of_entities(name: str, seed: int) -> None:
    network, params = network_of(name)
    level = sample_levels(jnp.arange(LEVELS), network.size)
    other = reordered(jax.tree.map(np.asarray, level), np.random.default_rng(seed))
    ours, others = (outputs(network, params, x, x.state) for x in (level, other))
    np.testing.assert_allclose(ours, others, atol=FROM_TANH)


def test_entity_network_accepts_sizes_without_some_kinds() -> None:
    """Without circles and thrusters, their encoders have no parameters."""
    size = SIZES["s"]._replace(circles=0, thrusters=0, polygons=7)
    level = empty_level(size, 2)
    network = EntityNetwork(size, width=8, depth=1, encoding=4)
    params = weights_of(network)
    assert set(params["params"]["policy"]) == {"polygons", "joints", "Dense_0"}
    assert np.isfinite(outputs(network, params, level, level.state)).all()


def test_gradient_reaches_every_parameter() -> None:
    network, params = network_of("s")
    size, rng = network.size, np.random.default_rng(0)
    constant = jit_once(network.constant)(sample_levels(jnp.arange(1), size))
    constant = jax.tree.map(lambda x: rng.uniform(0.1, 0.3, x.shape[:-1]).astype(np.float32), constant)
    moving = rng.uniform(0.1, 0.3, (7 * (size.bodies - FIXED_POLYGONS), 3)).astype(np.float32)

    def loss(params: Params):
        logits, value = forward(network, params, constant, moving)
        return jnp.square(logits).sum() + value.sum()

    for path, gradient in jax.tree_util.tree_leaves_with_path(jit_once(jax.grad(loss))(params)):
        assert (np.abs(gradient) > 0).all(), jax.tree_util.keystr(path)

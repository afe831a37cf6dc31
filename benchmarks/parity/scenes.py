"""Adversarial scenes: sampled levels changed into cases that are hardest for an engine.

Each scene is a function (levels, rng) -> levels over all lanes, numpy on the host; SCENES lists them.
"""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool
from numpy.typing import ArrayLike

from levelproof.levelgen.level import WORLD_SIDE, Level
from levelproof.levelgen.sampling.shuffle import collision_matrix
from levelproof.physics.mass import circle_area, circle_inertia, inverse, polygon_area, polygon_inertia
from levelproof.physics.types import FIXED_POLYGONS, State

FLOOR_TOP = 0.4  # m
Change = Callable[[Level, np.random.Generator], Level]


def inside(level: Level, rng: np.random.Generator) -> Level:
    """Put circles' centres inside polygons, including the floor and (rarely) the other scenery."""
    position = level.state.position.copy()
    for circle in range(level.size.polygons, level.size.bodies):
        weight = np.ones(level.size.polygons)
        weight[1:FIXED_POLYGONS] = 0.1
        polygon = _chosen(rng, level.model.active[: level.size.polygons] * weight[:, None])
        position[circle] = _point_in(level, polygon, rng)
    return replace(level, state=replace(level.state, position=position))


def overlap(level: Level, rng: np.random.Generator) -> Level:
    """Move bodies deep into other bodies; drop the joints of half of the lanes."""
    position = _on_others(level, rng)
    position += np.where(movable(level)[:, None], rng.normal(0, 0.05, position.shape), 0)
    return _moved(_loose(level, rng.random(level.role.shape[-1]) < 0.5), position)


def coincident(level: Level, rng: np.random.Generator) -> Level:
    """Move bodies exactly onto the centres of others, with equal angles in half of the lanes."""
    upright = movable(level) & (rng.random(level.role.shape[-1]) < 0.5)
    state = replace(level.state, rotation=np.where(upright, np.float32(0), level.state.rotation))
    level = _loose(replace(level, state=state), rng.random(level.role.shape[-1]) < 0.5)
    return _moved(level, _on_others(level, rng))


def triangles(level: Level, rng: np.random.Generator) -> Level:
    """Cut movable polygons to triangles and update their masses."""
    model, n = level.model, level.size.polygons
    cut = movable(level)[:n] & (rng.random(model.n_vertices.shape) < 0.9)
    centred = model.vertices - model.vertices[:, :3].mean(1, keepdims=True)
    centred[:, 3] = 0
    vertices = np.where(cut[:, None, None], centred, model.vertices).astype(np.float32)
    level = replace(level, model=replace(model, vertices=vertices, n_vertices=np.where(cut, 3, model.n_vertices)))
    return with_masses(level, np.concatenate([cut, np.zeros((level.size.circles, cut.shape[-1]), bool)]))


def fast(level: Level, rng: np.random.Generator) -> Level:
    """Throw bodies at up to 100 m/s, or at the bound of their spin."""
    shape = level.role.shape
    angle, quick = rng.uniform(-np.pi, np.pi, shape), rng.random(shape) < 0.5
    speed = np.where(quick, 100.0, rng.exponential(10, shape))
    velocity = np.stack([np.cos(angle), np.sin(angle)], 1) * speed[:, None]
    spin = np.where(rng.random(shape) < 0.2, rng.choice([-50.0, 50.0], shape), rng.normal(0, 15, shape))
    return _thrown(level, velocity, spin)


def bounce(level: Level, rng: np.random.Generator) -> Level:
    """Use high restitution, no or much friction, every collision mode, and random gravity."""
    shape = level.role.shape
    mode = np.where(level.model.collision_mode == 2, 2, rng.choice([0, 1, 1, 1, 2], shape)).astype(np.int32)
    pull = rng.normal([[0], [-6]], 4, level.model.gravity.shape) * (rng.random(shape[-1]) < 0.7)
    model = replace(
        level.model,
        restitution=rng.uniform(0.8, 1, shape).astype(np.float32),
        friction=rng.choice([0.0, 0.5, 2.0], shape).astype(np.float32),
        collision_mode=mode,
        gravity=pull.astype(np.float32),
    )
    return _thrown(replace(level, model=model), rng.normal(0, 8, (shape[0], 2, shape[1])), rng.normal(0, 10, shape))


def stacks(level: Level, rng: np.random.Generator) -> Level:
    """Pile upright bodies on the floor, each exactly touching the one below, without joints."""
    level = _loose(level, np.ones(level.role.shape[-1], bool))
    free, lanes = movable(level), level.role.shape[-1]
    position, rotation = level.state.position.copy(), np.where(free, np.float32(0), level.state.rotation)
    low, high = _upright_reach(level)
    piles = 1 if level.size.bodies <= 8 else 3
    offset = rng.normal(0, 0.02, lanes) * (rng.random(lanes) < 0.5)
    top = np.full((piles, lanes), FLOOR_TOP)
    for body in range(FIXED_POLYGONS, level.size.bodies):
        pile = body % piles
        x = (pile + 1) * WORLD_SIDE / (piles + 1) + offset * (body % 2)
        place = np.stack([x, top[pile] - low[body]])
        position[body] = np.where(free[body], place, position[body])
        top[pile] += np.where(free[body], high[body] - low[body], 0)
    return replace(level, state=replace(level.state, position=position.astype(np.float32), rotation=rotation))


def chains(level: Level, rng: np.random.Generator) -> Level:
    """Chain the movable bodies of a lane while joints last; half of the chains hang from the ceiling.

    Spare joints close loops. Anchors coincide along the chain, but not in the loops.
    """
    model, state, lanes = level.model, level.state, level.role.shape[-1]
    free = movable(level)
    order = np.argsort(np.where(free, rng.random(free.shape), 2), 0)  # movable bodies first, in any order
    count = free.sum(0)
    hangs = rng.random(lanes) < 0.5
    position = state.position.copy()
    anchor_a, anchor_b = (rng.normal(0, 0.15, model.joint_anchor_a.shape) for _ in "ab")
    a, b, active = np.array(model.joint_a), np.array(model.joint_b), np.zeros_like(model.joint_active)
    for joint in range(level.size.joints):
        along = joint + 1 < count + hangs  # whether there is a next body
        index = joint - hangs  # of body a in the order; -1: the ceiling
        loop = rng.integers(0, np.maximum(count - 1, 1))
        first = np.where(along, index, loop)
        second = np.where(along, index + 1, (loop + 1) % np.maximum(count, 1))
        body = lambda at: np.take_along_axis(order, np.clip(at, 0, len(order) - 1)[None], 0)[0]
        a[joint], b[joint] = np.where(first < 0, FIXED_POLYGONS - 1, body(first)), body(second)
        ceiling = first < 0
        anchor_a[joint] = np.where(ceiling, [[0], [-(WORLD_SIDE + 1)]] + anchor_a[joint], anchor_a[joint])
        active[joint] = (a[joint] != b[joint]) & (along | ((count > 1) & (rng.random(lanes) < 0.3)))
        meets = _at(position, a[joint]) + _turned(_at(state.rotation, a[joint]), anchor_a[joint])
        place = meets - _turned(_at(state.rotation, b[joint]), anchor_b[joint])
        position[b[joint], :, np.arange(lanes)] = np.where(active[joint] & along, place, _at(position, b[joint])).T
    fixed = rng.random(active.shape) < 0.3
    turned = _angle(state, a, b)
    joints = {
        "joint_active": active,
        "joint_a": a.astype(np.int32),
        "joint_b": b.astype(np.int32),
        "joint_anchor_a": anchor_a.astype(np.float32),
        "joint_anchor_b": anchor_b.astype(np.float32),
        "joint_fixed": fixed,
        "joint_rotation": np.where(fixed, turned, model.joint_rotation).astype(np.float32),
        "joint_limited": model.joint_limited & ~fixed,
    }
    model = replace(model, **joints)
    model = replace(model, collides=np.asarray(collision_matrix(model)))
    return replace(level, model=model, state=replace(state, position=position.astype(np.float32)))


def limits(level: Level, rng: np.random.Generator) -> Level:
    """Chain half of the lanes; put every joint at a limit or slightly beyond; use strong motors."""
    chained, lanes = chains(level, rng), level.role.shape[-1]
    half = np.arange(lanes) % 2 == 0
    level = _where(half, chained, level)
    model, shape = level.model, level.model.joint_active.shape
    turned = _angle(level.state, model.joint_a, model.joint_b) - model.joint_rotation
    turned += rng.choice([0.0, 0.0, 0.05, -0.05], shape)  # exactly at the limit, or beyond
    narrow, low = rng.choice([0.0, 0.1, 0.5], shape), rng.random(shape) < 0.5
    changes = {
        "joint_min": np.where(low, turned, turned - narrow),
        "joint_max": np.where(low, turned + narrow, turned),
        "motor_speed": rng.uniform(0.5, 3, shape),
        "motor_power": rng.uniform(0.5, 3, shape),
    }
    model = replace(
        model,
        joint_fixed=np.zeros(shape, bool),
        joint_limited=np.ones(shape, bool),
        motor_on=rng.random(shape) < 0.6,
        **{name: x.astype(np.float32) for name, x in changes.items()},
    )
    return replace(level, model=model, motor_auto=rng.random(shape) < 0.3)


def fixed(level: Level, rng: np.random.Generator) -> Level:
    """Fix every joint at an angle slightly off its current one."""
    model = level.model
    rotation = _angle(level.state, model.joint_a, model.joint_b) + rng.normal(0, 0.1, model.joint_a.shape)
    ones = np.ones(model.joint_fixed.shape, bool)
    return replace(level, model=replace(model, joint_fixed=ones, joint_rotation=rotation.astype(np.float32)))


def inactive(level: Level, rng: np.random.Generator) -> Level:
    """Deactivate bodies, joints and thrusters at random, whatever is attached to them."""
    off = lambda x, share: x & (rng.random(x.shape) >= share)
    active = np.where(movable(level), off(level.model.active, 0.4), level.model.active)
    model = replace(
        level.model,
        active=active,
        joint_active=off(level.model.joint_active, 0.2),
        thruster_active=off(level.model.thruster_active, 0.2),
    )
    return replace(level, model=model)


SCENES: dict[str, Change] = {
    scene.__name__: scene
    for scene in (inside, overlap, coincident, triangles, fast, bounce, stacks, chains, limits, fixed, inactive)
}


def movable(level: Level) -> Bool[np.ndarray, "body lane"]:
    """Return the mask of active bodies of finite mass."""
    return np.asarray(level.model.active) & (np.asarray(level.model.inverse_mass) != 0)


def with_masses(level: Level, where: Bool[np.ndarray, "body lane"]) -> Level:
    """Recompute masses and inertias from shapes and densities where `where` is set."""
    model = level.model
    area = np.concatenate([polygon_area(model.vertices, model.n_vertices), circle_area(model.radius)])
    turning = np.concatenate([polygon_inertia(model.vertices, model.n_vertices), circle_inertia(model.radius)])
    mass, inertia = (np.asarray(inverse(jnp.asarray(x * level.density))) for x in (area, turning))
    return replace(
        level,
        model=replace(
            model,
            inverse_mass=np.where(where, mass, model.inverse_mass),
            inverse_inertia=np.where(where, inertia, model.inverse_inertia),
        ),
    )


def _chosen(rng: np.random.Generator, weight: ArrayLike) -> np.ndarray:
    """Draw a row for each lane, with probabilities proportional to weights [row, lane]."""
    share = np.cumsum(np.asarray(weight), 0)
    return (rng.random(share.shape[-1]) * share[-1] >= share).sum(0).clip(max=len(share) - 1)


def _at(x: ArrayLike, body: ArrayLike) -> np.ndarray:
    """Return x[body[lane], ..., lane]."""
    body = np.asarray(body)
    return np.moveaxis(np.asarray(x)[body, ..., np.arange(len(body))], 0, -1)


def _turned(angle: ArrayLike, vector: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])


def _point_in(level: Level, polygon: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a random point in a polygon of each lane, m, clipped to the world with a margin."""
    corners, count = _at(level.model.vertices, polygon), _at(level.model.n_vertices, polygon)
    weight = rng.exponential(1, (len(corners), len(polygon))) * (np.arange(len(corners))[:, None] < count)
    local = (corners * (weight / weight.sum(0))[:, None]).sum(0)
    point = _at(level.state.position, polygon) + _turned(_at(level.state.rotation, polygon), local)
    return np.clip(point, -0.3 + FLOOR_TOP * (np.arange(2) == 1)[:, None], WORLD_SIDE + 0.3).astype(np.float32)


def _on_others(level: Level, rng: np.random.Generator) -> np.ndarray:
    """Return positions: most movable bodies move onto one other body of their lane."""
    free, position = movable(level), level.state.position
    stays = _chosen(rng, free + 1e-9)
    target = np.where(rng.random(free.shape) < 0.6, stays, np.arange(len(free))[:, None])
    return np.where(free[:, None], np.stack([_at(position, body) for body in target]), position)


def _moved(level: Level, position: np.ndarray) -> Level:
    return replace(level, state=replace(level.state, position=position.astype(np.float32)))


def _loose(level: Level, lanes: np.ndarray) -> Level:
    """Drop the joints of these lanes."""
    model = replace(level.model, joint_active=level.model.joint_active & ~lanes)
    apart = ~np.eye(level.size.bodies, dtype=bool)[..., None]
    return replace(level, model=replace(model, collides=np.where(lanes, apart, model.collides)))


def _thrown(level: Level, velocity: np.ndarray, spin: np.ndarray) -> Level:
    free = movable(level)
    state = replace(
        level.state,
        velocity=np.where(free[:, None], velocity, 0).astype(np.float32),
        angular_velocity=np.where(free, spin, 0).astype(np.float32),
    )
    return replace(level, state=state)


def _upright_reach(level: Level) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest point of each body about its centre at angle 0, m."""
    model = level.model
    used = np.arange(model.vertices.shape[1])[:, None] < np.asarray(model.n_vertices)[:, None]
    y = model.vertices[:, :, 1]
    low, high = np.where(used, y, np.inf).min(1), np.where(used, y, -np.inf).max(1)
    return np.concatenate([low, -model.radius]), np.concatenate([high, model.radius])


def _angle(state: State, a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Return the angle of body b relative to body a, rad."""
    rotation = lambda body: np.take_along_axis(np.asarray(state.rotation), np.asarray(body), 0)
    return rotation(b) - rotation(a)


def _where(lanes: np.ndarray, chosen: Level, other: Level) -> Level:
    return jax.tree.map(lambda x, y: np.where(lanes, x, y).astype(np.asarray(y).dtype), chosen, other)

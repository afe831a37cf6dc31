"""Golden states: what the reference does in one physics step and in one environment step.

This script runs inside the reference's own environment, with what benchmarks/reference has for it:

    python -m venv REF && REF/bin/pip install kinetix-env==3.0.2 "jax[cpu]"
    PYTHONPATH=benchmarks/reference REF/bin/python tests/golden/make_golden.py tests/golden

and writes s.npz, m.npz and l.npz there (`load.py` reads them). It samples levels, changes five eighths of them into
harder scenes (see SCENES), plays sticky random actions in 256-step episodes with automatic reset, and keeps from
each lane the state before an action at a random time. Every fourth lane keeps the state before its first end of
an episode instead, where it has one, so that rewards and ends are represented.

Arrays have the lane axis first and the reference's own names:
    before/NAME  the state, level constants included, without what the next step does not depend on
    after/NAME   what evolves, after ONE physics step with `control` (one number per joint, then per thruster)
    env_after/NAME, reward, done, goal, next_obs   of one env step (frame skip 2), no automatic reset
    obs, action, action_mask, scene
`next_obs` and `obs` are kept for the first lanes only (their number is the length of the array).
"""

import argparse
import json
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from actions import CHOICES, STICKINESS
from jax2d.engine import recalculate_mass_and_inertia
from kinetix.data.bc_utils import get_valid_action_mask_np
from kinetix.environment import EnvParams, static_env_params_from_size
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.spaces import ActionType, ObservationType
from world import flatten, sampler

EPISODE = 256  # env steps
SCENES = ("sampled", "sampled", "sampled", "inside", "limits", "fixed", "fast", "triangles")  # one lane in eight each
EARLY = 12  # env steps; circles inside polygons are pushed out soon, so these scenes are kept early
DYNAMIC = ("position", "rotation", "velocity", "angular_velocity")
IMPULSES = ("active", "acc_impulse_normal", "acc_impulse_tangent")
MANIFOLDS = ("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds")
CONTACT_NAMES = ("polygon", "circle-polygon", "circle-circle")
EVOLVING = {f"{kind}/{name}" for kind in ("polygon", "circle") for name in DYNAMIC}
EVOLVING |= {f"{kind}/{name}" for kind in MANIFOLDS for name in IMPULSES}
EVOLVING |= {"joint/acc_impulse", "joint/acc_r_impulse"}
DERIVED = {f"{kind}/{name}" for kind in MANIFOLDS for name in ("normal", "penetration", "collision_point")}
DERIVED |= {f"{kind}/restitution_velocity_target" for kind in MANIFOLDS}
DERIVED |= {"joint/global_position", "thruster/global_position"}
DERIVED |= {"polygon/radius", "circle/vertices", "circle/n_vertices", "polygon_highlighted", "circle_highlighted"}


def movable(state):
    """Active polygons with a finite mass, (lane, polygon)."""
    return state.polygon.active & (state.polygon.inverse_mass != 0)


def inside(state, rng, lanes):
    """Circles moved into a random active polygon, scenery included."""
    position, target = state.circle.position.copy(), state.polygon.active.copy()
    target[:, 1:4] &= rng.random(target[:, 1:4].shape) < 0.2
    for lane in np.flatnonzero(lanes):
        for circle in range(position.shape[1]):
            polygon = rng.choice(np.flatnonzero(target[lane]))
            corner = state.polygon.vertices[lane, polygon, : state.polygon.n_vertices[lane, polygon]]
            angle = state.polygon.rotation[lane, polygon]
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            point = rng.dirichlet(np.ones(len(corner))) @ corner
            if polygon == 0:  # the floor is 10 m deep: stay near its top
                point = np.array([rng.uniform(-2, 2), corner[:, 1].max() - rng.uniform(0, 0.3)])
            position[lane, circle] = state.polygon.position[lane, polygon] + turn @ point
    return state.replace(circle=state.circle.replace(position=position))


def limits(state, rng, lanes):
    """Revolute joints with narrow limits and strong motors, some past their limits from the start."""
    joint, shape = state.joint, state.joint.active.shape
    narrow = rng.uniform(0.02, 0.4, shape)
    relative = relative_rotation(state) - joint.rotation + rng.normal(0, 0.2, shape)
    return state.replace(
        joint=joint.replace(
            is_fixed_joint=pick(lanes, False, joint.is_fixed_joint),
            motor_has_joint_limits=pick(lanes, True, joint.motor_has_joint_limits),
            min_rotation=pick(lanes, relative - narrow, joint.min_rotation),
            max_rotation=pick(lanes, relative + narrow, joint.max_rotation),
            motor_on=pick(lanes, rng.random(shape) < 0.8, joint.motor_on),
            motor_speed=pick(lanes, rng.uniform(0.5, 3, shape), joint.motor_speed),
            motor_power=pick(lanes, rng.uniform(0.5, 3, shape), joint.motor_power),
        ),
        motor_auto=pick(lanes, rng.random(shape) < 0.3, state.motor_auto),
    )


def fixed(state, rng, lanes):
    """All joints fixed, at an angle a little off the present one."""
    rotation = relative_rotation(state) + rng.normal(0, 0.1, state.joint.active.shape)
    joint = state.joint
    return state.replace(
        joint=joint.replace(
            is_fixed_joint=pick(lanes, True, joint.is_fixed_joint), rotation=pick(lanes, rotation, joint.rotation)
        )
    )


def fast(state, rng, lanes):
    """Thrown bodies with restitution, friction and collision modes of all kinds, in other gravities."""

    def throw(bodies, moves):
        shape = bodies.active.shape
        mode = np.where(bodies.collision_mode == 2, 2, rng.choice([0, 1, 1, 1, 2], shape))
        return bodies.replace(
            velocity=pick(lanes, rng.normal(0, 6, (*shape, 2)) * moves[..., None], bodies.velocity),
            angular_velocity=pick(lanes, rng.normal(0, 15, shape) * moves, bodies.angular_velocity),
            restitution=pick(lanes, rng.random(shape), bodies.restitution),
            friction=pick(lanes, rng.uniform(0, 2, shape), bodies.friction),
            collision_mode=pick(lanes, mode, bodies.collision_mode),
        )

    return state.replace(
        polygon=throw(state.polygon, movable(state)),
        circle=throw(state.circle, state.circle.inverse_mass != 0),
        gravity=pick(lanes, rng.normal([0, -6], 4, state.gravity.shape), state.gravity),
    )


def triangles(state, rng, lanes):
    """Movable polygons lose their fourth vertex; mass and inertia follow."""
    cut = movable(state) & lanes[:, None] & (rng.random(state.polygon.active.shape) < 0.8)
    vertices = state.polygon.vertices.copy()
    vertices[cut] -= vertices[cut][:, :3].mean(1, keepdims=True)
    vertices[cut, 3] = 0
    n_vertices = np.where(cut, 3, state.polygon.n_vertices)
    return state.replace(polygon=state.polygon.replace(vertices=vertices, n_vertices=n_vertices))


CHANGES = {"inside": inside, "limits": limits, "fixed": fixed, "fast": fast, "triangles": triangles}


def pick(lanes, new, old):
    chosen = lanes.reshape(-1, *[1] * (old.ndim - 1))
    return np.where(chosen, new, old).astype(old.dtype)


def relative_rotation(state):
    """Rotation of each joint's body b relative to its body a, rad, (lane, joint)."""
    rotation = np.concatenate([state.polygon.rotation, state.circle.rotation], 1)
    of_a, of_b = (np.take_along_axis(rotation, index, 1) for index in (state.joint.a_index, state.joint.b_index))
    return of_b - of_a


def make_scenes(levels, static, seed):
    """Sampled levels turned into scenes by lane number."""
    rng = np.random.default_rng(seed)
    state = jax.tree.map(np.asarray, levels)
    scene = np.arange(len(state.timestep)) % len(SCENES)
    for number, name in enumerate(SCENES):
        if name in CHANGES:
            state = CHANGES[name](state, rng, scene == number)
    mass = jax.vmap(lambda s: recalculate_mass_and_inertia(s, static, s.polygon_densities, s.circle_densities))(state)
    cut = state.polygon.n_vertices == 3
    polygon = state.polygon.replace(
        inverse_mass=np.where(cut, mass.polygon.inverse_mass, state.polygon.inverse_mass),
        inverse_inertia=np.where(cut, mass.polygon.inverse_inertia, state.polygon.inverse_inertia),
    )
    return state.replace(polygon=polygon), scene


def make_rollout(env, params):
    """(levels, times (slot, lane), early-end lanes, key) -> states and actions at these times, (slot, lane, ...)."""

    def rollout(levels, times, wants_end, key):
        lanes, slots = times.shape[1], times.shape[0]
        choices = jnp.asarray(CHOICES)

        def step(carry, inputs):
            state, action, kept, ended = carry
            now, key = inputs
            keys = jax.random.split(key, 3)
            fresh = jax.random.randint(keys[0], action.shape, 0, choices)
            action = jnp.where(jax.random.uniform(keys[1], action.shape) < STICKINESS, action, fresh)
            _, after, _, done, _ = jax.vmap(env.step, (0, 0, 0, None, 0))(
                jax.random.split(keys[2], lanes), state, action, params, levels
            )
            take = times == now
            take = take.at[0].set(jnp.where(wants_end & done & ~ended, True, take[0] & ~(wants_end & ended)))

            def keep(old, new):
                return jnp.where(take.reshape(slots, lanes, *[1] * (new.ndim - 1)), new[None], old)

            kept = jax.tree.map(keep, kept, (state, action))
            return (after, action, kept, ended | done), None

        action = jax.random.randint(key, (lanes, len(CHOICES)), 0, choices)
        kept = jax.tree.map(lambda x: jnp.repeat(x[None], slots, 0), (levels, action))
        inputs = (jnp.arange(EPISODE), jax.random.split(key, EPISODE))
        carry, _ = jax.lax.scan(step, (levels, action, kept, jnp.zeros(lanes, bool)), inputs)
        return carry[2]

    return jax.jit(rollout)


def step_all(env, params, static, state, action):
    """One physics step and one environment step from every state."""

    def one(state, action):
        control = env.action_type.process_action(action, state, static)
        after, _ = env.physics_engine.step(state, params, control)
        next_obs, env_after, reward, done, info = env.step_env(jax.random.PRNGKey(0), state, action, params)
        return {
            "control": control,
            "after": after,
            "env_after": env_after,
            "obs": env.get_obs(state),
            "next_obs": next_obs,
            "reward": reward,
            "done": done,
            "goal": info["GoalR"],
        }

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(state, action))


def centre_inside(fields):
    """Circles whose centre lies in a polygon that they may collide with: (lane, circle, polygon)."""
    offset = fields["circle/position"][:, :, None] - fields["polygon/position"][:, None]
    angle = fields["polygon/rotation"][:, None]
    local = np.stack(
        [
            offset[..., 0] * np.cos(angle) + offset[..., 1] * np.sin(angle),
            offset[..., 1] * np.cos(angle) - offset[..., 0] * np.sin(angle),
        ],
        -1,
    )
    polygons = fields["polygon/active"].shape[1]
    inside = fields["circle/active"][:, :, None] & fields["polygon/active"][:, None]
    inside &= fields["collision_matrix"][:, polygons:, :polygons]
    corners, count = fields["polygon/vertices"], fields["polygon/n_vertices"]
    for corner in range(corners.shape[2]):
        successor = np.where(corner + 1 < count, corner + 1, 0)
        a = corners[:, None, :, corner]
        b = np.take_along_axis(corners, successor[..., None, None], 2)[:, None, :, 0]
        edge, point = b - a, local - a
        right = edge[..., 0] * point[..., 1] - edge[..., 1] * point[..., 0] < 0
        inside &= right | (corner >= count)[:, None]
    return inside


def count_states(fields):
    """Count the states that show each feature, as evidence of coverage."""
    before, after = (
        {name.removeprefix(prefix): x for name, x in fields.items() if name.startswith(prefix)}
        for prefix in ("before/", "after/")
    )
    joint, joints = before["joint/active"], before["joint/active"].shape[1]
    motor, thrust = fields["control"][:, :joints], fields["control"][:, joints:]
    free = joint & ~before["joint/is_fixed_joint"]
    rotation = np.concatenate([before["polygon/rotation"], before["circle/rotation"]], 1)
    of_a, of_b = (np.take_along_axis(rotation, before[f"joint/{x}_index"], 1) for x in "ab")
    relative = of_b - of_a - before["joint/rotation"]
    beyond = (relative < before["joint/min_rotation"]) | (relative > before["joint/max_rotation"])
    shows = {f"{name} contact": after[f"{kind}/active"] for name, kind in zip(CONTACT_NAMES, MANIFOLDS, strict=True)}
    shows |= {
        "two-point polygon contact": after["acc_rr_manifolds/active"].all(-1),
        "circle-polygon contact kept from the step before": before["acc_cr_manifolds/active"]
        & after["acc_cr_manifolds/active"],
        "circle centre inside a polygon": centre_inside(before),
        "triangle": before["polygon/active"] & (before["polygon/n_vertices"] == 3),
        "joint": joint,
        "fixed joint": joint & before["joint/is_fixed_joint"],
        "joint limit exceeded": free & before["joint/motor_has_joint_limits"] & beyond,
        "driven motor": free & before["joint/motor_on"] & (motor != 0),
        "firing thruster": before["thruster/active"] & (thrust != 0),
        "env step ends the episode": fields["done"],
        "env step reaches the goal": fields["goal"],
        "env step touches red": fields["reward"] < -0.5,
    }
    return {name: int(flag.reshape(len(flag), -1).any(1).sum()) for name, flag in shows.items()}


def gather(state, result):
    """Return the states before and after, and the other results that tests compare."""
    kept = EVOLVING | {"timestep", "last_distance"}
    fields = {f"before/{name}": x for name, x in flatten(state).items() if name not in DERIVED}
    fields |= {f"after/{name}": x for name, x in flatten(result["after"]).items() if name in EVOLVING}
    fields |= {f"env_after/{name}": x for name, x in flatten(result["env_after"]).items() if name in kept}
    return fields | {name: result[name] for name in ("control", "obs", "next_obs", "reward", "done", "goal")}


def make_size(size, lanes, slots, seed, obs_lanes):
    params, static = EnvParams(), static_env_params_from_size(size)
    env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, static)
    keys = jax.random.split(jax.random.PRNGKey(seed), lanes + 1)
    levels, scene = make_scenes(sampler(size)(keys[1:]), static, seed)
    rng = np.random.default_rng(seed + 1)
    times = rng.integers(0, EPISODE, (slots, lanes))
    times = np.where(np.array(SCENES)[scene] == "inside", times % EARLY, times)
    wants_end = np.arange(lanes) // len(SCENES) % 4 == 0
    levels = jax.tree.map(jnp.asarray, levels)
    state, action = make_rollout(env, params)(levels, jnp.asarray(times), jnp.asarray(wants_end), keys[0])
    state, action = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (state, action))
    result = step_all(env, params, static, state, action)

    fields = gather(state, result) | {"action": np.asarray(action), "scene": np.tile(scene, slots)}
    fields["action_mask"] = get_valid_action_mask_np(state, static, np.asarray(action))
    finite = np.all([np.isfinite(x).reshape(len(x), -1).all(1) for x in fields.values()], 0)
    fields = {name: values[finite] for name, values in fields.items()}
    counts = {"states": int(finite.sum()), "left out, not finite": int((~finite).sum())} | count_states(fields)
    fields |= {name: fields[name][:obs_lanes] for name in ("obs", "next_obs")}
    about = {
        "size": size,
        "seed": seed,
        "scenes": SCENES,
        "dense_reward_scale": params.dense_reward_scale,
        "frame_skip": static.frame_skip,
        "versions": {name: version(name) for name in ("kinetix-env", "jax2d", "jax", "numpy")},
        "counts": counts,
    }
    return {name: shrink(values) for name, values in fields.items()}, about


def shrink(values):
    """Floats to 32 bits, small integers to 16: `load.py` widens them again."""
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    return values.astype(np.int16) if values.dtype.kind in "iu" else values


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("out", type=Path, help="folder for {prefix}{size}.npz")
    parser.add_argument("--sizes", nargs="+", default=["s", "m", "l"])
    parser.add_argument("--lanes", type=int, default=768, help="levels a size")
    parser.add_argument("--slots", type=int, default=1, help="states kept of each level")
    parser.add_argument("--obs-lanes", type=int, default=192, help="states with observations")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--prefix", default="")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for size in given.sizes:
        fields, about = make_size(size, given.lanes, given.slots, given.seed, given.obs_lanes)
        path = given.out / f"{given.prefix}{size}.npz"
        np.savez_compressed(path, about=json.dumps(about), **fields)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB\n{json.dumps(about['counts'], indent=2)}", flush=True)


if __name__ == "__main__":
    main()

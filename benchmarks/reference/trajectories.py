# pyright: reportMissingImports=false
"""Play levels with the reference and write them in its reader's format. Runs inside the reference's own environment.

    python benchmarks/reference/trajectories.py OUT LEVELS.npz --size s --levels 512 --solved 4 --others 2

LEVELS.npz comes from `world.py`. Actions are random and sticky, and every level resets when an episode ends. OUT is a
zarr v2 group of two arrays, the second with other chunks and another compressor. It gets the first trajectories in
which every finished episode reaches the goal, and the first others.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import zarr
from actions import sticky_actions
from kinetix.data import get_valid_action_mask
from kinetix.environment import EnvParams, static_env_params_from_size
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.spaces import ActionType, ObservationType
from numcodecs import Blosc
from world import flatten, load_levels

STEPS = 256


def play(size, levels, actions):
    """Return states before each action, and whether it ended the episode, and in the goal; all (level, time, ...)."""
    static, params = static_env_params_from_size(size), EnvParams()
    env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, static, True)
    step = jax.vmap(env.step, (None, 0, 0, None, 0))

    def act(state, action):
        _, after, _, done, info = step(jax.random.PRNGKey(0), state, action, params, levels)
        return after, (state, done, info["GoalR"])

    played = jax.jit(lambda state, actions: jax.lax.scan(act, state, actions)[1])(levels, actions)
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), 0, 1), played)


def trajectories(size, states, actions, done):
    """Return structured records of 85 fields, (level, time)."""
    static = static_env_params_from_size(size)
    first = jax.tree.map(lambda x: jnp.asarray(x[:, 0]), states)
    mask = np.asarray(get_valid_action_mask(first, static, jnp.asarray(actions[:, 0])))
    fields = {f"env_state/{name}": values for name, values in flatten(states).items()}
    fields |= {"action": actions, "done": done, "action_mask": np.repeat(mask[:, None], STEPS, 1)}
    records = np.zeros(done.shape, [(name, x.dtype, (1, *x.shape[2:])) for name, x in fields.items()])
    for name, values in fields.items():
        records[name][:, :, 0] = values
    return records


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("levels_file")
    parser.add_argument("--size", required=True)
    for name in ("levels", "solved", "others"):
        parser.add_argument(f"--{name}", type=int, required=True)
    args = parser.parse_args()
    levels = load_levels(args.levels_file, args.size, 0, args.levels)
    actions = np.moveaxis(sticky_actions(STEPS, args.levels), 1, 2)  # (time, level, 6)
    states, done, goal = play(args.size, levels, jnp.asarray(actions))
    good = done.any(1) & (goal | ~done).all(1)
    chosen = np.concatenate([np.flatnonzero(good)[: args.solved], np.flatnonzero(~good)[: args.others]])
    assert len(chosen) == args.solved + args.others, f"{good.sum()} levels of {args.levels} are solved"
    records = trajectories(
        args.size, jax.tree.map(lambda x: x[chosen], states), np.moveaxis(actions, 1, 0)[chosen], done[chosen]
    )
    group, half = zarr.open_group(args.out, mode="w"), len(chosen) // 2
    write: Any = group.array  # zarr 2, which the reference has
    write("first", records[:half], chunks=(4, STEPS))
    write("second", records[half:], chunks=(2, 100), compressor=Blosc("zstd", 9, shuffle=0))


if __name__ == "__main__":
    main()

# pyright: reportMissingImports=false
"""The reference plays levels and writes what it saw as its reader wants it, with its own zarr. Runs inside its own
environment.

    python benchmarks/reference/trajectories.py OUT LEVELS.npz --size s --levels 512 --solved 4 --others 2

LEVELS.npz is as `world.py` writes it. The actions are random and sticky, and every level starts again when an episode
ends. OUT is a zarr v2 group of two arrays, of which the second has other chunks and another compressor. Kept are the
first trajectories in which every episode that ends reaches the goal, and the first others.
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
    """States before each action, and whether it ended the episode and in the goal, all (level, time, ...)."""
    static, params = static_env_params_from_size(size), EnvParams()
    env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, static, True)
    step = jax.vmap(env.step, (None, 0, 0, None, 0))

    def act(state, action):
        _, after, _, done, info = step(jax.random.PRNGKey(0), state, action, params, levels)
        return after, (state, done, info["GoalR"])

    played = jax.jit(lambda state, actions: jax.lax.scan(act, state, actions)[1])(levels, actions)
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), 0, 1), played)


def trajectories(size, states, actions, done):
    """Structures of 85 fields, (level, time)."""
    static = static_env_params_from_size(size)
    first = jax.tree.map(lambda x: jnp.asarray(x[:, 0]), states)
    mask = np.asarray(get_valid_action_mask(first, static, jnp.asarray(actions[:, 0])))
    fields = {f"env_state/{name}": values for name, values in flatten(states).items()}
    fields |= {"action": actions, "done": done, "action_mask": np.repeat(mask[:, None], STEPS, 1)}
    made = np.zeros(done.shape, [(name, x.dtype, (1, *x.shape[2:])) for name, x in fields.items()])
    for name, values in fields.items():
        made[name][:, :, 0] = values
    return made


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
    kept = np.concatenate([np.flatnonzero(good)[: args.solved], np.flatnonzero(~good)[: args.others]])
    assert len(kept) == args.solved + args.others, f"{good.sum()} levels of {args.levels} are solved"
    made = trajectories(
        args.size, jax.tree.map(lambda x: x[kept], states), np.moveaxis(actions, 1, 0)[kept], done[kept]
    )
    group, half = zarr.open_group(args.out, mode="w"), len(kept) // 2
    write: Any = group.array  # of zarr 2, which the reference has
    write("first", made[:half], chunks=(4, STEPS))
    write("second", made[half:], chunks=(2, 100), compressor=Blosc("zstd", 9, shuffle=0))


if __name__ == "__main__":
    main()

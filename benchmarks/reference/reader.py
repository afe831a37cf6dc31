# pyright: reportMissingImports=false
"""Read trajectories with the reference's reader, draw some with its renderer. Runs inside its own environment.

    python benchmarks/reference/reader.py OUT.npz FOLDER --size s --rows 4 --steps 0 10 40

OUT has every field of the first batch, of that many trajectories, (trajectory, 256, ...), by the reference's names, and
`frame` (trajectory, step, 125, 125, 3): pictures of the states at these steps.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from kinetix.data import TrajectoryDatasetManager
from kinetix.environment import EnvParams, static_env_params_from_size
from kinetix.render import make_render_pixels
from world import flatten


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("folder")
    parser.add_argument("--size", required=True)
    parser.add_argument("--rows", type=int, required=True)
    parser.add_argument("--steps", type=int, nargs="+", required=True)
    args = parser.parse_args()
    batch = TrajectoryDatasetManager(args.folder, batch_size=args.rows).load_next_batch()
    render = jax.jit(make_render_pixels(EnvParams(), static_env_params_from_size(args.size)))
    shown = jax.tree.map(lambda x: jnp.asarray(x[:, np.array(args.steps)]), batch.env_state)
    state_at = lambda i, t: jax.tree.map(lambda x: x[i, t], shown)
    frames = np.array([[render(state_at(i, t)) for t in range(len(args.steps))] for i in range(args.rows)])
    fields = {f"env_state/{name}": values for name, values in flatten(batch.env_state).items()}
    others = {"action": batch.action, "action_mask": batch.action_mask, "done": batch.done, "mask": batch.mask}
    np.savez(args.out, **{"frame": frames, **others, **fields})  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main()

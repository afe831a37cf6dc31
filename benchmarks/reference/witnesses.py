# pyright: reportMissingImports=false
"""Open level files with the reference and play their witnesses. Runs inside the reference's own environment.

    python benchmarks/reference/witnesses.py OUT.npz ACTIONS.npz FOLDER

FOLDER has level files of one size, in the order of their names. ACTIONS.npz has `action` (kind, 256, level, 6): a
witness of each kind for every level. OUT.npz has `reached` (kind, level): whether the first episode ended in the goal.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.spaces import ActionType, ObservationType
from kinetix.util.saving import load_from_json_file


def main(out, actions, folder):
    opened = [load_from_json_file(str(path)) for path in sorted(Path(folder).iterdir())]
    state = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(value) for value in x]), *[world for world, _, _ in opened])
    _, static, params = opened[0]
    assert all(others[1:] == (static, params) for others in opened)
    env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, static, False)
    step = jax.vmap(env.step_env, (None, 0, 0, None))

    def act(carry, action):
        state, over, reached = carry
        _, state, _, done, info = step(jax.random.PRNGKey(0), state, action, params)
        return (state, over | done, reached | (info["GoalR"] & done & ~over)), None

    none = jnp.zeros(len(opened), bool)
    play = jax.jit(lambda action: jax.lax.scan(act, (state, none, none), action)[0][2])
    with np.load(actions) as file:
        np.savez(out, reached=np.stack([play(kind) for kind in file["action"]]))


if __name__ == "__main__":
    main(*sys.argv[1:])

# pyright: reportMissingImports=false
"""Open level files with the reference and play them. Runs inside the reference's own environment.

    python benchmarks/reference/levels.py OUT.npz STEPS FILE...

The files are of one size. OUT has, by the reference's own names: `state/NAME` (STEPS + 1, level, ...), the states
before each action and the last one; `action`, `reward`, `done` and `goal` (STEPS, level, ...), under sticky random
actions without reset.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from actions import sticky_actions
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.spaces import ActionType, ObservationType
from kinetix.util.saving import load_from_json_file
from world import flatten


def play(env, params, state, actions):
    def step(state, action):
        _, after, reward, done, info = jax.vmap(env.step_env, (None, 0, 0, None))(
            jax.random.PRNGKey(0), state, action, params
        )
        return after, (state, reward, done, info["GoalR"])

    last, (states, *outcome) = jax.jit(lambda *x: jax.lax.scan(step, *x))(state, actions)
    states = jax.tree.map(lambda x, end: np.concatenate([x, end[None]]), states, last)
    return states, dict(zip(("reward", "done", "goal"), outcome, strict=True))


def main(out, steps, *files):
    opened = [load_from_json_file(path) for path in files]
    state = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(value) for value in x]), *[world for world, _, _ in opened])
    _, static, params = opened[0]
    assert all(others[1:] == (static, params) for others in opened)
    actions = np.moveaxis(sticky_actions(int(steps), len(files)), 1, 2)  # (step, level, 6)
    if len(actions):
        env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, static, False)
        states, outcome = play(env, params, state, jnp.asarray(actions))
    else:
        states, outcome = jax.tree.map(lambda x: np.asarray(x)[None], state), {}
    fields = {f"state/{name}": values for name, values in flatten(states).items()}
    np.savez(out, action=actions, **fields, **outcome)


if __name__ == "__main__":
    main(*sys.argv[1:])

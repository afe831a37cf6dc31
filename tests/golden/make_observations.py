"""Golden observations: what an agent of the reference sees, and what its actions do, in the golden states.

This script runs inside the reference's own environment, like `make_golden.py`, whose files it starts from:

    REF/bin/python tests/golden/make_observations.py tests/golden

and writes seen_s.npz, seen_m.npz and seen_l.npz there. Of the first states of each file (`--lanes`) it keeps

    flat, padded, entity/NAME   the symbolic observations. Numbers are kept of the first `--full` states only, of the
                                others `digest/NAME`: their sums under the weights that `weights` gives
    entity/*_mask, entity/*_indexes, entity/attention_mask   of all states
    image, palette              125x125 pixels as numbers of colours, (lane, x, y), and these colours
    discrete, continuous        random actions, and `control_discrete`, `control_continuous`: what they tell the
                                motors and thrusters

The reference caches the places of joints and thrusters in its states; here they are computed from the bodies.
"""

import argparse
import dataclasses
import json
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax2d.engine import recompute_global_joint_positions
from kinetix.environment import EnvParams, create_empty_env, static_env_params_from_size
from kinetix.environment.spaces import ContinuousActions, DiscreteActions
from kinetix.render.renderer_pixels import make_render_pixels
from kinetix.render.renderer_symbolic_entity import make_render_entities
from kinetix.render.renderer_symbolic_flat import make_render_symbolic

DIGITS = 8  # numbers a digest has


def weights(count):
    """(count, DIGITS) numbers: different observations have different sums under them."""
    return np.random.default_rng(count).standard_normal((count, DIGITS))


def with_fields(state, fields, prefix=""):
    """A state with those of its arrays replaced that `fields` has."""
    changes = {}
    for field in dataclasses.fields(state):
        value, name = getattr(state, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            changes[field.name] = with_fields(value, fields, f"{name}/")
        elif name in fields:
            changes[field.name] = jnp.asarray(fields[name]).astype(jnp.asarray(value).dtype)
    return state.replace(**changes)


def read_states(path, static, lanes):
    """The states of a golden file, (lane, ...)."""
    with np.load(path) as file:
        fields = {name.removeprefix("before/"): file[name][:lanes] for name in file.files if name.startswith("before/")}
    count = len(fields["timestep"])
    empty = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[None], count, 0), create_empty_env(static))
    states = with_fields(empty, fields)
    return jax.vmap(lambda state: recompute_global_joint_positions(state, static))(states)


def see(states, params, static):
    """Every observation of every state."""
    seen = {
        "flat": make_render_symbolic(params, static),
        "padded": make_render_symbolic(params, static, padded=True),
        "entity": make_render_entities(params, static),
    }
    seen = {name: jax.jit(jax.vmap(render))(states) for name, render in seen.items()}
    entity = seen.pop("entity")
    seen |= {f"entity/{field.name}": getattr(entity, field.name) for field in dataclasses.fields(entity)}
    return {name: np.asarray(values) for name, values in seen.items()}


def photograph(states, params, static):
    """Pixels as numbers of colours."""
    render = jax.jit(lambda chunk: jax.lax.map(make_render_pixels(params, static), chunk))
    image = np.asarray(render(states)).round().astype(np.uint8)
    packed = image.astype(np.int32) @ np.array([65536, 256, 1], np.int32)
    colours, number = np.unique(packed, return_inverse=True)
    palette = np.stack([colours >> 16, colours >> 8 & 255, colours & 255], -1).astype(np.uint8)
    assert len(palette) < 256
    return {"image": number.reshape(packed.shape).astype(np.uint8), "palette": palette}


def act(states, params, static, seed):
    """Random actions and what they tell the motors and thrusters."""
    kinds = {"discrete": DiscreteActions(params, static), "continuous": ContinuousActions(params, static)}
    keys = jax.random.split(jax.random.PRNGKey(seed), len(states.timestep))
    fields = {}
    for name, kind in kinds.items():
        action = jax.vmap(kind.random_action)(keys)
        if name == "continuous":
            action = 1.5 * action  # beyond the limits, too
        fields[name] = action
        fields[f"control_{name}"] = jax.jit(jax.vmap(lambda a, s, kind=kind: kind.process_action(a, s, static)))(
            action, states
        )
    return {name: np.asarray(values) for name, values in fields.items()}


def shrink(seen, full):
    """Numbers of the first states, digests of all of them."""
    fields = {}
    for name, values in seen.items():
        if values.dtype.kind == "f":
            rows = values.reshape(len(values), -1)
            fields[f"digest/{name}"] = (rows.astype(np.float64) @ weights(rows.shape[1])).astype(np.float32)
            values = values[:full]
        fields[name] = values.astype(np.int16) if values.dtype.kind in "iu" else values
    return fields


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folder", type=Path, help="has {size}.npz, is given seen_{size}.npz")
    parser.add_argument("--sizes", nargs="+", default=["s", "m", "l"])
    parser.add_argument("--lanes", type=int, default=512)
    parser.add_argument("--full", type=int, default=64)
    parser.add_argument("--seed", type=int, default=30)
    parser.add_argument("--out", type=Path, help="another folder for seen_{size}.npz")
    given = parser.parse_args()
    for size in given.sizes:
        params, static = EnvParams(), static_env_params_from_size(size)
        states = read_states(given.folder / f"{size}.npz", static, given.lanes)
        fields = shrink(see(states, params, static), given.full)
        fields |= photograph(states, params, static) | act(states, params, static, given.seed)
        about = {"size": size, "seed": given.seed}
        about["versions"] = {name: version(name) for name in ("kinetix-env", "jax2d", "jax", "numpy")}
        path = (given.out or given.folder) / f"seen_{size}.npz"
        np.savez_compressed(path, about=json.dumps(about), **fields)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB, {len(fields['image'])} states", flush=True)


if __name__ == "__main__":
    main()

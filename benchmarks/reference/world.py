# pyright: reportMissingImports=false
"""Worlds of the reference, inside its own environment: sampled, and converted from and to plain arrays.

Files are .npz with one array per path of the reference's state (`polygon/position`), level axis first, as
`levelgen.files.kinetix` reads them. Imports the reference, but nothing of ours.
"""

import argparse
import dataclasses
import os
from pathlib import Path

import numpy as np

# equal to our settings (pipeline/runtime.py), so that neither side has an advantage
SINGLE_THREAD = "--xla_cpu_multi_thread_eigen=false --xla_cpu_prefer_vector_width=512"
THREADS = ("NPROC", "PJRT_NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
BATCH = 512  # levels sampled at a time; bounds the sampler's memory


def stay_on(core: int | None) -> None:
    """Pin this process to one thread on one core; None: XLA uses all cores. Call it before importing JAX."""
    if core is not None:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {SINGLE_THREAD}".strip()
        os.environ.update(dict.fromkeys(THREADS, "1"))
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {core})


def flatten(state, prefix: str = "") -> dict[str, np.ndarray]:
    """Convert a state to {path: array}."""
    fields = {}
    for field in dataclasses.fields(state):
        value = getattr(state, field.name)
        if dataclasses.is_dataclass(value):
            fields |= flatten(value, f"{prefix}{field.name}/")
        else:
            fields[prefix + field.name] = np.asarray(value)
    return fields


def static_of(size: str):
    """Return the reference's static parameters of `s`, `m`, `l` or of `POLYGONS-CIRCLES-JOINTS-THRUSTERS`."""
    from kinetix.environment import static_env_params_from_size

    if "-" not in size:
        return static_env_params_from_size(size)
    names = ("num_polygons", "num_circles", "num_joints", "num_thrusters")
    return static_env_params_from_size("s").replace(**dict(zip(names, map(int, size.split("-")), strict=True)))


def load_levels(path: str, size: str, first: int, count: int):
    """Load levels `first` to `first + count - 1` of a file; indices wrap around."""
    import jax
    import jax.numpy as jnp
    from kinetix.environment.utils import create_empty_env

    empty = create_empty_env(static_of(size))
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files if "/" in name or name in flatten(empty)}
    index = (first + np.arange(count)) % len(fields["gravity"])

    def fill(state, prefix=""):
        values = {}
        for field in dataclasses.fields(state):
            value, name = getattr(state, field.name), prefix + field.name
            if dataclasses.is_dataclass(value):
                values[field.name] = fill(value, f"{name}/")
            elif name in fields:
                values[field.name] = jnp.asarray(fields[name][index], jnp.asarray(value).dtype)
            else:
                values[field.name] = jnp.broadcast_to(jnp.asarray(value), (count, *jnp.shape(value)))
        return state.replace(**values)

    return jax.tree.map(jnp.asarray, fill(empty))


def sampler(size: str):
    """Return the reference's sampler: a compiled function from keys (level, 2) to levels, level axis first."""
    import jax
    from kinetix.environment import EnvParams, static_env_params_from_size
    from kinetix.environment.ued.ued import make_reset_fn_sample_kinetix_level

    return jax.jit(jax.vmap(make_reset_fn_sample_kinetix_level(EnvParams(), static_env_params_from_size(size))))


def keys_of(seed: int, count: int):
    """Return keys for at least `count` levels, (batch, BATCH, 2)."""
    import jax

    return jax.random.split(jax.random.PRNGKey(seed), -(-count // BATCH) * BATCH).reshape(-1, BATCH, 2)


def sample_levels(size: str, count: int, seed: int) -> dict[str, np.ndarray]:
    """Sample levels of the reference's random distribution, as {path: array}."""
    sample = sampler(size)
    parts = [flatten(sample(keys)) for keys in keys_of(seed, count)]
    return {name: np.concatenate([part[name] for part in parts])[:count] for name in parts[0]}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", required=True)
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    args = parser.parse_args()
    fields = sample_levels(args.size, args.count, args.seed)
    np.savez_compressed(args.out, **fields)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main()

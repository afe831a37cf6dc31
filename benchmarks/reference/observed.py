# pyright: reportMissingImports=false
"""The reference's symbolic observation of batches that `batches.py` kept: its renderer, jitted and mapped over a batch.

A process of its own, because the reader's threads go on reading ahead.
"""

import argparse
import json
import pickle
import time
from pathlib import Path


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("kept", type=Path)
    parser.add_argument("--size", required=True)
    parser.add_argument("--seconds", type=float, required=True)
    args = parser.parse_args()

    import jax
    from kinetix.environment import EnvParams, static_env_params_from_size
    from kinetix.render import make_render_symbolic

    states = []
    with args.kept.open("rb") as file:
        while file.peek(1):
            states.append(pickle.load(file))
    render = jax.jit(jax.vmap(jax.vmap(make_render_symbolic(EnvParams(), static_env_params_from_size(args.size)))))
    shape = jax.block_until_ready(render(states[0])).shape
    start, count = time.process_time(), 0
    while time.process_time() - start < args.seconds:
        jax.block_until_ready(render(states[count % len(states)]))
        count += 1
    print(json.dumps({"core": (time.process_time() - start) / (count * shape[0]), "shape": shape}))


if __name__ == "__main__":
    main()

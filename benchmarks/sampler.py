"""Levels a second of our sampler and of the reference's, and the seconds of their first calls, compile included.

    python -m benchmarks.sampler [SIZE ...] [--write docs/benchmarks.md]

No cache of compiled code; one process each, one after the other, each with all cores and threads as its user has them.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from benchmarks.document import between_marks
from benchmarks.oracle import environment, oracle_python

LEVELS = 4096
MARK = "sampler"
BATCH = 512  # of the reference: its memory grows with the batch

OURS = """
import json, sys, time
import jax, numpy as np
from levelgen.level import SIZES
from levelgen.sampling.sampler import sample_levels
size, levels = SIZES[sys.argv[1]], int(sys.argv[2])
start = time.perf_counter()
jax.block_until_ready(sample_levels(np.arange(256), size))
first = time.perf_counter() - start
start = time.perf_counter()
jax.block_until_ready(sample_levels(np.arange(levels), size))
print(json.dumps({"first": first, "rate": levels / (time.perf_counter() - start)}))
"""

REFERENCE = """
import json, sys, time
import jax
from kinetix.environment import EnvParams, static_env_params_from_size
from kinetix.environment.ued.ued import make_reset_fn_sample_kinetix_level
size, levels, batch = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
sample = jax.jit(jax.vmap(make_reset_fn_sample_kinetix_level(EnvParams(), static_env_params_from_size(size))))
keys = jax.random.split(jax.random.PRNGKey(0), levels).reshape(-1, batch, 2)
start = time.perf_counter()
jax.block_until_ready(sample(keys[0]))
first = time.perf_counter() - start
count = len(keys) if size == "s" else 2
start = time.perf_counter()
for some in keys[:count]:
    jax.block_until_ready(sample(some))
print(json.dumps({"first": first, "rate": count * batch / (time.perf_counter() - start)}))
"""


def measured(python: object, program: str, *arguments: object) -> dict[str, float]:
    command = [str(python), "-c", program, *map(str, arguments)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sampler", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("size", nargs="*", default=list("sml"), help="s, m or l (default: all)")
    parser.add_argument("--write", type=Path, help="document to put the table into, between its marks")
    given = parser.parse_args()
    lines = ["| size | first call, s | reference | levels/s | reference | ratio |", "|---|---|---|---|---|---|"]
    for size in given.size:
        ours = measured(sys.executable, OURS, size, LEVELS)
        reference = measured(oracle_python(), REFERENCE, size, LEVELS, BATCH)
        lines.append(
            f"| {size} | {ours['first']:.1f} | {reference['first']:.0f} | {ours['rate']:,.0f} "
            f"| {reference['rate']:,.0f} | {ours['rate'] / reference['rate']:.1f} |"
        )
    print("\n".join(lines))
    if given.write:
        given.write.write_text(between_marks(given.write.read_text(), MARK, "\n".join(lines)))


if __name__ == "__main__":
    main()

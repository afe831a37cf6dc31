# pyright: reportMissingImports=false
"""The reference's side of `python -m benchmarks experts`, inside its own environment.

One run trains fresh experts (ppo.py) for a number of updates; solved.py measures what they solve.
"""

import argparse

import numpy as np
from serve import serve, timed
from world import load_levels, stay_on


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--levels", required=True, help="file of levels")
    parser.add_argument("--size", required=True)
    parser.add_argument("--first", type=int, required=True, help="first level of this process")
    parser.add_argument("--count", type=int, required=True, help="levels of this process")
    parser.add_argument("--environments", type=int, required=True)
    parser.add_argument("--horizon", type=int, required=True)
    parser.add_argument("--updates", type=int, required=True)
    parser.add_argument("--core", type=int)
    args = parser.parse_args()
    stay_on(args.core)

    import jax
    from ppo import Trainer

    levels = load_levels(args.levels, args.size, args.first, args.count)
    trainer = Trainer.of(args.size, args.environments, args.horizon)
    keys = jax.random.split(jax.random.PRNGKey(args.first), args.count)

    def compile_both():
        first = jax.jit(jax.vmap(trainer.start)).lower(keys, levels).compile()
        return first, jax.jit(jax.vmap(trainer.update)).lower(first(keys, levels), levels).compile()

    seconds, (first, compiled) = timed(compile_both)
    jax.block_until_ready(compiled(first(keys, levels), levels))  # the first run faults memory in

    def train():
        learner, ends = first(keys, levels), []
        for _ in range(args.updates):
            learner, flags = compiled(learner, levels)
            ends.append(flags)
        return jax.block_until_ready((learner, ends))

    def run() -> dict:
        seconds, (learner, ends) = timed(train)
        done, goal = (sum(float(end[k].sum()) for end in ends) for k in (0, 1))
        finite = all(bool(np.isfinite(np.asarray(x)).all()) for x in jax.tree.leaves(learner.params))
        return {"seconds": seconds, "done": done, "goal": goal, "finite": finite}

    serve({"compile_seconds": seconds}, run)


if __name__ == "__main__":
    main()

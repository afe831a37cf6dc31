"""Our side of `python -m benchmarks physics`: one process, which steps blocks of lanes that fit a core's cache."""

import argparse

import numpy as np

from benchmarks.reference.serve import serve, timed
from levelproof.pipeline.runtime import prepare_jax


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--levels", required=True, help="file of levels, as the reference has them")
    parser.add_argument("--actions", required=True, help="file of actions, (step, 6, lane)")
    parser.add_argument("--first", type=int, required=True, help="first lane of this process")
    parser.add_argument("--lanes", type=int, required=True, help="lanes of this process")
    parser.add_argument("--block", type=int, required=True, help="lanes stepped together")
    parser.add_argument("--core", type=int)
    args = parser.parse_args()
    prepare_jax(args.core)

    import jax

    from benchmarks.levels import load_levels
    from levelproof.levelgen.task import rules as task

    jax.config.update("jax_enable_compilation_cache", False)  # compiling is timed

    def rollout(level, now, actions):
        def act(now, action):
            now, outcome = task.step(level, now, action)
            return now, (outcome.reward.sum(), outcome.done.sum(), outcome.goal.sum())

        now, totals = jax.lax.scan(act, now, actions)
        return now, jax.tree.map(lambda x: x.sum(), totals)

    levels = load_levels(args.levels, args.first, args.lanes)
    actions = np.load(args.actions)[:, :, args.first : args.first + args.lanes]
    size = min(args.block, args.lanes)
    # pad the last block with its last lane, so that one program serves all
    cut = [np.minimum(np.arange(i, i + size), args.lanes - 1) for i in range(0, args.lanes, size)]
    blocks = [jax.tree.map(lambda x, at=at: jax.numpy.asarray(x[..., at]), (levels, actions)) for at in cut]
    worlds = [task.reset(level) for level, _ in blocks]
    first_level, first_actions = blocks[0]
    seconds, compiled = timed(lambda: jax.jit(rollout).lower(first_level, worlds[0], first_actions).compile())

    def play() -> list:
        out = [compiled(level, now, action) for (level, action), now in zip(blocks, worlds, strict=True)]
        return jax.block_until_ready(out)

    worlds = [now for now, _ in play()]  # the first run faults memory in

    def run() -> dict:
        nonlocal worlds
        seconds, out = timed(play)
        worlds = [now for now, _ in out]
        reward, done, goal = (float(sum(total[k] for _, total in out)) for k in range(3))
        finite = all(bool(np.isfinite(np.asarray(now.state.position)).all()) for now in worlds)
        return {"seconds": seconds, "reward": reward, "done": done, "goal": goal, "finite": finite}

    serve({"compile_seconds": seconds}, run)


if __name__ == "__main__":
    main()

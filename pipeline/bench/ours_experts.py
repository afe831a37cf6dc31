"""Our side of `levelproof bench experts`: one process of it. Experts train as in `levelproof generate`."""

import argparse

import numpy as np

from pipeline.bench.serve import serve, timed
from pipeline.runtime import prepare_jax


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--levels", required=True, help="file of levels, as the reference has them")
    parser.add_argument("--first", type=int, required=True, help="first level of this process")
    parser.add_argument("--count", type=int, required=True, help="levels of this process")
    parser.add_argument("--environments", type=int, required=True)
    parser.add_argument("--horizon", type=int, required=True)
    parser.add_argument("--updates", type=int, required=True)
    parser.add_argument("--core", type=int)
    given = parser.parse_args()
    prepare_jax(given.core)

    import jax

    from experts.config import ExpertConfig
    from experts.train import slot_count, train
    from levelgen.task import TaskParams
    from pipeline.bench.worlds import load_levels

    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured
    attempts = min(ExpertConfig.attempts, given.environments)  # of the evaluation, which is not measured
    config = ExpertConfig(environments=given.environments, horizon=given.horizon, attempts=attempts)
    levels = load_levels(given.levels, given.first, given.count)
    ids = np.arange(given.first, given.first + given.count, dtype=np.int32)
    slots = min(slot_count(config), given.count)
    batches = [np.minimum(np.arange(i, i + slots), given.count - 1) for i in range(0, given.count, slots)]

    def go(updates: int, batch: np.ndarray):
        mine = jax.tree.map(lambda x: x[..., batch], levels)
        return train(mine, jax.numpy.asarray(ids[batch]), updates, config, TaskParams())

    cold, _ = timed(lambda: go(1, batches[0]))
    warm, _ = timed(lambda: go(1, batches[0]))

    def run() -> dict:
        seconds, out = timed(lambda: [go(given.updates, batch) for batch in batches])
        finite = all(
            np.isfinite(np.asarray(x)).all() for slots, _ in out for x in jax.tree.leaves(slots.experts.params)
        )
        episodes, goals = 0.0, 0.0
        for slots, curve in out:
            ended = float(np.asarray(slots.progress.episodes).sum())
            episodes += ended
            goals += ended * float(np.nanmean(curve)) if ended else 0.0
        return {"seconds": seconds, "done": episodes, "goal": goals, "finite": bool(finite)}

    serve({"compile_seconds": cold - warm}, run)


if __name__ == "__main__":
    main()

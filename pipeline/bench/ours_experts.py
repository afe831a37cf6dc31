"""Our side of `levelproof bench experts`: one process of it. Experts train as in `levelproof generate`."""

import argparse

import numpy as np

from pipeline.bench.serve import serve, timed
from pipeline.runtime import prepare_jax

NEVER_ENDING = 10**6  # updates
# What the reference's side does; ours may have other defaults.
REFERENCE = {
    "width": 64,
    "depth": 2,
    "rehearsals": 0,
    "persistence": 0.0,
    "epochs": 4,
    "minibatches": 4,
    "learning_rate": 3e-4,
    "attempts": 1,
    "sticky_attempts": 0,
    "moved_attempts": 0,
}


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

    from experts.config import ExpertConfig, Rule, StopConfig
    from experts.slots import advance, empty_slots
    from experts.train import queue_of, slot_count
    from levelgen.task import TaskParams
    from pipeline.bench.worlds import load_levels

    jax.config.update("jax_enable_compilation_cache", False)  # compiling is measured
    # the reference's hyperparameters; no evaluation comes within the measured updates
    config = ExpertConfig(**REFERENCE, environments=given.environments, horizon=given.horizon)
    rules = TaskParams(dense_reward_scale=config.dense_reward_scale)
    levels = load_levels(given.levels, given.first, given.count)
    ids = np.arange(given.first, given.first + given.count, dtype=np.int32)
    slots = min(slot_count(config), given.count)
    batches = [np.minimum(np.arange(i, i + slots), given.count - 1) for i in range(0, given.count, slots)]

    def go(updates: int, batch: np.ndarray):
        queue = queue_of(jax.tree.map(lambda x: x[..., batch], levels), ids[batch], NEVER_ENDING, config)
        now, goals = empty_slots(slots, queue, config), np.zeros(len(batch))
        for _ in range(updates):
            before = np.asarray(now.slot.training.progress.episodes)
            now, seen = advance(now, queue, config, StopConfig(rule=Rule.BUDGET), rules)
            ended = np.asarray(now.slot.training.progress.episodes) - before
            goals += np.nan_to_num(np.asarray(seen.share)) * ended
        return now.slot.training, goals

    cold, _ = timed(lambda: go(1, batches[0]))
    warm, _ = timed(lambda: go(1, batches[0]))

    def run() -> dict:
        seconds, out = timed(lambda: [go(given.updates, batch) for batch in batches])
        finite = all(np.isfinite(np.asarray(x)).all() for training, _ in out for x in jax.tree.leaves(training.expert))
        episodes = sum(float(np.asarray(training.progress.episodes).sum()) for training, _ in out)
        goals = sum(float(goals.sum()) for _, goals in out)
        return {"seconds": seconds, "done": episodes, "goal": goals, "finite": bool(finite)}

    serve({"compile_seconds": cold - warm}, run)


if __name__ == "__main__":
    main()

"""Our side of `python -m benchmarks experts`: one process, which trains experts as `levelproof generate` does."""

import argparse
from dataclasses import replace

import numpy as np

from benchmarks.reference.serve import serve, timed
from levelproof.pipeline.runtime import prepare_jax


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--levels", required=True, help="file of levels, as the reference has them")
    parser.add_argument("--first", type=int, required=True, help="first level of this process")
    parser.add_argument("--count", type=int, required=True, help="levels of this process")
    parser.add_argument("--environments", type=int, required=True)
    parser.add_argument("--horizon", type=int, required=True)
    parser.add_argument("--updates", type=int, required=True)
    parser.add_argument("--core", type=int)
    args = parser.parse_args()
    prepare_jax(args.core)

    import jax

    from benchmarks.endless import endless_slots, update_slots
    from benchmarks.levels import load_levels
    from benchmarks.solved.variants import REFERENCE
    from levelproof.experts.pool.pool import slot_count
    from levelproof.experts.training.slots import Training
    from levelproof.levelgen.batching import take
    from levelproof.levelgen.task.rules import TaskParams

    jax.config.update("jax_enable_compilation_cache", False)  # compiling is timed
    no_evaluation = {"attempts": 1, "sticky_attempts": 0, "perturbed_attempts": 0}
    config = replace(REFERENCE.expert, environments=args.environments, horizon=args.horizon, **no_evaluation)
    rules = TaskParams(dense_reward_scale=config.dense_reward_scale)
    levels = load_levels(args.levels, args.first, args.count)
    slots = min(slot_count(config), args.count)
    batches = [np.minimum(np.arange(i, i + slots), args.count - 1) for i in range(0, args.count, slots)]

    def train(updates: int, batches: list[np.ndarray]) -> list[tuple[Training, float]]:
        """Train fresh experts, batch after batch; return their training states and goals reached."""
        return [train_batch(batch, updates) for batch in batches]

    def train_batch(batch: np.ndarray, updates: int) -> tuple[Training, float]:
        now, goals, ended = endless_slots(take(levels, batch), batch, config), 0.0, np.zeros(slots)
        for _ in range(updates):
            now, report = update_slots(now, config, rules)
            before, ended = ended, np.asarray(now.slot.training.progress.episodes)
            goals += float((np.nan_to_num(np.asarray(report.share)) * (ended - before)).sum())
        return now.slot.training, goals

    cold, _ = timed(lambda: train(1, batches[:1]))
    warm, _ = timed(lambda: train(1, batches[:1]))

    def run() -> dict:
        seconds, out = timed(lambda: train(args.updates, batches))
        finite = all(
            np.isfinite(np.asarray(x)).all() for training, _ in out for x in jax.tree.leaves(training.train_state)
        )
        episodes = sum(float(np.asarray(training.progress.episodes).sum()) for training, _ in out)
        return {"seconds": seconds, "done": episodes, "goal": sum(goals for _, goals in out), "finite": bool(finite)}

    serve({"compile_seconds": cold - warm}, run)


if __name__ == "__main__":
    main()

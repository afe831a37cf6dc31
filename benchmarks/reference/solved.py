# pyright: reportMissingImports=false
"""The reference's side of `python -m benchmarks solved --variant original`, inside its own environment.

Trains and evaluates the experts of ppo.py. Answers requests (see serve.py):
    begin     make fresh experts for the levels of the file `levels`, which has their `level_id`
    update    update all experts once
    evaluate  write flags of training and of an evaluation to the file `out`, level axis first; answer with the
              core-seconds since `begin`
"""

import argparse
import time

import numpy as np
from serve import answer
from world import load_levels, stay_on


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", required=True)
    parser.add_argument("--width", type=int, required=True, help="levels trained side by side; a file may have fewer")
    parser.add_argument("--environments", type=int, required=True)
    parser.add_argument("--horizon", type=int, required=True)
    parser.add_argument("--attempts", type=int, required=True, help="attempts of an evaluation")
    parser.add_argument("--steps", type=int, required=True, help="env steps of an attempt")
    parser.add_argument("--cache", required=True, help="folder for compiled code")
    parser.add_argument("--core", type=int)
    args = parser.parse_args()
    stay_on(args.core)

    import jax

    jax.config.update("jax_compilation_cache_dir", args.cache)
    answer({}, Batch(args).answer)


class Batch:
    """Levels and their experts, trained side by side."""

    def __init__(self, args: argparse.Namespace) -> None:
        import jax
        from ppo import Trainer

        def evaluate(learner, level, key):
            return trainer.evaluate(learner, level, key, args.attempts, args.steps)

        trainer = Trainer.of(args.size, args.environments, args.horizon)
        self.args, self.compiled = args, False
        self.start_all, self.update_all, self.evaluate_all = (
            jax.jit(jax.vmap(program)) for program in (trainer.start, trainer.update, evaluate)
        )

    def answer(self, request: dict) -> dict:
        if not self.compiled:  # so that compiling is not timed
            self.begin(request["levels"])
            self.update()
            self.results()
            self.compiled = True
        match request["do"]:
            case "begin":
                self.begin(request["levels"])
            case "update":
                self.update()
            case "evaluate":
                np.savez(request["out"], **self.results())  # pyright: ignore[reportArgumentType]
                return {"core_seconds": time.process_time() - self.since}
        return {}

    def begin(self, path: str) -> None:
        import jax

        self.since = time.process_time()
        with np.load(path) as file:
            ids = file["level_id"]
        self.count = len(ids)
        self.levels = load_levels(path, self.args.size, 0, self.args.width)
        seeds = np.resize(ids, self.args.width).astype(np.uint32)
        keys = jax.vmap(lambda seed: jax.random.split(jax.random.PRNGKey(seed)))(seeds)
        self.evaluation_keys = keys[:, 1]
        self.learner, self.flags = self.start_all(keys[:, 0], self.levels), []

    def update(self) -> None:
        self.learner, flags = self.update_all(self.learner, self.levels)
        self.flags.append([np.asarray(x) for x in flags])

    def results(self) -> dict[str, np.ndarray]:
        """Return training flags (level, env step, environment), evaluation actions and flags (level, step, attempt)."""
        trained = (np.concatenate(x, 1) for x in zip(*self.flags, strict=True))
        evaluated = (np.asarray(x) for x in self.evaluate_all(self.learner, self.levels, self.evaluation_keys))
        names = ("trained_done", "trained_goal", "action", "done", "goal")
        return {name: x[: self.count] for name, x in zip(names, (*trained, *evaluated), strict=True)}


if __name__ == "__main__":
    main()

"""An expert trained for the one level of a page, told about while it trains."""

from collections.abc import Iterator
from math import isnan
from threading import Event
from time import monotonic
from typing import Any

import jax
import numpy as np

from levelproof.experts.labels import WITNESSED
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.run import TrainingRun
from levelproof.experts.procedure import Procedure
from levelproof.experts.verdict.attempts import attempts
from levelproof.levelgen.files.level_file import LevelFile
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.pipeline.play.session import places_of

ATTEMPTS = 12  # that a page shows at once
SHOWN_STEPS = 128  # env steps of each
BETWEEN = 0.8  # s between attempts that are shown
Message = dict[str, Any]


def trained(file: LevelFile, procedure: Procedure, budget: int, stop: Event) -> Iterator[Message]:
    """Label a level as `generate` labels level files, and tell how far it is; the last message has the verdict.

    Args:
        file: the level and its rules.
        procedure: how it is labelled.
        budget: env steps of its expert.
        stop: set: end before the label is known.
    """
    yield {"stage": "compiling"}
    pool, shown = Pool(budget, procedure, file.rules), monotonic()
    level_id = level_id_for(content_hashes(file.level)[0])
    run = TrainingRun(pool, file.level, np.array([level_id]))
    while not stop.is_set():
        ended = pool.step()
        if run.submission is None:
            run.look()
            yield {"stage": "searching", "env_steps": run.totals().env_steps}
            continue
        if ended:
            yield verdict_of(run)
            return
        curve = run.submission.curves[0]
        yield {
            "stage": "training",
            "env_steps": run.totals().env_steps,
            "curve": [None if isnan(rate) else rate for rate in curve],
        }
        if monotonic() - shown > BETWEEN:
            shown, key = monotonic(), jax.random.key(len(curve))
            ((_, _, paused),) = pool.paused()
            params = paused.expert.begun.training.train_state.params
            seen = attempts(file.level, params, key, procedure.expert, file.rules, ATTEMPTS, SHOWN_STEPS)
            seen = jax.device_get(seen)
            each = [places_of(file.level, seen.position[..., i], seen.rotation[..., i]) for i in range(ATTEMPTS)]
            yield {"attempts": each, "goals": seen.goal.tolist()}
    yield {"stage": "stopped"}


def verdict_of(run: TrainingRun) -> Message:
    """What a page is told of a label; `witness` are actions [step, 6], or None."""
    env_steps = run.totals().env_steps
    result = run.finish()
    (verdict,) = result.verdicts
    solved = verdict.label in WITNESSED
    return {
        "stage": "done",
        "label": str(verdict.label),
        "reason": verdict.label_reason,
        "source": verdict.witness and str(verdict.witness),
        "success_rate": float(np.nan_to_num(verdict.success_rate)),
        "env_steps": env_steps,
        "witness": result.record.action[: verdict.steps_to_goal, :, 0] if solved else None,
    }

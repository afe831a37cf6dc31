"""Training of an expert for a page's level, with progress messages."""

from collections.abc import Iterator
from math import isnan
from threading import Event
from time import monotonic

import jax
import numpy as np

from levelproof.experts.labels import WITNESSED
from levelproof.experts.pool.pool import Pool
from levelproof.experts.pool.run import TrainingRun
from levelproof.experts.procedure import Procedure
from levelproof.experts.verdict.attempts import attempts
from levelproof.levelgen.files.level_file import LevelFile
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.pipeline.play.session import Message, places_of

ATTEMPTS = 12  # attempts shown side by side
SHOWN_STEPS = 128  # env steps shown of each attempt
ATTEMPT_INTERVAL = 0.8  # minimum s between updates of the attempts


def train_level(file: LevelFile, procedure: Procedure, budget: int, stop: Event) -> Iterator[Message]:
    """Label a level as `generate` labels level files; yield progress messages, the last with the verdict.

    Args:
        file: the level and its rules.
        procedure: how levels are labelled.
        budget: env steps the expert may use.
        stop: once set, training ends without a verdict.
    """
    yield {"stage": "compiling"}
    pool, shown = Pool(budget, procedure, file.rules), monotonic()
    level_id = level_id_for(content_hashes(file.level)[0])
    run = TrainingRun(pool, file.level, np.array([level_id]))
    while not stop.is_set():
        ended = pool.step()
        if run.submission is None:
            run.submit_searched()
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
        if monotonic() - shown > ATTEMPT_INTERVAL:
            shown, key = monotonic(), jax.random.key(len(curve))
            ((_, _, paused),) = pool.paused()
            params = paused.expert.begun.training.train_state.params
            played = attempts(file.level, params, key, procedure.expert, file.rules, ATTEMPTS, SHOWN_STEPS)
            played = jax.device_get(played)
            each = [places_of(file.level, played.position[..., i], played.rotation[..., i]) for i in range(ATTEMPTS)]
            yield {"attempts": each, "goals": played.goal.tolist()}
    yield {"stage": "stopped"}


def verdict_of(run: TrainingRun) -> Message:
    """Finish the run; return the message about its label. `witness` are actions [step, 6], or None."""
    env_steps = run.totals().env_steps
    result = run.finish()
    (verdict,) = result.verdicts
    solved = verdict.label in WITNESSED
    return {
        "stage": "done",
        "label": str(verdict.label),
        "reason": verdict.label_reason,
        "env_steps": env_steps,
        "witness": result.record.action[: verdict.steps_to_goal, :, 0] if solved else None,
    }

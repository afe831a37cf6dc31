"""Rounds of distilling: the learner plays, teachers label states of its episodes, and experts show their levels."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
from flax.typing import VariableDict
from jaxtyping import Array, Int, Int8, Key

from levelproof.configs.distill import DistillConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.evaluation import FirstAttempts, first_attempts, play_sampled
from levelproof.experts.generalist.demonstrations import demonstrations
from levelproof.experts.generalist.teachers import AT_ONCE, Asked, KnownExperts, Labels, Teacher, label_states
from levelproof.experts.generalist.visited import draw_states, state_at
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.levelgen.batching import by_blocks, take
from levelproof.levelgen.identity.keys import key_of_seed
from levelproof.levelgen.level import Level
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.dataset.order import EpochOrder
from levelproof.pipeline.learn.labelled import LabelBuffer, with_labels
from levelproof.pipeline.learn.pool import LevelPool

SHOWN_AT_ONCE = 256  # demonstrations that are played side by side
ASKING, SHOWING = 7, 8  # folded into the seed's key; `experts.generalist.train` takes 1 to 4


class TaughtLevels(NamedTuple):
    """The levels of a run, with what teachers know of them."""

    level_ids: Int[np.ndarray, " level"]
    levels: Level  # with first states; on the host, level axis last
    witnesses: LevelPool
    experts: KnownExperts
    rules: TaskParams

    def witness_of(self, levels: Int[np.ndarray, " state"]) -> Int8[np.ndarray, "256 6 state"]:
        """Return the witnesses of levels; the last action is repeated."""
        pool = self.witnesses
        row = pool.first[levels] + np.minimum(np.arange(RECORD_STEPS)[:, None], pool.steps[levels] - 1)
        return np.moveaxis(pool.action[row], -1, 1)


class Taught(NamedTuple):
    """Labels, and the levels that they are of."""

    level: Int[np.ndarray, " state"]  # index of each state's level
    labels: Labels


class LearnerEpisodes(NamedTuple):
    """The learner's episodes of a round."""

    level: Int[np.ndarray, " episode"]  # index of each episode's level
    levels: Level
    attempts: FirstAttempts


def teach(
    taught: TaughtLevels,
    config: DistillConfig,
    network: NetworkConfig,
    learner: VariableDict,
    labels: LabelBuffer,
    number: int,
) -> tuple[LabelBuffer, dict[str, float]]:
    """Return `labels` with those of round `number`, and the round's metrics."""
    rng = np.random.default_rng([config.seed, number, ASKING])
    key = key_of_seed(config.seed)
    asking, showing = (jax.random.fold_in(jax.random.fold_in(key, purpose), number) for purpose in (ASKING, SHOWING))
    played = play(taught, config, network, learner, number, int(rng.integers(2**31)))
    asked = ask(taught, config, network, learner, played, rng, asking) if config.states else None
    if asked:
        labels = with_labels(labels, *asked, config.path)
    numbers, reached = numbers_of(played, asked), []
    for shown in shown_by_experts(taught, config, network, showing, number):
        labels = with_labels(labels, *shown, config.path)
        reached.append(shown.labels.length > 0)
        numbers["distill/env_steps"] += shown.labels.env_steps
    numbers["distill/demonstrations"] = sum(map(len, reached))
    numbers["distill/demonstrated"] = float(np.concatenate(reached).mean()) if reached else np.nan
    return labels, numbers


def play(
    taught: TaughtLevels, config: DistillConfig, network: NetworkConfig, learner: VariableDict, number: int, seed: int
) -> LearnerEpisodes:
    """Let the learner play the levels of round `number`; `seed` decides its actions."""
    count = len(taught.level_ids)
    chosen, _ = EpochOrder(count, min(count, config.episodes), config.seed).items(number)
    levels, ids = take(taught.levels, chosen), taught.level_ids[chosen].astype(np.int32)
    attempts = first_attempts(play_sampled(network), learner, levels, ids, seed, taught.rules)
    return LearnerEpisodes(chosen, levels, attempts)


def ask(
    taught: TaughtLevels,
    config: DistillConfig,
    network: NetworkConfig,
    learner: VariableDict,
    played: LearnerEpisodes,
    rng: np.random.Generator,
    key: Key[Array, ""],
) -> Taught:
    """Ask the teachers about states of the learner's episodes; `rng` and `key` are consumed."""
    action, steps, solved = played.attempts
    episode, at = draw_states(rng, steps, solved, config.states, config.failed)
    into = lambda some: state_at(take(played.levels, episode[some]), action[..., episode[some]], at[some], taught.rules)
    states = by_blocks(into, len(at), AT_ONCE)
    level = played.level[episode]
    asked = Asked(take(played.levels, episode), states, taught.witness_of(level))
    experts = taught.experts.of(level)
    return Taught(level, label_states(asked, experts, learner, network, config.teachers, key, taught.rules))


def shown_by_experts(
    taught: TaughtLevels, config: DistillConfig, network: NetworkConfig, key: Key[Array, ""], number: int
) -> Iterator[Taught]:
    """Yield what kept experts show in round `number`, in batches; `key` is consumed."""
    known = np.flatnonzero(taught.experts.expert >= 0)
    if not config.demonstrations:
        return
    # An order independent of that of the levels that the learner plays
    order = EpochOrder(len(known), min(len(known), config.demonstrations), config.seed + SHOWING)
    level = known[order.items(number)[0]]
    for first in range(0, len(level), SHOWN_AT_ONCE):
        some = level[first : first + SHOWN_AT_ONCE]
        of_batch = take(taught.levels, some), taught.experts.of(some), config.teachers.sticky, config.teachers.perturbed
        of_key = jax.random.fold_in(key, first)
        yield Taught(some, demonstrations(*of_batch, network.reads_contacts, of_key, taught.rules))


def numbers_of(played: LearnerEpisodes, asked: Taught | None) -> dict[str, float]:
    """Return the metrics of the learner's episodes, and of what was asked about them."""
    teacher, length = (asked.labels.teacher, asked.labels.length) if asked else (np.zeros(0, int), np.zeros(0, int))
    by = {f"distill/by_{each.name.lower()}": int((teacher == each).sum()) for each in Teacher if each}
    labelled = length > 0
    mean = lambda x: float(x.mean()) if len(x) else np.nan
    return {
        "distill/solve_rate": float(played.attempts.solved.mean()),
        "distill/asked": len(length),
        **by,
        "distill/none": int((~labelled).sum()),
        "distill/labelled": mean(labelled),
        "distill/steps_to_goal": mean(length[labelled]),
        "distill/env_steps": int(played.attempts.env_steps.sum()) + (asked.labels.env_steps if asked else 0),
    }

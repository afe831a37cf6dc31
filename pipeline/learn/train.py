"""Reinforcement learning of one policy over many levels, with checkpoints from which a run continues bit for bit."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from levelproof.configs.train import TrainConfig
from levelproof.experts.generalist.config import CHUNK
from levelproof.experts.generalist.curricula import UNIFORM, Curriculum
from levelproof.experts.generalist.evolve import evolve
from levelproof.experts.generalist.learnability import learnability
from levelproof.experts.generalist.replay import replay
from levelproof.experts.generalist.rollout import table_of
from levelproof.experts.generalist.train import Learner, Programs, TrainingRecipe, UpdateFacts, programs_of
from levelproof.experts.networks.saved import Policy
from levelproof.levelgen.level import Level
from levelproof.levelgen.sampling.sampler import Sampler
from levelproof.levelgen.task.lanes import Table
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.curves import BLUE, GREEN, Curves, Panel
from levelproof.pipeline.learn.folder import continued, note_in, origin_of, settings_without, weights_digest
from levelproof.pipeline.learn.pace import Pace
from levelproof.pipeline.learn.run import Begun, Run, make_policy
from levelproof.pipeline.learn.trained_on import TrainingLevels, levels_for
from levelproof.pipeline.read.policies import policy_at, require_size
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.store.progress_bar import TextBar, say
from levelproof.pipeline.words import duration, many

COURSE = Curves(
    "train/env_steps",
    "env steps",
    (
        Panel("Episodes that reach the goal", {GREEN: "train/solve_rate"}, 1.0),
        Panel("Entropy, nats", {BLUE: "loss/entropy"}),
    ),
    {GREEN: "solve rate", BLUE: "entropy"},
)
LATER = ("settings", "ppo", "env_steps")  # in the note: where training ends, which a resumed run may move
WITHOUT_EFFECT = "log", "interval", "cores"  # settings that a resumed run may change; the cores are noted separately


def train(config: TrainConfig, out: Path, console: Console) -> None:
    """Train a policy, or continue a run; write it to `out`, and print where it is.

    Raises:
        UserError: levels, the policy to start from or settings are unusable; `out` is unusable, in use or has another
            run; or a library is missing.
        Failure: the data or the checkpoint is damaged.
    """
    tell = lambda text: say(console, text)
    cores = prepared_cores(config, note_in(out))
    source = levels_for(config, tell)
    start = policy_at(Path(config.start)) if config.start else None
    if start:
        require_size(start, source.levels.size, source.name, "start from one that plays any size")
        tell(f"Training {config.start} on {source.name}.")
    recipe = recipe_of(config, source, start, cores)
    if (share := config.ppo.samples(cores) * cores / config.ppo.environments) < config.ppo.subsample:
        why = f"each of {many(cores, 'core')} learns from a whole number of chunks of {CHUNK} lanes"
        tell(f"The policy learns from {share:.1%} of samples, not {config.ppo.subsample:.1%}, because {why}.")
    note = note_of(config, source, cores)

    def policy_of(note: dict[str, Any], learner: Learner) -> Policy:
        origin = origin_of(note, {"env_steps": int(learner.updates) * config.ppo.steps_per_update}, start)
        return Policy(recipe.network, learner.average, recipe.network.only_size(source.levels.size), origin)

    def begin() -> Begun[Learner]:
        table, params = table_of(source.levels, recipe.rules), start.params if start else None
        programs = programs_of(recipe, table, params, cores)
        fresh = programs.begin(table, params)
        table, params = jax.device_put((table, params), fresh.updates.sharding)  # once, not in every update
        learner = jax.tree.map(lambda x, like: jax.device_put(x, like.sharding), continued(out, fresh), fresh)
        updates = int(learner.updates)
        steps = updates * config.ppo.steps_per_update
        if updates > config.ppo.updates:
            raise UserError(f"{out} has {steps:,} env steps of training already: set a larger ppo.env_steps.")
        advance = lambda run: update_until_done(programs, learner, table, params, recipe, config.interval, run, console)
        return Begun(learner, steps, updates < config.ppo.updates, advance)

    make_policy(out, note, COURSE, config.log, begin, policy_of, tell, LATER)


def prepared_cores(config: TrainConfig, note: dict[str, Any] | None) -> int:
    """Set JAX up, and return how many devices share the lanes: as many as before if the run continues.

    Raises:
        UserError: JAX has fewer devices than that, or uses a GPU.
    """
    noted = (note or {}).get("cores", 0)
    wanted = noted if noted and config.ppo.divides_evenly(noted) else config.cores  # else it is another run's folder
    even = next((cores for cores in range(len(own_cores()), 1, -1) if config.ppo.divides_evenly(cores)), 1)
    prepare_jax(devices=wanted or even)
    if jax.default_backend() != "cpu":
        if wanted > 1:
            whose = "The run so far used" if wanted == noted else "The command asks for"
            raise UserError(f"{whose} {wanted} cores, but JAX uses a GPU here: set JAX_PLATFORMS=cpu.")
        return 1
    there = len(jax.devices())
    if wanted > there:
        raise UserError(f"cores is {wanted}, but JAX has been set up for {there} in this process: set cores={there}.")
    return wanted or min(even, there)


def recipe_of(config: TrainConfig, source: TrainingLevels, start: Policy | None, cores: int) -> TrainingRecipe:
    """Return what decides the programs.

    Raises:
        UserError: the cores do not divide the lanes evenly, or measured episodes would have no time to fail.
    """
    try:
        config.ppo.samples(cores)
    except ValueError as error:
        raise UserError(f"ppo.{error}.") from None
    network = start.network if start else config.network
    curriculum = curriculum_of(config, source.levels, source.rules)
    rules = config.ppo.training_rules(source.rules)
    return TrainingRecipe(network, source.levels.size, config.ppo, curriculum, rules, config.seed)


def curriculum_of(config: TrainConfig, levels: Level | Sampler, rules: TaskParams) -> Curriculum:
    """Return the curriculum that the settings name."""
    if config.chosen_by == "learnability":
        if config.curriculum.measured_steps < rules.max_timesteps:
            raise UserError(
                f"curriculum.measured_steps is {config.curriculum.measured_steps}, but episodes have up to "
                f"{rules.max_timesteps} env steps: late failures would not count, so raise it to at least that number."
            )
        return learnability(config.curriculum)
    if config.chosen_by == "replay":
        return replay(config.replay)
    if config.chosen_by == "evolve":
        assert isinstance(levels, Sampler)
        return evolve(config.evolve, config.replay, levels, rules)
    return UNIFORM


def note_of(config: TrainConfig, source: TrainingLevels, cores: int) -> dict[str, Any]:
    """Return what decides a run's result, as JSON."""
    settings = settings_without(config, WITHOUT_EFFECT)
    return {
        "settings": settings,
        "levels": source.facts,
        "start": weights_digest(config.start),
        "cores": cores,
    }


def update_until_done(
    programs: Programs,
    learner: Learner,
    table: Table,
    start: Any,
    recipe: TrainingRecipe,
    interval: int,
    run: Run[Learner],
    console: Console,
) -> Learner:
    """Take the updates that are left, or those until a stop; keep the learner and metrics every `interval` of them.

    Raises:
        Failure: the weights have diverged.
    """
    last, first, per_update = recipe.ppo.updates, int(learner.updates), recipe.ppo.steps_per_update
    pace, recent = Pace(), []
    every = recipe.curriculum.every
    with TextBar(console, "compiling", last, first) as bar, run.stop.heeded():
        for update in range(first + 1, last + 1):
            if every and (update - 1) % every == 0:
                learner = programs.between_updates(learner, table)
            learner, facts = programs.advance(learner, table, start)
            recent.append(jax.device_get(facts))
            rate = pace.count(per_update)
            words, solved = f"{update * per_update:,} env steps", averages(recent)["train/solve_rate"]
            if np.isfinite(solved):
                words += f" · {solved:.1%} solved"
            if rate:
                words += f" · {rate:,.0f} env steps/s · about {duration((last - update) * per_update / rate)} left"
            stops = run.stop.asked.is_set()
            if keep := update % interval == 0 or update == last or stops:
                with pace.aside():
                    numbers = {COURSE.step: update * per_update, "train/updates": update} | averages(recent)
                    numbers |= recipe.curriculum.facts(learner.curriculum)
                    numbers["train/env_steps_per_second"] = rate or np.nan  # unknown
                    recent = []
                    run.keep(learner, numbers, "loss/value", "ppo.learning_rate")
            bar.show(update, words, keep=keep)
            if stops:
                break
    return learner


def averages(recent: Sequence[UpdateFacts]) -> dict[str, float]:
    """Return the metrics of some updates; NaN where no episode ended."""
    total = UpdateFacts(*(np.sum(column) for column in zip(*recent, strict=True)))
    episodes = total.episodes or np.nan
    mean = lambda name: float(getattr(total, name) / len(recent))
    return {
        "train/episodes": int(total.episodes),
        "train/solve_rate": float(total.solved / episodes),
        "train/return": float(total.reward / episodes),
        "train/episode_steps": float(total.env_steps / episodes),
        "loss/entropy": mean("entropy"),
        "loss/value": mean("value_error"),
        "loss/kl": mean("kl_to_before"),
        "loss/kl_to_start": mean("kl_to_start"),
    }

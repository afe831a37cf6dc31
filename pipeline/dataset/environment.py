"""Construction of the environment from levels or from a split."""

import os
from dataclasses import replace
from pathlib import Path

from levelproof.levelgen.level import Level
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.sampler import Sampler, sampler
from levelproof.levelgen.task import environment
from levelproof.levelgen.task.environment import ActionType, Environment, EnvParams
from levelproof.levelgen.task.observe.kinds import ObservationType
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.physics.types import Size
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.read.levels import COLUMNS, levels_of, rules_of
from levelproof.pipeline.read.select import require_selected
from levelproof.pipeline.urls import quoted


def make(
    levels: Level | Sampler | Size | str | None = None,
    action_type: str = ActionType.MULTI_DISCRETE,
    observation_type: str = ObservationType.SYMBOLIC_FLAT,
    rules: TaskParams | None = None,
    auto_reset: bool = True,
    final_observation: bool = False,
    *,
    split: str | os.PathLike[str] | None = None,
    where: str | None = None,
    distribution: Distribution | str | None = None,
) -> tuple[Environment, EnvParams]:
    """Make an environment and its default parameters, from a size, from levels or from a split.

    The environment has gymnax's functions, such as `env.reset(key, params)` and `env.step(key, state, action, params)`,
    for one environment: batch them with `jax.vmap`.

    Args:
        levels: a size such as "s": every reset samples a new random level, and `level_index` is its id. Or levels from
            which resets draw uniformly, level axis last.
        action_type: `discrete` (an integer), `multi_discrete` (integers [6]: four motors, two thrusters) or
            `continuous` (floats [6]: motors in [-1, 1], thrusters in [0, 1]).
        observation_type: `symbolic_flat` (float32 [feature]), `symbolic_flat_padded`, `symbolic_entity` or `pixels`
            (`levelproof.levelgen.task.observe`).
        rules: task rules; None: those of the split, or the defaults.
        auto_reset: whether a step that ends an episode returns the first state and observation of the next one.
        final_observation: whether `info["final_observation"]` has the observation before an automatic reset.
        split: path or URL of a split, such as `data/128k/s`, instead of `levels`: uses all its levels, with or without
            a witness, sorted by id (`env.level_ids`).
        distribution: of the random levels of a size, or the name of a preset; None: the default.
        where: SQL condition on the manifest's columns that selects levels of the split, such as `label = 'solved' AND
            steps_to_goal < 64`; None: all.

    Returns:
        The environment, and its parameters, which hold the levels.

    Raises:
        UserError: neither or both of `levels` and `split` are given, the split does not exist, the condition is
            invalid, no level meets it, or there is no such preset.
        Failure: the split is damaged.
        ValueError: a type or a size is unknown, there are no levels, or `jax_enable_x64` is on.
    """
    if (levels is None) == (split is None):
        raise UserError("make takes either levels or split=, the path of a split: pass one of them.")
    kinds, resets = (action_type, observation_type), (auto_reset, final_observation)
    if split is not None:
        if distribution is not None:
            raise UserError("distribution= is only for random levels, but split= has its own levels: leave it out.")
        return _of_split(split, where, rules, kinds, resets)
    if where is not None:
        raise UserError("where= is a condition on the levels of a split: pass split= with it, not levels.")
    assert levels is not None
    if isinstance(levels, str | Size):
        levels = sampler(levels, _distribution(distribution))
    elif distribution is not None:
        raise UserError("distribution= is only for random levels: pass a size such as 's' as levels, or leave it out.")
    return environment.make(levels, *kinds, rules or DEFAULT_RULES, *resets)


def _of_split(
    split: str | os.PathLike[str],
    where: str | None,
    rules: TaskParams | None,
    kinds: tuple[str, str],
    resets: tuple[bool, bool],
) -> tuple[Environment, EnvParams]:
    """Make an environment of the levels of a split, with the task's rules there if `rules` are None."""
    manifest = require_selected(Path(split), ["level_id", *COLUMNS], where)
    rows = manifest.table
    if not rows.num_rows:
        raise UserError(
            f"The split {split} has no level for which {where} holds: `levelproof inspect {quoted(Path(split))}` shows "
            "its levels."
        )
    levels = levels_of(manifest, rows, in_command=False)
    env, params = environment.make(levels, *kinds, rules or rules_of(manifest), *resets)
    return replace(env, level_ids=rows["level_id"].to_numpy()), params


def _distribution(chosen: Distribution | str | None) -> Distribution:
    """Return the distribution, that of a preset's name, or the default. Raise UserError if there is no such preset."""
    if not isinstance(chosen, str):
        return chosen or Distribution()
    from levelproof.configs.compose import distributions  # imports Hydra

    known = distributions()
    if chosen not in known:
        raise UserError(f"There is no distribution {chosen!r}: choose one of {', '.join(known)}.")
    return known[chosen]

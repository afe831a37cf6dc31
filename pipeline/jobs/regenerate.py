"""Training a split's levels at another budget: `levelproof regenerate manifest=data/256k/s budget=1M`."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from levelproof.configs.compose import changed_settings, compose_job
from levelproof.configs.schema import from_files, other_sampler
from levelproof.experts.procedure import Procedure
from levelproof.pipeline.errors import Exit, UserError
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.processes import in_another_process
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.origins import Origin, origins_of
from levelproof.pipeline.store.seed.file import is_seed

OWN = ("manifest", "where", "continue")  # arguments that are not settings of a job
FIXED = ("size", "levels", "first_level", "level_files", "distribution")  # settings that the manifest decides
OF_PROCEDURE = {field.name for field in fields(Procedure)}  # groups of settings that a procedure decides
HINT = "as in levelproof regenerate manifest=data/256k/s budget=1M where=\"label = 'unsolved'\""


@stoppable()
def regenerate(arguments: Sequence[str], console: Console) -> Exit:
    """Train all levels of a manifest, or those that meet a condition, at another budget.

    Args:
        arguments: `manifest=SPLIT`, `budget=N`, and optionally `where=SQL`, `continue=true` and settings of `generate`.
        console: receives progress and messages.

    Raises:
        UserError: an argument is missing or wrong, or no level is chosen; or see `generate`.
        Failure: the manifest is damaged; or see `generate`.
    """
    own, settings = split_arguments(arguments)
    source, where = Path(own["manifest"]).expanduser(), own.get("where")
    # To hash the levels of seeds, JAX starts
    chosen = in_another_process(_chosen, source, where) if is_seed(source) else _chosen(source, where)
    config, level_ids, origins = chosen
    resumed = [f"continue_from={source}"] if own.get("continue") == "true" else []
    files = [f"level_files={source}"] if origins is not None else []
    job = replace(compose_job([*kept_settings(config, settings), *settings, *resumed, *files]), size=config["size"])
    return generate(job, ["levelproof", "regenerate", *arguments], console, level_ids, origins)


def _chosen(source: Path, where: str | None) -> tuple[Mapping[str, Any], list[int], dict[int, Origin] | None]:
    """Return a split's settings, the ids of the levels that meet a condition, and their origins if these are files.

    Raises:
        UserError: another sampler made the levels, or none meets the condition.
        Failure: the manifest is damaged.
    """
    if is_seed(source):
        prepare_jax(device="cpu")
    manifest = require_manifest(source, columns_in(where))
    config = manifest.config or {}
    if differs := other_sampler(config):
        raise UserError(f"The split {source} {differs}: use the levelproof that made it.")
    level_ids = select(manifest.table, where).column("level_id").to_pylist()
    if not level_ids:
        raise UserError(f"No level of {source} meets the condition {where!r}: choose others with where.")
    return config, level_ids, origins_of(source, level_ids) if from_files(config) else None


def split_arguments(arguments: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return the values of the arguments in OWN by name, and the arguments that are settings.

    Raises:
        UserError: an argument is missing or wrong, or a setting is one that the manifest decides.
    """
    values = {name: value for name, _, value in (argument.partition("=") for argument in arguments)}
    own = {name: values[name] for name in OWN if name in values}
    if "manifest" not in own:
        raise UserError(f"No manifest was given: name the split of the levels, {HINT}.")
    if "budget" not in values:
        raise UserError(f"No budget was given: set it, {HINT}.")
    for name in FIXED:
        if any(key.partition(".")[0] == name for key in values):
            raise UserError(f"{name} cannot be changed, because the manifest decides it: choose levels with where=SQL.")
    if own.get("continue", "false") not in ("true", "false"):
        raise UserError(f"continue is {own['continue']}: it must be true or false.")
    return own, [argument for argument in arguments if argument.partition("=")[0] not in OWN]


def kept_settings(config: Mapping[str, Any], settings: Sequence[str]) -> list[str]:
    """Return the settings that the manifest was made with, without the groups that a preset in `settings` replaces."""
    named = {setting.partition("=")[0] for setting in settings}
    replaced = OF_PROCEDURE if "procedure" in named else set()
    return [setting for setting in changed_settings(config) if setting.partition(".")[0] not in replaced]

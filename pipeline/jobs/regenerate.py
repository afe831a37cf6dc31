"""A split's levels again, at another budget: `levelproof regenerate manifest=data/256k/s budget=1M`."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from levelproof.configs.compose import compose_job, words_for
from levelproof.configs.schema import from_files
from levelproof.experts.procedure import Procedure
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.pipeline.errors import Exit, UserError
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.origins import origins_of

OWN = ("manifest", "where", "continue")  # words that are not settings of a job
NOT_OURS = ("size", "levels", "first_level", "level_files", "distribution")  # settings that the manifest decides
# Presets, and the groups of settings that each decides
PRESETS = {"procedure": {field.name for field in fields(Procedure)}}
HINT = "as in levelproof regenerate manifest=data/256k/s budget=1M where=\"label = 'unsolved'\""


def regenerate(words: Sequence[str], console: Console) -> Exit:
    """Train the levels of a manifest, all or those for which a condition holds, at another budget.

    `words` are `manifest=SPLIT`, `budget=N`, and if wanted `where=SQL`, `continue=true` and settings of `generate`.

    Raises:
        UserError: a word is missing or wrong, no level is chosen, or as `generate`.
        Failure: the manifest is damaged, or as `generate`.
    """
    own, settings = split_words(words)
    source = Path(own["manifest"]).expanduser()
    manifest = require_manifest(source, columns_in(own.get("where")))
    config = manifest.config or {}
    if config["sampler_version"] != SAMPLER_VERSION:
        raise UserError(
            f"The levels of {source} are of sampler version {config['sampler_version']}, and this program makes those "
            f"of version {SAMPLER_VERSION}: use the levelproof that made them."
        )
    level_ids = select(manifest.table, own.get("where")).column("level_id").to_numpy()
    if not len(level_ids):
        raise UserError(f"The condition {own.get('where')!r} holds for none of the {len(manifest.level_ids)} levels.")
    goes_on = [f"continue_from={source}"] if own.get("continue") == "true" else []
    of_files = [f"level_files={source}"] if from_files(config) else []
    job = replace(compose_job([*kept_words(config, settings), *settings, *goes_on, *of_files]), size=config["size"])
    origins = origins_of(source, level_ids) if of_files else None
    return generate(job, ["levelproof", "regenerate", *words], console, level_ids, origins)


def split_words(words: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Our own words by name, and those that are settings.

    Raises:
        UserError: one is missing, or there is one that the manifest decides.
    """
    values = {name: value for name, _, value in (word.partition("=") for word in words)}
    own = {name: values[name] for name in OWN if name in values}
    if "manifest" not in own:
        raise UserError(f"Which levels? Name the split they are in, {HINT}.")
    if "budget" not in values:
        raise UserError(f"Which budget? Give one, {HINT}.")
    for name in NOT_OURS:
        if any(word.partition(".")[0] == name for word in values):
            raise UserError(f"{name} cannot be changed here, it is that of the manifest: choose levels with where=SQL.")
    if own.get("continue", "false") not in ("true", "false"):
        raise UserError(f"continue is {own['continue']}: it must be true or false.")
    return own, [word for word in words if word.partition("=")[0] not in OWN]


def kept_words(config: Mapping[str, Any], settings: Sequence[str]) -> list[str]:
    """The settings that the manifest was made with, but for the groups of which `settings` name a preset."""
    named = {word.partition("=")[0] for word in settings}
    replaced = set[str]().union(*(groups for preset, groups in PRESETS.items() if preset in named))
    return [word for word in words_for(config) if word.partition(".")[0] not in replaced]

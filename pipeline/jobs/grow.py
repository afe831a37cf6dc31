"""The job of `levelproof grow`: ordinary splits from seed files."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from levelproof.configs.compose import compose_job
from levelproof.configs.schema import GrowConfig, from_files
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.jobs.schedule import WorkUnit, levels_text
from levelproof.pipeline.store import quarantine
from levelproof.pipeline.store.manifest import read_manifest, require_manifest
from levelproof.pipeline.store.progress_bar import say
from levelproof.pipeline.store.remote import absolute
from levelproof.pipeline.store.seed.columns import ROW_GROUP
from levelproof.pipeline.store.seed.file import describe_seed, is_seed, read_seed, seed_files
from levelproof.pipeline.store.seed.source import LevelSource, without_levels
from levelproof.pipeline.store.seed.write import content_digest
from levelproof.pipeline.urls import as_typed
from levelproof.pipeline.words import many

SETTINGS = ("density", "key_every", "executor", "workers")


def grow(source: Path, out: Path, settings: Sequence[str], console: Console) -> Exit:
    """Grow seed files into the split `out`, or continue an earlier run.

    Args:
        source: a seed file, or a folder of seed files.
        out: path of the split.
        settings: `NAME=VALUE` for names in SETTINGS.
        console: receives progress and messages.

    Raises:
        UserError: `source` has no seed file or one without its levels, `out` does not end in their budget and size, a
            setting is not one of SETTINGS, or as `generate`.
        Failure: a seed file is damaged or has levels that this program does not make, or as `generate`.
    """
    out = out.expanduser()
    if wrong := [setting for setting in settings if setting.partition("=")[0] not in SETTINGS]:
        raise UserError(
            f"`levelproof grow` does not accept {wrong[0]}: leave it out. It accepts {', '.join(SETTINGS)}; the seeds "
            "decide every setting that affects results."
        )
    if not is_seed(source):
        raise UserError(
            f"There is no seed file at {as_typed(source)}: name a file that `levelproof export SPLIT --format seed` "
            "wrote, or a folder of such files."
        )
    manifest = require_manifest(source, [])
    job = _job(source, out, settings, manifest.config or {})
    _require_levels(source, manifest.config or {})
    command = ["levelproof", "grow", as_typed(source), "-o", str(out), *settings]
    origins = {} if from_files(manifest.config or {}) else None  # ids of level files are far apart
    code = generate(job, command, console, manifest.level_ids.tolist(), origins)
    return max(code, _report(source, out, manifest.level_ids, console))


def _require_levels(source: Path, config: dict) -> None:
    """Refuse seed files that lack their levels, before any other check.

    Raises:
        UserError: a file lacks levels.
        Failure: a file is damaged.
    """
    for path in seed_files(source) if from_files(config) else ():
        if read_seed(path, ["content"])[1].column("content").null_count:
            raise without_levels(path)


def _job(source: Path, out: Path, settings: Sequence[str], config: dict) -> GrowConfig:
    """Return the job that grows seed files into `out`."""
    first = seed_files(source)[0]
    about = describe_seed(first)
    known = LevelSource.of(config, first)
    size, budget = config["size"], about.budget
    path = out.absolute()
    if (path.parent.name, path.name) != (budget, size):
        raise UserError(
            f"The seeds have size {size} and budget {budget}, but {out} does not end in {budget}/{size}: use "
            f"-o data/{budget}/{size}."
        )
    chosen = compose_job(settings)
    return GrowConfig(
        size=size,
        budget=budget,
        out=str(path.parent.parent),
        level_files=as_typed(absolute(source)),
        density=chosen.density,
        key_every=chosen.key_every,
        executor=chosen.executor,
        workers=chosen.workers,
        task=known.rules,
        grown=json.dumps(config, sort_keys=True),
    )


def _report(source: Path, split: Path, wanted: np.ndarray, console: Console) -> Exit:
    """Say what was left out, and whether levels here are not those that the seeds were exported from."""
    manifest = read_manifest(split, ["content_hash"])
    given_up = [run for left in quarantine.given_up(split, manifest.level_ids).values() for run in left]
    left_out = np.setdiff1d(wanted, np.concatenate([manifest.level_ids, *(np.arange(a, b + 1) for a, b in given_up)]))
    if len(left_out):
        levels = levels_text([WorkUnit(tuple(left_out.tolist()))])
        say(
            console,
            f"Left out: {many(len(left_out), 'level')}, whose first episodes on this machine differ from those in "
            f"the seeds ({levels}).",
        )
    drifted = 0
    for path in seed_files(source):
        about, rows = read_seed(path, [])
        ids = rows.column("level_id").to_numpy()
        for digest, first in zip(about.content, range(0, len(ids), ROW_GROUP), strict=True):
            some = ids[first : first + ROW_GROUP]
            if np.isin(some, manifest.level_ids).all():
                hashes = manifest.table.column("content_hash").take(np.searchsorted(manifest.level_ids, some))
                drifted += content_digest(hashes.to_pylist()) != digest
    if drifted:
        raise Failure(
            f"In {many(drifted, 'row group')}, this sampler makes other levels than those that {as_typed(source)} was "
            "exported from: use the levelproof that wrote it."
        )
    return Exit.FAILED if len(left_out) else Exit.DONE

"""`levelproof verify SPLIT --repair`: delete what is damaged, and regenerate it and what is missing bit for bit."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from rich.console import Console

from levelproof.configs.compose import changed_settings, compose_job
from levelproof.configs.errors import ConfigError
from levelproof.configs.numbers import parse_count
from levelproof.configs.schema import JobConfig, from_files, hash_of
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.processes import in_another_process
from levelproof.pipeline.read.levels import recorded_settings
from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.job_note import note_job, sound_note
from levelproof.pipeline.store.layout import EXPERTS, data_paths, fragment_files
from levelproof.pipeline.store.locks import is_written, without_commits
from levelproof.pipeline.store.mend import take_out
from levelproof.pipeline.store.progress_bar import say
from levelproof.pipeline.store.runs import merged, runs, runs_text
from levelproof.pipeline.store.split import locked, taken
from levelproof.pipeline.verify.findings import Findings, why_not_repaired

SETTINGS = ("executor", "workers", "unit", "device")  # settings of `generate` that a repair accepts
STORAGE = ("density", "key_every", "keep_experts")  # settings of how results are stored


@stoppable()
def repair(split: Path, settings: Sequence[str], console: Console) -> Exit:
    """Verify a split, and regenerate its damaged and missing levels; after a kill, the same command continues.

    Levels that cannot be regenerated here are reported and stay as they are.

    Returns FAILED if there are such levels, else the exit code of generating the others.

    Args:
        split: folder of the split.
        settings: `NAME=VALUE` for names in SETTINGS; the others keep their defaults.
        console: receives progress and messages.

    Raises:
        UserError: there is no split, it was imported or grown, another command writes to it, or a setting is not in
            SETTINGS.
        ConfigError: a setting has a wrong value.
        Failure: it was made with settings that this program does not accept, it has changed since it was examined, or
            a write failed.
    """
    if wrong := [setting for setting in settings if setting.partition("=")[0] not in SETTINGS]:
        raise UserError(
            f"A repair uses the settings of its split: leave out {wrong[0]}; {', '.join(SETTINGS)} may change."
        )
    how = compose_job(settings)  # raises ConfigError for the user's own mistakes, before anything takes time
    if is_written(split):
        raise UserError(f"Another levelproof command is writing to {split}: wait for it, or stop it first.")
    findings = _examine_split(split, how)
    print(findings.report(split))
    if not findings.wrong:
        return Exit.DONE
    if reason := why_not_repaired(split, findings):
        raise UserError(reason)
    job = _job(split, findings, settings)
    left = _not_regenerated(findings)
    lost = findings.lost - findings.unrepairable.keys()
    if files := from_files(job.results):
        ids = lost & findings.origins.keys()
    else:
        ids = lost | {i for first, last in findings.missing for i in range(first, last + 1)}
    with locked(split, partial(say, console)), without_commits(split, partial(say, console)):
        _require_as_examined(split, findings)
        _note(split, job, findings)
        take_out(split, lost, findings.changed, list(findings.fragments))
    with taken(split, partial(say, console)):
        pass  # taking it deletes the data that no fragment names any more
    origins = {i: findings.origins[i] for i in sorted(ids)} if files else None
    code = generate(job, _command(split), console, sorted(ids), origins, split) if ids else Exit.DONE
    for sentence in left:
        print(sentence)
    return Exit.FAILED if left else code


def _examine_split(split: Path, job: JobConfig) -> Findings:
    """Examine the split on the device that would regenerate lost levels, to find levels that another device made.

    In another process if Ray will fork this one, which must not have started JAX before.
    """
    if job.executor == "inline":
        return _examine(split, job.device, len(own_cores()))
    return in_another_process(_examine, split, job.device)


def _examine(split: Path, device: Literal["cpu", "gpu"], threads: int = 1) -> Findings:
    from levelproof.pipeline.verify.verify import examine  # starts JAX

    return examine(split, Console(stderr=True), device, threads)


def _require_as_examined(split: Path, findings: Findings) -> None:
    """Raise Failure if the split, now locked, has other fragments than when it was examined."""
    if fragment_files(split) != findings.examined:
        raise Failure(
            f"Another command has changed {split} since it was examined: once it has ended, run this one again."
        )


def _job(split: Path, findings: Findings, settings: Sequence[str]) -> JobConfig:
    """Return the job that made the split.

    Raises:
        Failure: its settings are lost, or this program does not accept them.
    """
    config = findings.config
    if config is None:
        raise Failure(
            f"The settings of {split} are lost, because no readable file has them: "
            "delete the split, and repeat the `levelproof generate` that made it."
        )
    kept = findings.names_experts or any(path.parent.name == EXPERTS for path in data_paths(split))
    files = [f"level_files={split}"] if from_files(config) else []
    budget = f"budget={findings.budget or _budget(split, config['budget'])}"
    with recorded_settings(split):
        # Of settings that are named twice, the last one counts
        how = [*_noted(split), *(["keep_experts=true"] if kept else []), *findings.stored.split()]
        job = compose_job([*changed_settings(config), budget, *files, *how, *settings])
        job = replace(job, size=config["size"])
    if job.hash != hash_of(config):
        raise Failure(f"This levelproof would make {split} with other settings: use the version that made it.")
    return job


def _noted(split: Path) -> list[str]:
    """Return what the noted command says of how results are stored, which no file shows if all are damaged."""
    note = sound_note(split)
    words = shlex.split(note.command) if note else []
    return [word for word in words if word.partition("=")[0] in STORAGE and "=" in word]


def _budget(split: Path, env_steps: int) -> str:
    """Return the budget as typed, which is the folder's name, unless the split was moved."""
    name = split.absolute().parent.name
    try:
        return name if parse_count(name, "budget") == env_steps else str(env_steps)
    except ConfigError:
        return str(env_steps)


def _not_regenerated(findings: Findings) -> list[str]:
    """Return sentences that name the levels which this machine cannot regenerate, and why."""
    sentences = []
    for reason in dict.fromkeys(findings.unrepairable.values()):
        ids = [level_id for level_id, why in findings.unrepairable.items() if why == reason]
        sentences.append(f"Not regenerated: {runs_text(runs(ids))}. Reason: {reason}.")
    ids = [i for i in findings.lost if from_files(findings.config or {}) and i not in findings.origins]
    if nameless := (findings.missing if from_files(findings.config or {}) else []) + runs(ids):
        sentences.append(f"Not regenerated: {runs_text(nameless)}, because no row names their level files.")
    return sentences


def _note(split: Path, job: JobConfig, findings: Findings) -> None:
    """Add the lost levels to the note before deleting any data, so that a later run makes them."""
    note = sound_note(split)
    wanted = note.level_ids.tolist() if note else findings.present
    note_job(split, job, _command(split), merged(wanted, runs(sorted(findings.lost))))


def _command(split: Path) -> list[str]:
    note = sound_note(split)
    return shlex.split(note.command) if note else ["levelproof", "verify", str(split), "--repair"]

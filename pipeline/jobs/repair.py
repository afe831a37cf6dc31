"""`levelproof verify SPLIT --repair`: what is damaged or missing is taken out, and made again as it was made before."""

import multiprocessing
import shlex
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.console import Console

from levelproof.configs.compose import compose_job, words_for
from levelproof.configs.errors import ConfigError
from levelproof.configs.numbers import parse_count
from levelproof.configs.schema import FROM_RECORDS, JobConfig, from_files, hash_of
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.jobs.generate import generate
from levelproof.pipeline.jobs.progress import say
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.job_note import note_job, sound_note
from levelproof.pipeline.store.layout import EXPERTS, data_paths
from levelproof.pipeline.store.locks import without_commits
from levelproof.pipeline.store.mend import take_out
from levelproof.pipeline.store.runs import merged, runs, told_levels
from levelproof.pipeline.store.split import locked, taken
from levelproof.pipeline.verify.findings import Findings

SETTINGS = ("executor", "workers", "unit", "device")  # of `generate`, that a repair may have


@stoppable()
def repair(split: Path, settings: Sequence[str], console: Console) -> Exit:
    """Verify a split, and make again what is wrong with it. Killed at any moment, it goes on where it was.

    `settings` are those of SETTINGS that are not to have their defaults. Levels that cannot be made again here stay
    as they are and are told.

    Returns FAILED where some are left, else what came of making the others.

    Raises:
        UserError: no split, a setting that is none of these, it was imported, or somebody is writing to it.
        Failure: it was made with other settings than this program knows, or the disk refuses.
    """
    if wrong := [word for word in settings if word.partition("=")[0] not in SETTINGS]:
        raise UserError(f"A repair has the settings of its split, not {wrong[0]}: it takes {', '.join(SETTINGS)} only.")
    findings = _examined(split, inline="executor=inline" in settings)
    print(findings.report(split))
    if not findings.wrong:
        return Exit.DONE
    _require_made(split, findings)
    job = _job(split, findings, settings)
    left = _left(findings)
    lost = findings.lost - findings.unrepairable.keys()
    if files := from_files(job.results):
        ids = lost & findings.origins.keys()
    else:
        ids = lost | {i for first, last in findings.missing for i in range(first, last + 1)}
    with locked(split, partial(say, console)), without_commits(split, partial(say, console)):
        _note(split, job, findings)
        take_out(split, lost, findings.changed, list(findings.fragments))
    with taken(split, partial(say, console)):
        pass  # what nothing names any more goes
    origins = {i: findings.origins[i] for i in sorted(ids)} if files else None
    end = generate(job, _command(split), console, sorted(ids), origins, split) if ids else Exit.DONE
    for sentence in left:
        print(sentence)
    return Exit.FAILED if left else end


def _examined(split: Path, inline: bool) -> Findings:
    """`examine`, by a process of its own where Ray is to fork this one, which must not have started JAX by then."""
    if inline:
        return _examine(split)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        found = process.submit(_examine, split)
        try:
            return found.result()
        except KeyboardInterrupt:  # SIGTERM reaches this process alone
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def _examine(split: Path) -> Findings:
    from levelproof.pipeline.verify.verify import examine  # starts JAX

    return examine(split, Console(stderr=True))


def _require_made(split: Path, findings: Findings) -> None:
    """Refuse a split of which this program has made nothing: whose actions are lost, nobody here can make again."""
    if (findings.config or {}).get("distribution") == FROM_RECORDS:
        raise UserError(
            f"The split {split} was imported, so nothing here makes its levels again: delete it, and import the folder "
            f"that they come from with `levelproof import FOLDER -o {split}`."
        )


def _job(split: Path, findings: Findings, settings: Sequence[str]) -> JobConfig:
    """The job that makes the split's levels as they were made."""
    config = findings.config
    if config is None:
        raise Failure(
            f"No file of {split} says any more with which settings it was made: "
            "delete it, and run the `levelproof generate` that made it again."
        )
    keep = [f"keep_experts={any(path.parent.name == EXPERTS for path in data_paths(split))}".lower()]
    files = [f"level_files={split}"] if from_files(config) else []
    budget = f"budget={findings.budget or _budget(split, config['budget'])}"
    try:
        job = compose_job([*words_for(config), budget, *keep, *files, *findings.stored.split(), *settings])
        job = replace(job, size=config["size"])
    except (ConfigError, ValueError, KeyError, TypeError) as error:
        raise Failure(f"The settings of {split} are none of this levelproof ({error}): use the one of then.") from None
    if job.hash != hash_of(config):
        raise Failure(f"This levelproof would make {split} with other settings: repair it with the one that made it.")
    return job


def _budget(split: Path, env_steps: int) -> str:
    """As it was typed: the name of the folder, if it is where it was made."""
    name = split.absolute().parent.name
    try:
        return name if parse_count(name, "budget") == env_steps else str(env_steps)
    except ConfigError:
        return str(env_steps)


def _left(findings: Findings) -> list[str]:
    """What cannot be made again here."""
    left = []
    for reason in dict.fromkeys(findings.unrepairable.values()):
        ids = [level_id for level_id, of in findings.unrepairable.items() if of == reason]
        left.append(f"Not made again: {told_levels(runs(ids))}, for {reason}.")
    ids = [i for i in findings.lost if from_files(findings.config or {}) and i not in findings.origins]
    if gone := (findings.missing if from_files(findings.config or {}) else []) + runs(ids):
        left.append(f"Not made again: {told_levels(gone)}, whose level files no row names.")
    return left


def _note(split: Path, job: JobConfig, findings: Findings) -> None:
    """Have what is lost wanted beside what was, before anything goes: whoever goes on makes it."""
    note = sound_note(split)
    wanted = note.level_ids.tolist() if note else findings.present
    note_job(split, job, _command(split), merged(wanted, runs(sorted(findings.lost))))


def _command(split: Path) -> list[str]:
    note = sound_note(split)
    return shlex.split(note.command) if note else ["levelproof", "verify", str(split), "--repair"]

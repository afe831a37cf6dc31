"""Is a split what it claims to be? Every byte held against its checksum, every level made again from its id or its
file, every label that needs no expert worked out again, every witness replayed.

Bits are promised on the stack that made a row. On another one a level has to look as its id makes it, its world has to
be the one that its row's content hash says, and its witness has to reach the goal.
"""

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from os import DirEntry
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console

from levelproof.configs.convert import typed
from levelproof.configs.errors import ConfigError
from levelproof.configs.schema import from_files
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.levelgen.level import size_of
from levelproof.levelgen.sampling.sampler import CHUNK, Distribution
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import Exit, Failure
from levelproof.pipeline.read.level_files import level_at
from levelproof.pipeline.read.levels import recorded_settings
from levelproof.pipeline.read.pace import Pace
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.bounds import DAMAGE, MAX_ROWS, bounded
from levelproof.pipeline.store.checksums import digests_of, has_own
from levelproof.pipeline.store.job_note import JobNote, sound_note
from levelproof.pipeline.store.layout import (
    BEGUN,
    FRAGMENT,
    JOB,
    MANIFEST,
    attempt_of,
    data_path,
    data_paths,
    entries,
    ids_of,
    made_within,
    unit_ids,
)
from levelproof.pipeline.store.locks import is_written
from levelproof.pipeline.store.manifest import (
    Fragment,
    differences,
    fragment_paths,
    read_fragment,
    require_manifest,
    told,
)
from levelproof.pipeline.store.origins import origin_of
from levelproof.pipeline.store.remote import is_remote
from levelproof.pipeline.store.runs import runs, told_levels, without
from levelproof.pipeline.store.shard import Shard, open_shard
from levelproof.pipeline.verify.evidence import COLUMNS, Evidence, Making, same_stack
from levelproof.pipeline.verify.findings import Findings

AT_ONCE = 4 * CHUNK  # rows that are looked at together, where fragments have fewer
ATTEMPTS = 3  # at a split of which fragments are sealed meanwhile

Part = tuple[Fragment, pa.Table]  # a fragment and its rows


def verify(split: Path, as_json: bool, console: Console) -> Exit:
    """Print what is wrong with `split`; FAILED if anything is.

    Raises:
        UserError: no split.
        Failure: other levels are made here, or fragments of several configurations lie side by side.
    """
    findings = examine(split, console)
    if as_json:
        print(json.dumps(findings.as_json(), indent=2))
    else:
        print(findings.report(split))
        if findings.wrong and not is_remote(split):
            print(f"Next:  levelproof verify {shlex.quote(str(split))} --repair")
    return Exit.FAILED if findings.wrong else Exit.DONE


def examine(split: Path, console: Console | None = None) -> Findings:
    """Look at every file, every row and every shard of a split; `console` is shown how far that is.

    Raises: as `verify`.
    """
    prepare_jax()
    for _ in range(ATTEMPTS - 1):
        before = _inodes(split)
        findings = _examined(split, console)
        if not findings.wrong or _inodes(split) == before:
            return findings
    return _examined(split, console)


def _inodes(split: Path) -> set[tuple[Path, int]]:
    """Fragments, each with the number by which the file system knows what has its name now."""
    return {*entries(split, MANIFEST, FRAGMENT, DirEntry.is_file).items()}


def _examined(split: Path, console: Console | None) -> Findings:
    findings = Findings()
    note, paths = _note(split, findings), fragment_paths(split)
    making: Making | None = None
    named: set[str] = set()  # by fragments that are sound
    known = [np.zeros(0, np.int64)]
    with Pace("levels", sum(map(_rows_in, paths)), console) as pace:
        for parts in _groups(paths, findings):
            making = making or _making(split, parts[0][0], findings)
            findings.budget = parts[0][1].column("budget")[0].as_py()
            findings.stored = min(parts[0][0].densities, default="")
            _require_one_configuration(split, parts, findings.config or {})
            _look_into(parts, making, findings, pace)
            known += [rows.column("level_id").to_numpy() for _, rows in parts]
            named |= {name for fragment, _ in parts for name in fragment.digests}
    there = np.unique(np.concatenate(known))
    findings.there = runs(there)
    say = lambda text: console and console.print(text, highlight=False, markup=False, soft_wrap=True)
    running = is_written(split, say)
    _damaged(split, note, there, named, running, findings)
    if note and not running:
        gone = without(without(note.level_ids.tolist(), there), np.array(sorted(findings.lost), np.int64))
        if gone:
            findings.missing = gone
            findings.wrong[f"The last command wanted {told_levels(gone)}, and no fragment has them."] = set()
    return findings


def _note(split: Path, findings: Findings) -> JobNote | None:
    note = sound_note(split)
    if note:
        findings.config = note.config
    elif not fragment_paths(split):
        require_manifest(split, [])  # raises: there is no split
    else:
        findings.tell(
            f"The file {split / JOB} is missing or damaged: nobody knows which levels the last command wanted.", []
        )
    return note


def _rows_in(path: Path) -> int:
    with suppress(*DAMAGE), bounded(path) as file:
        return file.rows
    return 0


def _groups(paths: Sequence[Path], findings: Findings) -> Iterator[list[Part]]:
    """Fragments and their rows, as many together as make AT_ONCE rows; those that are damaged are noted."""
    group: list[Part] = []
    for path in paths:
        try:
            part = _part(path)
            group += [part] if part[0].rows else []  # others are fences
        except Failure as failure:
            findings.fragments[path] = str(failure)
        if sum(rows.num_rows for _, rows in group) >= AT_ONCE or (group and path == paths[-1]):
            yield group
            group = []


def _part(path: Path) -> Part:
    """A fragment that is as it was committed. Of another one nothing is looked at: that can end a process.

    Raises:
        Failure: it is damaged or gone.
    """
    try:
        if not has_own(path):
            raise Failure(f"The fragment {path} is not what was committed: bytes of it have changed.")
        fragment, rows = read_fragment(path, ["level_id", *COLUMNS])
    except OSError as error:
        raise Failure(f"The fragment {path} cannot be read ({error.strerror or type(error).__name__}).") from None
    return fragment, rows


def _making(split: Path, fragment: Fragment, findings: Findings) -> Making:
    """Raises Failure where this program makes other levels, or plays them by other rules."""
    findings.config = config = fragment.config
    with recorded_settings(split):
        if config["sampler_version"] != SAMPLER_VERSION:
            raise ConfigError(f"sampler version {config['sampler_version']}, here it is {SAMPLER_VERSION}")
        size_of(config["size"])
        rules = typed(TaskParams, config["task"], "task")
        distribution = None if from_files(config) else typed(Distribution, config["distribution"], "distribution")
    return Making(split, config["size"], distribution, rules)


def _require_one_configuration(split: Path, parts: Sequence[Part], config: dict[str, Any]) -> None:
    for fragment, _ in parts:
        if changes := differences(config, fragment.config):
            raise Failure(
                f"The split {split} mixes two configurations, the one of {fragment.path.name} and an earlier one "
                f"({told(changes)}): move the fragments of one of them elsewhere, with their shards and experts."
            )


def _look_into(parts: Sequence[Part], making: Making, findings: Findings, pace: Pace) -> None:
    """Look at some fragments that are sound, and at all that they name."""
    rows = pa.concat_tables([rows for _, rows in parts])
    digests = {name: files for fragment, _ in parts for name, files in fragment.digests.items()}
    in_shards, in_experts = _named(rows, "shard"), _named(rows, "experts")
    shards = {name: _opened(name, making, ids, findings) for name, ids in in_shards.items()}
    unlike = {name: _unlike(making.split, name, digests.get(name, {})) for name in [*in_shards, *in_experts]}
    findings.unlike |= {name for name, files in unlike.items() if files}
    for first in range(0, rows.num_rows, CHUNK):
        block = rows.slice(first, CHUNK)
        Evidence(block, making, shards, findings).examine()
        pace.advance(block.num_rows)
    for name, level_ids in {**in_shards, **in_experts}.items():
        if not unlike[name] or shards.get(name, "") is None:  # sound, or told
            continue
        first, more = making.split / name / unlike[name][0], len(unlike[name]) - 1
        wrong = f"The file {first}{f' and {more} more beside it' if more else ''} is not what was committed."
        if name in in_experts or any(file.endswith("zarr.json") for file in unlike[name]):
            findings.tell(wrong, level_ids)
        elif not findings.lost & level_ids:  # all of them can be copied from it
            findings.wrong[wrong] = level_ids
    _note_losses(rows, making, findings)


def _named(rows: pa.Table, column: str) -> dict[str, set[int]]:
    """The shards or experts that rows name, and their levels."""
    named: dict[str, set[int]] = {}
    for level_id, name in zip(rows.column("level_id").to_pylist(), rows.column(column).to_pylist(), strict=True):
        if name is not None:
            named.setdefault(name, set()).add(level_id)
    return named


def _opened(name: str, making: Making, level_ids: set[int], findings: Findings) -> Shard | None:
    try:
        shard = open_shard(making.split, name, making.size)
    except Failure as failure:
        findings.unlike.add(name)
        findings.tell(str(failure), level_ids)
        return None
    findings.shards += 1
    return shard


def _unlike(split: Path, name: str, digests: Mapping[str, str]) -> list[str]:
    """The files of a shard or of experts that are not what they were: changed, missing or new."""
    try:
        found = digests_of(data_path(split, name), digests)
    except (Failure, OSError):
        found = {}
    return sorted(file for file in {**found, **digests} if found.get(file) != digests.get(file))


def _note_losses(rows: pa.Table, making: Making, findings: Findings) -> None:
    """What it takes to make those of these levels again that are lost."""
    rows = rows.filter(np.isin(rows.column("level_id").to_numpy(), list(findings.lost)))
    for row, same in zip(rows.to_pylist(), same_stack(rows), strict=True):
        level_id = row["level_id"]
        if not same:
            findings.beyond[level_id] = f"it was made on another stack, of {row['device']}"
        if making.distribution is None:
            findings.origins[level_id] = origin_of(making.split, row | {"shard": None})
            try:
                level_at(findings.origins[level_id])
            except Failure as failure:
                findings.beyond[level_id] = str(failure)[:-1]
        if level_id in findings.beyond:
            findings.unlike -= {row["shard"], row["experts"]}


def _damaged(
    split: Path, note: JobNote | None, there: np.ndarray, named: set[str], running: bool, findings: Findings
) -> None:
    """Find whose levels are lost with fragments that are damaged or, unless a run is writing, missing."""
    unnamed = [path for path in data_paths(split) if path.relative_to(split).as_posix() not in named]
    for fragment, wrong in findings.fragments.items():
        first, last = ids_of(fragment)
        mine = made_within(unnamed, fragment)
        unnamed = [path for path in unnamed if path not in mine]
        ids = _ids_in(mine) | {first, last} | _between(first, last, note, findings)
        findings.tell(wrong, _not_in(there, ids))
    if running:
        return
    begun = {attempt_of(path) for path in entries(split, MANIFEST, BEGUN, DirEntry.is_file)}
    for path in unnamed:
        lost = _not_in(there, _ids_in([path]))
        if lost and attempt_of(path) not in begun:
            findings.tell(f"No fragment names {path}: the one that did is missing.", lost)


def _not_in(there: np.ndarray, ids: set[int]) -> set[int]:
    return ids.difference(there[np.isin(there, list(ids))].tolist())


def _between(first: int, last: int, note: JobNote | None, findings: Findings) -> set[int]:
    """Which levels a fragment had that nobody can read any more: those that were wanted, or all, if ids make levels."""
    wanted = note.level_ids.tolist() if note else []
    if not from_files(findings.config or {}) and not any(a <= first <= last <= b for a, b in wanted):
        wanted = [*wanted, (first, last)]
    ids = (i for a, b in wanted for i in range(max(a, first), min(b, last) + 1))
    return set(islice(ids, MAX_ROWS))  # which its name and a note may say are many more


def _ids_in(data: Sequence[Path]) -> set[int]:
    """Levels that surely are in these shards and experts."""
    ids = {level_id for path in data for level_id in unit_ids(path)}
    for path in data:
        with suppress(Failure):
            ids |= set(Shard(path).level_ids)
    return ids

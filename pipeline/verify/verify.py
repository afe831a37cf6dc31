"""Verification of a split: compares every byte with its checksum, regenerates every level from its id or file,
recomputes every label that needs no expert, and replays every witness.

Worlds and records must match in every bit if this engine made them on any CPU, or if the same stack
(versions and device) made them. Otherwise a level must match the signature of the one that its id makes, its world
must match its row's content hash, and its witness must reach the goal.
"""

import json
from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from functools import partial
from itertools import islice
from os import DirEntry
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console

from levelproof.configs.schema import distribution_in, from_files, other_sampler, rules_in
from levelproof.levelgen.level import size_of
from levelproof.pipeline.errors import Exit, Failure
from levelproof.pipeline.read.level_files import level_at
from levelproof.pipeline.read.levels import recorded_settings
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.bounds import MAX_ROWS, unread
from levelproof.pipeline.store.checksums import digests_of
from levelproof.pipeline.store.fragment import Fragment, read_fragment
from levelproof.pipeline.store.job_note import JobNote, sound_note
from levelproof.pipeline.store.layout import (
    BEGUN,
    EXPERTS,
    INDEX_FILE,
    JOB,
    MANIFEST,
    attempt_of,
    data_path,
    data_paths,
    entries,
    fragment_files,
    ids_of,
    made_within,
    unit_ids,
)
from levelproof.pipeline.store.locks import is_written
from levelproof.pipeline.store.manifest import changes_text, differences, fragment_paths, index_of, require_manifest
from levelproof.pipeline.store.named import open_shard
from levelproof.pipeline.store.origins import RECORD, origin_of
from levelproof.pipeline.store.progress_bar import ProgressBar, say
from levelproof.pipeline.store.runs import runs, runs_text, without
from levelproof.pipeline.store.seed.file import is_seed
from levelproof.pipeline.store.shard import Shard
from levelproof.pipeline.urls import is_remote, quoted
from levelproof.pipeline.verify.cores import BLOCK, Device, Map, on_cores
from levelproof.pipeline.verify.evidence import Recipe, examine_rows, same_stack
from levelproof.pipeline.verify.findings import Findings, why_not_repaired
from levelproof.pipeline.verify.fragments import FragmentGroup, Part, grouped, rows_in
from levelproof.pipeline.verify.seeds import examine_seeds

GROUP_ROWS = 2 * BLOCK  # minimum number of rows per group of fragments, for each process
ROUNDS = 20  # maximum number of examinations, if fragments are sealed concurrently; each examines only new ones


@stoppable()
def verify(split: Path, as_json: bool, console: Console) -> Exit:
    """Verify `split`, print what is wrong, and return FAILED if anything is.

    Raises:
        UserError: the split does not exist.
        Failure: this version makes other levels, the split mixes several configurations, or a file cannot be read.
    """
    findings = examine(split, console)
    if as_json:
        print(json.dumps(findings.as_json(), indent=2))
    else:
        print(findings.report(split))
        repairable = findings.config and not is_remote(split) and not why_not_repaired(split, findings)
        if findings.wrong and repairable:
            print(f"Next:  levelproof verify {quoted(split)} --repair")
    return Exit.FAILED if findings.wrong else Exit.DONE


def examine(split: Path, console: Console | None = None, device: Device = None, threads: int = 1) -> Findings:
    """Check every file, row and shard of a split; show progress on `console`. `device` and `threads`: of `prepare_jax`.

    Raises:
        UserError, Failure: as `verify`.
    """
    prepare_jax(device=device, threads=threads)
    if is_seed(split):
        return examine_seeds(split, console, device)
    groups: list[FragmentGroup] = []
    for _ in range(ROUNDS):
        groups = _examined(split, groups, console, device)
        findings = _summed(split, groups, console)
        if not findings.wrong or fragment_files(split) == findings.examined:
            return findings
    there = fragment_files(split)
    return _summed(split, [group for group in groups if there.issuperset(group.files)], console, complete=False)


def _examined(
    split: Path, before: Sequence[FragmentGroup], console: Console | None, device: Device
) -> list[FragmentGroup]:
    """Examine the fragments that no group of `before` has; return the groups whose fragments are all still there.

    A seal, or another command, replaces fragments, and then removes what they alone name. So what is missing in a group
    of fragments that are still there was missing before.
    """
    there = fragment_files(split)
    groups = [group for group in before if there.issuperset(group.files)]
    new = sorted(there.difference(*(group.files for group in groups)))
    recipe: Recipe | None = None
    config = next((group.findings.config for group in groups if group.findings.config), None)
    count = sum(rows_in(path) for path, _ in new)
    with ProgressBar("levels", count, console) as progress, on_cores(count, device) as cores:
        for group, parts in grouped(new, cores.processes * GROUP_ROWS):
            groups.append(group)
            if not parts:
                continue
            findings, first = group.findings, parts[0][0]
            recipe = recipe or _recipe(split, first)
            findings.config = config = config or first.config
            findings.budget = parts[0][1].column("budget")[0].as_py()
            findings.stored = min(first.densities, default="")
            _require_one_configuration(split, parts, config)
            _check_fragments(parts, recipe, findings, cores.map, progress)
            group.ids.append(np.concatenate([rows.column("level_id").to_numpy() for _, rows in parts]))
            group.named.update(name for fragment, _ in parts for name in fragment.digests)
    return groups


def _summed(split: Path, groups: Sequence[FragmentGroup], console: Console | None, complete: bool = True) -> Findings:
    """Join the findings of groups, and add what only the whole split shows if they are `complete` and none writes."""
    findings = Findings()
    note = _note(split, findings)
    for group in groups:
        findings.include(group.findings)
        findings.examined.update(group.files)
    named = set[str]().union(*(group.named for group in groups))
    findings.names_experts = any(name.startswith(f"{EXPERTS}/") for name in named)
    present = np.unique(np.concatenate([np.zeros(0, np.int64), *(ids for group in groups for ids in group.ids)]))
    findings.present = runs(present)
    running = not complete or is_written(split, partial(say, console))
    _find_lost_levels(split, note, present, named, running, findings)
    if not running:
        _check_index(split, findings)
    if note and not running:
        missing = without(without(note.level_ids.tolist(), present), np.array(sorted(findings.lost), np.int64))
        if missing:
            findings.missing = missing
            findings.wrong[f"The last command requested {runs_text(missing)}, but no fragment has them."] = set()
    return findings


def _note(split: Path, findings: Findings) -> JobNote | None:
    note = sound_note(split)
    if note:
        findings.config = note.config
    elif not fragment_paths(split):
        require_manifest(split, [])  # raises: there is no split
    else:
        findings.add(
            f"The file {split / JOB} is missing or damaged: the levels that the last command requested are unknown.", []
        )
    return note


def _check_index(split: Path, findings: Findings) -> None:
    """Compare the index for readers of web servers, if there is one here, with the fragments that are there."""
    if is_remote(split):
        return
    wanted = index_of(split)
    for path in entries(split, MANIFEST, INDEX_FILE, DirEntry.is_file):
        if path.stat().st_size != len(wanted) or path.read_bytes() != wanted:
            findings.add(f"The index {path} differs from the fragments there: `levelproof seal` writes it anew.", [])


def _recipe(split: Path, fragment: Fragment) -> Recipe:
    """Return how to make and play the levels. Raise Failure if this version cannot."""
    config = fragment.config
    with recorded_settings(split):
        if differs := other_sampler(config):
            raise Failure(f"The split {split} {differs}: use the levelproof that made it.")
        size_of(config["size"])
        return Recipe(split, config["size"], distribution_in(config), rules_in(config))


def _require_one_configuration(split: Path, parts: Sequence[Part], config: dict[str, Any]) -> None:
    for fragment, _ in parts:
        if changes := differences(config, fragment.config):
            raise Failure(
                f"The split {split} mixes two configurations, the one of {fragment.path.name} and an earlier one "
                f"({changes_text(changes)}): move the fragments of one of them elsewhere, with their shards and "
                "experts."
            )


def _check_fragments(
    parts: Sequence[Part], recipe: Recipe, findings: Findings, run: Map, progress: ProgressBar
) -> None:
    """Check the rows of some sound fragments, and the shards and experts that they name."""
    rows = pa.concat_tables([rows for _, rows in parts])
    digests = {name: files for fragment, _ in parts for name, files in fragment.digests.items()}
    in_shards, in_experts = _levels_by_name(rows, "shard"), _levels_by_name(rows, "experts")
    changed = {name: _changed_files(recipe.split, name, digests.get(name, {})) for name in [*in_shards, *in_experts]}
    shards = {name: _opened(name, recipe, ids, findings, bool(changed[name])) for name, ids in in_shards.items()}
    findings.changed |= {name for name, files in changed.items() if files}
    at = np.arange(rows.num_rows)
    blocks = [rows.take(at[first : first + BLOCK]) for first in range(0, len(at), BLOCK)]  # slices pickle as the whole
    named = (
        {name: shards[name] for name in block.column("shard").unique().drop_null().to_pylist()} for block in blocks
    )
    for found in run(partial(_examined_block, recipe, frozenset(findings.changed)), blocks, named):
        findings.include(found)
        progress.advance(found.levels)
    for name, level_ids in {**in_shards, **in_experts}.items():
        if not changed[name] or shards.get(name, "") is None:  # sound, or already reported
            continue
        first, more = recipe.split / name / changed[name][0], len(changed[name]) - 1
        wrong = f"The file {first}{f' and {more} more beside it' if more else ''} is not what was committed."
        if name in in_experts or any(file.endswith("zarr.json") for file in changed[name]):
            findings.add(wrong, level_ids)
        elif not findings.lost & level_ids:  # every level can still be copied from it
            findings.wrong[wrong] = level_ids
    _note_losses(rows, recipe, findings)
    _keep_commands(parts, findings)


def _examined_block(recipe: Recipe, changed: Set[str], rows: pa.Table, shards: dict[str, Shard | None]) -> Findings:
    """Examine rows, perhaps in another process; `changed`: as in `Findings`, so far."""
    findings = Findings(changed={*changed})
    examine_rows(rows, recipe, shards, findings)
    return findings


def _levels_by_name(rows: pa.Table, column: str) -> dict[str, set[int]]:
    """Map the shards or experts that rows name to their levels."""
    named: dict[str, set[int]] = {}
    for level_id, name in zip(rows.column("level_id").to_pylist(), rows.column(column).to_pylist(), strict=True):
        if name is not None:
            named.setdefault(name, set()).add(level_id)
    return named


def _opened(name: str, recipe: Recipe, level_ids: set[int], findings: Findings, changed: bool) -> Shard | None:
    """Open a shard; None: it is damaged. Raise DataUnread if its bytes are those committed, but cannot be read now."""
    try:
        shard = open_shard(recipe.split, name, recipe.size)
    except Failure as failure:
        path = recipe.split / name
        if not changed and (machines := unread(path, failure) or unread(path, failure.__cause__)):
            raise machines from None
        findings.changed.add(name)
        findings.add(str(failure), level_ids)
        return None
    findings.shards += 1
    return shard


def _changed_files(split: Path, name: str, digests: Mapping[str, str]) -> list[str]:
    """List the files of a shard or of experts that are changed, missing or new. Raise DataUnread if one is unread."""
    try:
        current = digests_of(data_path(split, name), digests)
    except (Failure, OSError, MemoryError) as error:
        if machines := unread(split / name, error):
            raise machines from None
        current = {}
    return sorted(file for file in {**current, **digests} if current.get(file) != digests.get(file))


def _note_losses(rows: pa.Table, recipe: Recipe, findings: Findings) -> None:
    """Note for each lost level where it comes from, or why this machine cannot remake it."""
    rows = rows.filter(np.isin(rows.column("level_id").to_numpy(), list(findings.lost)))
    for row, same in zip(rows.to_pylist(), same_stack(rows), strict=True):
        level_id = row["level_id"]
        if not same:
            findings.unrepairable[level_id] = f"made with other versions or on another device ({row['device']})"
        if recipe.distribution is None:
            findings.origins[level_id] = origin_of(recipe.split, row | {"shard": None})
            try:
                level_at(findings.origins[level_id])
            except Failure as failure:
                findings.unrepairable[level_id] = str(failure)[:-1]
        if level_id in findings.unrepairable:
            findings.changed -= {row["shard"], row["experts"]}


def _keep_commands(parts: Sequence[Part], findings: Findings) -> None:
    """Note the commands of lost levels of an import: this split, which the repair reads, is not their source."""
    lost = [i for i, origin in findings.origins.items() if not origin.command and RECORD.fullmatch(origin.file)]
    for fragment, rows in parts:
        if np.isin(rows.column("level_id").to_numpy(), lost).any():
            with suppress(OSError):  # sealed since, so it will be examined again
                commands = read_fragment(fragment.path, ["level_id", "command"])[1].to_pylist()
                known = {row["level_id"]: row["command"] for row in commands}
                findings.origins |= {i: findings.origins[i]._replace(command=known[i]) for i in lost if i in known}


def _find_lost_levels(
    split: Path, note: JobNote | None, present: np.ndarray, named: set[str], running: bool, findings: Findings
) -> None:
    """Report levels lost with damaged fragments and, unless a run is writing, with missing fragments."""
    unnamed = [path for path in data_paths(split) if path.relative_to(split).as_posix() not in named]
    for fragment, wrong in findings.fragments.items():
        first, last = ids_of(fragment)
        own = made_within(unnamed, fragment)
        unnamed = [path for path in unnamed if path not in own]
        ids = _ids_in(own) | {first, last} | _between(first, last, note, findings)
        findings.add(wrong, _not_in(present, ids))
    if running:
        return
    begun = {attempt_of(path) for path in entries(split, MANIFEST, BEGUN, DirEntry.is_file)}
    for path in unnamed:
        lost = _not_in(present, _ids_in([path]))
        if lost and attempt_of(path) not in begun:
            findings.add(f"No fragment names {path}: the one that did is missing.", lost)


def _not_in(present: np.ndarray, ids: set[int]) -> set[int]:
    return ids.difference(present[np.isin(present, list(ids))].tolist())


def _between(first: int, last: int, note: JobNote | None, findings: Findings) -> set[int]:
    """Return the levels of an unreadable fragment: those requested or, if levels come from ids, its whole range."""
    wanted = note.level_ids.tolist() if note else []
    if not from_files(findings.config or {}) and not any(a <= first <= last <= b for a, b in wanted):
        wanted = [*wanted, (first, last)]
    ids = (i for a, b in wanted for i in range(max(a, first), min(b, last) + 1))
    return set(islice(ids, MAX_ROWS))  # because its name and a note may claim far more


def _ids_in(data: Sequence[Path]) -> set[int]:
    """Return levels that these shards and experts certainly hold."""
    ids = {level_id for path in data for level_id in unit_ids(path)}
    for path in data:
        with suppress(Failure):
            ids |= set(Shard(path).level_ids.tolist())
    return ids

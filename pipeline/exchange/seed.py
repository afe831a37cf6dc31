"""Export to a seed file: levels as ids, witnesses as the actions of one episode. docs/seeds.md describes it."""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
from rich.console import Console

from levelproof.configs.schema import REPEATED, from_files
from levelproof.experts.labels import Label
from levelproof.experts.witness.episode import checksum_of
from levelproof.experts.witness.resume import timesteps
from levelproof.levelgen.level import Level, size_of
from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.levelgen.task.actions import action_mask
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.levels import levels_of
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.read.select import both, columns_in, select_some
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store import files
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.created import writing_to
from levelproof.pipeline.store.density import LAST_DISTANCE, MOVES, STATE, task_states
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.origins import RECORD
from levelproof.pipeline.store.progress_bar import ProgressBar
from levelproof.pipeline.store.seed.columns import KEPT, ROW_GROUP, SCHEMA, SEEDS
from levelproof.pipeline.store.seed.file import SUFFIX
from levelproof.pipeline.store.seed.packed import pack_witness
from levelproof.pipeline.store.seed.rows import reason_of
from levelproof.pipeline.store.seed.source import LevelSource
from levelproof.pipeline.store.seed.worlds import pack_worlds
from levelproof.pipeline.store.seed.write import seed_bytes
from levelproof.pipeline.store.shard import STATES_DIFFER, Report, Unlike
from levelproof.pipeline.urls import as_typed, quoted
from levelproof.pipeline.words import many

NAMED = 30  # levels that a message lists at most, so that errors of MAX_LENGTH characters have room for them
READ = (
    "content_hash", "label_reason", "witness", "size", "budget", "shard", "row", "versions", "engine", "device", *KEPT,
)  # fmt: skip


def export_seed(split: Path, where: str | None, out: Path, with_levels: bool = True) -> None:
    """Write the levels of `split` that meet the condition (None: all) to a new seed file; print a summary.

    Args:
        split: a split, or seed files.
        where: condition on the manifest's columns.
        out: the new file.
        with_levels: whether levels that come from files are written; if not, `levels_elsewhere.add_levels` adds them.

    Raises:
        UserError: the split does not exist, the condition is invalid, no level or too many meet it, `out` exists or is
            not named as seed files are or cannot be written, its settings are such that this program could not read the
            file, or levels that come from ids or records should be left out.
        Failure: the split is damaged.
    """
    check_new_seed(out)
    prepare_jax()  # hashes are computed as conditions ask for them
    manifest = require_manifest(split, [*READ, *columns_in(where)], compact=True)
    rows = select_some(split, manifest.table, where)
    if rows.num_rows > SEEDS.max_rows:
        raise UserError(
            f"A seed file has at most {SEEDS.max_rows:,} levels, not {rows.num_rows:,}: write several files to "
            "one folder, which is read as one, with `levelproof export --format seed --where` and ranges of level_id."
        )
    if not with_levels:
        if not from_files(manifest.config or {}):
            raise UserError(f"The levels of {as_typed(split)} are sampled from their ids: leave out --without-levels.")
        rows = _without_folder(rows, split)
    config = {**(manifest.config or {}), **REPEATED}
    LevelSource.require_readable(config, split)
    with writing_to(out):
        with ProgressBar("levels", rows.num_rows, Console(stderr=True)) as bar:
            parts = (rows.slice(first, ROW_GROUP) for first in range(0, rows.num_rows, ROW_GROUP))
            differing = list[Unlike]()
            groups = (_group(manifest, part, with_levels, bar, differing.extend) for part in parts)
            data = seed_bytes(groups, config, rows["budget"][0].as_py())
        _require_alike(differing, where)
        files.write(out, data)
    solved = manifest.counts(np.isin(manifest.level_ids, rows["level_id"].to_numpy())).get(Label.SOLVED, 0)
    each = f", {len(data) / solved:.1f} bytes per solved one" if solved else ""
    print(f"{out}: {many(rows.num_rows, 'level')} of {as_typed(split)}, {solved:,} solved; {len(data):,} bytes{each}.")
    print(f'Next:  levelproof.open("{out}")')


def check_new_seed(out: Path) -> None:
    """Raise UserError unless `out` can be the path of a new seed file."""
    if out.suffix != SUFFIX:
        raise UserError(f"Cannot write {out}: the name of a seed file must end in {SUFFIX}, as in -o levels{SUFFIX}.")
    if out.exists():
        raise UserError(f"{out} already exists: name a new file with -o, or remove that one.")


def _without_folder(rows: pa.Table, split: Path) -> pa.Table:
    """Return rows that name their level files below the folder that all of them are in.

    Raises:
        UserError: levels are imported records, which `levels_elsewhere.add_levels` does not find.
    """
    files = [file or "" for file in rows.column("file").to_pylist()]
    if records := [file for file in files if RECORD.fullmatch(file)]:
        raise UserError(
            f"Levels of {as_typed(split)} are imported records ({records[0]} is one), which no command could add "
            "again: leave out --without-levels."
        )
    folders = [os.path.dirname(file) for file in files if os.path.isabs(file)]
    folder = os.path.commonpath(folders) if folders else ""
    below = [os.path.relpath(file, folder) if os.path.isabs(file) else file for file in files]
    return rows.set_column(rows.schema.get_field_index("file"), "file", [pa.array(below, pa.string())])


def _group(
    manifest: Manifest, rows: pa.Table, with_levels: bool, bar: ProgressBar, report: Report
) -> tuple[pa.Table, list[str]]:
    """Return a row group, and the content hashes of its levels; `bar` counts its rows, `report` is of `read_rows`."""
    columns: dict[str, Any] = {name: rows.column(name) for name in ("level_id", *KEPT)}
    columns |= {"source": rows.column("witness"), "label_reason": _reasons(rows), "made_with": _made_with(rows)}
    witnessed = np.flatnonzero(rows.column("shard").is_valid())
    witness, checksum = np.full(rows.num_rows, None, object), np.zeros(rows.num_rows, np.uint32)
    for first in range(0, len(witnessed), CHUNK):
        some = witnessed[first : first + CHUNK]
        witness[some], checksum[some] = _witnesses(manifest, rows.take(some), report)
        bar.advance(len(some))
    columns["witness"] = pa.array(witness.tolist(), pa.binary())
    columns["checksum"] = pa.array(checksum, mask=~rows.column("shard").is_valid().to_numpy())
    content = _content(manifest, rows) if with_levels else [None] * rows.num_rows
    columns["content"] = pa.array(list(content), pa.binary())
    table = pa.table({name: _plain(columns[name]) for name in SCHEMA.names}, schema=SCHEMA)
    bar.advance(rows.num_rows - len(witnessed))
    return table, rows.column("content_hash").to_pylist()


def _plain(column: Any) -> Any:
    """Return strings without dictionaries; other columns unchanged."""
    return column.cast(pa.string()) if pa.types.is_dictionary(column.type) else column


def _witnesses(manifest: Manifest, rows: pa.Table, report: Report) -> tuple[list[bytes], np.ndarray]:
    """Pack the first episodes of rows; return them and their checksums.

    Raises:
        Failure: an episode is not as the manifest says.
    """
    known = [field.name for field in table_for(size_of(rows["size"][0].as_py()))]
    wanted = [name for name in known if name.startswith(("level/", STATE)) or name in (LAST_DISTANCE, *MOVES)]
    arrays = read_rows(manifest.split, rows, wanted, report)
    steps, lanes = rows.column("steps_to_goal").fill_null(0).to_numpy(), np.arange(rows.num_rows)
    done, goal, action = (arrays[name] for name in ("record/done", "record/goal", "record/action"))
    wrong = (steps < 1) | (done.argmax(0) != steps - 1) | ~goal[steps - 1, lanes]
    if wrong.any():
        raise Failure(
            f"The first episode of level {rows['level_id'][int(wrong.argmax())]} does not end at the goal as its row "
            f"says: run `levelproof verify {quoted(manifest.split)}`."
        )
    live = np.asarray(action_mask(tree_of(Level, arrays, "level/")))
    packed = [pack_witness(action[: steps[i], :, i], live[:, i]) for i in lanes]
    return packed, checksum_of(task_states(arrays, STATE, timesteps(done)), steps)


def _require_alike(differing: Sequence[Unlike], where: str | None) -> None:
    """Raise Failure if checksums would be of states that this machine computes, which differ from the stored ones."""
    ids = [level_id for one in differing for level_id in one.level_ids]
    if not ids:
        return
    remedy = "export them on the machine that made them"
    if len(ids) <= NAMED:
        others = both(where, f"level_id NOT IN ({', '.join(map(str, ids))})")
        remedy += f', or leave them out with `levelproof export --format seed --where "{others}"`'
    raise Failure(
        f"{STATES_DIFFER} {many(len(ids), 'level')}, such as {ids[0]}, so checksums would not be those of the stored "
        f"states: {remedy}."
    )


def _content(manifest: Manifest, rows: pa.Table) -> Iterator[bytes | None]:
    """Yield each level's content; None for levels that come from ids."""
    if not from_files(manifest.config or {}):
        yield from [None] * rows.num_rows
        return
    for first in range(0, rows.num_rows, CHUNK):
        yield from pack_worlds(jax.tree.map(np.asarray, levels_of(manifest, rows.slice(first, CHUNK))))


def _reasons(rows: pa.Table) -> pa.Array:
    columns = [rows.column(name).to_pylist() for name in ("label", "witness", "steps_to_goal", "label_reason")]
    return pa.array(
        [None if reason_of(*known) else reason for *known, reason in zip(*columns, strict=True)], pa.string()
    )


def _made_with(rows: pa.Table) -> pa.Array:
    """Return the versions, engine and device of each row as JSON."""
    names = ("versions", "engine", "device")
    made = zip(*(rows.column(name).to_pylist() for name in names), strict=True)
    return pa.array([json.dumps(dict(zip(names, one, strict=True)), sort_keys=True) for one in made])

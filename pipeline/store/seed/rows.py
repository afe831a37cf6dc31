"""Seed files as manifests: columns that they leave out are recomputed from the others and the configuration."""

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from levelproof.configs.schema import from_files
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import WITNESSED, Label, Source, solved_reason, trivial_reason
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.identity.signature import signatures
from levelproof.levelgen.sampling.sampler import CHUNK
from levelproof.pipeline.store.bounds import DAMAGE
from levelproof.pipeline.store.columns import COLUMNS, REPETITIVE, schema_of
from levelproof.pipeline.store.fragment import Fragment
from levelproof.pipeline.store.progress_bar import shown_blocks
from levelproof.pipeline.store.remote import absolute, forget
from levelproof.pipeline.store.seed.columns import KEPT
from levelproof.pipeline.store.seed.file import SeedFile, damaged_seed, find_levels, read_seed, seed_files
from levelproof.pipeline.store.seed.source import LevelSource
from levelproof.pipeline.urls import as_typed

IDENTITIES = ("content_hash", "signature")
# Manifest column -> columns of the seed file that it is derived from, besides `level_id`, which is always read
MADE_FROM: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in KEPT},
    **dict.fromkeys(IDENTITIES, ("content",)),
    "label_reason": ("label", "label_reason", "source", "steps_to_goal"),
    "witness": ("source",),
    "shard": ("label",),
    "row": ("label",),
    **dict.fromkeys(("versions", "engine", "device"), ("made_with",)),
}
MANY = 20_000  # levels that take a while to hash
COSTS = ("env_steps", "evaluation_steps", "search_steps", "episodes")  # left out: 0 when read
Each = Callable[[pa.Table], pa.Table]


def seed_parts(
    source: Path, names: Sequence[str], level_ids: np.ndarray | None, compact: bool, each: Each | None
) -> list[tuple[Fragment, pa.Table]]:
    """Read the manifest's columns of all seed files at a path, as `store.manifest` reads fragments.

    Raises:
        Failure: a file is damaged, or makes other levels here.
    """
    parts = []
    for path in seed_files(source):
        forget(path)  # a remote one may have been replaced since it was last opened
        wanted = [name for column in names for name in MADE_FROM.get(column, ())]
        about, rows = _rows(path, wanted, level_ids)
        identities = _identities(about, rows) if {*IDENTITIES} & {*names} and rows.num_rows else {}
        try:
            table = manifest_rows(about, rows, identities, names, compact)
        except DAMAGE as error:  # of settings and of `made_with`, which are JSON
            raise damaged_seed(path, error) from error
        parts.append((about.fragment, table if each is None else each(table)))
    return parts


def _rows(path: Path, names: Sequence[str], level_ids: np.ndarray | None) -> tuple[SeedFile, pa.Table]:
    """Read rows with `row`, their positions in the file; it is not opened if it is known to have none of the levels."""
    if level_ids is None:
        about, rows = read_seed(path, names, compact=True)
        at = np.arange(rows.num_rows)
    else:
        about, at = find_levels(path, level_ids)
        if not len(at):
            return about, pa.table({})
        rows = read_seed(path, names, compact=True, at=at)[1]
        rows = rows.filter(np.isin(rows.column("level_id").to_numpy(), level_ids))
    return about, rows.append_column("row", pa.array(at, pa.int32()))


def manifest_rows(
    about: SeedFile, rows: pa.Table, identities: Mapping[str, pa.Array], names: Sequence[str], compact: bool
) -> pa.Table:
    """Make columns of the manifest from rows of a seed file (with `row`, their positions) and their `_identities`."""
    config, schema = about.fragment.config, schema_of(names, compact)
    if not rows.num_rows:
        return schema.empty_table()
    columns = []
    for field in schema:
        name = field.name
        if name in identities:
            column = identities[name]
        elif name == "level_id" or name in KEPT:
            column = rows.column(name)
        elif name == "witness":
            column = rows.column("source")
        elif name == "label_reason":
            column = _reasons(rows)
        elif name in ("shard", "row"):
            column = _places(about, rows, name)
        elif name in ("versions", "engine", "device"):
            column = _made_with(rows, name)
        elif name == "command":
            column = _commands(about, rows)
        else:
            constants = {"size": config["size"], "budget": about.budget, "config_hash": about.fragment.config_hash}
            constants |= dict.fromkeys(COSTS, 0) | {"learning_curve": []}
            column = pa.repeat(pa.scalar(constants.get(name), COLUMNS.field(name).type), rows.num_rows)
        columns.append(_as(column, field.type))
    return pa.table(columns, schema=schema)


def _as(column: Any, wanted: pa.DataType) -> Any:
    """Cast a column, whose strings may be dictionaries, to a type of the manifest."""
    if pa.types.is_dictionary(wanted) and not pa.types.is_dictionary(column.type):
        return column.dictionary_encode().cast(wanted)
    return column.cast(wanted)


def reason_of(label: str, source: str | None, steps: int | None) -> str | None:
    """Derive the reason for a label from the other columns; None: it does not follow from them."""
    if label == Label.TRIVIAL and steps:
        return trivial_reason(steps)
    if label == Label.SOLVED and steps and source not in (None, Source.IMPORT):
        return solved_reason(Source(source), RECORD_STEPS // steps)
    return None


def _reasons(rows: pa.Table) -> pa.Array:
    label, source = (_codes(rows.column(name)) for name in ("label", "source"))
    steps = rows.column("steps_to_goal").fill_null(0).to_numpy()
    kept = _codes(rows.column("label_reason"))
    keys = np.stack([label[0], source[0], np.where(kept[0] >= 0, 0, steps), kept[0]], 1)
    distinct, index = np.unique(keys, axis=0, return_inverse=True)
    text = [
        kept[1][k]
        if k >= 0
        else reason_of(label[1][a], source[1][b] if b >= 0 else None, n) or "the seed file has no reason"
        for a, b, n, k in distinct.tolist()
    ]
    return pa.DictionaryArray.from_arrays(pa.array(index.reshape(-1), pa.int32()), pa.array(text, pa.string()))


def _codes(column: pa.ChunkedArray) -> tuple[np.ndarray, list[str]]:
    """Return the codes of a string column, -1 for null, and the string of each code."""
    array = column.unify_dictionaries().combine_chunks()
    return array.indices.fill_null(-1).to_numpy(zero_copy_only=False), array.dictionary.to_pylist()


def _places(about: SeedFile, rows: pa.Table, name: str) -> pa.Array:
    label, names = _codes(rows.column("label"))
    witnessed = np.array([known in WITNESSED for known in names])[label]
    if name == "row":
        return pa.array(rows.column("row").to_numpy(), pa.int32(), mask=~witnessed)
    codes = pa.array(np.zeros(len(label), np.int32), mask=~witnessed)
    return pa.DictionaryArray.from_arrays(codes, pa.array([about.fragment.path.name]))


def _made_with(rows: pa.Table, name: str) -> pa.Array:
    codes, texts = _codes(rows.column("made_with"))
    values = pa.array([_parsed(text)[name] for text in texts], COLUMNS.field(name).type)
    if name in REPETITIVE:
        return pa.DictionaryArray.from_arrays(pa.array(codes, pa.int32()), values)
    return values.take(pa.array(codes))


@cache
def _parsed(text: str) -> Mapping[str, Any]:
    content = json.loads(text)
    pa.array([content["versions"]], COLUMNS.field("versions").type)
    return content


def _commands(about: SeedFile, rows: pa.Table) -> pa.Array:
    """Return the commands that regenerate rows: from their ids or, if these make no levels, from the seed file."""
    from levelproof.configs.compose import changed_settings  # imports Hydra

    config, path = about.fragment.config, about.fragment.path
    if from_files(config):
        source = as_typed(absolute(path))
        start = shlex.join(["levelproof", "regenerate", f"manifest={source}", f"budget={about.budget}"])
        start, end = f"{start} where='level_id = ", "'"
    else:
        start = shlex.join(["levelproof", "generate", f"budget={about.budget}", *changed_settings(config)])
        start, end = f"{start} first_level=", " levels=1"
    ids = rows.column("level_id").cast(pa.string())
    return pc.call_function("binary_join_element_wise", [pa.scalar(start), ids, pa.scalar(end), pa.scalar("")])


def _identities(about: SeedFile, rows: pa.Table) -> dict[str, pa.Array]:
    """Hash the levels of rows, which takes about a tenth of a millisecond for each; many show progress."""
    source = LevelSource.of(about.fragment.config, about.fragment.path)
    identities: dict[str, list[Any]] = {name: [] for name in IDENTITIES}
    for first in shown_blocks(rows.num_rows, CHUNK, "levels hashed", least=MANY):
        some = rows.slice(first, CHUNK)
        levels = source.levels(some.column("level_id").to_numpy(), some.column("content").to_pylist())
        identities["content_hash"] += content_hashes(levels)
        identities["signature"] += signatures(levels)
    return {name: pa.array(values, COLUMNS.field(name).type) for name, values in identities.items()}

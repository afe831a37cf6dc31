"""What is in a split: counts, rates, quantiles, duplicates and rows, by DuckDB over the manifest.

Reads no shard's data.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console

from levelproof.configs.compose import identified
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import DIVERGED, Label
from levelproof.pipeline.look import cost, duplicates
from levelproof.pipeline.look.facts import print_facts
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.look.reasons import kinds_of_reasons
from levelproof.pipeline.look.rows import EVERYTHING, SHOWN, Asked, ids_of, rows_of
from levelproof.pipeline.look.shares import solved_by_things
from levelproof.pipeline.read.levels import distribution_of
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.store.layout import data_path
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.remote import as_typed, is_listed
from levelproof.pipeline.store.shard import stored_bytes

QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
SPENT = ("scout_steps", "search_steps", "env_steps", "evaluation_steps")  # what levels cost, env steps
READ = (  # columns that the facts are from
    "label", "label_reason", "failed_by_noop", "witness", "steps_to_goal", "steps_to_first_success", *SPENT, "shard",
)  # fmt: skip
LIMIT = 10  # rows on a screen


def inspect(split: Path, asked: Asked, as_json: bool, against: Sequence[Path] = ()) -> None:
    """Print what is in `split`, of the rows that are asked for.

    The same levels are looked for in `against`: other splits, level files, folders of level files.

    Raises:
        UserError: no split, a condition or an order that DuckDB cannot use, or nothing to look in.
        Failure: a fragment is damaged, or names data that is not in the split.
    """
    facts = survey(split, asked, against, things=True)
    if as_json:
        json.dump(facts, sys.stdout, indent=2, allow_nan=False)
        print()
    else:
        print_facts(facts, asked.columns or SHOWN, Console(highlight=False, markup=False))


def survey(
    split: Path, asked: Asked = EVERYTHING, against: Sequence[Path] = (), things: bool = False
) -> dict[str, Any]:
    """The facts that `inspect` prints, as JSON's types; `things`: which levels are solved by what they are made of."""
    asked.check()
    columns = [*READ, *cost.READ, *columns_in(asked.where), *columns_in(asked.sort)]
    numbered = partial(duplicates.in_numbers, asked=columns)
    manifest = require_manifest(split, [*columns, *duplicates.COMPARED], compact=True, each=numbered)
    asked = asked._replace(limit=LIMIT if asked.limit is None else max(asked.limit, 0))
    alike = duplicates.perhaps_alike(manifest.table)
    manifest = replace(manifest, table=manifest.table.drop_columns([*duplicates.NUMBERS]))  # of millions of rows, much
    chosen, shown = select(manifest.table, asked.where), asked.limit or 0
    ids, wanted = chosen["level_id"].to_numpy(), ids_of(chosen, asked)
    alike = alike.filter(np.isin(alike["name"].to_numpy(), ids))
    facts = _told(split, manifest, chosen, _counts(chosen, "label"))
    facts["solved_by"] = solved_by_things(manifest, ids) if things else None
    others = {as_typed(other): duplicates.compared_in(other) for other in against}
    levels = duplicates.compared_of(split, ids) if others else None
    facts["duplicates"] = duplicates.within(alike, shown)
    facts["against"] = {name: duplicates.between(levels, other, shown) for name, other in others.items()}
    rows = [row for block in rows_of(split, wanted, asked.columns) for row in block.to_pylist()]
    return facts | {"rows": rows}


def _told(split: Path, manifest: Manifest, chosen: pa.Table, labels: dict[str, int]) -> dict[str, Any]:
    """What the rows that are chosen say."""
    told = chosen.select(["label_reason", "steps_to_goal", "steps_to_first_success", "env_steps"])
    label = chosen["label"].combine_chunks()  # compared by its indices: as texts, millions of rows take seconds
    numbers, names = label.indices.to_numpy(zero_copy_only=False), label.dictionary.to_pylist()
    of_label = {name: told.filter(pa.array(numbers == i)) for i, name in enumerate(names) if name in labels}
    none = told.slice(0, 0)
    solved, unsolved = (of_label.get(label, none) for label in (Label.SOLVED, Label.UNSOLVED))
    tried = solved.num_rows + unsolved.num_rows
    stored = sum(stored_bytes(data_path(split, shard)) for shard in manifest.shards) if is_listed(split) else None
    kept = manifest.table.num_rows - manifest.table.column("shard").null_count
    distribution = distribution_of(manifest)
    return {
        "split": as_typed(split),
        "config_hash": manifest.config_hash,
        "distribution": dict(zip(("name", "hash"), identified(distribution), strict=True)) if distribution else None,
        "levels": chosen.num_rows,
        "labels": labels,
        "reasons": {label: kinds_of_reasons(of["label_reason"]) for label, of in of_label.items()},
        "unsolvable": _counts(of_label.get(Label.UNSOLVABLE, none), "label_reason"),
        "diverged": sum(count for reason, count in _counts(unsolved, "label_reason").items() if DIVERGED in reason),
        "failed_by_noop": _total(chosen["failed_by_noop"].to_numpy()),
        "solve_rate": solved.num_rows / tried if tried else None,  # of the levels with an expert
        "solve_interval": Share(solved.num_rows, tried).rounded if tried else None,  # of 95%
        "witness": _counts(chosen.select(["witness"]).filter(pc.is_valid(chosen["witness"])), "witness"),  # pyright: ignore[reportAttributeAccessIssue]
        "steps_to_goal": _quantiles(solved, "steps_to_goal"),
        "steps_to_first_success": _quantiles(solved, "steps_to_first_success"),
        **{name: _total(chosen[name].to_numpy()) for name in SPENT},
        "env_steps_after_success": _total(solved["env_steps"].to_numpy() - solved["steps_to_first_success"].to_numpy()),
        "env_steps_unsolved": _total(unsolved["env_steps"].to_numpy()),
        "cost": cost.cost_of(chosen),
        "split_bytes": stored,  # of all the split's shards, whatever the condition
        "bytes_per_transition": stored / (kept * RECORD_STEPS) if stored and kept else None,
    }


def _total(values: np.ndarray) -> int:
    """Their sum; null is NaN here, and counts nothing."""
    return int(np.nansum(values))


def _counts(table: pa.Table, column: str) -> dict[str, int]:
    """How often each value of a column is there."""
    entries = table.column(column).value_counts().to_pylist()
    return dict(sorted((entry["values"], entry["counts"]) for entry in entries))


def _quantiles(table: pa.Table, column: str) -> dict[str, float] | None:
    values = table.column(column).drop_null().to_numpy()
    if not len(values):
        return None
    found = np.quantile(values, QUANTILES, method="nearest").tolist()
    return {f"{quantile:.0%}": value for quantile, value in zip(QUANTILES, found, strict=True)}

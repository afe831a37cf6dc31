"""Summary of a split: counts, rates, quantiles, duplicates and rows, from the manifest by DuckDB; reads no shards."""

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

from levelproof.configs.compose import name_and_hash
from levelproof.experts.labels import DIVERGED, Label
from levelproof.pipeline.look import cost, duplicates
from levelproof.pipeline.look.entities import solved_by_entities
from levelproof.pipeline.look.facts import STEPS, print_facts
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.look.query import ALL_ROWS, SHOWN, RowQuery, ids_of, prepare_for_seeds, rows_of
from levelproof.pipeline.look.reasons import kinds_of_reasons
from levelproof.pipeline.read.levels import distribution_of
from levelproof.pipeline.read.select import columns_in, select
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from levelproof.pipeline.store.named import bytes_named
from levelproof.pipeline.store.remote import is_listed
from levelproof.pipeline.tables import console_for_tables
from levelproof.pipeline.urls import as_typed

QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
SPENT = tuple(STEPS)
READ = (  # manifest columns that the facts need
    "label", "label_reason", "failed_by_noop", "witness", "steps_to_goal", "steps_to_first_success", *SPENT, "shard",
)  # fmt: skip
LIMIT = 10  # rows on a screen


def inspect(split: Path, query: RowQuery, as_json: bool, against: Sequence[Path] = ()) -> None:
    """Print a summary of `split` and the rows that `query` selects.

    Searches `against` (splits, level files, or folders of level files) for the same levels.

    Raises:
        UserError: no split, DuckDB rejects the condition or the order, or `against` has no levels.
        Failure: a fragment is damaged, or names data that the split lacks.
    """
    prepare_for_seeds(split, *against)
    facts = survey(split, query, against, entities=True)
    if as_json:
        json.dump(facts, sys.stdout, indent=2, allow_nan=False)
        print()
    else:
        print_facts(facts, query.columns or SHOWN, console_for_tables())


def survey(
    split: Path, query: RowQuery = ALL_ROWS, against: Sequence[Path] = (), entities: bool = False
) -> dict[str, Any]:
    """Collect the facts that `inspect` prints, as JSON types; `entities` adds the share solved by entity counts."""
    query.check()
    columns = [*READ, *cost.READ, *columns_in(query.where), *columns_in(query.sort)]
    hashed = partial(duplicates.hash_identities, kept=columns)
    manifest = require_manifest(split, [*columns, *duplicates.COMPARED], compact=True, each=hashed)
    query = query._replace(limit=LIMIT if query.limit is None else query.limit)
    candidates = duplicates.find_candidates(manifest.table)
    manifest = replace(
        manifest, table=manifest.table.drop_columns([*duplicates.NUMBERS])
    )  # saves memory: splits have millions of rows
    chosen, shown = select(manifest.table, query.where), query.limit or 0
    ids, wanted = chosen["level_id"].to_numpy(), ids_of(chosen, query)
    candidates = candidates.filter(np.isin(candidates["name"].to_numpy(), ids))
    facts = _summary(split, manifest, chosen, _counts(chosen, "label"))
    facts["solved_by"] = solved_by_entities(manifest, ids) if entities else None
    others = {as_typed(other): duplicates.comparison_of_source(other) for other in against}
    levels = duplicates.comparison_of_levels(split, ids) if others else None
    facts["duplicates"] = duplicates.within(candidates, shown)
    facts["against"] = {name: duplicates.between(levels, other, shown) for name, other in others.items()}
    rows = [row for block in rows_of(split, wanted, query.columns) for row in block.to_pylist()]
    return facts | {"rows": rows}


def _summary(split: Path, manifest: Manifest, chosen: pa.Table, labels: dict[str, int]) -> dict[str, Any]:
    """Summarise the chosen rows."""
    details = chosen.select(["label_reason", "steps_to_goal", "steps_to_first_success", "env_steps"])
    label = chosen["label"].combine_chunks()  # compare codes: comparing millions of strings takes seconds
    codes, names = label.indices.to_numpy(zero_copy_only=False), label.dictionary.to_pylist()
    of_label = {name: details.filter(pa.array(codes == i)) for i, name in enumerate(names) if name in labels}
    none = details.slice(0, 0)
    solved, unsolved = (of_label.get(label, none) for label in (Label.SOLVED, Label.UNSOLVED))
    tried = solved.num_rows + unsolved.num_rows
    stored = bytes_named(split, manifest.shards) if is_listed(split) else None
    transitions = manifest.transitions
    distribution = distribution_of(manifest)
    after = solved["env_steps"].to_numpy() - solved["steps_to_first_success"].to_numpy()
    spent = {name: _total(chosen[name].to_numpy()) for name in SPENT}
    spent |= {"env_steps_after_success": _total(after), "env_steps_unsolved": _total(unsolved["env_steps"].to_numpy())}
    return {
        "split": as_typed(split),
        "config_hash": manifest.config_hash,
        "distribution": dict(zip(("name", "hash"), name_and_hash(distribution), strict=True)) if distribution else None,
        "levels": chosen.num_rows,
        "labels": labels,
        "reasons": {label: kinds_of_reasons(rows["label_reason"]) for label, rows in of_label.items()},
        "unsolvable": _counts(of_label.get(Label.UNSOLVABLE, none), "label_reason"),
        "diverged": sum(count for reason, count in _counts(unsolved, "label_reason").items() if DIVERGED in reason),
        "failed_by_noop": _total(chosen["failed_by_noop"].to_numpy()),
        "solve_rate": solved.num_rows / tried if tried else None,  # of the levels that had an expert
        "solve_interval": Share(solved.num_rows, tried).rounded if tried else None,  # 95%
        "witness": _counts(chosen.select(["witness"]).filter(pc.is_valid(chosen["witness"])), "witness"),  # pyright: ignore[reportAttributeAccessIssue]
        "steps_to_goal": _quantiles(solved, "steps_to_goal"),
        "steps_to_first_success": _quantiles(solved, "steps_to_first_success"),
        **(dict.fromkeys(spent) if manifest.repeats else spent),
        "cost": cost.cost_of(chosen),
        "split_bytes": stored,  # all shards, whatever the condition
        "bytes_per_transition": stored / transitions if stored and transitions else None,
    }


def _total(values: np.ndarray) -> int:
    """Sum, with NaN (null in the manifest) as 0."""
    return int(np.nansum(values))


def _counts(table: pa.Table, column: str) -> dict[str, int]:
    """Count each value of a column."""
    entries = table.column(column).value_counts().to_pylist()
    return dict(sorted((entry["values"], entry["counts"]) for entry in entries))


def _quantiles(table: pa.Table, column: str) -> dict[str, float] | None:
    values = table.column(column).drop_null().to_numpy()
    if not len(values):
        return None
    quantiles = np.quantile(values, QUANTILES, method="nearest").tolist()
    return {f"{quantile:.0%}": value for quantile, value in zip(QUANTILES, quantiles, strict=True)}

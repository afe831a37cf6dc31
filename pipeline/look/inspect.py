"""What is in a split: counts, rates, quantiles, duplicates and rows, by DuckDB over the manifest.

Reads no shard's data.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from rich.console import Console
from rich.table import Table

from configs.compose import identified
from configs.convert import typed
from configs.schema import from_files
from experts.config import RECORD_STEPS
from experts.labels import DIVERGED, Label
from levelgen.sampling.distribution import Distribution
from pipeline.look import cost, duplicates
from pipeline.read.select import columns_in, select
from pipeline.store.layout import data_path
from pipeline.store.manifest import require_manifest
from pipeline.store.remote import as_typed, is_listed
from pipeline.store.shard import stored_bytes

QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
READ = (  # columns that the facts are from
    "label", "label_reason", "failed_by_noop", "steps_to_goal", "steps_to_first_success", "env_steps", "shard",
)  # fmt: skip
SHOWN = ("level_id", "label", "success_rate", "steps_to_goal", "steps_to_first_success", "env_steps")


def inspect(split: Path, where: str | None, rows: int, as_json: bool, against: Sequence[Path] = ()) -> None:
    """Print what is in `split`, of the rows for which the SQL condition `where` holds.

    The same levels are looked for in `against`: other splits, level files, folders of level files.

    Raises:
        UserError: no split, a condition that DuckDB cannot use, or nothing to look in.
        Failure: a fragment is damaged, or names data that is not in the split.
    """
    facts = survey(split, where, rows, against)
    if as_json:
        json.dump(facts, sys.stdout, indent=2, allow_nan=False)
        print()
    else:
        _print(facts, Console(highlight=False))


def survey(split: Path, where: str | None = None, rows: int = 10, against: Sequence[Path] = ()) -> dict[str, Any]:
    """The facts that `inspect` prints, as JSON's types."""
    manifest, shown = require_manifest(split, [*READ, *cost.READ, *columns_in(where)], compact=True), max(rows, 0)
    chosen = select(manifest.table, where)
    labels, reasons = _counts(chosen, "label"), _counts(chosen, "label_reason")
    told = chosen.select(["label_reason", "steps_to_goal", "steps_to_first_success", "env_steps"])
    solved, unsolved, unsolvable = (
        told.filter(pc.equal(chosen["label"], label.value))  # pyright: ignore[reportAttributeAccessIssue]
        for label in (Label.SOLVED, Label.UNSOLVED, Label.UNSOLVABLE)
    )
    tried, ids = solved.num_rows + unsolved.num_rows, chosen["level_id"].to_numpy()
    stored = sum(stored_bytes(data_path(split, shard)) for shard in manifest.shards) if is_listed(split) else None
    kept = manifest.table.num_rows - manifest.table.column("shard").null_count
    config = manifest.config or {}
    distribution = None if from_files(config) else typed(Distribution, config["distribution"], "distribution")
    others = {str(other): duplicates.compared_in(other) for other in against}
    levels = duplicates.compared_of(split, ids) if others else None
    return {
        "split": as_typed(split),
        "config_hash": manifest.config_hash,
        "distribution": dict(zip(("name", "hash"), identified(distribution), strict=True)) if distribution else None,
        "levels": chosen.num_rows,
        "labels": labels,
        "unsolvable": _counts(unsolvable, "label_reason"),
        "diverged": sum(count for reason, count in reasons.items() if DIVERGED in reason),
        "failed_by_noop": _total(chosen["failed_by_noop"].to_numpy()),
        "solve_rate": solved.num_rows / tried if tried else None,  # of the levels with an expert
        "steps_to_goal": _quantiles(solved, "steps_to_goal"),
        "steps_to_first_success": _quantiles(solved, "steps_to_first_success"),
        "duplicates": duplicates.within(duplicates.perhaps_alike(split, ids), shown),
        "against": {name: duplicates.between(levels, other, shown) for name, other in others.items()},
        "env_steps": _total(chosen["env_steps"].to_numpy()),
        "env_steps_after_success": _total(solved["env_steps"].to_numpy() - solved["steps_to_first_success"].to_numpy()),
        "env_steps_unsolved": _total(unsolved["env_steps"].to_numpy()),
        "cost": cost.cost_of(chosen),
        "split_bytes": stored,  # of all the split's shards, whatever the condition
        "bytes_per_transition": stored / (kept * RECORD_STEPS) if stored and kept else None,
        "rows": require_manifest(split, level_ids=ids[:shown]).table.to_pylist()
        if len(ids[:shown])
        else [],  # with all columns
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


def _print(facts: dict[str, Any], console: Console) -> None:
    labels = ", ".join(f"{count} {label}" for label, count in facts["labels"].items()) or "none"
    of = facts["distribution"]
    lines = {
        "split": facts["split"],
        "distribution": f"{of['name'] or 'of its own'} ({of['hash']})"
        if of
        else "none, levels are of level files or imported",
        "levels": f"{facts['levels']} ({labels})",
        "unsolvable": "; ".join(f"{count} {reason}" for reason, count in facts["unsolvable"].items()) or None,
        "experts that diverged": str(facts["diverged"]) if facts["diverged"] else None,
        "failed by doing nothing": str(facts["failed_by_noop"]),
        "solve rate of experts": f"{facts['solve_rate']:.1%}" if facts["solve_rate"] is not None else None,
        "steps to goal": _told(facts["steps_to_goal"]),
        "training steps to first success": _told(facts["steps_to_first_success"]),
        "duplicates": duplicates.told(facts["duplicates"]),
        **{f"duplicates in {other}": duplicates.told(found) for other, found in facts["against"].items()},
        "training env steps": _steps_told(facts),
        "cost": cost.cost_told(facts["cost"]) if facts["cost"] else None,
        "shards": f"{facts['split_bytes']:,} bytes" if facts["split_bytes"] is not None else None,
        "bytes per transition": f"{facts['bytes_per_transition']:.1f}" if facts["bytes_per_transition"] else None,
    }
    for name, text in lines.items():
        if text is not None:
            console.print(f"{name + ':':32} {text}", markup=False, soft_wrap=True)
    table = Table(*SHOWN, box=None, pad_edge=False, padding=(0, 1, 0, 0))  # fits 80 columns
    for row in facts["rows"]:
        table.add_row(*(_cell(row[name]) for name in SHOWN))
    if facts["rows"]:
        console.print()
        console.print(table)


def _steps_told(facts: dict[str, Any]) -> str:
    steps, after, unsolved = (facts[f"env_steps{of}"] for of in ("", "_after_success", "_unsolved"))
    if not steps:
        return "0"
    return f"{steps:,} ({after / steps:.0%} after a first success, {unsolved / steps:.0%} of levels unsolved)"


def _told(quantiles: dict[str, float] | None) -> str | None:
    return ", ".join(f"{name}: {value:,.0f}" for name, value in quantiles.items()) if quantiles else None


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)

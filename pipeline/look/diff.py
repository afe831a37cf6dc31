"""Comparison of the same levels in two splits: which each split solved, and at what cost.

Reads the manifests only, no shards. The splits may differ in budget or procedure.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.table import Table

from levelproof.experts.labels import TRAINED, WITNESSED, Label
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look import cost
from levelproof.pipeline.look.duplicates import COMPARED, CONTENT, HALVES, hash_identities
from levelproof.pipeline.look.inspect import QUANTILES, SPENT
from levelproof.pipeline.look.query import prepare_for_seeds
from levelproof.pipeline.read.select import columns_in, labelled, select
from levelproof.pipeline.store.manifest import Manifest, changes_text, differences, require_manifest
from levelproof.pipeline.tables import console_for_tables, folded
from levelproof.pipeline.urls import as_typed
from levelproof.pipeline.words import number

READ = (*cost.READ, "steps_to_goal", *SPENT)
LABELS = [label.value for label in Label]


def diff(one: Path, other: Path, where: str | None, rows: int, as_json: bool) -> None:
    """Print how two splits of the same levels differ; `where` is a condition on rows of the first.

    Raises:
        UserError: a split is missing, DuckDB rejects the condition, or the splits have different levels.
        Failure: a fragment is damaged.
    """
    prepare_for_seeds(one, other)
    facts = compare(one, other, where, rows)
    if as_json:
        json.dump(facts, sys.stdout, indent=2, allow_nan=False)
        print()
    else:
        _print(facts, console_for_tables())


def compare(one: Path, other: Path, where: str | None = None, rows: int = 10) -> dict[str, Any]:
    """Collect the facts that `diff` prints, as JSON types."""
    (left, right), manifests, alone = _read((one, other), where)
    solved, tried = np.stack([labelled(rows, WITNESSED) for rows in (left, right)]), labelled(left, TRAINED)
    tried |= labelled(right, TRAINED)
    only = [solved[i] & ~solved[1 - i] for i in range(2)]
    ids, gained = left["level_id"].to_numpy(), int(only[1].sum() - only[0].sum())
    spent = [_spent(side, manifest) for side, manifest in zip((left, right), manifests, strict=True)]
    totals = [sum(steps.values()) if steps else 0 for steps in spent]
    costs = [cost.cost_of(side) for side in (left, right)]
    seconds = [sum(side["seconds"].values()) if side else 0.0 for side in costs]
    counts = [[int(mask.sum()) for mask in (side & tried, tried)] for side in solved]
    return {
        "splits": [as_typed(one), as_typed(other)],
        "settings": differences(*(manifest.config or {} for manifest in manifests)),  # that decide results and differ
        "levels": left.num_rows,
        "alone": alone,
        "solved": [{"solved": hits, "tried": tries} for hits, tries in counts],
        "both": int((solved[0] & solved[1]).sum()),
        "neither": int((~solved[0] & ~solved[1] & tried).sum()),
        "only": [int(mask.sum()) for mask in only],
        "p": exact_p(*(int(mask.sum()) for mask in only)),
        "only_rows": [ids[mask][:rows].tolist() for mask in only],
        "labels": _label_changes(left, right),
        "env_steps": spent,
        "env_steps_for_one_more": (totals[1] - totals[0]) / gained if gained and all(spent) else None,
        "cost": costs,
        "seconds_for_one_more": (seconds[1] - seconds[0]) / gained if gained and _comparable(costs) else None,
        "steps_to_goal": _paired(left, right, solved[0] & solved[1]),
    }


def exact_p(fewer: int, more: int) -> float:
    """Two-sided p-value of McNemar's exact test, which treats each discordant pair as a fair coin flip."""
    few, flips = min(fewer, more), fewer + more
    heads = np.arange(1, few + 1)
    ratios = np.cumsum(np.log((flips - heads + 1) / heads))  # log of P(k heads) / P(0 heads), k = 1, 2, ...
    return float(min(1.0, 2 * np.exp(np.concatenate([[0.0], ratios]) - flips * np.log(2)).sum()))


def _read(
    splits: tuple[Path, Path], where: str | None
) -> tuple[tuple[pa.Table, pa.Table], list[Manifest], list[int | None]]:
    """Read the rows (READ) of levels in both splits, the manifests without rows, and the numbers of other levels."""
    manifests = []
    for split, columns in zip(splits, ([*READ, *columns_in(where)], READ), strict=True):
        hashed = partial(hash_identities, kept=columns)
        manifests.append(require_manifest(split, [*columns, *COMPARED], compact=True, each=hashed))
    chosen, others = select(manifests[0].table, where), manifests[1].table
    common = _common(chosen, others, splits)
    alone = [rows.num_rows - common[0].num_rows for rows in (chosen, others)]
    nothing = chosen.schema.empty_table()  # so that memory holds the rows of other levels no longer
    manifests = [replace(manifest, table=nothing) for manifest in manifests]
    return common, manifests, [alone[0], alone[1] if where is None else None]


def _common(one: pa.Table, other: pa.Table, splits: tuple[Path, Path]) -> tuple[pa.Table, pa.Table]:
    """Select the rows (from `hash_identities`) of levels that are in both tables, in the same order.

    A level's content hash may differ between stacks, whose bits differ; half of its signature still matches.

    Raises:
        UserError: no level is in both, or an id names different levels.
    """
    _, here, there = np.intersect1d(one["level_id"].to_numpy(), other["level_id"].to_numpy(), True, True)
    sides = "{} and {}".format(*splits)
    if not len(here):
        raise UserError(f"{sides} have no level in common: give two splits of the same levels.")
    left, right = one.take(here), other.take(there)
    same = lambda mine, theirs: left[mine].to_numpy() == right[theirs].to_numpy()
    alike = np.logical_or.reduce([same(CONTENT, CONTENT), *(same(*pair) for pair in product(HALVES, HALVES))])
    if not alike.all():
        raise UserError(
            f"Level {left['level_id'][int(alike.argmin())]} differs between {sides}: "
            "give two splits of one size and one distribution."
        )
    return left.select(["level_id", *READ]), right.select(["level_id", *READ])


def _spent(rows: pa.Table, manifest: Manifest) -> dict[str, int] | None:
    """Total the env steps by stage; None where costs were left behind."""
    if manifest.repeats:
        return None
    return {name: int(rows[name].to_numpy().sum()) for name in SPENT}


def _comparable(costs: Sequence[dict[str, Any] | None]) -> bool:
    """Whether both splits know the cost of as many levels, in seconds of the same kind of device."""
    return all(costs) and len({(side["of"], side["levels"]) for side in costs if side}) == 1


def _label_changes(left: pa.Table, right: pa.Table) -> dict[str, dict[str, int]]:
    """Count levels by their label in `left`, then by their label in `right`."""
    codes = [np.array([LABELS.index(word) for word in side["label"].to_pylist()]) for side in (left, right)]
    counts = np.zeros((len(LABELS), len(LABELS)), int)
    np.add.at(counts, (codes[0], codes[1]), 1)
    return {
        label: {other: int(count) for other, count in zip(LABELS, row, strict=True) if count}
        for label, row in zip(LABELS, counts, strict=True)
        if row.any()
    }


def _paired(left: pa.Table, right: pa.Table, both: np.ndarray) -> dict[str, Any] | None:
    """Compare steps to the goal of levels that both splits solve, with the p-value of a sign test."""
    steps = np.stack([side["steps_to_goal"].to_numpy()[both] for side in (left, right)]).astype(float)
    steps = steps[:, ~np.isnan(steps).any(0)]
    if not steps.size:
        return None
    shorter, longer = int((steps[1] < steps[0]).sum()), int((steps[1] > steps[0]).sum())
    quantiles = [np.quantile(side, QUANTILES, method="nearest").tolist() for side in steps]
    return {
        "levels": steps.shape[1],
        "quantiles": [dict(zip((f"{q:.0%}" for q in QUANTILES), side, strict=True)) for side in quantiles],
        "shorter": shorter,
        "longer": longer,
        "p": exact_p(shorter, longer),
        "median_change": float(np.median(steps[1] - steps[0])),
    }


def _print(facts: dict[str, Any], console: Console) -> None:
    one, other = facts["splits"]
    table = Table("", one, other, "difference", box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for column in table.columns[1:]:
        column.justify = "right"
    shares = [f"{side['solved'] / side['tried']:.1%}" if side["tried"] else "-" for side in facts["solved"]]
    gained = facts["only"][1] - facts["only"][0]
    table.add_row("levels solved", *(f"{side['solved']:,}" for side in facts["solved"]), f"{gained:+,}")
    table.add_row("share of undecided levels", *shares, f"p {_p(facts['p'])}")
    table.add_row("solved by this split only", *(f"{count:,}" for count in facts["only"]), "")
    for name in SPENT if all(facts["env_steps"]) else ():
        here, there = (side[name] for side in facts["env_steps"])
        if here or there:
            table.add_row(name.replace("_", " "), f"{here:,}", f"{there:,}", f"{there - here:+,}")
    if _comparable(facts["cost"]):
        here, there = (sum(side["seconds"].values()) for side in facts["cost"])
        table.add_row(f"{facts['cost'][0]['of']}-seconds", f"{here:,.0f}", f"{there:,.0f}", f"{there - here:+,.0f}")
    if steps := facts["steps_to_goal"]:
        for quantile in steps["quantiles"][0]:
            here, there = (side[quantile] for side in steps["quantiles"])
            name = "median" if quantile == "50%" else quantile
            table.add_row(f"steps to goal, {name}", f"{here:,.0f}", f"{there:,.0f}", f"{there - here:+,.0f}")
    console.print(folded(table))
    say = lambda text: console.print(text, soft_wrap=not console.is_terminal)
    say("")
    one_sided = [
        f"{count:,} only in {split}" for count, split in zip(facts["alone"], facts["splits"], strict=True) if count
    ]
    say(f"{facts['levels']:,} levels are in both" + (f" ({', '.join(one_sided)})." if one_sided else "."))
    say(f"Settings that differ: {changes_text(facts['settings']) or 'none'}.")
    for name, unit in (("env_steps", "env steps"), ("seconds", "seconds")):
        if (more := facts[f"{name}_for_one_more"]) is not None:
            say(f"{more * gained:+,.0f} {unit} for {gained:+,} solved levels: {number(more)} per extra level.")
    if steps:
        say(
            f"Of {steps['levels']:,} levels that both solve, {steps['shorter']:,} take fewer steps in {other} and "
            f"{steps['longer']:,} more, p {_p(steps['p'])}."
        )
    for split, ids, count in zip(facts["splits"], facts["only_rows"], facts["only"], strict=True):
        if ids:
            say(f"Solved only in {split}: {', '.join(map(str, ids))}{', ...' if len(ids) < count else ''}")


def _p(p: float) -> str:
    return f"= {p:.2g}" if p >= 1e-4 else "< 0.0001"

"""Tables of how many levels each variant solves, and comparisons level by level."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.report import Table
from benchmarks.solved.results import Results, by_size, count, mean, share
from benchmarks.solved.variants import VARIANTS
from benchmarks.statistics import mcnemar
from levelproof.experts.labels import BY_EXPERT

ENOUGH = 1000  # undecided levels for a solved share that may be quoted
QUARTER = "alone"  # the variant compared with the reference also at a quarter of the budget
HEAD = (
    "variant", "undecided levels", "solved (95% interval)", "by an expert's own witness",
    "an expert reaches the goal by itself", "at a quarter of the budget", "env steps a level",
    "core-seconds a solved level", "success rate", "steps to goal",
)  # fmt: skip
PAIRED_HEAD = ("variant", "against", "levels of both", "only the first solves", "only the other solves", "p")


def tables(results: Sequence[Results]) -> list[Table]:
    """Make the tables of each size and budget: its variants, and pairs of them."""
    groups: dict[tuple[str, int], list[Results]] = {}
    for each in sorted(results, key=order):
        groups.setdefault((each.header.size, each.header.budget), []).append(each)
    result = []
    for (size, budget), group in groups.items():
        title = f"**Size {size}, {count(budget)} env steps**, {ids_of(group)}"
        result.append(Table(HEAD, [line(each) for each in group], title))
        if pairs := paired(group):
            result.append(Table(PAIRED_HEAD, pairs, "Level by level"))
    return result


def variants_of(results: Sequence[Results]) -> str:
    """List the variants with their descriptions."""
    names = {each.header.variant for each in results}
    return "\n".join(f"- `{name}`: {each.text}" for name, each in VARIANTS.items() if name in names)


def order(results: Results) -> tuple:
    header, names = results.header, list(VARIANTS)
    variant = names.index(header.variant) if header.variant in names else len(names)
    return by_size(header.size), header.budget, variant


def ids_of(group: Sequence[Results]) -> str:
    ids = {level_id for each in group for level_id in each.rows}
    return f"levels {min(ids):,} to {max(ids):,}" if ids else "no levels"


def line(results: Results) -> list[str]:
    """Make a variant's row."""
    header, trained, solved = results.header, results.trained, results.solved()
    rows = [trained[level_id] for level_id in solved]
    seconds = sum(row["core_seconds"] for row in results.rows.values())
    quarter = len(results.solved(header.budget / 4))
    own = [row["witness"] and row["witness"] in BY_EXPERT for row in rows]
    rate = mean([row["success_rate"] for row in rows])
    few = " (few)" if header.variant == "default" and len(trained) < ENOUGH else ""
    return [
        f"`{header.variant}`",
        f"{len(trained)} of {len(results.rows)}{few}",
        share(len(solved), len(trained)),
        known_share(own),
        known_share([reaches(row) for row in rows]),
        share(quarter, len(trained)) if header.stops_early else "-",
        f"{mean([steps_of(row) for row in trained.values()]) or 0:,.0f}",
        f"{seconds / len(solved):.3g}" if solved else "-",
        f"{rate:.3f}" if rate is not None else "-",
        f"{statistics.median(row['steps_to_goal'] for row in rows):.0f}" if rows else "-",
    ]


def reaches(row: Mapping[str, Any]) -> bool | None:
    """Whether the expert of a solved level reaches the goal by itself, whatever found the witness; None: unknown."""
    if row["witness"] in BY_EXPERT or (row["success_rate"] or 0) > 0:
        return True
    return row["most_probable_succeeds"]


def known_share(facts: Sequence[bool | None]) -> str:
    """Format the share of true facts; - if any is unknown."""
    return f"{sum(map(bool, facts)) / len(facts):.1%}" if facts and None not in facts else "-"


def steps_of(row: Mapping[str, Any]) -> int:
    """Return a level's env steps: of training, evaluations and search."""
    return sum(row[name] or 0 for name in ("env_steps", "evaluation_steps", "search_steps"))


def paired(group: Sequence[Results]) -> list[list[str]]:
    """Make a row for each variant and each other one it is compared with, if both have results."""
    by_name, lines = {each.header.variant: each for each in group}, []
    for name, one in by_name.items():
        against = VARIANTS[name].against if name in VARIANTS else ()
        others = [by_name[other] for other in against if other in by_name]
        solved = {f"`{name}`": one.solved()}
        if name == QUARTER and one.header.stops_early:
            solved[f"`{name}`, a quarter of the budget"] = one.solved(one.header.budget / 4)
        for text, levels in solved.items():
            lines += [[text, f"`{other.header.variant}`", *discordant(one, other, levels)] for other in others]
    return lines


def discordant(one: Results, other: Results, solved: set[int]) -> list[str]:
    """Count levels that both tried, and that only one solved; append p."""
    both = one.trained.keys() & other.trained.keys()
    solved, theirs = solved & both, other.solved() & both
    p = mcnemar(len(solved - theirs), len(theirs - solved))
    return [str(len(both)), str(len(solved - theirs)), str(len(theirs - solved)), f"{p:.2g}"]

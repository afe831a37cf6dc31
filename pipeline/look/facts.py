"""Facts of `inspect` in words, wrapped to the terminal's width."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from levelproof.pipeline.look import cost, duplicates
from levelproof.pipeline.look.entities import ENTITIES
from levelproof.pipeline.tables import folded

NAMES = 33  # characters; column where the text of a line begins
REASONS = 4  # shown per label; the rest are only counted
STEPS = {  # columns of env steps, by stage, and what takes them
    "search_steps": "search",
    "env_steps": "training",
    "evaluation_steps": "evaluation",
}


def print_facts(facts: Mapping[str, Any], shown: Sequence[str], console: Console) -> None:
    """Print the facts of `survey`, then the `shown` columns of its rows."""
    for name, texts in _lines(facts).items():
        for i, text in enumerate(texts if isinstance(texts, list) else [texts]):
            line = f"{(name + ':') * (not i):{NAMES - 1}} {text}"
            if console.is_terminal:  # files and pipes get one line per fact
                line = textwrap.fill(line, console.width, subsequent_indent=" " * NAMES, drop_whitespace=True)
            console.print(line, soft_wrap=True)
    table = Table(*shown, box=None, pad_edge=False, padding=(0, 1, 0, 0))  # fits 80 columns
    for row in facts["rows"]:
        table.add_row(*(_cell(row[name]) for name in shown))
    if facts["rows"]:
        console.print()
        console.print(folded(table))


def _lines(facts: Mapping[str, Any]) -> dict[str, str | list[str]]:
    labels = ", ".join(f"{count} {label}" for label, count in facts["labels"].items()) or "none"
    distribution, rate, interval = facts["distribution"], facts["solve_rate"], facts["solve_interval"]
    lines: dict[str, str | list[str] | None] = {
        "split": facts["split"],
        "distribution": f"{distribution['name'] or 'custom'} ({distribution['hash']})"
        if distribution
        else "none: levels come from level files or an import",
        "levels": f"{facts['levels']} ({labels})",
        **{f"{label}, because": _reasons(kinds) for label, kinds in facts["reasons"].items()},
        "experts that diverged": str(facts["diverged"]) if facts["diverged"] else None,
        "failed by doing nothing": str(facts["failed_by_noop"]),
        "solved of undecided levels": f"{rate:.1%} ({_interval(interval)})" if rate is not None else None,
        **_by_entities(facts["solved_by"]),
        "witnesses": ", ".join(f"{count} {name}" for name, count in facts["witness"].items()) or None,
        "steps to goal": _list(facts["steps_to_goal"]),
        "training steps to first success": _list(facts["steps_to_first_success"]),
        "env steps": _steps(facts),
        "training env steps": _training(facts),
        "cost": cost.describe_cost(facts["cost"]) if facts["cost"] else None,
        "duplicates": duplicates.describe(facts["duplicates"]),
        **{f"duplicates in {other}": duplicates.describe(pairs) for other, pairs in facts["against"].items()},
        "shards of the split": f"{facts['split_bytes']:,} bytes" if facts["split_bytes"] is not None else None,
        "bytes per transition": f"{facts['bytes_per_transition']:.1f}" if facts["bytes_per_transition"] else None,
    }
    return {name: text for name, text in lines.items() if text}


def _reasons(kinds: Mapping[str, int]) -> list[str]:
    """List the most frequent reasons, one per line."""
    shown = [f"{count} {kind}" for kind, count in list(kinds.items())[:REASONS]]
    rest = sum(list(kinds.values())[REASONS:])
    return [*shown, f"{rest} other reasons"] if rest else shown


def _by_entities(shares: Mapping[str, Any] | None) -> dict[str, str | None]:
    """Share of levels solved, by the number of each kind of entity they have."""
    if shares and shares["problem"]:
        return {"solved, by entities": shares["problem"]}
    if not shares or not shares["levels"]:
        return {}
    sample = f" (of {shares['levels']:,} sampled)" if shares["sampled"] < shares["of"] else ""
    ends = lambda share: "-".join(f"{100 * end:.0f}" for end in share["interval"])
    shown = lambda share: f"{share['solved'] / share['tried']:.0%} ({ends(share)}) of {share['tried']:,}"
    return {
        f"solved, by {name}": ", ".join(f"{count}: {shown(share)}" for count, share in shares[name].items())
        + sample * (name == ENTITIES[0])
        for name in ENTITIES
        if len(shares[name]) > 1
    }


def _interval(ends: Sequence[float]) -> str:
    return " to ".join(f"{end:.1%}" for end in ends)


def _steps(facts: Mapping[str, Any]) -> str | None:
    """Describe env steps by stage."""
    if facts["env_steps"] is None:
        return None
    total = sum(facts[name] for name in STEPS)
    parts = [f"{facts[name] / total:.0%} {what}" for name, what in STEPS.items() if facts[name]]
    return f"{total:,} ({', '.join(parts)})" if total else "0"


def _training(facts: Mapping[str, Any]) -> str | None:
    steps, after, unsolved = (facts[f"env_steps{suffix}"] for suffix in ("", "_after_success", "_unsolved"))
    if not steps:
        return None if steps is None else "0"
    return f"{steps:,} ({after / steps:.0%} after a first success, {unsolved / steps:.0%} on unsolved levels)"


def _list(quantiles: Mapping[str, float] | None) -> str | None:
    return ", ".join(f"{name}: {value:,.0f}" for name, value in quantiles.items()) if quantiles else None


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)

"""Evaluation of a policy: solve rates on levels, beside those of players that learned nothing."""

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from levelproof.experts.evaluation import (
    Player,
    do_nothing,
    play,
    play_most_probable,
    play_randomly,
    play_sampled,
    play_sticky,
)
from levelproof.experts.networks.saved import Policy, PolicyError, load_policy
from levelproof.levelgen.level import name_of
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.jobs.progress import say
from levelproof.pipeline.learn.measured import MeasuredLevels, levels_in, sealed_levels
from levelproof.pipeline.learn.solve_rates import Solved, solve_rates
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.words import many

NOTHING = "doing nothing"
ALL, NOT_TRIVIAL, SOLVED = "all", "that doing nothing does not solve", "labelled solved"  # denominators


def evaluate(
    policy: Path | None,
    place: Path | None,
    where: str | None,
    sizes: Sequence[str],
    count: int | None,
    attempts: int,
    seed: int,
    as_json: bool,
) -> None:
    """Play levels, and print a table of solve rates or JSON.

    Args:
        policy: folder of a policy; None: baselines only.
        place: split, or folder of level files; None: the sealed levels.
        where: SQL condition that selects levels of a split.
        sizes: sizes of the sealed levels.
        count: number of levels, the first ones; None: all.
        attempts: attempts at each level.
        seed: of the attempts.
        as_json: whether to print JSON instead of tables.

    Raises:
        UserError: the policy or the levels do not exist, or do not fit each other.
        Failure: the split is damaged.
    """
    prepare_jax()
    loaded = _loaded(policy) if policy else None
    entrants = _entrants(loaded)
    console = Console(stderr=True)
    sealed = (sealed_levels(size, count) for size in dict.fromkeys(sizes))
    groups = levels_in(place, where, count, partial(say, console)) if place else sealed
    facts = []
    for group in groups:
        _require_size(loaded, group)
        facts.append(_measured(group, entrants, attempts, seed, console))
    if as_json:
        json.dump({"policy": policy and str(policy), "attempts": attempts, "seed": seed, "levels": facts}, sys.stdout)
        print()
        return
    for group in facts:
        _print(group, attempts, Console(highlight=False, markup=False))
    print("In brackets: 95% intervals over levels.")


class _Entrant(NamedTuple):
    player: Player
    params: Any = ()
    chance: bool = True  # whether attempts differ


def _entrants(policy: Policy | None) -> dict[str, _Entrant]:
    """Return all that play the levels, by the name that the table shows."""
    entrants = {
        NOTHING: _Entrant(do_nothing, chance=False),
        "random": _Entrant(play_randomly),
        "sticky random": _Entrant(play_sticky),
    }
    if policy:
        entrants["policy, sampled"] = _Entrant(play_sampled(policy.network), policy.params)
        entrants["policy, greedy"] = _Entrant(play_most_probable(policy.network), policy.params, chance=False)
    return entrants


def _loaded(folder: Path) -> Policy:
    try:
        return load_policy(folder)
    except PolicyError as error:
        raise UserError(str(error)) from None


def _require_size(policy: Policy | None, group: MeasuredLevels) -> None:
    if policy and policy.size not in (None, group.levels.size):
        raise UserError(
            f"The policy plays levels of size {name_of(policy.size)} only, and those of {group.name} have "
            f"{name_of(group.levels.size)}: choose others with --on or --size."
        )


def _measured(
    group: MeasuredLevels, entrants: dict[str, _Entrant], attempts: int, seed: int, console: Console
) -> dict[str, Any]:
    """Play one group of levels; return its facts as JSON types."""
    solved: dict[str, Solved] = {}
    with _shown(console, group.name, len(group.level_ids) * len(entrants)) as follow:
        for name, (player, params, chance) in entrants.items():
            tries = attempts if chance else 1
            played = play(player, params, group.levels, group.level_ids, tries, seed, group.rules, follow)
            solved[name] = played.solved
    chosen = {ALL: np.ones(len(group.level_ids), bool), NOT_TRIVIAL: ~solved[NOTHING][:, 0]}
    if group.solved is not None:
        chosen[SOLVED] = group.solved
    return {
        "levels": group.name,
        "of": {
            title: {name: solve_rates(each[some]) for name, each in solved.items()}
            for title, some in chosen.items()
            if some.any()
        },
    }


def _print(facts: dict[str, Any], attempts: int, console: Console) -> None:
    for title, players in facts["of"].items():
        count = next(iter(players.values()))["levels"]
        console.print(f"{facts['levels']}: {many(count, 'level')} ({title})", soft_wrap=True)
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 1))
        for column in ("", "one attempt", f"best of {attempts}", "worst tenth"):
            table.add_column(column, justify="right" if table.columns else "left", no_wrap=True)
        for name, rates in players.items():
            table.add_row(name, *(_shown_rate(rates[key]) for key in ("once", "best", "worst")))
        console.print(table)
        console.print()


def _shown_rate(rate: dict[str, Any] | None) -> str:
    if rate is None:
        return "-"
    low, high = rate["interval"]
    return f"{100 * rate['rate']:.1f}% ({100 * low:.1f}-{100 * high:.1f})"


@contextmanager
def _shown(console: Console, name: str, total: int) -> Iterator[Any]:
    """Show a bar on a terminal; yield a function that advances it."""
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(f"playing {name}", total=total)
        yield lambda count: bar.update(task, advance=count)

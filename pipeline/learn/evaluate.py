"""Evaluation of a policy: solve rates on levels, beside those of players that learned nothing."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
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
from levelproof.experts.networks.saved import BUILTIN, Policy
from levelproof.levelgen.level import SIZES, name_of
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.jobs.progress import say
from levelproof.pipeline.learn.looks import LOOKS, log_look
from levelproof.pipeline.learn.measured import MeasuredLevels, is_split, levels_in, midway_levels, sealed_levels
from levelproof.pipeline.learn.published import PROTOCOLS, published_levels
from levelproof.pipeline.learn.solve_rates import Solved, solve_rates
from levelproof.pipeline.learn.specialists import Specialists, sealed_specialists, specialists_of
from levelproof.pipeline.read.agents import SUFFIX as AGENT_SUFFIX
from levelproof.pipeline.read.agents import agent_in
from levelproof.pipeline.read.policies import policy_at, require_size
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.words import many

SEALED = "sealed"
ATTEMPTS = 8
WIDE = 120  # columns of a table that no terminal shows: in 80, Rich would cut long rates
NOTHING, SAMPLED, AGENT = "doing nothing", "policy, sampled", "agent"
ALL, NOT_TRIVIAL, SOLVED = "all", "that doing nothing does not solve", "labelled solved"  # denominators


def evaluate(
    policy: Path | None,
    on: str,
    where: str | None,
    sizes: Sequence[str] | None,
    count: int | None,
    attempts: int | None,
    seed: int,
    starts: Sequence[float],
    experts: Sequence[Path],
    as_json: bool,
) -> None:
    """Play levels, and print a table of solve rates or JSON.

    Args:
        policy: folder of a policy, or a Python file with an agent; None: baselines only.
        on: SEALED, a name in PROTOCOLS, a split, or a folder of level files.
        where: SQL condition that selects levels of a split.
        sizes: sizes of the sealed or published levels; None: s of the sealed, all of the published.
        count: number of levels, the first ones; None: all.
        attempts: attempts at each level; None: as many as published rates come from, else ATTEMPTS.
        seed: of the attempts.
        starts: where in the witnesses of a split attempts start, as shares of the steps to the goal, 0 to below 1.
        experts: splits whose own experts of the levels stand in the table, too.
        as_json: whether to print JSON instead of tables.

    Raises:
        UserError: the policy or the levels do not exist, or do not fit each other; or the agent fails.
        Failure: the split is damaged.
    """
    prepare_jax()
    agent = agent_in(policy) if policy and policy.suffix == AGENT_SUFFIX else None
    loaded = policy_at(policy) if policy and not agent else None
    entrants = _entrants(loaded) | ({AGENT: _Entrant(agent)} if agent else {})
    console = Console(stderr=True)
    facts = []
    if attempts is None:
        attempts = PROTOCOLS[on].attempts if on in PROTOCOLS else ATTEMPTS
    for group in _groups(on, where, sizes, count, starts, partial(say, console)):
        if loaded:
            require_size(loaded, group.levels.size, group.name, "choose others with --on or --size")
        facts.append(_measured(group, entrants, _own_experts(group, on, experts, attempts), attempts, seed, console))
        if agent and agent.error:
            raise UserError(f"{agent.error}.")
    if policy and on == SEALED:
        log, name = (policy.with_suffix(f".{LOOKS}"), AGENT) if agent else (policy / LOOKS, SAMPLED)
        if looks := log_look(log, name, facts, attempts, seed):
            say(console, f"Look {looks} at the sealed levels; {log} lists every look with this policy.")
        elif not str(policy).startswith(BUILTIN):  # those that come with levelproof were chosen before this look
            say(console, f"Cannot write {log}, so this look at the sealed levels is not recorded.")
    if as_json:
        json.dump({"policy": policy and str(policy), "attempts": attempts, "seed": seed, "levels": facts}, sys.stdout)
        print()
        return
    for group in facts:
        _print(group, attempts, Console(highlight=False, markup=False, width=None if sys.stdout.isatty() else WIDE))
    print("In brackets: 95% intervals over levels.")
    if any(group["published"] for group in facts):
        print("sfl-paper, sfl-1m-envs: the reference's agents, with the rates that it published.")


def is_named(on: str) -> bool:
    """Whether this is the name of a set of levels, not a path."""
    return on == SEALED or on in PROTOCOLS


def _groups(
    on: str,
    where: str | None,
    sizes: Sequence[str] | None,
    count: int | None,
    starts: Sequence[float],
    tell: Callable[[str], None],
) -> Iterator[MeasuredLevels]:
    """Yield the levels to play. Arguments and errors as `evaluate`."""
    if any(starts):
        if is_named(on) or not is_split(Path(on)):
            raise UserError(
                f"--start plays from states of a split's witnesses, but {on} is not a split: name one with --on."
            )
        for start in starts:
            yield midway_levels(Path(on), where, count, start)
    elif on == SEALED:
        for size in dict.fromkeys(sizes or ["s"]):
            yield sealed_levels(size, count)
    elif on in PROTOCOLS:
        yield from published_levels(on, [*dict.fromkeys(sizes or SIZES)], count, tell)
    else:
        yield from levels_in(Path(on), where, count, tell)


class _Entrant(NamedTuple):
    player: Player
    params: Any = ()
    chance: bool = True  # whether attempts differ by random draws


def _entrants(policy: Policy | None) -> dict[str, _Entrant]:
    """Return all that play the levels, by the name that the table shows."""
    entrants = {
        NOTHING: _Entrant(do_nothing, chance=False),
        "random": _Entrant(play_randomly),
        "sticky random": _Entrant(play_sticky),
    }
    if policy:
        entrants[SAMPLED] = _Entrant(play_sampled(policy.network), policy.params)
        entrants["policy, greedy"] = _Entrant(play_most_probable(policy.network), policy.params, chance=False)
    return entrants


def _own_experts(group: MeasuredLevels, on: str, splits: Sequence[Path], attempts: int) -> list[Specialists]:
    """Return the rated attempts of the levels' own experts; of two with one budget, the second names its split."""
    own = sealed_specialists(name_of(group.levels.size), len(group.level_ids), attempts) if on == SEALED else []
    for split in splits:
        one = specialists_of(split, group.level_ids, attempts)
        taken = any(one.name == other.name for other in own)
        own.append(one._replace(name=f"{one.name}, {split}") if taken else one)
    return own


def _measured(
    group: MeasuredLevels,
    entrants: dict[str, _Entrant],
    experts: Sequence[Specialists],
    attempts: int,
    seed: int,
    console: Console,
) -> dict[str, Any]:
    """Play one group of levels; return its facts as JSON types."""
    solved, steps = dict[str, Solved](), dict[str, Any]()
    with _shown(console, group.name, len(group.level_ids) * len(entrants)) as follow:
        for name, (player, params, chance) in entrants.items():
            tries = attempts if chance else 1
            played = play(player, params, group.levels, group.level_ids, tries, seed, group.rules, follow)
            solved[name], steps[name] = played
    solved |= dict(experts)
    chosen = {ALL: np.ones(len(group.level_ids), bool), NOT_TRIVIAL: ~solved[NOTHING][:, 0]}
    if group.solved is not None:
        chosen[SOLVED] = group.solved
    return {
        "levels": group.name,
        "start": group.start,
        "published": dict(group.published),
        "of": {
            title: {
                name: solve_rates(each[some], steps[name][some] if name in steps else None)
                for name, each in solved.items()
            }
            for title, some in chosen.items()
            if some.any()
        },
    }


def _print(facts: dict[str, Any], attempts: int, console: Console) -> None:
    counts = {title: next(iter(players.values()))["levels"] for title, players in facts["of"].items()}
    for title, players in facts["of"].items():
        count = counts[title]
        if title != ALL and count == counts[ALL]:
            continue  # the same levels
        console.print(f"{facts['levels']}: {many(count, 'level')} ({title})", soft_wrap=True)
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))  # fits 80 columns
        for column in ("", "one attempt", f"best of {attempts}", "worst tenth", "steps"):
            table.add_column(column, justify="right" if table.columns else "left", no_wrap=True)
        for name, rates in players.items():
            steps = "-" if rates["steps"] is None else f"{rates['steps']:.0f}"
            table.add_row(name, *(_shown_rate(rates[key]) for key in ("once", "best", "worst")), steps)
        for name, rate in facts["published"].items() if title == ALL else ():
            table.add_row(name, f"{rate:.0%}", "-", "-", "-")
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

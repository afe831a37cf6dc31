"""Evaluation of a policy: solve rates on levels, beside those of players that learned nothing."""

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
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
from levelproof.experts.networks.saved import BUILTIN, CONFIG, Policy
from levelproof.levelgen.level import SIZES, name_of
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.looks import LOOKS, SEALED, log_look
from levelproof.pipeline.learn.measured import MeasuredLevels, is_split, levels_in, midway_levels, sealed_levels
from levelproof.pipeline.learn.published import AGENTS, PROTOCOLS, published_levels
from levelproof.pipeline.learn.sealed import SEALED_IDS
from levelproof.pipeline.learn.solve_rates import Solved, difference, solve_rates
from levelproof.pipeline.learn.specialists import Specialists, sealed_specialists, specialists_of
from levelproof.pipeline.read.agents import SUFFIX as AGENT_SUFFIX
from levelproof.pipeline.read.agents import Agent, agent_in
from levelproof.pipeline.read.policies import policy_at, require_size
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.progress_bar import ProgressBar, say
from levelproof.pipeline.tables import console_for_tables, folded
from levelproof.pipeline.urls import as_typed
from levelproof.pipeline.words import many

ATTEMPTS = 8
NOTHING, POLICY, OTHER, AGENT = "doing nothing", "policy", "other", "agent"
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
    against: Path | None = None,
) -> None:
    """Play levels, and print a table of solve rates or JSON.

    Args:
        policy: folder of a policy, or a Python file with an agent; None: baselines only.
        on: SEALED, a name in PROTOCOLS, a split, or a folder of level files.
        where: SQL condition that selects levels of a split.
        sizes: sizes of the sealed or published levels; None: s of the sealed, all of the published.
        count: number of levels, the first ones; None: all.
        attempts: attempts at each level; None: the number behind the published rates, or else ATTEMPTS.
        seed: of the attempts.
        starts: where in the witnesses of a split attempts start, as shares of the steps to the goal, 0 to below 1.
        experts: splits whose experts of these levels are listed for comparison.
        as_json: whether to print JSON instead of tables.
        against: another policy or agent, with which `policy` is compared level by level; None: none.

    Raises:
        UserError: the policy or the levels do not exist, or do not fit each other; or the agent fails.
        Failure: the split is damaged.
    """
    prepare_jax()
    contestants = [_contestant(path, title) for path, title in ((policy, POLICY), (against, OTHER)) if path]
    entrants = BASELINES | {name: entrant for each in contestants for name, entrant in each.entrants.items()}
    console = Console(stderr=True)
    facts, looked_at = [], []
    if attempts is None:
        attempts = PROTOCOLS[on].attempts if on in PROTOCOLS else ATTEMPTS
    groups = [*_groups(on, where, sizes, count, starts, partial(say, console))]
    _require_sizes(contestants, groups)  # before anything is played
    for group, own in zip(groups, _own_experts(groups, on, experts, attempts), strict=True):
        facts.append(_measured(group, entrants, own, [each.main for each in contestants], attempts, seed, console))
        if np.isin(group.level_ids, SEALED_IDS).any():  # in a split of them, too
            looked_at.append(facts[-1])
    for each in contestants if looked_at else ():
        _log(each, looked_at, attempts, seed, console)
    if as_json:
        others = {"against": str(against)} if against else {}
        about = {"policy": policy and str(policy), **others, "attempts": attempts, "seed": seed}
        json.dump(about | {"levels": facts}, sys.stdout)
        print()
    else:
        _print_all(facts, attempts)


def _print_all(facts: Sequence[dict[str, Any]], attempts: int) -> None:
    """Print the tables of all groups of levels, and what they need to be read."""
    for group in facts:
        _print(group, attempts, console_for_tables())
    print("In brackets: 95% intervals over levels.")
    if any(group["published"] for group in facts):
        agents = ", ".join(f"{name} ({steps} env steps on {levels})" for name, (steps, levels) in AGENTS.items())
        print(f"{agents}: the reference's agents, with the rates that it published.")


def _require_sizes(contestants: Sequence["_Contestant"], groups: Sequence[MeasuredLevels]) -> None:
    """Raise UserError if a policy cannot play levels of a group's size."""
    for group in groups:
        for each in contestants:
            if each.policy:
                require_size(each.policy, group.levels.size, group.name, "choose others with --on or --size")


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
        data = Dataset(Path(on), where, (), 0.0)
        for start in starts:
            yield midway_levels(data, count, start)
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


BASELINES = {
    NOTHING: _Entrant(do_nothing, chance=False),
    "random": _Entrant(play_randomly),
    "sticky random": _Entrant(play_sticky),
}


class _Contestant(NamedTuple):
    """A policy or an agent that is measured."""

    path: Path
    main: str  # name of the player that looks and comparisons are about
    entrants: dict[str, _Entrant]  # by the name that the table shows
    policy: Policy | None = None

    @property
    def looks(self) -> Path:
        """Path of its log of looks at sealed levels."""
        return self.path / LOOKS if self.policy else self.path.with_suffix(f".{LOOKS}")


def _contestant(path: Path, title: str) -> _Contestant:
    if path.suffix == AGENT_SUFFIX:
        name = AGENT if title == POLICY else title
        return _Contestant(path, name, {name: _Entrant(agent_in(path))})
    if (path.is_file() or is_split(path)) and not (path / CONFIG).exists():
        raise UserError(f"{as_typed(path)} is not a policy: name a policy's folder; levels go after --on.")
    policy = policy_at(path)
    sampled = _Entrant(play_sampled(policy.network), policy.params)
    greedy = _Entrant(play_most_probable(policy.network), policy.params, chance=False)
    main = f"{title}, sampled"
    return _Contestant(path, main, {main: sampled, f"{title}, greedy": greedy}, policy=policy)


def _log(one: _Contestant, looked_at: Sequence[dict[str, Any]], attempts: int, seed: int, console: Console) -> None:
    """Log a look at sealed levels beside the policy, and tell the user."""
    if looks := log_look(one.looks, one.main, looked_at, attempts, seed):
        say(console, f"Evaluation {looks} of this policy on sealed levels: {one.looks} lists them all.")
    elif not str(one.path).startswith(BUILTIN):  # those that come with levelproof were chosen before this look
        say(console, f"Cannot write {one.looks}, so this evaluation is not recorded.")


def _own_experts(
    groups: Sequence[MeasuredLevels], on: str, splits: Sequence[Path], attempts: int
) -> list[list[Specialists]]:
    """Return the rated attempts of the own experts of each group's levels.

    If two splits have the same budget, the name of the second includes its split.

    Raises:
        UserError: a split is unusable, as `specialists_of` says, or has no level of any group's size.
    """
    sealed = lambda group: sealed_specialists(name_of(group.levels.size), len(group.level_ids), attempts)
    own = [sealed(group) if on == SEALED else [] for group in groups]
    for split in splits:
        found = [specialists_of(split, group, attempts) for group in groups]
        if not any(found):
            sizes = ", ".join(dict.fromkeys(name_of(group.levels.size) for group in groups))
            raise UserError(f"The levels of {split} are not of size {sizes}: name another split with --experts.")
        for others, one in zip(own, found, strict=True):
            if one:
                taken = any(one.name == other.name for other in others)
                others.append(one._replace(name=f"{one.name}, {split}") if taken else one)
    return own


def _measured(
    group: MeasuredLevels,
    entrants: dict[str, _Entrant],
    experts: Sequence[Specialists],
    compared: Sequence[str],
    attempts: int,
    seed: int,
    console: Console,
) -> dict[str, Any]:
    """Play one group of levels; return its facts as JSON types.

    With two players in `compared`, `difference` says by how much the first is better than the second.

    Raises:
        UserError: an agent fails.
    """
    solved, steps = dict[str, Solved](), dict[str, Any]()
    what = f"levels of {group.name}, player by player"
    with ProgressBar(what, len(group.level_ids) * len(entrants), console) as bar:
        for name, (player, params, chance) in entrants.items():
            tries, follow = attempts if chance else 1, partial(_advance, bar, player)
            played = play(player, params, group.levels, group.level_ids, tries, seed, group.rules, follow)
            solved[name], steps[name] = played
    solved |= dict(experts)
    chosen = {ALL: np.ones(len(group.level_ids), bool), NOT_TRIVIAL: ~solved[NOTHING][:, 0]}
    if group.solved is not None:
        chosen[SOLVED] = group.solved
    sealed = np.isin(group.level_ids, SEALED_IDS)
    if not sealed.all():
        chosen[SEALED] = sealed
    chosen = {title: some for title, some in chosen.items() if some.any()}
    apart = {}
    if len(compared) == 2:
        pair = [solved[name] for name in compared]
        apart["difference"] = {title: difference(*(each[some] for each in pair)) for title, some in chosen.items()}
    return apart | {
        "levels": group.name,
        "start": group.start,
        "published": dict(group.published),
        "of": {
            title: {
                name: solve_rates(each[some], steps[name][some] if name in steps else None)
                for name, each in solved.items()
            }
            for title, some in chosen.items()
        },
    }


def _advance(bar: ProgressBar, player: Player, count: int) -> None:
    """Advance the bar. Raise UserError if the player is an agent that has failed: from then on it does nothing."""
    if isinstance(player, Agent) and player.error:
        raise UserError(f"{player.error}.")
    bar.advance(count)


def _print(facts: dict[str, Any], attempts: int, console: Console) -> None:
    counts = {title: next(iter(players.values()))["levels"] for title, players in facts["of"].items()}
    for title, players in facts["of"].items():
        count = counts[title]
        if title != ALL and count == counts[ALL]:
            continue  # the same levels
        console.print(f"{facts['levels']}: {many(count, 'level')} ({title})", soft_wrap=True)
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))  # fits 80 columns
        for column in ("", "one attempt", f"best of {attempts}", "worst tenth", "steps"):
            table.add_column(column, justify="right" if table.columns else "left")
        for name, rates in players.items():
            steps = "-" if rates["steps"] is None else f"{rates['steps']:.0f}"
            table.add_row(name, *(_shown_rate(rates[key]) for key in ("once", "best", "worst")), steps)
        for name, rate in facts["published"].items() if title == ALL else ():
            table.add_row(name, f"{rate:.0%}", "-", "-", "-")
        console.print(folded(table))
        if apart := facts.get("difference", {}).get(title):
            low, high = (f"{100 * x:+.1f}" for x in apart["interval"])
            ours = AGENT if AGENT in players else POLICY
            say_difference = f"{ours} minus other, one attempt, level by level: {100 * apart['rate']:+.1f} points"
            console.print(f"{say_difference} ({low} to {high})")
        console.print()


def _shown_rate(rate: dict[str, Any] | None) -> str:
    if rate is None:
        return "-"
    low, high = rate["interval"]
    return f"{100 * rate['rate']:.1f}% ({100 * low:.1f}-{100 * high:.1f})"

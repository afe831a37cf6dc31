"""Learners at equal cost: RL from scratch, a clone of searched levels, and RL from that clone.

Everything that a way needs counts as its core-seconds. A stopped run resumes, except in a search: every command
continues what it left, training from its checkpoint, and the folder keeps finished evaluations. A way takes hours, so
the repository keeps finished ones, and other machines add theirs: where training from scratch runs at half the pace of
the first runs, a CPU second counts half, whether the machine or that day's learner made it slower.
"""

import argparse
import hashlib
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any, NamedTuple

from benchmarks.cloning import ATTEMPTS, SAMPLED, command, interval_text, kept, lines_of, slug, timed_split
from benchmarks.plotting import pyplot, save
from benchmarks.report import Report, Table
from benchmarks.teaching import DISTILLING
from levelproof.configs.compose import compose_train
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.evaluate import ALL, SOLVED
from levelproof.pipeline.runtime import own_cores
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.provenance import device

FINISHED = Path(__file__).parent / "results" / "equal"  # a file for each finished run
POINTS = 100  # of its curve
PACE = 84_500.0  # env steps of s a core-second of training from scratch where the first runs were made (AMD EPYC)
PACED = 15  # updates that measure a processor's pace
LOOKS = 0.25, 0.5, 1.0  # shares of the core-seconds after which a policy is measured
HOUR = 3600.0  # core-seconds of the first page; one of more hours has a page of its own
LATE = 1.05  # of the time planned for training until then: how late that may be
FIRST = 50_000  # id of the first level to clone from; the measured ones are sealed
BETWEEN_SEEDS = 10_000_000  # ids
SCRATCH = ("network.width=64",)
TUNING = ("ppo.learning_rate=2e-4", "ppo.entropy_weight=0.002", "ppo.critic_updates=5")
UPDATES, STEPS, SECONDS, RATE = "train/updates", "train/env_steps", "train/core_seconds", "train/solve_rate"
SETTLED = 5  # updates, after which lines no longer favour short episodes
SHARES = "of all", "of solved", "best of 8"
PLAYERS = "random", "sticky random", "its own expert, 256k"
CLONE, START = "clone", "builtin:s"


class Way(NamedTuple):
    """How a policy is made."""

    settings: Sequence[str]  # of `levelproof train`, which has the rest of the core-seconds
    start: str = ""  # policy that training starts from; CLONE: one that is made first
    colour: str = "#777777"
    own_levels: bool = False  # whether to train on solved levels that are searched first: those of the clone, if any
    teachers: bool = False  # whether `levelproof distill` takes half of the clone's updates

    @property
    def searches(self) -> bool:
        """Whether levels are searched first."""
        return self.own_levels or self.start == CLONE


SEARCHING, PACING = Lock(), Lock()  # several ways share levels, a clone and a pace
WAYS = {
    "from scratch": Way(SCRATCH, colour="#0072b2"),
    "from scratch, learnability": Way((*SCRATCH, "levels=learnability"), colour="#56b4e9"),
    "from scratch, replay": Way((*SCRATCH, "levels=replay"), colour="#117733"),
    "from scratch, evolve": Way((*SCRATCH, "levels=evolve"), colour="#882255"),
    "levels, reinforcement on these levels": Way(SCRATCH, colour="#000000", own_levels=True),
    "levels, clone, reinforcement": Way(TUNING, CLONE, "#d55e00"),
    "levels, clone, learnability": Way((*TUNING, "levels=learnability"), CLONE, "#e69f00"),
    "levels, clone, reinforcement on these levels": Way(TUNING, CLONE, "#cc79a7", own_levels=True),
    "levels, clone, learnability on these levels": Way(
        (*TUNING, "choice=learnability"), CLONE, "#999933", own_levels=True
    ),
    "levels, clone, teachers, reinforcement": Way(TUNING, CLONE, "#661100", teachers=True),
    "from builtin:s": Way(TUNING, START, "#009e73"),
}


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS), help="default: all")
    parser.add_argument("--size", default="s", help="size of the levels (default: s)")
    parser.add_argument("--seeds", type=int, default=1, help="policies of each way (default: 1)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of all training")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path("equal"), help="where everything is kept")
    parser.add_argument("--core-seconds", type=float, default=HOUR, help=f"of each policy (default: {HOUR:g})")
    parser.add_argument("--levels", default="8k", help="levels to search for a clone (default: 8k)")
    parser.add_argument("--updates", type=int, default=1500, help="updates of a clone (default: 1500)")
    parser.add_argument("--cloning", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of a clone")
    parser.add_argument("--finished", type=Path, default=FINISHED, help="where finished runs are kept")
    parser.add_argument(
        "--only-finished",
        action="store_true",
        help="make no run, and show the longest finished run of each way and seed within --core-seconds",
    )


def run(args: argparse.Namespace) -> Report:
    runs = [(way, seed) for way in args.ways for seed in range(args.seeds)]
    if args.only_finished:
        results = [each for one in runs for each in longest(args, *one)]
    else:
        with ThreadPoolExecutor(len(own_cores())) as threads:
            results = [json.loads(file.read_text()) for file in threads.map(lambda one: finished(args, *one), runs)]
    if not results:
        raise UserError(f"--only-finished: {args.finished} has none of these runs; without it they are made.")
    players, dates = results[0]["sealed"], sorted(each["date"][:10] for each in results)
    rows = [list(row) for row in dict.fromkeys(tuple(row) for each in results for row in rows_of(each))]
    rows += [row_of(name, ("", "", "", "", ""), players, name) for name in PLAYERS if name in players[ALL]]
    shown = {each["way"] for each in results}
    size = "" if args.size == "s" else args.size
    hours = f"{args.core_seconds / HOUR:g}" if args.core_seconds > HOUR else ""
    page = "_".join(filter(None, ("equal", size, hours and f"{hours}h")))
    head = ("policy", "seed", "pace", "env steps", "core-seconds before training", "in all", *SHARES)
    return Report(
        ", ".join(filter(None, ("Learners at equal cost", size and f"size {size}", hours and f"{hours} core-hours"))),
        results,
        [
            Table(head, rows, f"Share of sealed levels of {args.size} solved with sampled actions; 95% intervals"),
            by_cost(results),
        ],
        [
            f"Every policy has at most {args.core_seconds:,.0f} core-seconds of one core, with compiling, for all "
            f"that it is made from: if its row names them, the search of {args.levels} levels (`procedure=label "
            f"budget=16k`, ids from {FIRST:,} on, for the second seed from {FIRST + BETWEEN_SEEDS:,}), the clone "
            f"({', '.join((f'{args.updates:,} updates', *(f'`{each}`' for each in (*SCRATCH, *args.cloning))))}); then "
            "reinforcement learning, on random levels unless its row says otherwise"
            f"{f'; what {START} took is not counted' if any(WAYS[way].start == START for way in shown) else ''}. "
            "*Pace*: env steps that training from scratch on s takes in a CPU second of the core, with the learner of "
            f"that day. A core-second here is the CPU time of {PACE:,.0f} of them, so seconds of different paces are "
            "comparable: at lower paces, RL on random levels takes up to 11% fewer env steps in them"
            f"{', and curricula up to 17% fewer' if args.size == 's' else ''}. *Of all*: "
            f"{players[ALL]['random']['levels']:,} levels, of which some cannot be solved; *of solved*, and the best "
            f"of 8 attempts at them: the {players[SOLVED]['random']['levels']:,} that are labelled solved.",
            *[f"*Teachers*: half of the clone's updates are of `levelproof distill {' '.join(DISTILLING)}`."]
            * any(WAYS[way].teachers for way in shown),
            *dict.fromkeys(each["remark"] for each in results if "remark" in each),
            *(f"{way}: `levelproof train {words_of(args, way, 0)}{started(way)}`." for way in WAYS if way in shown),
            f"![Shares that reach the goal, in training and of sealed levels, against core-seconds]({page}.svg)",
            "Left: share of training episodes that reach the goal, by the current weights, on fresh random levels or "
            "those that the way trains on. Right, as in the table: share of the sealed levels labelled solved that the "
            "saved average of the weights solves; after a clone, the first point is the clone.",
        ],
        page=page,
        plots={f"{page}.svg": partial(draw, results)},
        made=f"{' to '.join(dict.fromkeys((dates[0], dates[-1])))}, on "
        f"{', '.join(dict.fromkeys(each['device'].removeprefix('cpu: ') for each in results))}",
    )  # fmt: skip


def longest(args: argparse.Namespace, way: str, seed: int) -> list[dict[str, Any]]:
    """Return the result of a way's longest finished run within the core-seconds, if there is one."""
    about, files = stem_of(args, way, seed)[1], args.finished.glob(f"{slug(way)}-{args.size}-{seed}-*.json")
    is_this = lambda each: all(each[name] == value for name, value in about.items() if name != "core_seconds")
    runs = [each for each in (json.loads(file.read_text()) for file in files) if is_this(each)]
    runs = [each for each in runs if each["core_seconds"] <= args.core_seconds]
    return [max(runs, key=lambda each: each["core_seconds"])] if runs else []


def stem_of(args: argparse.Namespace, way: str, seed: int) -> tuple[str, dict[str, Any]]:
    """Return how the name of a finished run's file begins, and what it is a run of."""
    about = {
        "way": way,
        "size": args.size,
        "seed": seed,
        "core_seconds": args.core_seconds,
        "train": words_of(args, way, seed),
        "levels": args.levels if WAYS[way].searches else None,
        "clone": [f"train.updates={args.updates}", *args.cloning] if WAYS[way].start == CLONE else None,
        "measured": args.measured,
    }
    told = hashlib.sha256(json.dumps(about).encode()).hexdigest()[:8]
    return f"{slug(way)}-{args.size}-{seed}-{told}", about


def finished(args: argparse.Namespace, way: str, seed: int) -> Path:
    """Return the file of a run, which is made if there is none."""
    stem, about = stem_of(args, way, seed)
    file = args.finished / f"{stem}.json"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        made = {"device": device(), "date": datetime.now(UTC).isoformat(timespec="seconds")}
        write(file, (json.dumps(about | made | measured(args, way, seed), indent=1) + "\n").encode())
    return file


def measured(args: argparse.Namespace, way: str, seed: int) -> dict[str, Any]:
    """Make one policy, and measure it and its clone on sealed levels; core-seconds are those of PACE.

    Raises:
        UserError: nothing is left for training, or the folder has a longer run.
    """
    folder, here = args.folder / f"{slug(way)}-{args.size}-{seed}", pace(args)
    scale = here / PACE  # of core-seconds
    start, before, clone = WAYS[way].start, 0.0, None
    if start == CLONE:
        with SEARCHING:
            start, seconds = cloned(args, way, seed)
            before = scale * seconds
            clone = kept(start.with_name(f"{start.name}-{args.measured}.json"), start, *measuring(args))
    elif WAYS[way].own_levels:
        with SEARCHING:
            before = scale * searched(args, seed)
    ends, curve, rates = [share * args.core_seconds for share in LOOKS], [], {}
    look_at = lambda spent: folder.with_name(f"{folder.name}-after-{spent}-{args.measured}.json")
    if before >= ends[-1]:
        raise UserError(f"{way}: what comes before training takes {before:,.0f} core-seconds: raise --core-seconds.")
    limits = {end: (end - before) / scale for end in ends if end > before}  # in seconds of this processor
    so_far = sum(line[SECONDS] for line in lines_of(folder)[-1:])  # 0: not yet begun
    if so_far > LATE * limits[ends[-1]]:
        raise UserError(f"{folder} has a run of more than {ends[-1]:,.0f} core-seconds: choose another --folder.")
    for spent, limit in limits.items():
        look, is_last = look_at(f"{spent:g}"), spent == ends[-1]
        if not is_last and (look.exists() or so_far > LATE * limit):
            continue  # a run that was stopped, or had fewer core-seconds, came that far
        curve = trained(args, folder, way, start, seed, limit)
        so_far = curve[-1][SECONDS]
        if not is_last and so_far > LATE * limit:
            continue  # the first command takes longer
        rates = kept(args.folder / f"{folder.name}-{curve[-1][STEPS]}-{args.measured}.json", folder, *measuring(args))
        solved = rates[SOLVED][SAMPLED]["once"]
        told = {"planned": spent, SECONDS: before + scale * curve[-1][SECONDS], "solved": solved}
        write(look, (json.dumps(told) + "\n").encode())
    looks = [json.loads(look.read_text()) for look in folder.parent.glob(look_at("*").name)]
    looks = sorted((look for look in looks if look["planned"] <= args.core_seconds), key=lambda look: look["planned"])
    lines = [*curve[:: -(-len(curve) // POINTS)], curve[-1]]
    some = [
        {name: line.get(name) for name in (UPDATES, STEPS, RATE)} | {SECONDS: scale * line[SECONDS]} for line in lines
    ]
    return {"pace": here, "before": before, "curve": some, "looks": looks, "sealed": rates, "cloned": clone}


def pace(args: argparse.Namespace) -> float:
    """Return how many env steps of s a core-second of training from scratch takes here; measured once a folder."""
    file, words = args.folder / "pace.json", ("size=s", "cores=1", *SCRATCH, "interval=5")
    steps = PACED * compose_train(words).ppo.steps_per_update
    with PACING, TemporaryDirectory() as folder:  # one that was stopped would have compiled twice
        if not file.exists():
            command("train", *words, f"ppo.env_steps={steps}", "-o", folder)
            first, *_, last = lines_of(Path(folder))  # the first comes after compiling
            rate = (last[STEPS] - first[STEPS]) / (last[SECONDS] - first[SECONDS])
            file.parent.mkdir(parents=True, exist_ok=True)
            write(file, json.dumps(rate).encode())
        return json.loads(file.read_text())


def measuring(args: argparse.Namespace) -> Sequence[Any]:
    """Return the words of `levelproof evaluate` that choose the levels and attempts."""
    return "--size", args.size, "--attempts", ATTEMPTS, "--levels", args.measured


def cloned(args: argparse.Namespace, way: str, seed: int) -> tuple[Path, float]:
    """Search levels, and clone what solves them; return the policy, and the core-seconds of both."""
    updates = args.updates // 2 if WAYS[way].teachers else args.updates
    policy, split = args.folder / f"clone-{args.size}-{args.levels}-{updates}-{seed}", split_of(args, seed)
    spent, words = searched(args, seed), (f"train.updates={updates}", f"seed={seed}")
    command("clone", split, "-o", policy, *SCRATCH, *words, *args.cloning)
    spent += lines_of(policy)[-1]["bc/core_seconds"]
    if WAYS[way].teachers:
        start, policy = policy, policy.with_name(f"distilled-{args.size}-{args.levels}-{updates}-{seed}")
        command("distill", split, "-o", policy, "where=label = 'solved'", f"start={start}", *words, *DISTILLING)
        spent += lines_of(policy)[-1]["distill/core_seconds"]
    return policy, spent


def searched(args: argparse.Namespace, seed: int) -> float:
    """Search levels; return the CPU seconds that it took. Raises as `timed_split`."""
    job = f"levels={args.levels}", f"size={args.size}", f"first_level={FIRST + BETWEEN_SEEDS * seed}"
    return timed_split(split_of(args, seed).parents[1], *job, "procedure=label", "budget=16k")


def settings_of(args: argparse.Namespace, way: str, seed: int) -> Sequence[str]:
    """Return the settings of `levelproof train` that say what is trained on, and how."""
    own = f"levels={split_of(args, seed)}", "where=label = 'solved'"
    levels = own if WAYS[way].own_levels else (f"size={args.size}",)
    return *levels, "cores=1", *WAYS[way].settings, *args.set


def words_of(args: argparse.Namespace, way: str, seed: int) -> str:
    """Return the settings as a shell takes them, wherever the folder is."""
    words = [word.replace(f"{args.folder}/", "") for word in settings_of(args, way, seed)]
    return " ".join(f'"{word}"' if " " in word else word for word in words)


def started(way: str) -> str:
    """Return the setting of the policy to start from, as the page shows it."""
    start = WAYS[way].start
    made = "distilled/" if WAYS[way].teachers else "clone/"
    return f" start={made if start == CLONE else start}" if start else ""


def split_of(args: argparse.Namespace, seed: int) -> Path:
    """Return where the levels of a clone are."""
    return args.folder / f"data-{args.size}-{args.levels}-{seed}" / "16k" / args.size


def trained(
    args: argparse.Namespace, policy: Path, way: str, start: Path | str, seed: int, limit: float
) -> list[dict[str, float]]:
    """Train a policy until the next update would exceed `limit` core-seconds; return the lines of its metrics.

    Each command trains up to a number of env steps that the rate so far suggests; the first trains until the
    policy has had one update, which comes after those that fit the critic of a start.
    """
    words = [*settings_of(args, way, seed), f"seed={seed}", "interval=5"]
    if start:
        words.append(f"start={start}")
    curve = lines_of(policy)
    ppo = compose_train(words).ppo
    steps = curve[-1][STEPS] if curve else ppo.steps_per_update * (1 + (ppo.critic_updates if start else 0))
    while True:
        command("train", *words, f"ppo.env_steps={int(steps)}", "-o", policy)
        curve = lines_of(policy)
        first, last = curve[0], curve[-1]
        update = last[STEPS] / last[UPDATES]
        # Of a single update, most of the seconds are compiling
        rate = (last[STEPS] - first[STEPS]) / (last[SECONDS] - first[SECONDS]) if len(curve) > 1 else 0.0
        begun = first[SECONDS] - (first[UPDATES] - 1) * update / rate if rate else first[SECONDS]
        left = limit - last[SECONDS] - begun  # the next command starts anew
        if left <= 0 or (rate and left * rate < update):
            return curve
        steps = last[STEPS] + (left * rate // update * update if rate else update)


def rows_of(each: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows of a policy: of its clone, if it has one, and of itself."""
    last, rows, run = each["curve"][-1], [], (str(each["seed"]), f"{each['pace']:,.0f}")
    if each["cloned"]:
        cost = *run, "0", "", f"{each['before']:,.0f}"
        name = "levels, clone, teachers" if WAYS[each["way"]].teachers else "levels, clone"
        rows.append(row_of(name, cost, each["cloned"]))
    cost = *run, f"{last[STEPS]:,}", f"{each['before']:,.0f}", f"{each['before'] + last[SECONDS]:,.0f}"
    return [*rows, row_of(each["way"], cost, each["sealed"])]


def by_cost(results: Sequence[Mapping[str, Any]]) -> Table:
    """Return the shares of solved sealed levels that policies had after some core-seconds, those before included."""
    shares = [{look["planned"]: look["solved"] for look in each["looks"]} for each in results]
    costs = sorted({cost for each in shares for cost in each})
    rows = [
        [each["way"], str(each["seed"]), *(interval_text(share[cost]) if cost in share else "" for cost in costs)]
        for each, share in zip(results, shares, strict=True)
    ]
    head = ("policy", "seed", *(f"after {cost:,.0f}" for cost in costs))
    return Table(head, rows, "Share of the levels labelled solved, after some core-seconds")


def row_of(name: str, cost: Sequence[str], rates: Mapping[str, Any], player: str = SAMPLED) -> list[str]:
    ways = ((ALL, "once"), (SOLVED, "once"), (SOLVED, "best"))
    return [name, *cost, *(interval_text(rates[levels][player][key]) for levels, key in ways)]


def draw(results: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Plot solve rates, in training and of sealed levels, against all core-seconds, those before training included."""
    plt = pyplot()
    figure, (training, sealed) = plt.subplots(1, 2, figsize=(9, 4.5), layout="constrained", sharex=True, sharey=True)
    labelled = set[str]()  # ways in the legend
    for each in results:
        curve = [line for line in each["curve"] if line[UPDATES] > SETTLED and line.get(RATE)]
        colour, label = WAYS[each["way"]].colour, None if each["way"] in labelled else each["way"]
        labelled.add(each["way"])
        training.plot(
            [each["before"] + line[SECONDS] for line in curve], [100 * line[RATE] for line in curve], color=colour, lw=1
        )
        seconds, rates = zip(*looks_of(each), strict=True)
        sealed.plot(seconds, [100 * rate for rate in rates], color=colour, label=label, lw=1, marker="o", markersize=3)
    training.set(xlim=(0, None), xlabel="core-seconds", ylabel="reach the goal, %", title="episodes of training")
    sealed.set(xlabel="core-seconds", title="sealed levels labelled solved")
    figure.legend(frameon=False, loc="outside lower center", ncols=2, fontsize="small")
    save(figure, path)


def looks_of(each: Mapping[str, Any]) -> list[tuple[float, float]]:
    """Return core-seconds and shares of the solved sealed levels: of the clone, if there is one, and of the policy."""
    clone = [(each["before"], each["cloned"][SOLVED][SAMPLED]["once"]["rate"])] if each["cloned"] else []
    return [*clone, *((look[SECONDS], look["solved"]["rate"]) for look in each["looks"])]

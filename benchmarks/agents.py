"""Policies compared with the reference's published agents, on the same levels and by the same protocol."""

import argparse
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.cloning import SAMPLED, command, interval_text
from benchmarks.published import write
from benchmarks.report import Report, Table
from levelproof.experts.networks.saved import WEIGHTS, load_policy, policy_folder
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.levelgen.level import SIZES
from levelproof.physics.step import ENGINE_VERSION
from levelproof.pipeline.learn.evaluate import ALL
from levelproof.pipeline.learn.published import AGENTS, HANDMADE, PROTOCOLS, RANDOM, random_file
from levelproof.pipeline.read.policies import policy_at

BASELINES = ("doing nothing", "random", "sticky random")


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policies", nargs="*", default=["builtin:s"], help="policies (default: builtin:s)")
    parser.add_argument("--folder", type=Path, default=Path("agents"), help="where finished evaluations are kept")
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES), help="default: all")
    parser.add_argument("--levels", type=int, help="use only the first levels of each size; leaves out published rates")


def run(args: argparse.Namespace) -> Report:
    for policy in args.policies:
        policy_at(Path(policy))  # a wrong name fails before the reference writes levels
    args.folder.mkdir(parents=True, exist_ok=True)
    for size in args.sizes:
        write(size)
    results = [evaluated(args, policy, on, size) for policy in args.policies for on in PROTOCOLS for size in args.sizes]
    tables = [
        table_of([each for each in results if each["on"] == on], title)
        for on, title in ((RANDOM, "Random levels"), (HANDMADE, "Handmade levels"))
    ]
    notes = [
        "Shares of levels solved by sampled actions, first episode only, mean over "
        f"{PROTOCOLS[RANDOM].attempts} attempts at a random level and {PROTOCOLS[HANDMADE].attempts} at a handmade "
        "one: the protocol of the reference (kinetix-env 3.0.2), whose README has the rates of `sfl-paper` and "
        "`sfl-1m-envs`. The levels are those that the reference makes here (some of m and l differ by machine); our "
        "policies play in our engine. Unsolvable levels count. Brackets: 95% intervals over levels; the published "
        "rates have none, and this is not the first look at these levels.",
        "Env steps are those played in training by reinforcement learning, without measurements of learnability or "
        "searches for demonstrations; `builtin:s` and `builtin:m` used neither.",
        *(
            f"`{policy}` also learned from demonstrations, whose env steps are not counted: witnesses of up to "
            f"{count:,} levels."
            for policy in args.policies
            if (count := demonstrated(policy))
        ),
    ]
    return Report("Policies beside published agents", results, tables, notes)


def evaluated(args: argparse.Namespace, policy: str, on: str, size: str) -> dict[str, Any]:
    """Return a policy's evaluation on the levels of a size, from its file if an earlier run made it."""
    made_of = repr((ENGINE_VERSION, SAMPLER_VERSION)).encode() + (policy_folder(policy) / WEIGHTS).read_bytes()
    if on == RANDOM:
        made_of += random_file(size).read_bytes()  # some of m and l differ between machines
    digest = hashlib.sha256(made_of).hexdigest()[:12]
    file = args.folder / f"{digest}-{on}-{size}-{args.levels or 'all'}.json"
    if not file.exists():
        some = ("--levels", args.levels) if args.levels else ()
        file.write_text(command("evaluate", policy, "--on", on, "--size", size, *some, "--json"))
    (group,) = json.loads(file.read_text())["levels"]
    steps = [
        f"{each['env_steps']:,}, {short(each['levels']['levels'])}" for each in history(policy) if "env_steps" in each
    ]
    facts = {"policy": policy, "on": on, "size": size, "env_steps": "; ".join(steps) or "none"}
    return facts | {"rates": group["of"][ALL], "published": group["published"], "levels": levels_of(group)}


def demonstrated(policy: str) -> int:
    """Return how many levels' witnesses a policy, or one that its training started from, was cloned from."""
    return sum(split["levels"] for origin in history(policy) for split in origin.get("splits", []))


def history(policy: str) -> list[dict[str, Any]]:
    """Return the origins of the policies that training started from, the first one first, and of this policy."""
    origins = [dict(load_policy(policy).origin)]
    while "start_origin" in origins[0]:
        origins.insert(0, origins[0]["start_origin"])
    return origins


def short(levels: str) -> str:
    """Return what a policy was trained on: the size of a split, whose path says nothing elsewhere, or a curriculum."""
    return f"a split of {Path(levels).name}" if "/" in levels else levels


def levels_of(group: dict[str, Any]) -> int:
    """Return the number of levels of an evaluation."""
    return group["of"][ALL][SAMPLED]["levels"]


def table_of(results: Sequence[dict[str, Any]], title: str) -> Table:
    """Return the rates on one set of levels: baselines, policies, published agents."""
    of = {policy: [each for each in results if each["policy"] == policy] for policy in (e["policy"] for e in results)}
    first = next(iter(of.values()))
    rows = [[name, "", *(once(each, name) for each in first)] for name in BASELINES]
    rows += [[f"**{name}**", own[0]["env_steps"], *(once(each, SAMPLED) for each in own)] for name, own in of.items()]
    if all(each["published"] for each in first):
        rates = lambda agent: [f"{each['published'][agent]:.0%}" for each in first]
        rows += [[agent, ", ".join(origin), *rates(agent)] for agent, origin in AGENTS.items()]
    return Table(
        ("player", "env steps, trained on", *(f"{e['size']} ({e['levels']} levels)" for e in first)), rows, title
    )


def once(result: dict[str, Any], player: str) -> str:
    return interval_text(result["rates"][player]["once"])

"""Networks of policies for all levels: clones at equal core-seconds, and the arithmetic that each update reaches.

Every network clones the same levels for the same core-seconds of one core; its speed, measured first and kept, decides
how many updates that is. A stopped run resumes: `levelproof clone` from its checkpoint, and the folder keeps
finished evaluations.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import training
from benchmarks.cloning import ATTEMPTS, GREEDY, SAMPLED, command, interval_text, kept, lines_of
from benchmarks.report import Report, Table
from levelproof.configs.clone import CloneConfig
from levelproof.configs.compose import compose_clone
from levelproof.experts.config import ExpertConfig
from levelproof.experts.imitation import Imitation, Transitions, begin_imitation, imitate
from levelproof.experts.networks.chunks import lanes_at_once
from levelproof.experts.policy import initial, network_of
from levelproof.experts.pool.pool import slot_count
from levelproof.experts.training import ppo
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import name_of
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.actions import action_mask
from levelproof.levelgen.task.observe.flat import dynamic_features
from levelproof.physics.types import Size
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.learn.clone import size_for, source_of
from levelproof.pipeline.learn.evaluate import SOLVED
from levelproof.pipeline.learn.pool import PartedSplit, read_pool
from levelproof.pipeline.runtime import own_cores, prepare_jax
from levelproof.pipeline.store.provenance import device, versions

FEW, REPEATS, DRAWN = 2, 5, 100  # updates at once, how often, and batches drawn
EXPERTS, BASELINES = "experts' own", ("random", "sticky random")


class Kind(NamedTuple):
    """A network, and how its clone is measured."""

    settings: Sequence[str]  # of `levelproof clone`
    attempts: int = ATTEMPTS  # at each sealed level


KINDS = {
    "attention": Kind(("network.width=64",)),
    "invariant": Kind(("network.kind=invariant", "network.width=256", "network.depth=3")),
    "flat": Kind(("network.kind=flat", "network.width=256", "network.depth=3")),
    "transformer": Kind(("network.kind=transformer", "network.width=128", "network.heads=8")),
    "pixels": Kind(("network.kind=pixels", "network.width=256", "train.batch=128"), 1),
}


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("split", type=Path, help="split to clone from")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="default: all")
    parser.add_argument("--core-seconds", type=float, default=400, help="of each clone's updates (default: 400)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="further settings of every clone")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path("kinds"), help="where everything is kept")


def run(args: argparse.Namespace) -> Report:
    prepare_jax(min(own_cores()))  # keeps this process, and so its clones, to one core
    fast = kept_speeds(args)
    results = [measured(args, name, fast[name]) for name in args.kinds]
    most = max(results, key=lambda each: KINDS[each["network"]].attempts)
    players, attempts = most["sealed"], KINDS[most["network"]].attempts
    rows = [row_of(each) for each in results]
    rows += [[name, *[""] * 4, interval_text(players[name]["once"]), "", best_text(players[name], attempts)]
             for name in BASELINES]  # fmt: skip
    head = ("network", "weights", "updates", "core-seconds", "accuracy", "sampled", "greedy", "best of 8")
    paces = [[EXPERTS, *pace_cells(fast[EXPERTS]), "", ""]]
    paces += [[name, *pace_cells(fast[name]), *shares(fast, name)] for name in args.kinds]
    further = "".join(f" {word}" for word in args.set)
    return Report(
        "Clones by several networks",
        results,
        [
            Table(head, rows, f"Share of the solved sealed levels that clones of {args.split} solve; 95% intervals"),
            Table(("network", "samples/s", "kFLOP per sample", "GFLOP/s", "of the experts'", "reading and drawing"),
                  paces, "Updates on one core"),
        ],
        [
            f"One seed each, with as many updates as take {args.core_seconds:,.0f} core-seconds at the speed of the "
            f"second table; the column of core-seconds includes reading, compiling and validation. "
            f"`levelproof clone {args.split} train.updates=...{further}` with: "
            + "; ".join(f"*{name}*: `{' '.join(KINDS[name].settings)}`" for name in args.kinds) + ".",
            "*Accuracy*: share of the entries of validation levels in which the policy's most probable choice is the "
            f"witness's. Sealed levels: the {players['random']['levels']:,} that are labelled solved; attempts at "
            "each: " + ", ".join(f"{name} {KINDS[name].attempts}" for name in args.kinds) + ".",
            f"The experts' own network trains in slots of {slot_count(ExpertConfig())}; a sample of theirs is an env "
            "step in one epoch. FLOP are those that XLA counts before it optimises a program, of a policy's update or "
            "of the gradient of an expert's, whose optimiser adds about a hundredth. A policy's update is timed with "
            "its batch at hand; *reading and drawing* is the share that these would add: reading the levels in "
            "memory anew every `refresh` updates, and drawing each batch from them.",
        ],
    )  # fmt: skip


def measured(args: argparse.Namespace, name: str, fast: Mapping[str, Any]) -> dict[str, Any]:
    """Clone with one network, and measure the policy on sealed levels."""
    kind, policy = KINDS[name], args.folder / name
    updates = max(1, round(args.core_seconds * fast["samples_per_second"] / fast["batch"]))
    command("clone", args.split, "-o", policy, *kind.settings, f"train.updates={updates}", *args.set)
    words = "--size", fast["size"], "--attempts", kind.attempts, "--levels", args.measured
    sealed = kept(policy / "sealed.json", policy, *words)[SOLVED]
    return {"network": name, "updates": updates, "weights": fast["weights"], "sealed": sealed,
            "metrics": lines_of(policy)[-1]}  # fmt: skip


def row_of(result: Mapping[str, Any]) -> list[str]:
    sealed, metrics = result["sealed"], result["metrics"]
    return [
        result["network"],
        f"{result['weights']:,}",
        f"{result['updates']:,}",
        f"{metrics['bc/core_seconds']:,.0f}",
        f"{metrics['bc/validation_accuracy']:.1%}",
        *(interval_text(sealed[player]["once"]) for player in (SAMPLED, GREEDY)),
        best_text(sealed[SAMPLED], KINDS[result["network"]].attempts),
    ]


def best_text(rates: Mapping[str, Any], attempts: int) -> str:
    return interval_text(rates["best"]) if attempts == ATTEMPTS else ""


def shares(fast: Mapping[str, Any], name: str) -> list[str]:
    """Return a network's share of the FLOP/s of the experts', and of its core-seconds that go into its batches."""
    reached = [one["samples_per_second"] * one["flops_per_sample"] for one in (fast[name], fast[EXPERTS])]
    return [f"{reached[0] / reached[1]:.0%}", f"{fast[name]['feeding']:.1%}"]


def pace_cells(fast: Mapping[str, Any]) -> list[str]:
    rate, flops = fast["samples_per_second"], fast["flops_per_sample"]
    return [f"{rate:,.0f}", f"{flops / 1e3:,.0f}", f"{rate * flops / 1e9:.1f}"]


def kept_speeds(args: argparse.Namespace) -> dict[str, Any]:
    """Return what `speeds` finds, from its file if an earlier run measured the same."""
    args.folder.mkdir(parents=True, exist_ok=True)
    file = args.folder / "speeds.json"
    settings = {name: [*KINDS[name].settings] for name in args.kinds}
    of = [str(args.split), args.set, settings, device(), versions()]
    if not file.exists():
        file.write_text(json.dumps({"of": of, "found": speeds(args)}))
    kept = json.loads(file.read_text())
    if kept["of"] != of:
        raise UserError(
            f"{args.folder} has speeds of another machine, or of other networks, settings or levels: choose another "
            "--folder."
        )
    return kept["found"]


def speeds(args: argparse.Namespace) -> dict[str, Any]:
    """Measure the updates of the policies' networks and of the experts', in turns on one core."""
    configs = {name: compose_clone((*KINDS[name].settings, *args.set)) for name in args.kinds}
    source = source_of(args.split, next(iter(configs.values())), lambda _: None)
    size, experts, feeds, updates = source.data.size, ExpertConfig(), {}, {}
    for name, config in configs.items():
        batch, feeds[name] = fed(source, config)
        updates[name] = Update(source, config, batch)
    taken = turns({EXPERTS: ready_experts(size), **updates})
    samples = slot_count(experts) * experts.steps_per_update * experts.epochs
    found: dict[str, Any] = {
        EXPERTS: {"samples_per_second": samples / taken[EXPERTS], "flops_per_sample": expert_flops(size, experts)}
    }
    for name, update in updates.items():
        batch, seconds = configs[name].train.batch, taken[name] / FEW
        found[name] = {
            "size": name_of(size),
            "batch": batch,
            "samples_per_second": batch / seconds,
            "flops_per_sample": update.flops_per_sample,
            "weights": sum(x.size for x in jax.tree.leaves(update.state.params)),
            "feeding": feeds[name] / (feeds[name] + seconds),
        }
    return found


class Update:
    """Updates of one network from a batch at hand."""

    def __init__(self, source: PartedSplit, config: CloneConfig, batch: Transitions) -> None:
        self._batch, self._config = batch, config
        self.state: Imitation = begin_imitation(np.int32(0), config.network, size_for([source], config), config.train)
        few = lanes_at_once(batch.level.size, config.train.batch)  # of chunks, XLA counts a single one
        chunk = Transitions(take(batch.level, np.arange(few)), batch.motion[:few], batch.action[:few])
        self.flops_per_sample = flops_of(imitate.lower(self.state, chunk, config.network, config.train)) / few

    def __call__(self) -> Any:
        for _ in range(FEW):
            self.state, _ = imitate(self.state, self._batch, self._config.network, self._config.train)
        return self.state


def fed(source: PartedSplit, config: CloneConfig) -> tuple[Transitions, float]:
    """Return a batch, and the core-seconds of a batch: drawing it, and its share of reading the levels in memory."""
    chosen, rng = source.train[: config.pool], np.random.default_rng(0)
    read_pool(source.data, chosen[:1], config.network)  # compiles
    begin = time.process_time()
    pool = read_pool(source.data, chosen, config.network)
    reading = time.process_time() - begin if len(source.train) > config.pool else 0.0
    draw = lambda: pool.draw(rng, rng.integers(0, len(pool.steps), config.train.batch))
    begin = time.process_time()
    for _ in range(DRAWN):
        draw()
    drawing = time.process_time() - begin
    return draw(), reading / config.refresh + drawing / DRAWN


def ready_experts(size: Size) -> Callable[[], Any]:
    """Return a function that makes an update of each expert in the slots of a pool."""
    config = ExpertConfig()
    levels = jax.device_get(sample_levels(jnp.arange(slot_count(config)), size))
    calls = training.calls(levels, config)
    next(calls)
    return next(calls)


def expert_flops(size: Size, config: ExpertConfig) -> float:
    """Count the FLOP of one sample in an epoch of an expert's update."""
    network, level = network_of(size, config), sample_levels(jnp.arange(1), size)
    features, live = network.constant(level), action_mask(level)
    constants = jax.tree.map(lambda x: x[..., 0], ppo.LevelConstants(features, live))
    params = initial(jax.random.key(0), network, constants.features)
    count, columns = config.steps_per_update // config.minibatches, len(dynamic_features(size)) + len(live) + 4
    minibatch = ppo.from_rows(jnp.zeros((count, columns)))
    gradient = jax.jit(jax.grad(ppo.loss), static_argnums=(1, 4))
    return flops_of(gradient.lower(params, network, constants, minibatch, config)) / count


def flops_of(program: jax.stages.Lowered) -> float:
    """Return the FLOP of a program without loops, as XLA counts them before it optimises it."""
    counted = program.cost_analysis()
    if not counted:
        raise Failure("This version of jaxlib counts no FLOP.")
    return counted["flops"]


def turns(calls: Mapping[str, Callable[[], Any]]) -> dict[str, float]:
    """Return the median core-seconds of calls that take turns, after a first of each, which compiles."""
    seconds = {name: [] for name in calls}
    for repeat in range(1 + REPEATS):
        for name, call in calls.items():
            begin = time.process_time()
            jax.block_until_ready(call())
            if repeat:
                seconds[name].append(time.process_time() - begin)
    return {name: float(np.median(each)) for name, each in seconds.items()}

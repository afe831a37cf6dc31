"""Imitation of teachers at the learner's own states, round after round (DAgger, Ross et al. 2011, arXiv:1011.0686).

In a round, the learner plays, teachers label states of its episodes (`rounds.py`), and updates follow. Everything that
decides how a run continues is in its checkpoint or follows from the settings and the round's number.
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int
from rich.console import Console

from levelproof.configs.distill import DistillConfig
from levelproof.experts.generalist.teachers import KnownExperts, no_experts
from levelproof.experts.imitation import Imitation, Likeness, Transitions, begin_imitation, imitate
from levelproof.experts.labels import Label
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.experts.networks.saved import Policy
from levelproof.levelgen.batching import take
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.curves import BLUE, GREEN, YELLOW, Curves, Panel
from levelproof.pipeline.learn.folder import continued, origin_of, settings_without, weights_digest
from levelproof.pipeline.learn.kept_experts import experts_of
from levelproof.pipeline.learn.labelled import LabelBuffer, empty_labels
from levelproof.pipeline.learn.pace import Pace
from levelproof.pipeline.learn.pool import read_pool
from levelproof.pipeline.learn.rounds import TaughtLevels, teach
from levelproof.pipeline.learn.run import Begun, Run, make_policy
from levelproof.pipeline.learn.sealed import require_not_sealed, require_some_usable, without_sealed
from levelproof.pipeline.read.policies import policy_at, require_size
from levelproof.pipeline.read.select import labelled
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.progress_bar import ProgressBar, TextBar, say
from levelproof.pipeline.words import duration

COURSE = Curves(
    "distill/updates",
    "updates",
    (
        Panel("Episodes that reach the goal", {GREEN: "distill/solve_rate"}, 1.0),
        Panel("Successes of teachers", {BLUE: "distill/labelled", YELLOW: "distill/demonstrated"}, 1.0),
    ),
    {GREEN: "the learner's episodes", BLUE: "states with a label", YELLOW: "demonstrations"},
)
WITHOUT_EFFECT = ("log",)  # settings that a continued run may change


class ChosenLevels(NamedTuple):
    """Levels of a split to learn from, before their witnesses are read."""

    data: Dataset
    chosen: Int[np.ndarray, " level"]  # their indices in `data`
    facts: dict[str, Any]  # what identifies them, as JSON
    experts: KnownExperts


class Distillation(NamedTuple):
    """Training under way, with all that decides how it continues."""

    imitation: Imitation
    labels: LabelBuffer


def distill(split: Path, config: DistillConfig, out: Path, console: Console) -> None:
    """Train a policy on the labels of teachers, or continue a run; write it to `out`, and print where it is.

    Raises:
        UserError: the split, the policy to start from or settings are unusable; `out` is unusable, in use or has
            another run; no teacher labels any state; or a library is missing.
        Failure: the data or the checkpoint is damaged.
    """
    prepare_jax()
    tell = lambda text: say(console, text)
    start = policy_at(Path(config.start)) if config.start else None
    network = start.network if start else config.network
    chosen = levels_for(split, config, tell)
    size = chosen.data.size
    if start:
        require_size(start, size, str(split), "start from one that plays any size")
    note = note_of(chosen, config)

    def policy_of(note: dict[str, Any], now: Distillation) -> Policy:
        origin = origin_of(note, {"updates": int(now.imitation.updates)}, start)
        return Policy(network, now.imitation.average, network.only_size(size), origin)

    def begin() -> Begun[Distillation]:
        taught = witnessed(chosen, network, console)
        params = start.params if start else None
        columns = taught.witnesses.motion.shape[1]
        fresh = Distillation(
            begin_imitation(np.int32(config.seed), network, size, config.train, params),
            empty_labels(config.buffer, columns),
        )
        now = continued(out, fresh)
        now = now._replace(labels=jax.device_get(now.labels))
        updates = int(now.imitation.updates)
        advance = lambda run: update_until_done(taught, config, network, now, run, console)
        return Begun(now, updates, updates < config.train.updates, advance)

    make_policy(out, note, COURSE, config.log, begin, policy_of, tell)


def levels_for(split: Path, config: DistillConfig, tell: Callable[[str], None]) -> ChosenLevels:
    """Choose among the levels of a split with a witness; leave out trivial ones and copies of sealed levels.

    Raises:
        UserError: the split is unusable, has sealed ids, or no usable level.
        Failure: its data is damaged.
    """
    data = Dataset(split, config.where or None, (), 0.0)
    ids = data.manifest["level_id"].to_numpy()
    require_not_sealed(split, ids, config.where)
    usable = without_sealed(split, data.content_hashes, tell)
    require_some_usable(split, usable)
    trivial = labelled(data.manifest, [Label.TRIVIAL])
    if not (usable & ~trivial).any():
        raise UserError(f"All levels of {split} that meet the condition are trivial: choose others with where.")
    chosen = np.flatnonzero(usable & ~trivial)
    if len(chosen) > config.pool:
        tell(f"Only {config.pool:,} of {len(chosen):,} levels of {split} are used, drawn once: raise pool for more.")
        chosen = np.sort(np.random.default_rng(config.seed).choice(chosen, config.pool, replace=False))
    facts = {
        "split": str(split),
        "levels": len(chosen),
        "ids": data.fingerprint,
        "copies_of_sealed": int((~usable).sum()),
    }
    experts = no_experts(len(chosen))
    if config.demonstrations or (config.states and config.teachers.expert):
        experts = experts_of(split, ids[chosen], tell)
    if experts.config:
        tell(f"{int((experts.expert >= 0).sum()):,} of {len(chosen):,} levels have a kept expert.")
        facts["experts"] = weights_of(experts)
    if not experts.config and (config.demonstrations or not config.teachers.searches):
        only = "demonstrations need them" if config.demonstrations else "no other teacher is asked"
        remedy = "demonstrations=0 and states above 0" if config.demonstrations else "teachers.random above 0"
        raise UserError(
            f"{split} has no kept experts of these levels, and {only}: set {remedy}, or make a split on this "
            "machine with keep_experts=true."
        )
    shown = min(config.demonstrations, int((experts.expert >= 0).sum()))
    if config.buffer < (most := (config.states + shown) * config.path):
        raise UserError(
            f"buffer is {config.buffer:,}, but a round has up to {most:,} transitions, {config.path} of each of "
            f"{config.states + shown:,} labels: raise buffer to that, or the round's first labels are lost."
        )
    return ChosenLevels(data, chosen, facts, experts)


def weights_of(experts: KnownExperts) -> str:
    """Return a digest of experts' weights, and of which levels have one."""
    has_one = experts.expert >= 0
    digest = hashlib.sha256(has_one.tobytes())
    for leaf in jax.tree.leaves(experts.params):
        digest.update(np.ascontiguousarray(leaf[experts.expert[has_one]]).data)  # in the order of the levels
    return digest.hexdigest()[:16]


def witnessed(levels: ChosenLevels, network: NetworkConfig, console: Console) -> TaughtLevels:
    """Read chosen levels with their witnesses, as far as the network reads their states.

    Raises:
        Failure: their data is damaged.
    """
    data, chosen = levels.data, levels.chosen
    with ProgressBar("levels read", len(chosen), console) as bar:
        witnesses = read_pool(data, chosen, network, follow=bar.advance)
    ids = data.manifest["level_id"].to_numpy()[chosen]
    return TaughtLevels(ids, data.levels(chosen), witnesses, levels.experts, data.rules)


def note_of(levels: ChosenLevels, config: DistillConfig) -> dict[str, Any]:
    """Return what decides a run's result, as JSON."""
    settings = settings_without(config, WITHOUT_EFFECT)
    return {"splits": [levels.facts], "settings": settings, "start": weights_digest(config.start)}


def update_until_done(
    taught: TaughtLevels,
    config: DistillConfig,
    network: NetworkConfig,
    now: Distillation,
    run: Run[Distillation],
    console: Console,
) -> Distillation:
    """Take the rounds that are left, or those until a stop; keep the state and its metrics after each.

    Raises:
        UserError: no state has a label, and no witness is learned from.
        Failure: the weights have diverged.
    """
    last, first = config.train.updates, int(now.imitation.updates)
    pace = Pace()
    with TextBar(console, "compiling", last, first) as bar, run.stop.heeded():
        for update in range(first, last, config.interval):
            bar.show(update, f"{update:,}/{last:,} updates · asking teachers")
            number = update // config.interval
            labels, numbers = teach(taught, config, network, now.imitation.average, now.labels, number)
            now = now._replace(labels=labels)
            if not now.labels.filled and not config.witnesses:
                more = "states or teachers.random" if config.states else "demonstrations"
                raise UserError(f"No teacher reached the goal: set witnesses above 0, or raise {more}.")
            until = min(update + config.interval, last)
            now, recent = learn(taught, config, network, now, until)
            numbers = {COURSE.step: until, **numbers, **likeness_of(recent)}
            by_teachers = (
                f"{numbers['distill/labelled']:.1%} of states labelled"
                if config.states
                else f"{numbers['distill/demonstrated']:.1%} of demonstrations reach the goal"
            )
            words = f"{until:,}/{last:,} updates · {numbers['distill/solve_rate']:.1%} solved · {by_teachers}"
            if rate := pace.count(until - update):
                words += f" · about {duration((last - until) / rate)} left"
            run.keep(now, numbers, "distill/loss", "train.learning_rate")
            bar.show(until, words, keep=True)
            if run.stop.asked.is_set():
                break
    return now


def learn(
    taught: TaughtLevels, config: DistillConfig, network: NetworkConfig, now: Distillation, until: int
) -> tuple[Distillation, list[Likeness]]:
    """Take the updates below number `until`; return the likeness before each."""
    imitation, recent = now.imitation, []
    for batch in batches(taught, now.labels, config, range(int(imitation.updates), until)):
        imitation, likeness = imitate(imitation, batch, network, config.train)
        recent.append(jax.device_get(likeness))
    return now._replace(imitation=imitation), recent


def batches(taught: TaughtLevels, labels: LabelBuffer, config: DistillConfig, updates: range) -> Iterator[Transitions]:
    """Yield the batches of these updates: transitions of witnesses and of teachers."""
    total, rows = config.train.batch, labels.filled
    shown_by_witnesses = round(total * config.witnesses) if rows else total
    for update in updates:
        rng = np.random.default_rng([config.seed, update])
        mine = rng.integers(0, len(taught.level_ids), shown_by_witnesses)
        drawn = taught.witnesses.draw(rng, mine)
        row = rng.integers(0, max(rows, 1), total - shown_by_witnesses)
        yield Transitions(
            take(taught.witnesses.level, np.concatenate([mine, labels.level[row]])),
            np.concatenate([drawn.motion, labels.motion[row]]),
            np.concatenate([drawn.action, labels.action[row].astype(np.int32)]),
        )


def likeness_of(recent: Sequence[Likeness]) -> dict[str, float]:
    """Return the metrics of a round's updates."""
    means = [float(np.mean(column)) for column in zip(*recent, strict=True)]
    return dict(zip(("distill/loss", "distill/accuracy"), means, strict=True))

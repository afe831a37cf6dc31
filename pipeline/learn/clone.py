"""Behaviour cloning of one policy on splits, with checkpoints from which a run continues bit for bit."""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from flax.typing import VariableDict
from rich.console import Console

from levelproof.configs.clone import CloneConfig
from levelproof.experts.evaluation import FirstEpisodes, play, play_sampled
from levelproof.experts.imitation import Imitation, Likeness, Transitions, begin_imitation, compare, imitate
from levelproof.experts.networks.over_levels import PolicyKind
from levelproof.experts.networks.saved import Policy
from levelproof.levelgen.level import name_of
from levelproof.physics.types import Size
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.dataset.subsets import TRAIN, VALIDATION, in_subset
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.curves import BLUE, GREEN, Curves, Panel
from levelproof.pipeline.learn.folder import continued, origin_of, settings_without
from levelproof.pipeline.learn.pace import Pace
from levelproof.pipeline.learn.pool import Feed, PartedSplit, validation_batches
from levelproof.pipeline.learn.run import Begun, Run, make_policy
from levelproof.pipeline.learn.sealed import require_not_sealed, without_sealed
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.progress_bar import ProgressBar, TextBar, say
from levelproof.pipeline.words import duration

SOLVED = "eval/sampled_episode_solve_rate"
EPISODES = {  # metrics of validation levels played, under the reference's names: values of episodes
    SOLVED: lambda one: one.solved,
    "eval/sampled_episode_length": lambda one: one.env_steps,
}
COURSE = Curves(
    "bc/updates",
    "updates",
    (
        Panel("Loss, nats per entry", {GREEN: "bc/loss", BLUE: "bc/validation_loss"}),
        Panel("Accuracy, share of entries", {GREEN: "bc/accuracy", BLUE: "bc/validation_accuracy"}, 1.0),
        Panel("Levels solved, share", {BLUE: SOLVED}, 1.0),
    ),
    {GREEN: "training", BLUE: "validation"},
)
WITHOUT_EFFECT = "log", "interval", "played"  # settings that a continued run may change


def clone(splits: Sequence[Path], config: CloneConfig, out: Path, console: Console) -> None:
    """Train a policy on the witnesses of splits, or continue a run; write it to `out`, and print where it is.

    Raises:
        UserError: a split is unusable or has sealed levels, `out` is unusable, in use or has another run, or a library
            is missing.
        Failure: the data or the checkpoint is damaged.
    """
    prepare_jax()
    tell = lambda text: say(console, text)
    sources = [source_of(split, config, tell) for split in splits]
    size, note = size_for(sources, config), note_of(sources, config)

    def policy_of(note: dict[str, Any], state: Imitation) -> Policy:
        origin = origin_of(note, {"updates": int(state.updates)})
        return Policy(config.network, state.average, config.network.only_size(size), origin)

    def begin() -> Begun[Imitation]:
        state = continued(out, begin_imitation(np.int32(config.seed), config.network, size, config.train))
        updates = int(state.updates)
        advance = lambda run: train(sources, config, state, run, console)
        return Begun(state, updates, updates < config.train.updates, advance)

    curves = COURSE if config.played else COURSE._replace(panels=COURSE.panels[:-1])
    make_policy(out, note, curves, config.log, begin, policy_of, tell)


def source_of(split: Path, config: CloneConfig, tell: Callable[[str], None]) -> PartedSplit:
    """Open a split and divide its levels into training and validation; report and leave out copies of sealed levels.

    Raises:
        UserError: the split is unusable, has sealed ids, or too few levels besides copies.
    """
    data = Dataset(split, config.where or None, (), config.validation)
    ids = data.manifest["level_id"].to_numpy()
    require_not_sealed(split, ids, config.where)
    hashes = data.content_hashes
    usable = without_sealed(split, hashes, tell)
    copies = int((~usable).sum())
    train, kept = (np.flatnonzero(usable & in_subset(hashes, part, config.validation)) for part in (TRAIN, VALIDATION))
    if not len(train) or not len(kept):
        count = len(data) - copies
        raise UserError(
            f"{split} has too few levels ({count}) for validation={config.validation}: name a larger split, or change "
            "where or validation."
        )
    return PartedSplit(data, train, kept, copies)


def size_for(sources: Sequence[PartedSplit], config: CloneConfig) -> Size:
    """Return the size to initialise the network for. Raise UserError if it fits one, and the splits have several."""
    sizes = list(dict.fromkeys(source.data.size for source in sources))
    if len(sizes) > 1 and config.network.kind is PolicyKind.FLAT:
        names = ", ".join(map(name_of, sizes))
        raise UserError(f"network.kind=flat fits levels of one size, not of {names}: use attention or invariant.")
    return sizes[0]


def note_of(sources: Sequence[PartedSplit], config: CloneConfig) -> dict[str, Any]:
    """Return what decides a run's result, as JSON."""
    settings = settings_without(config, WITHOUT_EFFECT)
    splits = [
        {"split": str(s.data.split), "levels": len(s.data), "ids": s.data.fingerprint, "copies_of_sealed": s.copies}
        for s in sources
    ]
    return {"splits": splits, "settings": settings}


def train(
    sources: Sequence[PartedSplit],
    config: CloneConfig,
    state: Imitation,
    run: Run[Imitation],
    console: Console,
) -> Imitation:
    """Take the updates that are left, or those until a stop; validate, and keep the state, every `config.interval`.

    Raises:
        Failure: the weights have diverged.
    """
    last, first, recent = config.train.updates, int(state.updates), []
    pace = Pace()
    feed, total = Feed(sources, config), sum(len(source.train) for source in sources)
    if feed.used < total:
        text = f"Only {feed.used:,} of {total:,} levels are used: raise pool or train.updates, or lower refresh."
        say(console, text)
    with ProgressBar("levels read", feed.levels, console) as bar:
        batches = feed.batches(first, feed.read(first, bar.advance))
    with closing(batches), TextBar(console, "reading validation levels", last, first) as bar:
        held = {str(source.data.split): held_of(source, config) for source in sources}
        bar.show(first, "compiling")
        with run.stop.heeded():
            for update, batch in enumerate(batches, first + 1):
                state, likeness = imitate(state, batch, config.network, config.train)
                recent.append(likeness)
                jax.block_until_ready(likeness)
                rate, speed = pace.count(1), ""
                if rate:
                    speed = (
                        f" · {rate * config.train.batch:,.0f} samples/s · about {duration((last - update) / rate)} left"
                    )
                words, stops = f"{update:,}/{last:,} updates{speed}", run.stop.asked.is_set()
                if keep := update % config.interval == 0 or update == last or stops:
                    with pace.aside():
                        numbers = {COURSE.step: update, "bc/samples_per_second": rate * config.train.batch or np.nan}
                        numbers |= averages("", recent)
                        if update == last or not stops:  # validation may take longer than a stop leaves
                            numbers |= validated(state, held, config)
                            words = f"{line_of(update, last, numbers)}{speed}"
                        recent = []
                        run.keep(state, numbers, "bc/loss", "train.learning_rate")
                bar.show(update, words, keep=keep)
                if stops:
                    break
    return state


class Held(NamedTuple):
    """What the policy is validated on, of one split."""

    batches: list[Transitions]
    play: Callable[[VariableDict], FirstEpisodes] | None  # plays some levels; None: none are to be played


def held_of(source: PartedSplit, config: CloneConfig) -> Held:
    batches, data = validation_batches(source, config), source.data
    if not config.played:
        return Held(batches, None)
    some = np.random.default_rng(config.seed).permutation(source.validation)[: config.played]
    ids, levels, player = data.manifest["level_id"].to_numpy()[some], data.levels(some), play_sampled(config.network)
    return Held(batches, lambda params: play(player, params, levels, ids, 1, config.seed, data.rules))


def validated(state: Imitation, held: dict[str, Held], config: CloneConfig) -> dict[str, float]:
    """Return validation metrics of the averaged policy, over all splits and for each; it also plays some levels."""
    params = state.average
    each = {
        name: ([compare(params, batch, config.network) for batch in one.batches], one.play and one.play(params))
        for name, one in held.items()
    }
    numbers = validation_numbers([*each.values()])
    for name, one in each.items() if len(each) > 1 else ():
        numbers |= {f"{key}/{name}": value for key, value in validation_numbers([one]).items()}
    return numbers


def validation_numbers(each: Sequence[tuple[Sequence[Likeness], FirstEpisodes | None]]) -> dict[str, float]:
    numbers = averages("validation_", [likeness for some, _ in each for likeness in some])
    if episodes := [one for _, one in each if one]:
        for name, which in EPISODES.items():
            numbers[name] = float(np.concatenate([which(one) for one in episodes]).mean())
    return numbers


def averages(prefix: str, likenesses: Sequence[Any]) -> dict[str, float]:
    names = ("loss", "accuracy")
    return {f"bc/{prefix}{name}": float(np.mean([getattr(x, name) for x in likenesses])) for name in names}


def line_of(update: int, last: int, numbers: dict[str, float]) -> str:
    loss, accuracy = (numbers[f"bc/validation_{name}"] for name in ("loss", "accuracy"))
    solved = f" · {numbers[SOLVED]:.1%} solved" if SOLVED in numbers else ""
    validation = f"validation loss {loss:.3f}, accuracy {accuracy:.1%}"
    return f"{update:,}/{last:,} updates · loss {numbers['bc/loss']:.3f} · {validation}{solved}"

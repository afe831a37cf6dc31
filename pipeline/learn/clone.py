"""Behaviour cloning of one policy on splits, with checkpoints from which a run continues bit for bit."""

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from safetensors.numpy import load_file, save

from levelproof.configs.clone import CloneConfig
from levelproof.configs.convert import plain
from levelproof.experts.imitation import Imitation, begin_imitation, compare, imitate
from levelproof.experts.networks.over_levels import PolicyKind
from levelproof.experts.networks.saved import CONFIG, Policy, named, save_policy, unnamed
from levelproof.levelgen.level import name_of
from levelproof.physics.types import Size
from levelproof.pipeline.dataset.dataset import Dataset
from levelproof.pipeline.dataset.subsets import TRAIN, VALIDATION, in_subset
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.progress import say
from levelproof.pipeline.learn.measured import SEALED
from levelproof.pipeline.learn.metrics import STEP, Metrics
from levelproof.pipeline.learn.pool import Feed, PartedSplit, Transitions, validation_batches
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.files import write
from levelproof.pipeline.words import duration, many

CHECKPOINT, RUN = "checkpoint.safetensors", "run.json"
WITHOUT_EFFECT = ("log",)  # settings that a continued run may change


def clone(splits: Sequence[Path], config: CloneConfig, out: Path, console: Console) -> None:
    """Train a policy on the witnesses of splits, or continue to; write it to `out`, and print where it is.

    Raises:
        UserError: a split is unusable or has sealed levels, `out` has another run, or a library is missing.
        Failure: the data or the checkpoint is damaged.
    """
    prepare_jax()
    sources = [source_of(split, config) for split in splits]
    size, note = size_for(sources, config), note_of(sources, config)
    require_same_run(out, note)
    out.mkdir(parents=True, exist_ok=True)
    state = continued(out, begin_imitation(np.int32(config.seed), config.network, size, config.train))
    write(out / RUN, (json.dumps(note, indent=2) + "\n").encode())
    tell = lambda text: say(console, text)
    metrics, done = Metrics(out, config.log, note, int(state.updates), tell), False
    try:
        if int(state.updates) < config.train.updates:
            state = train(sources, config, out, state, metrics, console)
        done = True
    finally:
        metrics.close(done)
    keep(out, state, config, size, note)
    tell(f"The policy is in {out}. Next: levelproof.load_policy({str(out)!r}), as docs/train.md shows.")


def source_of(split: Path, config: CloneConfig) -> PartedSplit:
    """Open a split, and part its levels. Raise UserError if it is unusable or has sealed levels."""
    data = Dataset(split, config.where or None, (), config.validation)
    ids = data.manifest["level_id"].to_numpy()
    sealed = int(((ids >= SEALED.start) & (ids < SEALED.stop)).sum())
    if sealed:
        raise UserError(
            f"{split} has {many(sealed, 'level')} with ids from {SEALED.start} to {SEALED.stop - 1}, which are sealed "
            f"to measure policies: exclude them, as in where='level_id < {SEALED.start}'."
        )
    hashes = data.manifest["content_hash"].to_pylist()
    train, kept = (np.flatnonzero(in_subset(hashes, part, config.validation)) for part in (TRAIN, VALIDATION))
    if not len(train) or not len(kept):
        raise UserError(f"{split} has too few levels ({len(data)}) for validation={config.validation}: add levels.")
    return PartedSplit(data, train, kept)


def size_for(sources: Sequence[PartedSplit], config: CloneConfig) -> Size:
    """Return the size that the network is made for. Raise UserError if it fits one and there are several."""
    sizes = list(dict.fromkeys(source.data.size for source in sources))
    if len(sizes) > 1 and config.network.kind is PolicyKind.FLAT:
        names = ", ".join(map(name_of, sizes))
        raise UserError(f"network.kind=flat fits levels of one size, not of {names}: use attention or invariant.")
    # Parameters that fit any size need one of every kind of entity to be made for
    return sizes[0] if config.network.kind is PolicyKind.FLAT else Size(5, 1, 1, 1)


def note_of(sources: Sequence[PartedSplit], config: CloneConfig) -> dict[str, Any]:
    """Return what decides a run's result, as JSON."""
    settings = {name: value for name, value in plain(config).items() if name not in WITHOUT_EFFECT}
    splits = [{"split": str(s.data.split), "levels": len(s.data), "ids": s.data.fingerprint} for s in sources]
    return {"splits": splits, "settings": settings}


def require_same_run(out: Path, note: dict[str, Any]) -> None:
    """Raise UserError if `out` holds a run of other settings or data, or a policy of unknown origin."""
    try:
        before = json.loads((out / RUN).read_text())
    except FileNotFoundError:
        if (out / CONFIG).exists():
            raise UserError(f"{out} has a policy already: choose another folder with -o.") from None
        return
    except (OSError, ValueError) as error:
        raise Failure(f"Cannot read {out / RUN} ({error}): choose another folder with -o.") from None
    if before != note:
        raise UserError(f"{out} has a run with other settings or levels: repeat its command, or choose another -o.")


def continued(out: Path, fresh: Imitation) -> Imitation:
    """Return the state in the checkpoint of `out`, or `fresh` if it has none."""
    if not (out / CHECKPOINT).exists():
        return fresh
    try:
        return unnamed(fresh, load_file(out / CHECKPOINT))
    except Exception as error:  # the library raises types of its own
        raise Failure(f"The checkpoint in {out} is damaged ({error}): start again with another -o.") from None


def keep(out: Path, state: Imitation, config: CloneConfig, size: Size, note: dict[str, Any]) -> None:
    """Write the policy, then the checkpoint."""
    fits = size if config.network.kind is PolicyKind.FLAT else None
    save_policy(out, Policy(config.network, state.average, fits, note | {"updates": int(state.updates)}))
    write(out / CHECKPOINT, save(named(state)))


def train(
    sources: Sequence[PartedSplit], config: CloneConfig, out: Path, state: Imitation, metrics: Metrics, console: Console
) -> Imitation:
    """Take the updates that are left; validate, and write a checkpoint, every `config.interval` of them."""
    size, note, last = size_for(sources, config), note_of(sources, config), config.train.updates
    first, recent, began, aside = int(state.updates), [], time.monotonic(), 0.0
    with shown(console, last, first) as show:
        feed = Feed(sources, config, lambda count: show(0, f"reading {count} levels"))
        held = {str(source.data.split): validation_batches(source, config) for source in sources}
        for update, seen in enumerate(feed.batches(first), first + 1):
            state, likeness = imitate(state, seen, config.network, config.train)
            recent.append(likeness)
            jax.block_until_ready(likeness)
            if update == first + 1:
                began = time.monotonic()  # reading and compiling do not count
            rate = (update - first - 1) / max(time.monotonic() - began - aside, 1e-9)
            pace = (
                f"{rate * config.train.batch:,.0f} samples/s · about {duration((last - update) / max(rate, 1e-9))} left"
            )
            show(1, f"{update:,}/{last:,} updates · {pace}")
            if update % config.interval == 0 or update == last:
                paused = time.monotonic()
                numbers = {STEP: update, "bc/samples_per_second": rate * config.train.batch}
                numbers |= averages("", recent) | validated(state, held, config)
                recent = []
                keep(out, state, config, size, note)
                metrics.write(numbers)
                say(console, f"{line_of(update, last, numbers)} · {pace}")
                aside += time.monotonic() - paused
    return state


def validated(state: Imitation, held: dict[str, list[Transitions]], config: CloneConfig) -> dict[str, float]:
    """Compare the averaged policy with the validation levels, of all splits and of each."""
    each = {name: [compare(state.average, seen, config.network) for seen in some] for name, some in held.items()}
    numbers = averages("validation_", [likeness for some in each.values() for likeness in some])
    for name, some in each.items() if len(each) > 1 else ():
        numbers |= {f"{key}/{name}": value for key, value in averages("validation_", some).items()}
    return numbers


def averages(prefix: str, likenesses: Sequence[Any]) -> dict[str, float]:
    names = ("loss", "accuracy")
    return {f"bc/{prefix}{name}": float(np.mean([getattr(x, name) for x in likenesses])) for name in names}


def line_of(update: int, last: int, numbers: dict[str, float]) -> str:
    loss, accuracy = (numbers[f"bc/validation_{name}"] for name in ("loss", "accuracy"))
    return f"{update:,}/{last:,} updates · loss {numbers['bc/loss']:.3f} · validation {loss:.3f}, {accuracy:.1%} right"


@contextmanager
def shown(console: Console, total: int, completed: int) -> Iterator[Any]:
    """Show a bar on a terminal; yield a function that advances it and changes its text."""
    columns = BarColumn(), TaskProgressColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("reading levels", total=total, completed=completed)
        yield lambda count, text: bar.update(task, advance=count, description=text)

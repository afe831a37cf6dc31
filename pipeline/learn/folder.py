"""A training run's folder: its note (`run.json`), checkpoint and policy."""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from levelproof.configs.convert import plain
from levelproof.configs.train import CURRICULA
from levelproof.experts.networks.saved import CONFIG, WEIGHTS, Policy, named, policy_folder, save_policy, unnamed
from levelproof.levelgen.level import name_of
from levelproof.physics.types import Size
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.learn.metrics import METRICS
from levelproof.pipeline.store.disk import explaining_writes, read_regular
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.locks import only_trainer
from levelproof.pipeline.store.manifest import changes_text, differences
from levelproof.pipeline.store.provenance import device, learned_with, versions
from levelproof.pipeline.urls import quoted

CHECKPOINT, RUN = "checkpoint.safetensors", "run.json"
MADE_BY = "made_by"  # in the note: versions and devices that have trained the run, in turn
# Key paths in notes of what was named, which may have moved: fingerprints and digests beside them identify it
NAMED = ("splits", "split"), ("levels", "levels"), ("settings", "start")
T = TypeVar("T")


def made(out: Path) -> Path:
    """Create the folder of a policy. Raise UserError if it cannot be one."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"Cannot write a policy to {out} ({error.strerror}): choose another folder with -o.") from None
    return out


@contextmanager
def writing_run(out: Path) -> Iterator[Callable[[], None]]:
    """Create and lock a run's folder; yield a function to call before each write, as `only_trainer` does.

    Raises:
        UserError: `out` cannot be the folder of a policy, or another command is writing to it.
        Failure: a write fails.
    """
    with explaining_writes(out, "what was saved stays"), only_trainer(made(out)) as require_ours:
        patterns = *(f".{name}.[0-9]*" for name in (CHECKPOINT, RUN, METRICS)), f"{WEIGHTS}.tmp", f"{CONFIG}.tmp"
        for unfinished in (path for pattern in patterns for path in out.glob(pattern)):  # of a killed command
            unfinished.unlink(missing_ok=True)
        yield require_ours


def require_same_run(out: Path, note: dict[str, Any], free: Sequence[str] = ()) -> None:
    """Raise UserError if `out` holds a run of other settings or data, or a policy of unknown origin.

    `free` is the key path of the one value in the note that may differ.
    """
    if (before := note_in(out)) is None:
        if (out / CONFIG).exists():
            raise UserError(f"{out} has a policy already: choose another folder with -o.")
        return
    ours = note.get("settings", {}).get("levels")
    paths = [(MADE_BY,), free, *NAMED, *([] if ours in CURRICULA else [("settings", "levels")])]
    if changes := differences(*(reduce(_without, paths, one) for one in (before, note))):
        named = {
            name.removeprefix("settings."): change
            for name, change in changes.items()
            if name.startswith("settings.") or name == "cores"
        }
        what = changes_text(named) or "the levels or the start differ"  # only digests differ, which tell users nothing
        raise UserError(f"{out} has a run with other settings or levels ({what}): repeat its command, or change -o.")


def stacks_in(out: Path) -> list[dict[str, Any]]:
    """Return the versions and devices that have trained the run in `out`, in turn; empty for a new run.

    Raises:
        Failure: the note is damaged.
    """
    stacks = (note_in(out) or {}).get(MADE_BY, [])
    if not (isinstance(stacks, list) and all(isinstance(each, dict) for each in stacks)):
        raise Failure(f"{out / RUN} is damaged ({MADE_BY}): choose another folder with -o.")
    return stacks


def with_stack(note: dict[str, Any], tell: Callable[[str], None]) -> dict[str, Any]:
    """Return a note, which has `stacks_in`, with this machine's versions and device last.

    Tells the user if other versions or another device trained the run last: its bytes may then differ.
    """
    before, now = note[MADE_BY], versions() | learned_with() | {"device": device()}
    last = before[-1] if before else {}
    if others := ", ".join(f"{name} {value}" for name, value in last.items() if now.get(name) != value):
        tell(f"This run was last trained with {others}, so its policy may differ from that of an uninterrupted run.")
    return note | {MADE_BY: before if last == now else [*before, now]}


def _without(note: Any, path: Sequence[str]) -> Any:
    """Return JSON without the value at a path of keys, in lists of each entry; unchanged if it has none."""
    if isinstance(note, list):
        return [_without(one, path) for one in note]
    if not path or not isinstance(note, dict):
        return note
    name, *inner = path
    return {
        key: _without(value, inner) if key == name else value for key, value in note.items() if inner or key != name
    }


def note_in(out: Path) -> dict[str, Any] | None:
    """Return what decides the result of the run in `out`, or None if no run has saved anything there.

    Raises:
        Failure: the note is damaged.
    """
    try:
        note = json.loads(read_regular(out / RUN))
        if not isinstance(note, dict) or type(note.get("cores", 1)) is not int:
            raise ValueError("it does not describe a run")
        saved = (out / CHECKPOINT).exists() or (out / CONFIG).exists()
        # A run that was stopped before its first checkpoint gives way to one of other settings
        return note if saved or MADE_BY not in note else None
    except (FileNotFoundError, NotADirectoryError):  # `made` refuses a file
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise Failure(f"Cannot read {out / RUN} ({error}): choose another folder with -o.") from None


def write_note(out: Path, note: dict[str, Any]) -> None:
    write(out / RUN, (json.dumps(note, indent=2) + "\n").encode(), durable=True)


def continued(out: Path, fresh: T) -> T:
    """Return the state, a pytree, in the checkpoint of `out`, or `fresh` if the run has saved nothing yet.

    Raises:
        UserError: `out` has a policy but no checkpoint, and a new run would overwrite it.
        Failure: the checkpoint is damaged.
    """
    try:
        return unnamed(fresh, load(read_regular(out / CHECKPOINT)))
    except FileNotFoundError:
        if (out / CONFIG).exists():
            raise UserError(f"{out} has a policy, but no {CHECKPOINT}: put it back, or change -o.") from None
        return fresh
    except OSError as error:
        raise Failure(f"Cannot read {out / CHECKPOINT} ({error.strerror or error}): make it readable.") from None
    except (LookupError, TypeError, ValueError, SafetensorError) as error:
        raise Failure(f"The checkpoint in {out} is damaged ({error}): start over in a new folder.") from None


def settings_without(config: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return settings as JSON, without those that a resumed run may change."""
    return {name: value for name, value in plain(config).items() if name not in names}


def tell_done(out: Path, only: Size | None, tell: Callable[[str], None]) -> None:
    """Tell the user where the policy is, and the next command; `only` is the one size that it plays, if any."""
    tell(f"The policy is in {out}. Next: levelproof evaluate {quoted(out)}{f' --size {name_of(only)}' if only else ''}")


def weights_digest(policy: str) -> str | None:
    """Return the SHA-256 of the weights of the policy that a run starts from; None for an empty name."""
    return hashlib.sha256((policy_folder(policy) / WEIGHTS).read_bytes()).hexdigest() if policy else None


def require_finite(loss: float, setting: str) -> None:
    """Raise Failure if a loss is not finite, so that diverged weights do not replace the checkpoint."""
    if not math.isfinite(loss):
        raise Failure(
            f"The loss is {loss}, so the weights have diverged: start over with a smaller {setting} in a new folder "
            "(no checkpoint was overwritten)."
        )


def origin_of(note: dict[str, Any], progress: dict[str, int], start: Policy | None = None) -> dict[str, Any]:
    """Return a policy's origin: what decides its run, how far the run is, and the policy that it started from, if any.

    A run with a start keeps the start's network, so the settings of a new network are left out.
    """
    if start is None:
        return note | progress
    settings = {name: value for name, value in note["settings"].items() if name != "network"}
    return note | progress | {"settings": settings, "start_origin": dict(start.origin)}


def keep_run(out: Path, policy: Policy, state: Any) -> None:
    """Write the checkpoint, then the policy, so that a stopped run never has a policy without a checkpoint.

    Raises:
        Failure: the weights are not finite, and nothing was written.
    """
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(policy.params)):
        raise Failure(
            "The weights have diverged: start over with a smaller learning rate in a new folder (no checkpoint was "
            "overwritten)."
        )
    write(out / CHECKPOINT, save(named(state)), durable=True)
    save_policy(out, policy)

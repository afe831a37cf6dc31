"""A training run under way: the metrics, checkpoints and policy that `clone`, `train` and `distill` write."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from levelproof.experts.networks.saved import Policy
from levelproof.pipeline.learn.curves import Curves
from levelproof.pipeline.learn.folder import (
    MADE_BY,
    keep_run,
    require_finite,
    require_same_run,
    stacks_in,
    tell_done,
    with_stack,
    write_note,
    writing_run,
)
from levelproof.pipeline.learn.metrics import Metrics
from levelproof.pipeline.stopping import Stop, stoppable

T = TypeVar("T")


@dataclass
class Run(Generic[T]):
    """Writes a run whose state is a pytree T into its folder."""

    out: Path
    metrics: Metrics
    require_ours: Callable[[], None]  # raises if another process has recreated the folder
    policy_of: Callable[[dict[str, Any], T], Policy]
    note: dict[str, Any]  # in the folder
    trained: dict[str, Any]  # replaces the note once an update is saved
    stop: Stop  # heeded while updates are taken: the run ends after the next save

    def save(self, state: T) -> Policy:
        """Write the checkpoint, then the policy; return the policy. Raises as `keep_run` and `require_ours`."""
        self.require_ours()
        policy = self.policy_of(self.note, state)
        keep_run(self.out, policy, state)
        return policy

    def keep(self, state: T, numbers: Mapping[str, float], loss: str, setting: str) -> None:
        """Append a line of metrics, with the run's core-seconds so far; then save.

        Args:
            state: what the run continues from.
            numbers: the metrics, by name.
            loss: the one of them that must be finite.
            setting: the setting that prevents divergence if it is smaller.

        Raises:
            Failure: the weights have diverged, and nothing was written.
        """
        require_finite(numbers[loss], setting)
        clock = f"{self.metrics.step.partition('/')[0]}/core_seconds"
        before = self.metrics.last.get(clock, 0.0)  # of earlier processes
        # Before the checkpoint: a run that continues drops lines after it
        self.metrics.write({**numbers, clock: before + time.process_time()})
        if self.note != self.trained:
            self.note = self.trained
            write_note(self.out, self.note)
        self.save(state)


class Begun(NamedTuple, Generic[T]):
    """A new or continued run before its next update."""

    state: T
    steps: int  # taken so far, as `curves.step` counts them
    trains: bool  # whether updates are left
    advance: Callable[[Run[T]], T]  # takes them, and returns the state


def make_policy(
    out: Path,
    note: dict[str, Any],
    curves: Curves,
    log: str,
    begin: Callable[[], Begun[T]],
    policy_of: Callable[[dict[str, Any], T], Policy],
    tell: Callable[[str], None],
    free: Sequence[str] = (),
) -> None:
    """Lock a run's folder, take the updates that are left, save the policy, and tell the user where it is.

    Ctrl-C and SIGTERM end the run after the update, or the round, that is being taken, which is saved.

    Args:
        out: the run's folder.
        note: what decides the run's result; the versions and the device that train it now are added with the first
            update that is saved.
        curves, log: see `Metrics`; if no updates are left, nothing is logged.
        begin: begins or continues the run, once the folder is locked.
        policy_of: makes the policy of the note and the run's state.
        tell: reports a sentence to the user.
        free: see `require_same_run`.

    Raises:
        UserError, Failure: as `writing_run`, `require_same_run`, `stacks_in` and `Metrics`.
        KeyboardInterrupt: the run was stopped.
    """
    with stoppable() as stop, writing_run(out) as require_ours:
        require_same_run(out, note, free)
        state, steps, trains, advance = begin()
        note = note | {MADE_BY: stacks_in(out)}
        trained = with_stack(note, tell) if trains else note
        write_note(out, note)
        with Metrics(out, curves, log if trains else "none", trained, steps, tell, require_ours) as metrics:
            run = Run(out, metrics, require_ours, policy_of, note, trained, stop)
            if trains:
                try:
                    state = advance(run)
                except KeyboardInterrupt:
                    tell(f"Stopped: the same command continues the run in {out}.")
                    raise
            policy = run.save(state)
    tell_done(out, policy.size, tell)

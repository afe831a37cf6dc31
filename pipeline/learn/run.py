"""A training run under way: the metrics, checkpoints and policy that `clone`, `train` and `distill` write."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

from levelproof.experts.networks.saved import Policy
from levelproof.pipeline.learn.curves import Curves
from levelproof.pipeline.learn.folder import MADE_BY, keep_run, require_finite, stacks_in, with_stack, write_note
from levelproof.pipeline.learn.metrics import Metrics

T = TypeVar("T")


class Run(Generic[T]):
    """Writes a run whose state is a pytree T into its folder."""

    def __init__(
        self,
        out: Path,
        metrics: Metrics,
        require_ours: Callable[[], None],
        policy_of: Callable[[dict[str, Any], T], Policy],
        note: dict[str, Any],
        trained: dict[str, Any],
    ) -> None:
        """`note` is in the folder; `trained` replaces it once an update is saved."""
        self._out, self._metrics, self._require_ours, self._policy_of = out, metrics, require_ours, policy_of
        self._note, self._trained = note, trained
        self._clock = f"{metrics.step.partition('/')[0]}/core_seconds"
        self._before = metrics.last.get(self._clock, 0.0)  # of earlier processes

    def save(self, state: T) -> None:
        """Write the checkpoint, then the policy. Raises as `keep_run` and `require_ours`."""
        self._require_ours()
        keep_run(self._out, self._policy_of(self._note, state), state)

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
        # Before the checkpoint: a run that continues drops lines after it
        self._metrics.write({**numbers, self._clock: self._before + time.process_time()})
        if self._note != self._trained:
            self._note = self._trained
            write_note(self._out, self._note)
        self.save(state)


@contextmanager
def recorded(
    out: Path,
    note: dict[str, Any],
    curves: Curves,
    log: str,
    steps: int,
    policy_of: Callable[[dict[str, Any], T], Policy],
    tell: Callable[[str], None],
    require_ours: Callable[[], None],
    trains: bool,
) -> Iterator[Run[T]]:
    """Write a run's note, and open its metrics; yield the run.

    Args:
        out: the run's folder.
        note: what decides the run's result; the versions and the device that train it now are added with the first
            update that is saved.
        curves, log, steps, require_ours: see `Metrics`.
        policy_of: makes the policy of the note and the run's state.
        tell: reports a sentence to the user.
        trains: whether updates are left; if not, nothing is told or logged.

    Raises:
        UserError, Failure: as `stacks_in` and `Metrics`.
    """
    note = note | {MADE_BY: stacks_in(out)}
    trained = with_stack(note, tell) if trains else note
    write_note(out, note)
    with Metrics(out, curves, log if trains else "none", trained, steps, tell, require_ours) as metrics:
        yield Run(out, metrics, require_ours, policy_of, note, trained)

"""Scalars of a run for TensorBoard or Weights & Biases (the setting `log`), computed from the run's events."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from levelproof.configs.schema import JobConfig
from levelproof.pipeline.errors import UserError, last_line
from levelproof.pipeline.store.event_files import Event
from levelproof.pipeline.urls import is_remote

LIBRARIES = {"tensorboard": "tensorboardX", "wandb": "wandb"}
FOLDER, PROJECT = "log", "levelproof"
# Kind of env steps by the stage whose seconds they took
STAGES = {"search": "searched", "training": "trained", "evaluation": "evaluated"}


class ScalarWriter(Protocol):
    """A logging library's writer."""

    place: str  # folder or URL where users find the scalars

    def write(self, scalars: Mapping[str, float]) -> None: ...

    def close(self, done: bool) -> None: ...


def require_library(log: str) -> None:
    """Raise UserError if the library that `log` needs is missing."""
    try:
        if log in LIBRARIES:
            import_module(LIBRARIES[log])
    except ImportError:
        raise UserError(
            f'log={log} needs {LIBRARIES[log]}: run `pip install -e ".[log]"` in the clone, or set log=none.'
        ) from None


@contextmanager
def logged(job: JobConfig, split: Path, say: Callable[[str], None]) -> Iterator[Callable[[Sequence[Event]], None]]:
    """Yield a function that takes the events of a run so far and logs scalars of the latest.

    If the library or the disk fails, the user is told once, and the run continues without a log.
    """
    log, done = GuardedLog(job.log, say), False

    def opened() -> ScalarWriter:
        # Object stores cannot append to files
        folder = Path(FOLDER, *split.parts[-2:]) if is_remote(split) else split / FOLDER
        return writer_of(job.log, folder, "levels/committed", f"{job.budget}/{job.size}", job.results)

    def take(events: Sequence[Event]) -> None:
        nonlocal done
        done = events[-1].get("how") == "done"
        log.use(lambda writer: writer.write(scalars(events[0], events[-1])))

    if job.log != "none":
        log.open(opened)
    try:
        yield take
    finally:
        log.use(lambda writer: writer.close(done))


class GuardedLog:
    """A logging library's writer whose failure ends no run: the user is told once, and nothing more is logged."""

    def __init__(self, log: str, say: Callable[[str], None]) -> None:
        """Begin without a writer; `log` is the setting, for messages."""
        self._log, self._say = log, say
        self._writer: ScalarWriter | None = None

    def open(self, make: Callable[[], ScalarWriter]) -> None:
        """Open the writer that `make` returns, and say where its scalars are."""
        with self._guarded():
            writer = make()
            self._say(f"Scalars for {self._log}: {writer.place}")
            self._writer = writer

    def use(self, act: Callable[[ScalarWriter], None]) -> None:
        """Call `act` with the writer, if there still is one."""
        if writer := self._writer:
            with self._guarded():
                act(writer)

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # libraries raise types of their own
            self._writer = None
            self._say(f"Cannot log to {self._log} ({last_line(error)}): the run continues without a log.")


def writer_of(log: str, folder: Path, step: str, name: str, settings: Mapping[str, Any]) -> ScalarWriter:
    """Open the writer that `log` names: `step` is the scalar to plot over, `name` and `settings` describe the run.

    Raises:
        UserError: a link has the name of the folder.
    """
    if folder.is_symlink():
        raise UserError(f"{folder} is a link: replace it with a folder, or set log=none")
    return TensorBoardWriter(folder, step) if log == "tensorboard" else WandbWriter(folder, step, name, settings)


def scalars(began: Event, state: Event) -> dict[str, float]:
    """Return the numbers to plot by name, without those that are not known yet."""
    done, elapsed = state["done"], state["time"] - began["time"]
    numbers = {
        "levels/committed": done,
        "levels/solved": state["solved"],
        "levels/per_second": (done - began["done"]) / elapsed if elapsed > 0 else 0.0,  # since the run began
        "env_steps/total": state["env_steps"],
        "failures/attempts": state["failures"],
        "failures/units_given_up": state["quarantined"],
        "workers": sum(host["count"] for host in state["workers"].values()),
    }
    if done:
        numbers["levels/solved_share"] = state["solved"] / done
    if state["rate"]:
        numbers["env_steps/per_second"] = state["rate"]
    for stage, kind in STAGES.items():
        if seconds := state["seconds"][stage]:  # summed over workers, so this is the speed of one busy worker
            numbers[f"env_steps/per_second_of_{stage}"] = state["spent"][kind] / seconds
    return numbers


class TensorBoardWriter:
    """A file of TensorBoard events.

    Bypasses tensorboardX's writer thread: a full disk kills that thread, and its full queue then blocks the caller.
    """

    def __init__(self, folder: Path, step: str) -> None:
        writer, self._summary, self._events = (
            import_module(f"tensorboardX.{name}") for name in ("event_file_writer", "summary", "proto.event_pb2")
        )
        run = folder / f"{datetime.now(UTC):%Y%m%dT%H%M%S}"
        run.mkdir(parents=True, exist_ok=True)
        self._step = step
        self._writer, self.place = writer.EventsWriter(str(run / "events")), str(run)

    def write(self, scalars: Mapping[str, float]) -> None:
        now, step = datetime.now(UTC).timestamp(), int(scalars[self._step])
        for name, value in scalars.items():
            summary = self._summary.scalar(name, value)
            self._writer.write_event(self._events.Event(wall_time=now, step=step, summary=summary))
        self._writer.flush()

    def close(self, done: bool) -> None:
        self._writer.close()


class WandbWriter:
    """A run of Weights & Biases. WANDB_PROJECT, WANDB_MODE etc. apply."""

    def __init__(self, folder: Path, step: str, name: str, settings: Mapping[str, Any]) -> None:
        wandb = import_module("wandb")
        folder.mkdir(parents=True, exist_ok=True)
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=name,
            config=dict(settings),
            dir=folder.absolute(),
            settings=wandb.Settings(console="off", silent=True, disable_git=True),
        )
        self._run.define_metric("*", step_metric=step)
        here = str(Path(self._run.dir).parent)
        self.place = here if self._run.offline else self._run.url or here

    def write(self, scalars: Mapping[str, float]) -> None:
        self._run.log(dict(scalars))

    def close(self, done: bool) -> None:
        self._run.finish(exit_code=0 if done else 1)

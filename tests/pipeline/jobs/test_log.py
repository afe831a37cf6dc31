"""Logging of a run's scalars: their values, files that the libraries read, and errors that never end the run."""

import struct
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from levelproof.pipeline.jobs.log import TensorBoardWriter, logged, scalars
from tests.pace import patience
from tests.pipeline.command import TINY, assert_refused, here
from tests.pipeline.made import made_job

BEGAN = {"time": 100.0, "event": "started", "levels": 8, "done": 2, "solved": 1}
STATE = {
    "time": 110.0,
    "event": "progress",
    "done": 4,
    "solved": 3,
    "env_steps": 900,
    "spent": {"searched": 300, "trained": 600, "evaluated": 0, "idle": 0},
    "seconds": {"search": 2.0, "training": 3.0, "evaluation": 0.0},
    "rate": 90,
    "failures": 1,
    "quarantined": 0,
    "workers": {"a": {"count": 2, "silent": 0.1}, "b": {"count": 1, "silent": 0.1}},
}


def tensorboard_file(folder: Path) -> Iterator[tuple[str, int, float]]:
    """Yield name, step and value of each scalar from TensorFlow's records: length, checksum, event, checksum."""
    from tensorboardX.proto.event_pb2 import Event

    (path,) = folder.glob("*/events.out.tfevents.*")
    data, at = path.read_bytes(), 0
    while at < len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        event = Event.FromString(data[at + 12 : at + 12 + length])
        yield from ((value.tag, event.step, value.simple_value) for value in event.summary.value)
        at += length + 16


def test_scalars_match_the_events() -> None:
    assert scalars(BEGAN, STATE) == {
        "levels/committed": 4,
        "levels/solved": 3,
        "levels/solved_share": 0.75,
        "levels/per_second": 0.2,
        "env_steps/total": 900,
        "env_steps/per_second": 90,
        "env_steps/per_second_of_search": 150.0,
        "env_steps/per_second_of_training": 200.0,
        "failures/attempts": 1,
        "failures/units_given_up": 0,
        "workers": 3,
    }
    first = scalars(BEGAN, STATE | {"time": 100.0, "done": 0, "solved": 0, "rate": 0})
    assert first["levels/per_second"] == 0
    assert first.keys().isdisjoint({"levels/solved_share", "env_steps/per_second"})


@pytest.mark.slow
def test_logged_writes_to_the_working_folder_if_the_split_is_in_a_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    messages: list[str] = []
    with logged(made_job("data", "log=tensorboard"), Path("s3://bucket/data/128k/s"), messages.append) as log:
        log([BEGAN, STATE])
    (sentence,) = messages
    assert sentence.startswith("Scalars for tensorboard: log/128k/s/")
    logged_values = {name: value for name, _, value in tensorboard_file(tmp_path / "log/128k/s")}
    assert logged_values == pytest.approx(scalars(BEGAN, STATE))


@pytest.mark.parametrize("refuses", ["from the first", "later", "at the end"])
def test_logged_reports_a_failing_log_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses: str) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    name = {"from the first": "__init__", "later": "write", "at the end": "close"}[refuses]
    monkeypatch.setattr(TensorBoardWriter, name, refuse)
    messages: list[str] = []
    with logged(made_job("data", "log=tensorboard"), tmp_path, messages.append) as log:
        log([BEGAN, STATE])
        log([BEGAN, STATE])
    assert [line for line in messages if "No space left" in line] == [messages[-1]]
    assert messages[-1].startswith("Cannot log to tensorboard")
    assert messages[-1].endswith("the run continues without a log.")


def test_logged_rejects_a_log_folder_that_is_a_link(tmp_path: Path) -> None:
    for name in ("split", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "split/log").symlink_to(tmp_path / "elsewhere")
    messages: list[str] = []
    with logged(made_job("data", "log=tensorboard"), tmp_path / "split", messages.append) as log:
        log([BEGAN, STATE])
    assert [text for text in messages if "split/log is a link" in text] == messages
    assert len(messages) == 1
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize(("log", "library"), [("tensorboard", "tensorboardX"), ("wandb", "wandb")])
def test_generate_refuses_to_start_without_the_log_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, log: str, library: str
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    done = here(["generate", *TINY, "executor=inline", f"log={log}"], tmp_path)
    assert_refused(done, 2, f'log={log} needs {library}: run `pip install -e ".[log]"`')
    assert not list(tmp_path.iterdir())


def generated(words: Sequence[str], folder: Path) -> str:
    done = here(["generate", "unit=1", "budget=5k", "executor=inline", *words], folder)
    assert done.returncode == 0, done.stderr
    assert "Cannot log" not in done.stderr
    return done.stderr


@pytest.mark.campaign
def test_tensorboard_and_wandb_read_the_scalars(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Log a run to offline Weights & Biases, then the same command with more levels to TensorBoard."""
    wandb = pytest.importorskip("wandb")
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    monkeypatch.setenv("WANDB_MODE", "offline")
    log_text = generated(["levels=2", "log=wandb"], tmp_path)
    wandb.teardown()
    (kept,) = (tmp_path / "data/5k/s/log").glob("wandb/offline-run-*/run-*.wandb")
    assert f"Scalars for wandb: {kept.parent}\n" in log_text
    assert b"levels/committed" in kept.read_bytes()
    generated(["levels=4", "log=tensorboard"], tmp_path)
    (run,) = (tmp_path / "data/5k/s/log").glob("2*")
    read = accumulator.EventAccumulator(str(run)).Reload()
    assert {"levels/solved_share", "env_steps/total", "workers"} <= set(read.Tags()["scalars"])
    points = read.Scalars("levels/committed")
    assert (points[0].step, points[-1].step, points[-1].value) == (2, 4, 4.0)
    assert abs(points[-1].wall_time - time.time()) < patience(600)

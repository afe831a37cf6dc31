"""Runs on real Ray workers, undisturbed and killed in several ways, all end in the same split as a run without Ray."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from levelproof.pipeline.stopping import LAST
from levelproof.pipeline.store.event_files import events_of, runs_in
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from tests.pace import patience, wait_until
from tests.pipeline.command import ROOT, descendants, heed_ctrl_c, here, listening, run, start, status, title, until
from tests.pipeline.jobs.test_log import tensorboard_file
from tests.pipeline.made import assert_same_content

LEVELS = 16  # enough that a run is still active when it is killed after its first unit
COMMAND = ["generate", f"levels={LEVELS}", "unit=1", "budget=5k"]
ALONE = "workers=1"  # for tests that need no more, because starting each takes time
SPLIT = Path("data/5k/s")
LOOPBACK = ("0100007F:", "00000000000000000000000001000000:", "0000000000000000FFFF00000100007F:")  # in /proc/net/tcp


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the split of a run without Ray; it logs scalars, which change no bit."""
    folder = tmp_path_factory.mktemp("undisturbed")
    done = here([*COMMAND, "executor=inline", "log=tensorboard"], folder)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    (run,) = runs_in(folder / SPLIT)
    events = events_of(run)
    began, *_, ended = events
    assert [began["event"], ended["event"], ended["how"]] == ["started", "ended", "done"]
    committed = sum(event["levels"] for event in events if event["event"] == "committed")
    assert committed == ended["done"] == began["levels"]
    plotted = list(tensorboard_file(folder / SPLIT / "log"))
    assert plotted[0] == ("levels/committed", 0, 0.0)
    assert ("levels/committed", LEVELS, LEVELS) in plotted
    assert "env_steps/per_second_of_training" in {name for name, *_ in plotted}
    return folder / SPLIT


def assert_same_split(split: Path, other: Path) -> None:
    assert_same_content(split, other)
    assert {f"shards/{path.name}" for path in (split / "shards").iterdir()} == read_manifest(split).shards


def workers(process: subprocess.Popen[str]) -> list[int]:
    """Return the process ids of Ray's workers that have units now."""
    return sorted(pid for pid in descendants(process.pid) if title(pid).startswith("ray::WorkerActor.work"))


def assert_all_gone(pids: set[int]) -> None:
    wait_until(lambda: not any((state := status(pid)) and state[0] != "Z" for pid in pids), 30, "processes are left")


def test_undisturbed_run_commits_every_level(undisturbed: Path) -> None:
    manifest = read_manifest(undisturbed)
    assert manifest.level_ids.tolist() == list(range(LEVELS))
    assert "solved" in manifest.labels
    assert not (undisturbed / "quarantine").exists()


@pytest.mark.slow  # the only job on Ray that every change has to pass
def test_number_of_workers_changes_no_result(undisturbed: Path, tmp_path: Path) -> None:
    done = run([*COMMAND, "executor=ray"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert_same_split(tmp_path / SPLIT, undisturbed)


@pytest.mark.campaign
def test_unit_size_changes_no_result(undisturbed: Path, tmp_path: Path) -> None:
    assert run(["generate", "levels=1", "first_level=2", "budget=5k", "executor=inline"], tmp_path).returncode == 0
    assert run(["generate", f"levels={LEVELS}", "unit=16", "budget=5k", "executor=inline"], tmp_path).returncode == 0
    assert_same_split(tmp_path / SPLIT, undisturbed)


@pytest.mark.parametrize("executor", ["inline", pytest.param("ray", marks=pytest.mark.campaign)])
def test_command_killed_by_sigkill_continues_to_the_same_bits(undisturbed: Path, tmp_path: Path, executor: str) -> None:
    process = start([*COMMAND, ALONE, f"executor={executor}"], tmp_path)
    until(lambda: fragment_paths(tmp_path / SPLIT), process)
    family = {pid for pid in descendants(process.pid) if "Agent" not in title(pid)}
    process.kill()
    process.communicate()
    assert_all_gone(family)  # without Ray's two idle agents, which try for a minute to report the death
    assert 1 <= len(fragment_paths(tmp_path / SPLIT)) < LEVELS
    done = here([*COMMAND, "executor=inline"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "are already there" in done.stderr
    assert_same_split(tmp_path / SPLIT, undisturbed)


@pytest.mark.campaign
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_run_with_a_killed_worker_stops_and_continues_to_the_same_bits(
    undisturbed: Path, tmp_path: Path, number: signal.Signals
) -> None:
    """Another worker takes over the dead one's units, and is busy when the run is stopped. All listen on loopback."""
    process = start([*COMMAND, ALONE, "executor=ray"], tmp_path, preexec_fn=heed_ctrl_c)
    until(lambda: fragment_paths(tmp_path / SPLIT), process)
    places = listening(descendants(process.pid))
    assert places
    assert not {place: who for place, who in places.items() if not place.startswith(LOOPBACK)}
    (worker,) = until(lambda: workers(process), process)
    os.kill(worker, signal.SIGKILL)
    before = len(fragment_paths(tmp_path / SPLIT))
    until(lambda: len(fragment_paths(tmp_path / SPLIT)) > before, process)
    family = descendants(process.pid)
    begin = time.monotonic()
    os.killpg(process.pid, number)  # as a terminal does
    _, err = process.communicate(timeout=patience(60))
    took = time.monotonic() - begin
    assert process.returncode == 130, err
    assert "trying again" in err
    assert "Stopped: " in err or took >= LAST  # on a slow machine the command's timer ends it before the message
    assert "Traceback" not in err
    assert_all_gone(family)
    done = here([*COMMAND, "executor=inline"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert_same_split(tmp_path / SPLIT, undisturbed)
    assert not (tmp_path / SPLIT / "quarantine").exists()


def test_driver_does_not_start_jax(tmp_path: Path) -> None:
    """JAX in the driver would take the workers' GPU memory; threads and cache must be set before JAX starts."""
    program = (
        "from levelproof.configs.compose import compose_job; compose_job([]); "
        "from levelproof.pipeline.jobs import cluster, generate"
    )
    environment = os.environ | {"JAX_PLATFORMS": "no_such_platform", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=environment, check=True, timeout=patience(1800))

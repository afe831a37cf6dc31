"""Workers that die and clusters that shrink, on real Ray: everything that can be done is done."""

import subprocess
from pathlib import Path

import pytest

from pipeline.jobs.schedule import COMPANY
from pipeline.store.manifest import fragment_paths, read_manifest
from tests.pipeline.command import PATIENCE, assert_refused, run, start, until

LEVELS, DEADLY = 8, 2
SETTINGS = ("generate", f"levels={LEVELS}", "unit=1", "budget=5k")
SPLIT = Path("data/5k/s")


def fragile(deadly: int, cwd: Path) -> subprocess.CompletedProcess[str]:
    return run([str(deadly), *SETTINGS], cwd, module="tests.pipeline.fragile")


@pytest.mark.slow
def test_a_level_that_kills_its_worker_takes_no_other_with_it(tmp_path: Path) -> None:
    done = fragile(DEADLY, tmp_path)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert "raylet" not in done.stdout + done.stderr
    split = tmp_path / SPLIT
    assert read_manifest(split).level_ids.tolist() == [i for i in range(LEVELS) if i != DEADLY]
    (note,) = (split / "quarantine").iterdir()
    assert "The worker died" in note.read_text()
    assert f"Given up: level {DEADLY}, for the reason in {SPLIT}/quarantine/{note.name}" in done.stdout
    deaths = [line for line in done.stderr.splitlines() if "The worker died" in line]
    assert len(deaths) == len(COMPANY), done.stderr  # a line each, however many levels it took
    assert deaths[-1].startswith(f"Level {DEADLY} failed")
    assert deaths[-1].endswith(": given up.")


@pytest.mark.slow
def test_workers_that_cannot_start_stop_the_run(tmp_path: Path) -> None:
    done = fragile(-1, tmp_path)
    assert_refused(done, 1, "No worker can start (The worker died", "executor=inline may tell more")
    assert not (tmp_path / SPLIT / "quarantine").exists()


def test_a_cluster_that_is_not_there_is_named(tmp_path: Path) -> None:
    done = run(SETTINGS, tmp_path, address="127.0.0.1:9")
    assert_refused(
        done, 2, "There is no Ray cluster at RAY_ADDRESS=127.0.0.1:9 (Connection refused)", "ray start --head"
    )


@pytest.mark.slow
def test_a_cluster_of_two_machines_that_loses_one(tmp_path: Path) -> None:
    """Ray's own nodes, each with a core: what the lost one had at work goes to the other, and no unit waits for it."""
    from ray.cluster_utils import Cluster

    machine = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=machine)
    try:
        second = cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)
        process = start(SETTINGS, tmp_path, address=cluster.address)
        until(lambda: fragment_paths(tmp_path / SPLIT), process)
        cluster.remove_node(second, allow_graceful=False)
        _, err = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, err
        assert "Traceback" not in err
        assert read_manifest(tmp_path / SPLIT).level_ids.tolist() == list(range(LEVELS))
        own = run(["generate", "levels=1", "budget=2k", "out=own"], tmp_path)
        assert own.returncode == 0, own.stderr  # a cluster that RAY_ADDRESS does not name is let be
    finally:
        cluster.shutdown()

"""Number of workers that a machine gets by its cores, GPUs and memory. One test runs real Ray."""

import os
import subprocess
import sys

import pytest

from levelproof.levelgen.level import size_of
from levelproof.pipeline.jobs.places import (
    GB,
    Machine,
    bytes_of_worker,
    memory_to_reserve,
    shortage,
    workers_by_machine,
)
from tests.pace import patience
from tests.pipeline.command import COMMAND_SECONDS, ROOT

NEED = 2 * GB

# A machine with two cores, memory for one worker, which tells what Ray reserves for it, and a GPU that an actor holds
HELD = """
import ray
from levelproof.configs.compose import compose_job
from pathlib import Path
from rich.console import Console
from levelproof.pipeline.jobs import cluster
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Scheduler
from levelproof.pipeline.runtime import NO_GPU

class Telling(cluster.WorkerActor):
    def begin(self, *_):
        return str(ray.get_runtime_context().get_assigned_resources().get("memory"))

cluster.WorkerActor = Telling
ray.init(address="local", include_dashboard=False, num_cpus=2, num_gpus=1, _memory=2 * 10**9, log_to_driver=False)
Holder = ray.remote(num_cpus=0, num_gpus=1)(type("Holder", (), {"there": lambda self: True}))
holder = Holder.remote()
ray.get(holder.there.remote())
messages = []
board = Board(Tally(8, 0, 0), Console())
board.say = messages.append
cluster.GPU_PATIENCE = 1.0
crew = cluster.Crew(compose_job(["device=gpu", "unit=1"]), Path("data"), Scheduler([], 8), board)
assert not crew._gpus and crew._job.device == "cpu", messages
crew.follow_cluster()
assert len(crew._handles) == 1, crew._handles
gpu, memory = messages
assert gpu == "Workers use CPU cores, not GPUs: all of them were still in use after 1 s.", gpu
assert memory.endswith("has 2.0 GB of memory free, and a worker of this size needs 1.5 GB: it runs 1 of 2 workers.")
crew.start_workers()
reserved = ray.get(crew._handles[0].answer, timeout=600.0)
assert reserved == str(1.5 * 10**9), reserved
crew._handles[0].end()
cluster.GPU_PATIENCE = 600.0
ray.kill(holder)
assert cluster._why_no_gpu() == NO_GPU  # it is free, but JAX cannot use it
ray.get(Holder.remote().there.remote(), timeout=600.0)  # the probe has released it
"""


def machine(cores: int, memory: float | None = None, gpus: int = 0) -> Machine:
    resources = {"CPU": cores, "GPU": gpus} | ({} if memory is None else {"memory": memory})
    return {"NodeManagerHostname": "a", "Resources": resources}


def test_workers_by_machine_fit_cores_and_memory() -> None:
    machines = {"a": machine(8, 8.5 * GB), "b": machine(2, 100 * GB), "c": machine(4)}
    assert workers_by_machine(machines, "CPU", 100, NEED) == {"a": 4, "b": 2, "c": 4}
    assert workers_by_machine(machines, "CPU", 4, NEED) == {"a": 2, "b": 1, "c": 1}
    assert workers_by_machine({"a": machine(8, 100 * GB, gpus=2)}, "GPU", 100, NEED) == {"a": 2}


def test_machine_with_little_memory_gets_one_worker_that_reserves_all_of_it() -> None:
    small = machine(2, 1 * GB)
    assert workers_by_machine({"a": small}, "CPU", 100, NEED) == {"a": 1}
    assert memory_to_reserve(small, NEED) == 1 * GB
    assert memory_to_reserve(machine(2, 9 * GB), NEED) == memory_to_reserve(machine(2), NEED) == NEED
    assert workers_by_machine({"head": machine(0, 9 * GB)}, "CPU", 100, NEED) == {}


def test_shortage_reports_memory_that_leaves_a_core_without_a_worker() -> None:
    sentence = "a has 4.5 GB of memory free, and a worker of this size needs 2.0 GB: it runs 2 of 4 workers."
    assert shortage(machine(4, 4.5 * GB), "CPU", 100, NEED) == sentence
    assert shortage(machine(4, 4.5 * GB), "CPU", 2, NEED) == ""
    assert shortage(machine(4, 8 * GB), "CPU", 100, NEED) == ""
    assert shortage(machine(4), "CPU", 100, NEED) == ""


def test_bytes_of_worker_grow_with_the_size() -> None:
    """As docs/cluster.md says."""
    needs = [bytes_of_worker(size_of(size)) for size in ("s", "m", "l", "20-28-8-4")]
    assert needs == [1.5 * GB, 1.8 * GB, 1.8 * GB, 2.5 * GB]


@pytest.mark.campaign
def test_crew_does_not_wait_for_a_gpu_that_others_hold() -> None:
    command = [sys.executable, "-c", HELD]
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_raylet_start_wait_time_s": str(int(patience(COMMAND_SECONDS))),
    }
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=patience(COMMAND_SECONDS), check=False
    )
    assert done.returncode == 0, done.stderr

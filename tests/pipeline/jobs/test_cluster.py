"""Workers that die and clusters that grow and shrink, mostly on real Ray: every level that can be made is made."""

import io
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.request import urlopen

import pytest
from ray._private import ray_constants
from ray.exceptions import ActorUnavailableError, RayError
from rich.console import Console

from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs import cluster, likeness
from levelproof.pipeline.jobs.address import noticing_slow_starts, require_reachable
from levelproof.pipeline.jobs.likeness import mismatch, unseen, versions_of, with_absolute_paths
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import MAX_UNITS, Round, Scheduler, UnitOutcome, WorkUnit
from levelproof.pipeline.stopping import stoppable
from levelproof.pipeline.store.layout import JOB
from levelproof.pipeline.store.leases import served
from levelproof.pipeline.store.locks import only_writer
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from tests.pace import patience, wait_until
from tests.pipeline.command import COMMAND_SECONDS, ROOT, assert_refused, descendants, run, start, title, until
from tests.pipeline.made import lasting, made_job

LEVELS, DEADLY = 8, 2
SETTINGS = ("generate", f"levels={LEVELS}", "unit=1", "budget=5k", "executor=ray")
SPLIT = Path("data/5k/s")
MEMORY: dict[str, Any] = {"object_store_memory": 80 * 2**20}  # of a node of Ray
STALLED = 150  # s; longer than compiling keeps a worker of a fast machine silent


def fragile(deadly: int, cwd: Path) -> subprocess.CompletedProcess[str]:
    return run([str(deadly), str(patience(COMMAND_SECONDS)), *SETTINGS], cwd, module="tests.pipeline.fragile")


@pytest.mark.campaign
def test_level_that_kills_its_worker_is_quarantined_alone(tmp_path: Path) -> None:
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
    assert len(deaths) == len(MAX_UNITS), done.stderr  # one line per death, however many levels failed
    assert deaths[-1].startswith(f"Level {DEADLY} failed")
    assert deaths[-1].endswith(": given up.")


@pytest.mark.campaign
def test_run_fails_if_no_worker_can_start(tmp_path: Path) -> None:
    done = fragile(-1, tmp_path)
    assert_refused(done, 1, "No worker can start (The worker died", "try executor=inline")
    assert not (tmp_path / SPLIT / "quarantine").exists()


def test_generate_names_an_unreachable_cluster(tmp_path: Path) -> None:
    done = run(SETTINGS, tmp_path, address="127.0.0.1:9")
    assert_refused(
        done, 2, "There is no Ray cluster at RAY_ADDRESS=127.0.0.1:9 (Connection refused)", "ray start --head"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder in which even root cannot create files")
def test_generate_names_a_ray_folder_that_is_not_writable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_TMPDIR", "/proc/sys/ray")
    assert_refused(run(SETTINGS, tmp_path), 1, "Ray cannot start", "/proc/sys/ray", "RAY_TMPDIR")


@pytest.mark.parametrize("kind", [Exception, TimeoutError])  # types that Ray raises
def test_connected_explains_a_ray_that_starts_too_slowly(kind: type, monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: Any) -> None:
        raise kind("The current node timed out during startup. This could happen because some of the raylet failed.")

    monkeypatch.setattr(cluster.ray, "init", init)
    sentence = r"cannot start \(The current node timed out .*is less busy, .*=inline\.$"
    with pytest.raises(Failure, match=sentence), cluster.connected():
        pass


def test_connected_explains_a_cluster_of_other_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: Any) -> None:
        started, ours = "    Ray: 2.40.0\n    Python: 3.12.1", "    Ray: 2.50.0\n    Python: 3.11.7"
        raise RuntimeError(
            f"Version mismatch: The cluster was started with:\n{started}\nThis process on node 127.0.0.1 was started "
            f"with:\n{ours}\n"
        )

    monkeypatch.setattr(cluster.ray, "init", init)
    sentence = r"another Ray or Python than this command \(The cluster .* Ray: 2\.40\.0 .* Python: 3\.11\.7\): install"
    with pytest.raises(UserError, match=sentence), cluster.connected():
        pass


@pytest.mark.campaign
def test_workers_do_without_a_gpu_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_OVERRIDE_RESOURCES", '{"GPU": 1}')
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", str(int(patience(COMMAND_SECONDS))))
    before = ray_constants.ENABLE_RAY_CLUSTER
    cases = (  # lambdas, because Ray sends them by value
        (lambda: time.sleep(600), 1.0, "timed out"),
        (lambda: os.abort(), patience(COMMAND_SECONDS), "died"),
    )
    with cluster.connected():
        assert not ray_constants.ENABLE_RAY_CLUSTER, "it listens on loopback"
        for probe, seconds, reason in cases:
            monkeypatch.setattr(cluster, "jax_sees_a_gpu", probe)
            monkeypatch.setattr(cluster, "PROBE_PATIENCE", seconds)
            why = cluster._why_no_gpu()
            assert why.startswith("the cluster has one, but no answer came from it (")
            assert reason in why
    assert before == ray_constants.ENABLE_RAY_CLUSTER, "later clusters of this process listen where they did"


def test_slow_starts_are_noticed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "192.0.2.7:6379")
    with noticing_slow_starts(60):
        pass
    with noticing_slow_starts(0.01):
        (line,) = wait_until(lambda: capsys.readouterr().err.splitlines(), 60, "no notice")
    assert line.startswith("Still waiting for the cluster at RAY_ADDRESS=192.0.2.7:6379 to answer")


@pytest.mark.parametrize("address", ["127.0.0.1:99999", "a..b:6379"])
def test_require_reachable_names_an_invalid_address(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(UserError, match=f"There is no Ray cluster at RAY_ADDRESS={re.escape(address)} "):
        require_reachable(address)


def python(program: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a program that starts a local Ray."""
    environment = os.environ | {"RAY_raylet_start_wait_time_s": str(int(patience(COMMAND_SECONDS)))} | variables
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(
        command,
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=patience(COMMAND_SECONDS),
        check=False,
    )


# A driver whose folder is recreated and taken over by another command before its worker starts. The worker commits
# ready-made results by the real commit.
CUT_OFF = """
import os, pathlib, shutil, sys
from rich.console import Console
from levelproof.pipeline.jobs import cluster
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Round, Scheduler, UnitOutcome, WorkUnit
from levelproof.pipeline.stopping import Stop
from levelproof.pipeline.store.locks import only_writer
from tests.pipeline.made import made_job

class Ready(cluster.WorkerActor):
    def begin(self, program, job, split, *more):
        self.split = split
        return super().begin(program, job, split, *more)

    def work(self, order, seconds):
        from levelproof.pipeline.jobs.unit import failure
        from tests.pipeline.driver import commit_made

        (unit,) = order.units
        try:
            commit_made(self.split, unit)
        except Exception as error:
            return Round([failure(self.split, unit, error)], {}, 0)
        return Round([UnitOutcome(unit, reason="It was committed.")], {}, 0)

def settle(outcomes):
    for outcome in outcomes:
        sys.exit(outcome.fatal or outcome.reason)

cluster.WorkerActor = Ready
split = pathlib.Path(sys.argv[1])
with only_writer(split, print):
    shutil.rmtree(split)
    split.mkdir()
    with only_writer(pathlib.Path(os.path.relpath(split)), print):  # the other command, by another path to the folder
        board = Board(Tally(2, 0, 0), Console(stderr=True))
        job, scheduler = made_job("data", "unit=2", "workers=1"), Scheduler([WorkUnit((0, 1))], 2)
        cluster.run(job, split, scheduler, settle, board, Stop())
"""


@pytest.mark.campaign
def test_late_worker_commits_only_for_its_own_driver(tmp_path: Path) -> None:
    split = tmp_path / SPLIT
    split.mkdir(parents=True)
    done = python(CUT_OFF, str(split))
    assert "Another command has taken over" in done.stderr, done.stderr
    assert not fragment_paths(split)


# A command on a machine where JAX would take a GPU if it were asked. Its worker tells where JAX computes.
ON_WHAT = """
import sys
from pathlib import Path
from rich.console import Console
from levelproof.pipeline.jobs import cluster
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Round, Scheduler, UnitOutcome, WorkUnit
from levelproof.pipeline.stopping import Stop
from tests.pipeline.made import made_job

class Telling(cluster.WorkerActor):
    def work(self, order, seconds):
        import jax

        told = f"{jax.config.jax_platforms} {[device.platform for device in jax.devices()]}"
        return Round([UnitOutcome(unit, reason=told) for unit in order.units], {}, 0)

def settle(outcomes):
    for outcome in outcomes:
        sys.exit(outcome.reason)

cluster.WorkerActor = Telling
board = Board(Tally(2, 0, 0), Console(stderr=True))
job, scheduler = made_job("data", "unit=2", "workers=1"), Scheduler([WorkUnit((0, 1))], 2)
cluster.run(job, Path("data"), scheduler, settle, board, Stop())
"""


@pytest.mark.campaign
def test_a_worker_uses_the_cpu_where_jax_prefers_a_gpu() -> None:
    done = python(ON_WHAT, JAX_PLATFORMS="cuda,cpu")
    assert done.stderr.splitlines()[-1] == "cpu ['cpu']", done.stderr


def test_with_absolute_paths_resolves_every_path() -> None:
    """Workers run in another folder than the command."""
    job = with_absolute_paths(made_job("data", "continue_from=data/5k/s"))
    assert job.out == str(Path("data").absolute())
    assert job.continue_from == str(Path("data/5k/s").absolute())
    assert with_absolute_paths(made_job()).continue_from == ""


def test_crew_follows_the_room_of_its_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    cores: dict[str, int] = {"head": 0}
    named = lambda name, number: {"NodeID": name, "NodeManagerHostname": name, "Resources": {"CPU": number}}
    nodes = lambda: [named(name, number) | {"Alive": True} for name, number in cores.items()]
    monkeypatch.setattr(cluster.ray, "nodes", nodes)
    monkeypatch.setattr(cluster.ray, "cluster_resources", dict)
    monkeypatch.setattr(cluster, "RESCAN", 0.0)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    crew, capped = (
        cluster.Crew(made_job("data", "unit=1", *words), SPLIT, Scheduler([], 6), Board(Tally(1, 0, 0), Console()))
        for words in ((), ("workers=2",))
    )
    there = lambda crew: sorted(handle.node for handle in crew._handles)
    for changes, most, two in (
        ({}, [], []),  # the crew waits for machines to join
        ({"a": 2}, ["a", "a"], ["a", "a"]),
        ({"b": 2}, ["a", "a", "b", "b"], ["a", "b"]),
        ({"b": 8}, ["a", "a", "b", "b", "b", "b"], ["a", "b"]),  # one worker for each of six units
        ({"a": 0}, ["b"] * 6, ["b", "b"]),
    ):
        cores |= changes
        for each, wanted in ((crew, most), (capped, two)):
            each.follow_cluster()
            each.follow_cluster()
            assert there(each) == wanted
    crew._handles[0].up = True
    cores |= {"b": 0, "c": 3}
    crew.follow_cluster()
    assert there(crew) == ["b", "c", "c", "c"], "a running worker stays"
    crew._refuse(crew._handles[-1], "The worker on c has jax 0.1, and this command jax 0.2: install the same.")
    crew.follow_cluster()
    assert there(crew) == ["b"]


def test_crew_excludes_a_machine_when_several_of_its_workers_are_refused_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    why = "The worker on a has jax 0.1, and this command jax 0.2: install the same."
    answers = {"a0": why, "a1": why, "b0": "", "b1": ""}
    monkeypatch.setattr(cluster.ray, "cluster_resources", dict)
    monkeypatch.setattr(cluster.ray, "wait", lambda references, **_: (references, []))
    monkeypatch.setattr(cluster.ray, "get", answers.__getitem__)
    crew = cluster.Crew(made_job("data", "unit=1"), SPLIT, Scheduler([], 6), Board(Tally(1, 0, 0), Console()))
    crew._handles = [cluster.WorkerHandle(answer[0], answer[0], answer=answer) for answer in answers]
    assert crew.wait() == []
    assert [(handle.node, handle.up) for handle in crew._handles] == [("b", True), ("b", True)]


def test_crew_hands_on_the_units_of_workers_on_a_refused_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """The running worker began before another program was installed on its machine."""
    monkeypatch.setattr(cluster.ray, "cluster_resources", dict)
    scheduler = Scheduler([WorkUnit((0, 1, 2))], 6)
    crew = cluster.Crew(made_job("data", "unit=1"), SPLIT, scheduler, Board(Tally(3, 0, 0), Console()))
    running, late, elsewhere = crew._handles = [cluster.WorkerHandle(node, node) for node in "aab"]
    running.up = elsewhere.up = True
    for worker in (running, elsewhere):
        scheduler.join(worker, 0.0)
    assert scheduler.order(running, 0.0).units == [WorkUnit((0, 1, 2))]
    crew._refuse(late, "The worker on a has jax 0.1, and this command jax 0.2: install the same.")
    assert crew._handles == [elsewhere]
    assert scheduler.order(elsewhere, 0.0).units == [WorkUnit((0, 1, 2))]
    assert [*scheduler.workers] == [elsewhere]


def crew_of(monkeypatch: pytest.MonkeyPatch, handles: list[cluster.WorkerHandle]) -> tuple[cluster.Crew, io.StringIO]:
    """Return a crew of these workers, and what it says; units of one level wait for each that is up."""
    monkeypatch.setattr(cluster.ray, "cluster_resources", dict)
    monkeypatch.setattr(cluster.ray, "kill", lambda actor: None)
    monkeypatch.setattr(cluster, "_machines", lambda: {"a": {}, "b": {}})
    said, scheduler = io.StringIO(), Scheduler([WorkUnit((0,)), WorkUnit((1,))], 2)
    crew = cluster.Crew(made_job("data", "unit=1"), SPLIT, scheduler, Board(Tally(2, 0, 0), Console(file=said)))
    crew._handles = handles
    for handle in handles:
        if handle.up:
            scheduler.join(handle, 0.0)
            scheduler.order(handle, 0.0)
    return crew, said


def test_crew_gives_up_workers_that_cannot_start(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (cluster.WorkerHandle(node, node) for node in "ab")
    crew, said = crew_of(monkeypatch, [first, second])
    for _ in range(cluster.STARTS):
        assert crew._handles == [first, second]
        assert crew._lose(first, "a traceback", "The worker died: no room") == []
        crew._give_up()
    assert crew._handles == [second]
    assert said.getvalue() == "A worker cannot start (The worker died: no room) and is given up; 1 remain.\n"
    for _ in range(cluster.STARTS):
        crew._give_up()
        crew._lose(second, "a traceback", "The worker died: no file")
    with pytest.raises(Failure, match=r"No worker can start \(The worker died: no file\): try executor=inline"):
        crew._give_up()


def test_crew_takes_a_worker_that_was_out_of_reach_for_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    """It may have worked on without the driver's orders."""

    def get(reference: str) -> str:
        if reference == "a round":
            raise ActorUnavailableError("The actor is temporarily unavailable.", None)
        return reference

    monkeypatch.setattr(cluster.ray, "get", get)
    actor = SimpleNamespace(__ray_ready__=SimpleNamespace(remote=lambda: "an answer"))
    handle = cluster.WorkerHandle("a", "a", actor=actor, answer="a round", up=True)
    crew, _ = crew_of(monkeypatch, [handle])
    assert crew._hear(handle) == []
    assert (handle.answer, handle.up) == ("an answer", True)
    (failed,) = crew._hear(handle)
    assert failed.reason == "The worker was out of reach"
    assert (handle.actor, handle.up, handle.out_of_reach) == (None, False, False)


def test_crew_hands_on_the_units_of_a_lost_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    def get(_: str) -> None:
        raise RayError("The node died.")

    monkeypatch.setattr(cluster.ray, "get", get)
    lost, other = (cluster.WorkerHandle(node, node, answer="a round", up=True) for node in "cb")
    crew, said = crew_of(monkeypatch, [lost])
    assert crew._hear(lost) == []
    assert said.getvalue() == "c is lost; others take over level 0.\n"
    assert crew._scheduler.waiting == 2
    crew._scheduler.join(other, 0.0)
    assert crew._scheduler.order(other, 0.0).units == [WorkUnit((0,))]


def test_crew_names_the_machine_of_a_fatal_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    handle = cluster.WorkerHandle("a", "a", up=True)
    crew, _ = crew_of(monkeypatch, [handle])
    full = UnitOutcome(WorkUnit((0,)), fatal="Cannot write to /tmp, because the disk is full.")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    (outcome,) = crew._report(handle, Round([full], {}, 0))
    assert outcome.fatal == "On a: Cannot write to /tmp, because the disk is full."
    named = replace(full, fatal="The worker on a does not find level 0.")
    assert named.on("a") == named


def test_fatal_failure_lets_other_workers_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = {"wait": ["full disk"], "leave": ["committed", "full disk"]}
    calls = {name: lambda *_, found=found: found for name, found in answers.items()}
    calls |= dict.fromkeys(("follow_cluster", "start_workers", "order"), lambda: None)
    monkeypatch.setattr(cluster, "connected", nullcontext)
    monkeypatch.setattr(cluster, "Crew", lambda *_: SimpleNamespace(**calls))
    settled: list[Any] = []

    def settle(outcomes: Any) -> None:
        for outcome in outcomes:
            settled.append(outcome)
            if outcome == "full disk":
                raise Failure(f"{outcome} {len(settled)}")

    board = Board(Tally(1, 0, 0), Console(quiet=True))
    with pytest.raises(Failure, match="full disk 1"), stoppable() as stop:
        cluster.run(made_job("data"), SPLIT, Scheduler([WorkUnit((0,))], 1), settle, board, stop)
    assert settled == ["full disk", "committed", "full disk"]


def test_crew_starts_thousands_of_workers_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The crew polls for a signal to stop between parts, so it waits for no more than one."""
    handles, now = [cluster.WorkerHandle("a", "a") for _ in range(3000)], [0.0]

    def start(handle: cluster.WorkerHandle, *_: Any) -> None:
        now[0] += cluster.STARTING / 64  # about as long as Ray takes
        handle.actor = "started"

    monkeypatch.setattr(cluster.WorkerHandle, "start", start)
    monkeypatch.setattr(cluster, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(cluster.ray, "cluster_resources", dict)
    scheduler = Scheduler([WorkUnit(range(10_000))], 10_000)
    crew = cluster.Crew(made_job("data", "unit=1"), SPLIT, scheduler, Board(Tally(1, 0, 0), Console()))
    crew._handles = handles
    counts = [crew.start_workers() or sum(handle.starting for handle in handles) for _ in range(2)]
    assert counts == [65, 130], "it looks at the clock before it starts a worker"


def test_worker_that_does_not_see_the_split_is_refused(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On another machine, the folder may be missing or another one, such as of an earlier run there."""
    monkeypatch.setattr(likeness, "UNSEEN", 0)
    here = Path(shutil.copytree(split, tmp_path / "here"))
    with only_writer(here, print):
        ours = served(here)
        assert ours
        assert unseen(here, ours) == unseen(here, "") == ""
        (tmp_path / "file").touch()
        earlier = Path(shutil.copytree(split, tmp_path / "earlier"))
        with only_writer(earlier, print):
            pass
        for elsewhere in tmp_path / "missing", tmp_path / "file", earlier:
            assert f"does not see this command's {elsewhere}: use a folder that all machines share" in unseen(
                elsewhere, ours
            )


def test_mismatch_names_what_differs() -> None:
    job = made_job()
    versions = versions_of(job)
    assert mismatch(versions, job) == ""
    others = {"jax": "0.1", "optax": "0.1", "levelproof": "7", "configuration": "abc", "source": "def"}
    for name, other in others.items():
        refusal = mismatch(versions | {name: other}, job)
        assert f" has {name} {versions[name]}, and this command {name} {other}: install" in refusal
        assert socket.gethostname() in refusal
        assert f"(it imports {likeness.ROOT})" in refusal


@pytest.fixture
def machines() -> Iterator[Any]:
    """Start a cluster whose head has no core."""
    from ray.cluster_utils import Cluster

    machines = Cluster(initialize_head=True, head_node_args=MEMORY | {"num_cpus": 0, "include_dashboard": False})
    yield machines
    machines.shutdown()


@pytest.mark.campaign
def test_run_survives_machines_that_join_and_leave(tmp_path: Path, machines: Any) -> None:
    """Start a head without a core; add a node to the waiting run, add another, then remove the first.

    Workers run in another folder than the command, which names the split to continue from by a relative path.
    """
    alone = "search.env_steps=0"  # so that experts leave levels to continue
    endless = ("generate", "levels=1k", "unit=1", "budget=5k", "keep_experts=true", alone)
    process = start(endless, tmp_path, address=str(machines.address))
    until((tmp_path / SPLIT / JOB).exists, process)
    first = machines.add_node(num_cpus=1, **MEMORY)
    until(lambda: fragment_paths(tmp_path / SPLIT), process)
    second = machines.add_node(num_cpus=1, **MEMORY)
    until(lambda: works_on(second), process)
    machines.remove_node(first, allow_graceful=False)
    before = len(fragment_paths(tmp_path / SPLIT))
    until(lambda: len(fragment_paths(tmp_path / SPLIT)) > before + LEVELS, process)
    process.terminate()
    _, err = process.communicate(timeout=patience(COMMAND_SECONDS))
    assert process.returncode == 130, err
    assert " is lost; others take over level" in err
    assert "Traceback" not in err

    rows = read_manifest(tmp_path / SPLIT).table.to_pylist()
    trained = next(row for row in rows if row["label"] == "unsolved" and row["experts"])
    (tmp_path / SPLIT / trained["experts"]).unlink()
    words = ["regenerate", f"manifest={SPLIT}", "budget=8k", f"where=level_id = {trained['level_id']}"]
    again = run([*words, "continue=true"], tmp_path, address=str(machines.address))
    assert again.returncode == 3, again.stdout + again.stderr
    (note,) = (tmp_path / "data/8k/s/quarantine").iterdir()
    assert f"The experts in {tmp_path / SPLIT / trained['experts']} cannot be read" in note.read_text()

    own = run(["generate", "levels=1", "budget=5k", "out=own", "executor=ray"], tmp_path)
    assert own.returncode == 0, own.stderr  # the command ignores a cluster that RAY_ADDRESS does not name


@pytest.mark.campaign
def test_ray_exports_progress_to_prometheus(tmp_path: Path) -> None:
    pytest.importorskip("aiohttp", reason="needs ray[default], which exports metrics to Prometheus")
    from ray.cluster_utils import Cluster

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    node: dict[str, Any] = {"object_store_memory": 80 * 2**20, "num_cpus": 1, "metrics_export_port": port}
    machines = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    gauges: dict[str, float] = {}

    def scraped() -> bool:
        with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/metrics", timeout=patience(10)) as answer:
            for line in answer.read().decode().splitlines():
                if match := re.fullmatch(r'ray_levelproof_(\w+)\{.*split="5k/s".*\} (\S+)', line):
                    gauges[match[1]] = float(match[2])
        return gauges.get("levels", 0) > 0

    try:
        process = start(("generate", "levels=1k", "unit=1", "budget=5k"), tmp_path, address=str(machines.address))
        until(scraped, process)
        committed = len(fragment_paths(tmp_path / SPLIT))
        process.terminate()
        process.communicate(timeout=patience(COMMAND_SECONDS))
    finally:
        machines.shutdown()
    assert gauges.keys() == {"levels", "solved", "env_steps"}
    assert 0 <= gauges["solved"] <= gauges["levels"] <= committed
    assert gauges["env_steps"] > 0


@pytest.mark.campaign
def test_crew_replaces_a_stalled_worker(tmp_path: Path) -> None:
    alone = ("search.env_steps=0", "stop.rule=budget")  # so that experts train long
    command = ["generate", f"levels={LEVELS}", "unit=1", "budget=1M", "workers=1", "executor=ray", *alone]
    process = start([str(LEVELS), str(patience(STALLED)), *command], tmp_path, module="tests.pipeline.fragile")
    split, busy = tmp_path / "data/1M/s", "ray::Fragile.work"
    working = lambda: [pid for pid in descendants(process.pid) if title(pid).startswith(busy)]
    worker, *_ = until(lambda: fragment_paths(split) and working(), process)
    os.kill(worker, signal.SIGSTOP)
    _, err = process.communicate(timeout=patience(COMMAND_SECONDS))
    assert process.returncode == 0, err
    assert "was silent for" in err
    assert read_manifest(split).level_ids.tolist() == list(range(LEVELS))


@pytest.mark.campaign
def test_lost_machines_and_a_restarted_driver_change_no_bit(tmp_path: Path, machines: Any) -> None:
    command = ["generate", "levels=24", "unit=2", "budget=5k"]
    first = machines.add_node(num_cpus=1, **MEMORY)
    process = start(command, tmp_path, address=str(machines.address))
    until(lambda: fragment_paths(tmp_path / SPLIT), process)
    machines.remove_node(first, allow_graceful=False)
    machines.add_node(num_cpus=1, **MEMORY)
    before = len(fragment_paths(tmp_path / SPLIT))
    until(lambda: len(fragment_paths(tmp_path / SPLIT)) > before, process)
    process.kill()
    process.communicate()
    again = run(command, tmp_path, address=str(machines.address))
    assert again.returncode == 0, again.stderr
    assert run([*command, "out=whole", "executor=inline"], tmp_path).returncode == 0
    assert repr(lasting(tmp_path / SPLIT)) == repr(lasting(tmp_path / "whole/5k/s"))


def works_on(machine: Any) -> bool:
    """Whether a worker on this node of Ray has units."""
    raylets = {info[0].process.pid for kind, info in machine.all_processes.items() if kind == "raylet"}
    return any(title(pid).startswith("ray::WorkerActor.work") for raylet in raylets for pid in descendants(raylet))

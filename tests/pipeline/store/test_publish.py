"""Splits written to an object store equal those in a folder, whatever the store, the writers and the workers do."""

import errno
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from levelproof.pipeline.errors import Failure, StoreFailure, UserError
from levelproof.pipeline.jobs import seal as jobs_seal
from levelproof.pipeline.jobs import unit
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import failure
from levelproof.pipeline.store import leases, leftovers, machine, objects, publish, remote, requests
from levelproof.pipeline.store import seal as sealing
from levelproof.pipeline.store.checksums import has_own
from levelproof.pipeline.store.event_files import KEPT, events_of, new_run, runs_in, write_events
from levelproof.pipeline.store.layout import (
    FRAGMENT,
    WRITER_LOCK,
    attempt_of,
    begun_path,
    data_paths,
    fragment_path,
    new_attempt,
    unit_name,
)
from levelproof.pipeline.store.leases import Lease, LeaseLost
from levelproof.pipeline.store.leftovers import clean
from levelproof.pipeline.store.locks import is_written
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.store.objects import get, put, remove, require_conditions
from levelproof.pipeline.store.publish import ended
from levelproof.pipeline.store.requests import obstore_module
from levelproof.pipeline.store.seal import Piece, seal
from levelproof.pipeline.store.split import locked
from levelproof.pipeline.verify import verify
from tests.pace import patience, wait_until
from tests.pipeline.command import ROOT, TINY, run
from tests.pipeline.command import here as command
from tests.pipeline.driver import LEVELS, SPLIT, UNIT, commit_made, drive, require_same_content
from tests.pipeline.made import assert_same_content, honest_split
from tests.pipeline.servers import (
    AZURE_KEY,
    AZURE_NAME,
    Answer,
    Server,
    azure_process,
    bucket_of,
    forget,
    s3_process,
    serving,
    serving_bucket,
)
from tests.pipeline.servers import before as before_it

OUT = "s3://bucket/data"
THERE = Path(OUT) / SPLIT


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the same job into a folder."""
    out = tmp_path_factory.mktemp("here")
    drive(str(out))
    return out / SPLIT


ALSO_MOTO = pytest.mark.parametrize(
    "server", ["little", pytest.param("moto", marks=pytest.mark.campaign)], indirect=True
)  # moto implements S3's preconditions independently of ours


@pytest.fixture
def server(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moto: Any
) -> Iterator[Server]:
    """Start a store with an empty bucket."""
    monkeypatch.setattr(leases, "POLL", 0.02)
    answers = before_it(*moto()) if getattr(request, "param", "") == "moto" else None
    with serving_bucket(monkeypatch, tmp_path, patience(2), answers) as server:
        yield server


@pytest.fixture
def moto() -> Iterator[Any]:
    """Return a function that starts a process that serves S3."""
    with ExitStack() as stack:
        yield lambda: stack.enter_context(s3_process())


def empty() -> None:
    remove(remote.stored_in(THERE))
    forget()


def require_whole(here: Path) -> None:
    """Check that the split is complete, with nothing else beside it."""
    manifest = require_same_content(THERE, here)
    left = {path.relative_to(THERE).as_posix() for path in remote.stored_in(THERE)}
    fragments = {name for name in left if FRAGMENT.fullmatch(name)}
    assert len(fragments) == LEVELS // UNIT
    assert {path.relative_to(THERE).as_posix() for path in data_paths(THERE)} == manifest.shards
    rest = {name for name in left - fragments if not name.startswith("shards/")}
    assert rest == {"job.json", ".writer.lock"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("every", "how"),
    [(0, ""), (3, "busy"), (4, "lost"), pytest.param(4, "cut", marks=pytest.mark.campaign)],
)
def test_store_gets_what_a_folder_gets(server: Server, here: Path, every: int, how: str) -> None:
    server.spoil(every, how)
    drive(OUT)
    server.spoil(0)
    require_whole(here)
    count = server.count
    drive(OUT)
    assert not [line for line in server.log[count:] if line.startswith("PUT") and "/shards/" in line]


@pytest.mark.slow
def test_requests_to_a_slow_store_are_retried(server: Server, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(requests.PATIENCE, "read_timeout", timedelta(seconds=patience(0.5)))
    forget()
    server.spoil(25, "slow")
    drive(OUT)
    server.spoil(0)
    require_whole(here)


def test_large_files_are_sent_a_few_at_a_time_and_may_take_long(
    server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The limit of silence of other requests would include the time that it takes to send them."""
    sent = requests.SENDS * objects.PART, requests.REQUESTS * requests.MUCH
    limits = requests.SENDING, requests.PATIENCE["read_timeout"]
    assert all(8 * size / limit.total_seconds() < 0.6e6 for size, limit in zip(sent, limits, strict=True))
    monkeypatch.setitem(requests.PATIENCE, "read_timeout", timedelta(seconds=patience(0.5)))
    forget()
    (tmp_path / "file").write_bytes(bytes(requests.MUCH + 1))
    server.meanwhile = lambda _: time.sleep(0.1)
    count = 2 * requests.SENDS
    remote.at_once(THERE, put, [THERE / f"shards/{i}" for i in range(count)], [tmp_path / "file"] * count)
    assert server.crowd.most == requests.SENDS
    server.spoil(1, "slow")
    count = server.count
    put(THERE / "shards/0", tmp_path / "file")
    assert server.count == count + 1


def dies_at(server: Server, request: int) -> None:
    """Let the store fail from this request on."""
    begun = server.count
    server.meanwhile = lambda count: server.spoil(1, "gone") if count - begun >= request else None


def requests_of_a_run(server: Server) -> int:
    before = server.count
    drive(OUT)
    server.meanwhile = lambda _: None
    count = server.count - before
    obstore_module().delete(remote.place(THERE)[0], [remote.place(path)[1] for path in remote.stored_in(THERE)])
    forget()
    return count


@pytest.mark.slow
@pytest.mark.parametrize("some", [1, pytest.param(8, marks=pytest.mark.campaign)])
def test_generate_resumes_after_the_store_fails(
    server: Server, here: Path, monkeypatch: pytest.MonkeyPatch, some: int
) -> None:
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=0.2))
    monkeypatch.setattr(leases, "SILENCE", 0.1)
    whole_run = requests_of_a_run(server)
    for request in sorted(random.Random(some).sample(range(1, whole_run), some)):
        dies_at(server, request)
        with pytest.raises(StoreFailure, match=r"^Cannot (read|write) s3://bucket/data.* \(it does not answer\)"):
            drive(OUT)
        server.meanwhile = lambda _: None
        server.spoil(0)
        forget()
        drive(OUT)
        require_whole(here)
        empty()


@pytest.mark.campaign
def test_generate_resumes_after_a_kill_at_any_request(server: Server, here: Path) -> None:
    whole_run = requests_of_a_run(server)
    for request in sorted(random.Random(0).sample(range(1, whole_run), 5)):
        begun = server.count
        words = [sys.executable, "-m", "tests.pipeline.driver", OUT]
        with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
            server.meanwhile = lambda count: process.kill() if count - begun == request else None  # noqa: B023
        server.meanwhile = lambda _: None
        assert process.returncode == -signal.SIGKILL
        forget()
        drive(OUT)
        require_whole(here)
        empty()


def taken_over(split: Path) -> Lease:
    """Take the split over as another writer, which cleans it as in its own process."""
    lease = Lease(split, print)
    clean(split, print)
    return lease


STEPS = {  # requests of an attempt: text that a request's line in the log contains, and its number among such lines
    "mark": ("begun", 1),
    "look": (".parquet", 2),  # the first checks for an unreported commit
    "lease": (".writer.lock", 1),
    "data": ("PUT /bucket/data/128k/s/shards/", 1),
    "fragment": ("PUT /bucket/data/128k/s/manifest/0", 1),
    "end": ("POST", 1),
}


@pytest.mark.slow
@ALSO_MOTO
@pytest.mark.parametrize(
    "step",
    ["look", "fragment", *(pytest.param(x, marks=pytest.mark.campaign) for x in ("mark", "lease", "data", "end"))],
)
def test_workers_of_a_replaced_writer_commit_before_or_never(
    server: Server, here: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """The worker pauses before one of its requests until another writer has taken over and cleaned up."""
    monkeypatch.setattr(leases, "RENEWAL", 1000.0)
    monkeypatch.setattr(leases, "SILENCE", -1.0)
    with leases.leased(THERE, print):
        mine, theirs, begun = leases._served[THERE], list[Lease](), server.count

        def meanwhile(count: int) -> None:
            text, number = STEPS[step]
            if sum(text in line for line in server.log[begun:count]) == number:
                server.meanwhile = lambda _: None
                theirs.append(taken_over(THERE))

        server.meanwhile = meanwhile
        if step == "end":
            commit_made(THERE, WorkUnit((0, 1)))
        else:
            with pytest.raises(LeaseLost, match="has taken over s3://bucket/data/128k/s"):
                commit_made(THERE, WorkUnit((0, 1)))
            assert not len(read_manifest(THERE).level_ids)
        leases._served[THERE] = theirs[0].token
        commit_made(THERE, WorkUnit((0, 1)))
        leases._served[THERE] = mine
        with pytest.raises(LeaseLost):
            commit_made(THERE, WorkUnit((2, 3)))
        theirs[0].release()
    drive(OUT)
    require_whole(here)


@pytest.mark.slow
@ALSO_MOTO
def test_seal_preserves_a_split_in_a_store(server: Server, here: Path, tmp_path: Path) -> None:
    drive(OUT)
    done = command(["seal", str(THERE)], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "merged 3 fragments into 1" in done.stdout
    assert_sealed(here)


@pytest.mark.slow
@ALSO_MOTO
@pytest.mark.parametrize("request_of", ["fragment", pytest.param("data", marks=pytest.mark.campaign)])
def test_seal_of_a_replaced_writer_commits_nothing(
    server: Server, here: Path, monkeypatch: pytest.MonkeyPatch, request_of: str
) -> None:
    """It pauses before it overwrites a fragment of the same name, until another writer has taken over."""
    monkeypatch.setattr(leases, "RENEWAL", 1000.0)
    monkeypatch.setattr(leases, "SILENCE", -1.0)
    drive(OUT)
    piece, (text, number), theirs = Piece.of(read_manifest(THERE).fragments[0]), STEPS[request_of], list[Lease]()
    with leases.leased(THERE, print):
        begun = server.count

        def meanwhile(count: int) -> None:
            if sum(text in line for line in server.log[begun:count]) == number:
                server.meanwhile = lambda _: None
                theirs.append(taken_over(THERE))

        server.meanwhile = meanwhile
        with pytest.raises(LeaseLost, match="has taken over s3://bucket/data/128k/s"):
            seal(THERE, [piece])
    theirs[0].release()
    forget()
    require_whole(here)


@pytest.mark.slow
@ALSO_MOTO
@pytest.mark.parametrize("sealed", [False, True])
def test_commit_keeps_its_data_if_the_answer_is_lost_and_another_writer_takes_over(
    server: Server, here: Path, monkeypatch: pytest.MonkeyPatch, sealed: bool
) -> None:
    """The mark of another attempt makes that writer change the fragment's bytes before the request is repeated."""
    if sealed:
        drive(OUT)
    put(new_attempt(THERE, unit_name(0, 1)).begun, b"")
    put_if = publish.put_if

    def put_twice(path: Path, data: bytes, there: Any) -> Any:
        monkeypatch.setattr(publish, "put_if", put_if)
        assert put_if(path, data, there)
        clean(THERE, print)
        assert get(path).data != data
        return put_if(path, data, there)

    monkeypatch.setattr(publish, "put_if", put_twice)
    if sealed:
        seal(THERE, [Piece.of(read_manifest(THERE).fragments[0])])
    else:
        commit_made(THERE, WorkUnit((0, 1)))
        drive(OUT)
    forget()
    manifest = require_same_content(THERE, here)
    assert {path.relative_to(THERE).as_posix() for path in data_paths(THERE)} == manifest.shards
    assert not [path for path in remote.stored_in(THERE) if path.suffix == ".begun"]


@pytest.mark.parametrize(("step", "requests_after"), [("merge_shards", 0), ("write_fragment", 1)])
def test_interrupted_seal_removes_only_the_marks_that_it_made_and_at_once(
    server: Server, monkeypatch: pytest.MonkeyPatch, step: str, requests_after: int
) -> None:
    drive(OUT)
    pieces, before = list(map(Piece.of, read_manifest(THERE).fragments)), remote.stored_in(THERE)
    counts = list[int]()

    def interrupt(*_: Any) -> None:
        counts.append(server.count)
        raise KeyboardInterrupt

    monkeypatch.setattr(sealing, step, interrupt)
    with pytest.raises(KeyboardInterrupt):
        seal(THERE, pieces)
    assert server.count - counts[0] == requests_after
    assert remote.stored_in(THERE) == before


def test_seal_makes_the_requests_for_all_shards_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each request that names one of the shards is answered when the others have come, or else counts as alone."""
    bucket, barriers, alone = bucket_of(tmp_path / "s3"), dict[str, threading.Barrier](), list[str]()
    names = re.compile("never")

    def answers(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        kind, named = names.subn("SHARD", f"{method} {path}")
        if named and not alone:
            try:
                barriers.setdefault(kind, threading.Barrier(LEVELS // UNIT)).wait(patience(5))
            except threading.BrokenBarrierError:
                alone.append(kind)
        return bucket(method, path, headers, body)

    monkeypatch.setattr(leases, "POLL", 0.02)
    with serving_bucket(monkeypatch, tmp_path, patience(30), answers) as server:
        drive(OUT)
        pieces = list(map(Piece.of, read_manifest(THERE).fragments))
        names = re.compile("|".join(map(attempt_of, data_paths(THERE))))
        begun = server.count
        seal(THERE, pieces)
        log, shards = server.log[begun:], LEVELS // UNIT
    assert barriers
    assert not alone
    assert sum(line.startswith("POST") for line in log) == 4, "fragments, shards, their marks, and the seal's own"
    assert sum("list-type" in line and "continuation" not in line for line in log) == 1 + 3 * shards


@pytest.mark.campaign
def test_seal_resumes_after_the_store_fails(
    server: Server, here: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=0.2))
    monkeypatch.setattr(leases, "SILENCE", 0.1)
    drive(OUT)
    count = server.count
    assert command(["seal", str(THERE)], tmp_path).returncode == 0
    for request in sorted(random.Random(0).sample(range(1, server.count - count), 5)):
        server.meanwhile = lambda _: None
        server.spoil(0)
        empty()
        drive(OUT)
        dies_at(server, request)
        command(["seal", str(THERE)], tmp_path)
        server.meanwhile = lambda _: None
        server.spoil(0)
        forget()
        require_same_content(THERE, here)
        assert command(["seal", str(THERE)], tmp_path).returncode == 0
        assert_sealed(here)


def assert_sealed(here: Path) -> None:
    manifest = require_same_content(THERE, here)
    assert [fragment.sealed for fragment in manifest.fragments] == [True]
    assert {path.relative_to(THERE).as_posix() for path in data_paths(THERE)} == manifest.shards
    assert not [path for path in remote.stored_in(THERE) if path.suffix == ".begun"]


def test_full_disk_of_temporary_files_is_named_instead_of_the_store(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failed write, unlike a failed open, does not name its file."""

    def fail(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    words = f"^Cannot write to {tempfile.gettempdir()}, because the disk is full"
    with pytest.raises(Failure, match=words), locked(THERE, print):
        fail()
    monkeypatch.setattr(jobs_seal, "seal", fail)
    with pytest.raises(Failure, match=words):
        jobs_seal.Sealer(THERE, [], print)._seal([])
    assert re.match(words, failure(THERE, WorkUnit((0,)), OSError(errno.ENOSPC, "")).fatal)


@pytest.mark.slow
def test_data_committed_while_a_store_is_cleaned_is_not_called_unnamed(
    server: Server, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An earlier writer's worker commits after the manifest was read, and removes its mark before marks are listed."""
    told, answers, put_if = list[str](), [], publish.put_if

    def put_while_cleaning(path: Path, data: bytes, there: Any) -> Any:
        monkeypatch.setattr(publish, "put_if", put_if)

        def read_then_commit(*given: Any, **more: Any) -> Any:
            manifest = read_manifest(*given, **more)
            answers.append(put_if(path, data, there))
            remove([file for file in remote.stored_in(THERE) if file.suffix == ".begun"])
            return manifest

        monkeypatch.setattr(leftovers, "read_manifest", read_then_commit)
        clean(THERE, told.append)
        monkeypatch.setattr(leftovers, "read_manifest", read_manifest)
        return answers[0]

    monkeypatch.setattr(publish, "put_if", put_while_cleaning)
    commit_made(THERE, WorkUnit((0, 1)))
    assert told == []
    drive(OUT)
    forget()
    require_same_content(THERE, here)


@ALSO_MOTO
def test_one_of_two_attempts_at_a_unit_is_committed(server: Server) -> None:
    with ThreadPoolExecutor() as threads:
        for ended in [threads.submit(commit_made, THERE, WorkUnit((0, 1))) for _ in range(3)]:
            ended.result()
    manifest = read_manifest(THERE)
    assert manifest.level_ids.tolist() == [0, 1]
    assert not [name for name in remote.stored_in(THERE) if name.suffix == ".begun"]
    assert {path.relative_to(THERE).as_posix() for path in data_paths(THERE)} == manifest.shards


def test_commit_to_a_store_skips_levels_of_an_unreported_commit(server: Server, here: Path) -> None:
    """An attempt returned some of its levels, but its report was lost, so the whole unit was assigned again."""
    commit_made(THERE, WorkUnit((0, 3)))
    commit_made(THERE, WorkUnit((0, 1, 2, 3)))
    commit_made(THERE, WorkUnit((0, 1, 2, 3)))
    manifest = read_manifest(THERE)
    assert [fragment.path.stem for fragment in manifest.fragments] == [unit_name(0, 3), unit_name(1, 2)]
    assert manifest.level_ids.tolist() == [0, 1, 2, 3]
    assert {path.relative_to(THERE).as_posix() for path in data_paths(THERE)} == manifest.shards


def test_publishing_refuses_a_unit_that_an_earlier_commit_has_in_part(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The earlier attempt commits after this one has looked which of its levels are committed."""
    commit_made(THERE, WorkUnit((0, 3)))
    monkeypatch.setattr(unit, "committed_levels", lambda *_: frozenset())
    with pytest.raises(Failure, match=r"committed first as .*, without some of the levels"):
        commit_made(THERE, WorkUnit((0, 1, 2, 3)))
    manifest = read_manifest(THERE)
    assert manifest.level_ids.tolist() == [0, 3]
    assert {path.relative_to(THERE).as_posix() for path in data_paths(THERE)} == manifest.shards
    assert not [name for name in remote.stored_in(THERE) if name.suffix == ".begun"]


@pytest.mark.parametrize(("first", "last"), [(4, 44), (40, None)], ids=["the first page's header", "its end"])
def test_publishing_names_a_damaged_fragment(server: Server, first: int, last: int | None) -> None:
    commit_made(THERE, WorkUnit((0, 1)))
    (path,) = fragment_paths(THERE)
    data = bytearray(get(path).data)
    data[first:last] = bytes(40)
    put(path, bytes(data))
    with pytest.raises(Failure, match=r"fragment s3://bucket/data/128k/s/.* is damaged: remove it"):
        commit_made(THERE, WorkUnit((0, 1)))


def test_lease_refuses_a_second_writer_while_it_is_renewed(
    server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(leases, "RENEWAL", 0.05)
    with leases.leased(THERE, print):
        assert is_written(THERE)
        with pytest.raises(UserError, match=r"Another levelproof command is writing to s3://bucket/data/128k/s"):
            drive(OUT)
    assert not is_written(THERE)
    drive(OUT)
    facts = json.loads(command(["status", str(THERE), "--json"], tmp_path).stdout)
    assert (facts["split"], facts["wanted"], facts["done"], facts["running"]) == (
        f"{OUT}/{SPLIT}",
        LEVELS,
        LEVELS,
        False,
    )


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Let Ctrl-C interrupt this process, even if the tests run as a background job, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_lease_of_a_silent_writer_is_taken_and_the_writer_notices(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "SILENCE", patience(0.3))
    monkeypatch.setattr(leases, "NOTICE", 0.0)
    monkeypatch.setattr(leases, "RENEWAL", patience(2.0))
    messages, theirs = list[str](), list[Lease]()
    with pytest.raises(LeaseLost), leases.leased(THERE, print):  # noqa: PT012
        theirs.append(Lease(THERE, messages.append))
        time.sleep(patience(30))  # until the loss of the lease interrupts it
    theirs[0].release()
    (sentence,) = messages
    assert f"still writes to s3://bucket/data/128k/s: after {leases.SILENCE:.0f} s" in sentence


def left_by_a_killed_writer(**other: Any) -> bytes:
    """Return a lease of a process that has ended, on this machine except for the `other` entries."""
    with subprocess.Popen(["true"]) as ended_process:
        pass
    text = json.loads(leases._about("theirs", renewals=7))
    return json.dumps(text | {"pid": ended_process.pid} | other).encode()


def test_lock_that_no_process_holds_is_taken_at_once_a_dead_ones_on_its_machine_only(
    server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Another machine with the same host name waits, although PID namespaces outside of containers are equal, too."""
    monkeypatch.setattr(leases, "NOTICE", 0.0)
    messages: list[str] = []
    for lock in (
        left_by_a_killed_writer(),
        b'{"writer": "a folder\'s, copied here", "host": "another", "pid": 1}',
        b"[",
    ):
        put(THERE / WRITER_LOCK, lock)
        Lease(THERE, messages.append).release()
        assert not messages
    monkeypatch.setattr(leases, "SILENCE", patience(0.3))
    for boot_id in ("a55af8d1-3d1c-4b2c-8a5e-5f0c2a9b0001", None):  # of the other machine; None: unknown
        put(THERE / WRITER_LOCK, left_by_a_killed_writer())
        with monkeypatch.context() as elsewhere:
            (tmp_path / "boot_id").write_text(boot_id or "")
            elsewhere.setattr(machine, "BOOT_ID", tmp_path / ("boot_id" if boot_id else "none"))
            messages.clear()
            Lease(THERE, messages.append).release()
        (sentence,) = messages
        assert "still writes to s3://bucket/data/128k/s" in sentence


@pytest.mark.usefixtures("interruptible")
def test_lease_survives_lost_responses_to_renewals(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=0.1))
    monkeypatch.setattr(leases, "RENEWAL", 0.05)
    try:
        lease = Lease(THERE, print)
        for _ in range(2):
            server.spoil(1, "lost")  # succeeds, but the response is lost
            await_renewals(lambda: lease._renewals, 3)  # at least two of them failed
            server.spoil(0)
            await_renewals(lambda: json.loads(get(THERE / WRITER_LOCK).data)["renewals"], 3)
    except KeyboardInterrupt:
        pytest.fail("it mistook its own renewal for another writer's")
    lease.release()
    assert get(THERE / WRITER_LOCK).data == b"{}"


def test_verify_finds_missing_levels_after_a_kill_in_a_store_whose_clock_is_ahead(
    server: Server, tmp_path: Path
) -> None:
    split = honest_split(tmp_path / "s3/bucket/data", unit=2, units=2)
    for path in [*split.glob(f"*/{unit_name(2, 3)}*")]:
        path.unlink() if path.is_file() else shutil.rmtree(path)
    with on_a_day("Fri, 01 Jan 2038 00:00:00 GMT", tmp_path / "s3") as patched:
        put(THERE / WRITER_LOCK, left_by_a_killed_writer(within="another machine"))
        patched.setattr(leases, "WATCH", patience(0.3))
        patched.setattr(verify, "prepare_jax", lambda **_: None)  # JAX keeps the cache folder of these tests
        done = command(["verify", str(THERE), "--json"], tmp_path)
    assert done.returncode == 1, done.stdout
    facts = json.loads(done.stdout)
    assert facts["missing"] == [[2, 3]]
    assert [entry["what"] for entry in facts["wrong"]] == [
        "The last command requested levels 2 to 3, but no fragment has them."
    ], "nothing else is wrong"


def await_renewals(count: Callable[[], int], more: int) -> None:
    """Wait until `count` has risen by `more`."""
    before = count()
    wait_until(lambda: count() >= before + more, 60, "no renewal")


@contextmanager
def on_a_day(day: str, folder: Path) -> Iterator[pytest.MonkeyPatch]:
    """Serve a folder from a store whose clock shows this day, in place of the current server."""
    bucket = bucket_of(folder)

    def on_that_day(*request: Any) -> Answer:
        answer = bucket(*request)
        return answer._replace(headers=answer.headers | {"Last-Modified": day})

    with serving(on_that_day) as other, pytest.MonkeyPatch.context() as patched:
        patched.setenv("AWS_ENDPOINT_URL", other.url)
        forget()
        yield patched


@pytest.mark.parametrize("day", ["Thu, 01 Jan 1981 00:00:00 GMT", "Fri, 01 Jan 2038 00:00:00 GMT"])
def test_is_leased_compares_no_clocks(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, day: str
) -> None:
    """Neither the store's, which dates the lease by `day`, nor this machine's."""
    monkeypatch.setattr(leases, "RENEWAL", 0.1)
    monkeypatch.setattr(leases, "NOTICE", 0.0)
    messages = list[str]()
    with on_a_day(day, tmp_path / "s3") as patched:
        assert not is_written(THERE, messages.append)
        with leases.leased(THERE, print):
            assert is_written(THERE, print)
        assert not is_written(THERE, messages.append)
        put(THERE / WRITER_LOCK, left_by_a_killed_writer())
        assert not is_written(THERE, messages.append)
        for text in (json.dumps({"writer": "a folder's, copied here"}).encode(), b"[" * leases.MAX_BYTES):
            put(THERE / WRITER_LOCK, text)
            assert not is_written(THERE, messages.append)
        assert not messages, "each of these is known at once"
        put(THERE / WRITER_LOCK, left_by_a_killed_writer(within="another machine"))
        patched.setattr(leases, "WATCH", patience(0.3))
        assert not is_written(THERE, messages.append)
        (sentence,) = messages
        assert sentence.startswith("Checking whether a run still writes to s3://bucket/data/128k/s, which takes up to")


@pytest.mark.slow
@pytest.mark.parametrize(("every", "how"), [(0, ""), (2, "lost")])
def test_google_store_gets_what_a_folder_gets(
    server: Server, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int, how: str
) -> None:
    """This store reports an error if a deleted file is deleted again."""
    account = {"client_email": "", "private_key": "", "private_key_id": "", "disable_oauth": True}
    (tmp_path / "account.json").write_text(json.dumps(account | {"gcs_base_url": server.url}))
    monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT", str(tmp_path / "account.json"))
    server.spoil(every, how)
    drive("gs://bucket/data")
    server.spoil(0)
    split = Path("gs://bucket/data") / SPLIT
    require_same_content(split, here)
    kept, *gone = fragment_paths(split)
    remove(gone[:1])
    remove(gone)
    assert [*fragment_paths(split)] == [kept]


@pytest.mark.campaign
@pytest.mark.parametrize(("every", "how"), [(0, ""), (3, "busy"), (4, "lost"), (4, "cut")])
def test_azure_store_gets_what_a_folder_gets(
    server: Server, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int, how: str
) -> None:
    azurite = os.environ.get("LEVELPROOF_TEST_AZURITE")
    if not azurite:
        pytest.skip("LEVELPROOF_TEST_AZURITE names no azurite-blob (npm install azurite)")
    split = Path("az://bucket/data") / SPLIT
    with azure_process(azurite, tmp_path) as there, serving(before_it(*there)) as between:
        monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", AZURE_NAME)
        monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_KEY", AZURE_KEY)
        monkeypatch.setenv("AZURE_STORAGE_ENDPOINT", f"{between.url}/{AZURE_NAME}")
        between.spoil(every, how)
        drive("az://bucket/data")
        between.spoil(0)
        require_same_content(split, here)
        count = between.count
        drive("az://bucket/data")  # everything is done already
        assert not [line for line in between.log[count:] if line.startswith("PUT") and "/shards/" in line]
        between.spoil(1, "gone")
        forget()
        with pytest.raises(StoreFailure, match="az://bucket"):
            read_manifest(split)


@pytest.mark.parametrize("out", ["https://host/data", "hf://datasets/me/data"])
def test_generate_refuses_read_only_urls(out: str) -> None:
    with pytest.raises(UserError, match=rf"Nothing can be written to {out}/128k/s: give a folder, or a URL of s3"):
        drive(out)


def test_generate_refuses_a_store_without_preconditions(server: Server, tmp_path: Path) -> None:
    conditional = bucket_of(tmp_path / "s3")
    unconditional = lambda method, path, headers, body: conditional(
        method, path, {name: x for name, x in headers.items() if not name.startswith("if-")}, body
    )
    with serving(unconditional) as other, pytest.MonkeyPatch.context() as patched:
        patched.setenv("AWS_ENDPOINT_URL", other.url)
        forget()
        with pytest.raises(UserError, match="does not support the preconditions"):
            drive(OUT)


def test_require_conditions_reports_a_busy_store_as_busy(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever digits the name of the probe file contains."""
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=0.2))
    server.spoil(1)
    with pytest.raises(StoreFailure, match=r"Cannot write .*501 \(503 Service Unavailable\)"):
        require_conditions(THERE / ".job.json.501")


def test_new_writer_gives_no_damaged_fragment_a_valid_digest(server: Server) -> None:
    commit_made(THERE, WorkUnit((0, 1)))
    (path,) = fragment_paths(THERE)
    put(mark := new_attempt(THERE, unit_name(0, 1)).begun, b"")
    before = get(path).data
    assert ended(THERE, [mark], []) == {mark}
    assert len(get(path).data) > len(before)
    forget()
    assert has_own(path)
    put(path, get(path).data.replace(b"PAR1", b"PAR2", 1))
    with pytest.raises(Failure, match="is damaged: remove it"):
        ended(THERE, [mark], [])


@ALSO_MOTO
def test_fences_are_invisible_to_readers_and_replaced_by_units(server: Server, here: Path) -> None:
    mark = new_attempt(THERE, unit_name(0, 1)).begun
    put(mark, b"")
    assert ended(THERE, [mark], []) == {mark}
    assert ended(THERE, [mark], []) == {mark}  # another fence
    assert not read_manifest(THERE).fragments
    commit_made(THERE, WorkUnit((0, 1)))
    before = get(fragment := fragment_path(THERE, unit_name(0, 1))).data
    assert ended(THERE, [mark], []) == {mark}
    assert get(fragment).data != before
    assert read_manifest(THERE).level_ids.tolist() == [0, 1]
    (shard,) = data_paths(THERE)
    assert ended(THERE, [begun_path(shard)], []) == set()  # committed after the caller's look
    assert ended(THERE, [begun_path(shard)], [f"shards/{shard.name}"]) == {begun_path(shard)}
    drive(OUT)
    require_whole(here)


@pytest.mark.campaign
@pytest.mark.parametrize("server", ["moto"], indirect=True)
def test_generate_writes_the_same_to_a_store_and_a_folder(server: Server, tmp_path: Path) -> None:
    generate = ["generate", *TINY, "keep_experts=true"]
    assert command([*generate, "executor=inline"], tmp_path).returncode == 0
    done = run([*generate, f"out={OUT}", "workers=1", "executor=ray"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert f"levelproof inspect {OUT}/5k/s" in done.stdout
    split = Path(OUT) / "5k/s"
    here = tmp_path / "data/5k/s"
    assert_same_content(split, here)
    there, kept = (read_manifest(at).table["experts"].is_valid().to_pylist() for at in (split, here))
    assert there == kept
    verified = command(["verify", str(split)], tmp_path)
    assert verified.returncode == 0, verified.stdout
    assert "0 problems" in verified.stdout


def test_new_run_removes_the_oldest_events_in_a_store(server: Server) -> None:
    for number in range(KEPT + 1):
        write_events(new_run(THERE), [{"time": float(number), "event": "started"}])
    assert sorted(event["time"] for run in runs_in(THERE) for event in events_of(run)) == list(range(1, KEPT + 1))

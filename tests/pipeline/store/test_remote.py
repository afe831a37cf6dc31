"""Remote splits read as the same split in a folder, or fail with one sentence."""

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from datetime import timedelta
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import obstore
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from obstore.store import MemoryStore, S3Store

import levelproof
from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure, LevelproofError, StoreFailure, UserError
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store import event_files, hub, job_note, leases, remote, requests
from levelproof.pipeline.store.event_files import events_of
from levelproof.pipeline.store.fields import same_bits
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.job_note import NoteError, note_job, read_note
from levelproof.pipeline.store.layout import FRAGMENT, MANIFEST, WRITER_LOCK, entries
from levelproof.pipeline.store.leases import is_leased
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest, require_manifest, write_index
from levelproof.pipeline.store.split import taken
from levelproof.pipeline.urls import as_typed, is_remote
from levelproof.pipeline.verify.verify import examine
from tests.pace import patience, wait_until
from tests.pipeline.command import ROOT, assert_refused, line_of
from tests.pipeline.command import here as command
from tests.pipeline.made import made_job, made_split, played_split
from tests.pipeline.servers import (
    HOST,
    SLOW,
    Answer,
    Server,
    before,
    bucket_of,
    files_of,
    forget,
    hub_of,
    s3_process,
    serving,
)

UNITS = [[Label.SOLVED] * 2, [Label.UNSOLVED, Label.SOLVED, Label.SOLVED], [Label.SOLVED] * 4]
KEYS = {"access_key_id": "any", "secret_access_key": "any", "region": "us-east-1"}
S3 = Path("s3://bucket/data/s")
FIELDS = ("record/state/position", "record/action", "level/role")
PIECE = 2**16  # a level of size s is several


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_split(tmp_path_factory.mktemp("made"), UNITS)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Use small pieces, an empty cache, short time-outs and no cached metadata."""
    monkeypatch.setenv("LEVELPROOF_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(remote, "PIECE", PIECE)
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=patience(2)))
    monkeypatch.setitem(requests.RETRIES, "backoff", {"init_backoff": timedelta(milliseconds=5)})
    monkeypatch.setattr(hub, "PAUSE", 0.005)
    for name in [name for name in os.environ if name.startswith(("AWS_", "HF_", "GOOGLE_"))]:
        monkeypatch.delenv(name)
    forget()


class Bucket(NamedTuple):
    """A bucket behind a server that counts requests and can make them fail."""

    server: Server
    put: Callable[[str, bytes], Any]  # under a key


@pytest.fixture(scope="module", params=["little", pytest.param("moto", marks=pytest.mark.campaign)])
def made_bucket(split: Path, request: pytest.FixtureRequest, tmp_path_factory: Any) -> Iterator[Bucket]:
    """Serve a bucket with the split: from a minimal S3 server, or from moto in a process."""
    if request.param == "little":
        folder = tmp_path_factory.mktemp("s3")
        shutil.copytree(split, folder / "bucket/data/s")
        with serving(bucket_of(folder)) as server:
            yield Bucket(server, lambda key, data: (folder / "bucket" / key).write_bytes(data))
        return
    with s3_process() as (host, port), serving(before(host, port)) as server:
        options = {"endpoint": f"http://{host}:{port}", "client_options": {"allow_http": True}}
        store = S3Store("bucket", **KEYS, **options)  # pyright: ignore[reportArgumentType]
        for file in (file for file in split.rglob("*") if file.is_file()):
            obstore.put(store, f"data/s/{file.relative_to(split).as_posix()}", file)
        yield Bucket(server, lambda key, data: obstore.put(store, key, data))


@pytest.fixture
def bucket(made_bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> Bucket:
    for name, value in {**KEYS, "endpoint_url": made_bucket.server.url}.items():
        monkeypatch.setenv(f"AWS_{name}".upper(), value)
    made_bucket.server.spoil(0)
    made_bucket.server.log.clear()
    return made_bucket


def witnessed(split: Path) -> pa.Table:
    table = require_manifest(split).table
    return table.filter(pc.is_valid(table["shard"]))  # pyright: ignore[reportAttributeAccessIssue]


def require_same(there: Path, here: Path, fields: Sequence[str] | None = FIELDS) -> None:
    """Compare manifest and records, bit for bit."""
    assert read_manifest(there).table.equals(read_manifest(here).table)
    rows = witnessed(there).take([7, 0, 3, 1, 6, 0])
    found, true = read_rows(there, rows, fields), read_rows(here, rows, fields)
    assert found.keys() == true.keys()
    assert all(same_bits(found[name], true[name]).all() for name in true)


def data_requests(server: Server) -> list[str]:
    return [line for line in server.log if line.startswith("GET") and "list-type" not in line]


def test_paths_represent_urls() -> None:
    for url in ("s3://bucket/data/s", "gs://b", "https://host:80/a", "hf://datasets/user/name@v1/1M/s"):
        assert is_remote(Path(url))
        assert as_typed(Path(url)) == url
        assert str(UserError(f"There is no split at {Path(url)}.")) == f"There is no split at {url}."
    assert not is_remote(Path("data/s"))
    assert not is_remote(Path())


@settings(max_examples=40, deadline=None)
@given(size=st.integers(0, 5000), most=st.sampled_from([0, 700, 10**6]), data=st.data())
def test_remote_file_reads_any_spans(size: int, most: int, data: st.DataObject, tmp_path_factory: Any) -> None:
    content = np.random.default_rng(size).bytes(size)
    store, folder = MemoryStore(), tmp_path_factory.mktemp("cache")
    obstore.put(store, "shards/x.zarr/c/0", content)
    place = st.integers(0, size).flatmap(lambda first: st.tuples(st.just(first), st.integers(0, size - first)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(remote, "PIECE", 256)
        patch.setattr(remote, "_store", lambda *_: store)
        patch.setattr(remote, "_cache", lambda: remote.PieceCache(folder, most))
        for _ in range(2):
            remote._known.clear()
            file = remote.RemoteFile(Path("s3://bucket/shards/x.zarr/c/0"))
            places = data.draw(st.lists(place, max_size=6))
            assert list(file.read(places)) == [content[first : first + length] for first, length in places]


def test_split_in_s3_reads_as_its_folder(bucket: Bucket, split: Path) -> None:
    require_same(S3, split, fields=None)
    assert data_requests(bucket.server)


def test_split_in_s3_opens_as_its_folder(bucket: Bucket, split: Path) -> None:
    there, here = (levelproof.open(path, where="label = 'solved'", validation=0.0) for path in (S3, split))
    assert there.manifest.equals(here.manifest)
    words: dict[str, Any] = {"batch_size": 3, "seed": 0, "observation": None, "fields": ["record/state/position"]}
    for one, other in zip(there.batches(**words), here.batches(**words), strict=True):
        assert one.level_id.tolist() == other.level_id.tolist()
        assert same_bits(one.fields["record/state/position"], other.fields["record/state/position"]).all()
    again = pickle.loads(pickle.dumps(there))
    assert same_bits(
        np.asarray(again.state(4, 17).level.state.position), np.asarray(here.state(4, 17).level.state.position)
    ).all()


def test_second_read_fetches_nothing(bucket: Bucket, split: Path) -> None:
    require_same(S3, split)
    forget()
    bucket.server.log.clear()
    require_same(S3, split)
    assert bucket.server.log
    assert data_requests(bucket.server) == []


def test_one_trajectory_fetches_pieces_not_its_shard(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "PIECE", 2**12)
    monkeypatch.setattr(remote, "MAX_PIECES", 1)
    rows = witnessed(S3)
    bucket.server.log.clear()
    read_rows(S3, rows.slice(5, 1), ["record/action"])
    whole = sum(about.size for about in remote.stored_in(S3 / rows["shard"][5].as_py()).values())
    assert 2**12 * len(data_requests(bucket.server)) < whole / 4


def test_changed_files_are_fetched_again(bucket: Bucket, split: Path, tmp_path: Path) -> None:
    require_same(S3, split)
    other = Path(shutil.copytree(split, tmp_path / "s"))
    shard = sorted((other / "shards").iterdir())[0]
    file = next(file for file in shard.rglob("*") if file.is_file() and "act/c" in file.as_posix())
    file.write_bytes(bytes(file.stat().st_size))
    key = f"data/s/{file.relative_to(other).as_posix()}"
    try:
        bucket.put(key, file.read_bytes())
        with pytest.raises(Failure, match="open the split again"):
            require_same(S3, split)
    finally:
        bucket.put(key, (split / file.relative_to(other)).read_bytes())
    require_same(S3, split)


def test_read_detects_a_file_that_changes_between_pieces(bucket: Bucket, split: Path) -> None:
    key, path = "data/s/shards/x", S3 / "shards/x"
    bucket.put(key, bytes(3 * PIECE))
    file = remote.RemoteFile(path)
    assert next(file.read([(0, 10)])) == bytes(10)
    bucket.put(key, b"1" * 3 * PIECE)
    with pytest.raises(OSError, match=r"s3://bucket/data/s/shards/x has changed"):
        next(file.read([(PIECE, 10)]))
    assert next(remote.RemoteFile(path).read([(PIECE, 10)])) == b"1" * 10


def test_fragment_that_was_replaced_since_it_was_listed_is_missing(bucket: Bucket, split: Path) -> None:
    """So readers list again: a writer may replace it, such as by a fence. It is not damaged."""
    path = min(entries(S3, MANIFEST, FRAGMENT, lambda _: True))
    file = split / MANIFEST / path.name
    key = f"data/s/{MANIFEST}/{path.name}"
    bucket.put(key, file.read_bytes() + b"longer")
    try:
        with pytest.raises(FileNotFoundError):
            read_fragment(path)
    finally:
        bucket.put(key, file.read_bytes())
    assert require_manifest(S3, []).level_ids.tolist() == require_manifest(split, []).level_ids.tolist()


@pytest.mark.parametrize("how", ["busy", "cut"])
def test_read_survives_throttling_and_cut_off_responses(bucket: Bucket, split: Path, how: str) -> None:
    bucket.server.spoil(3, how)
    require_same(S3, split)


def test_read_waits_for_slow_bytes_but_not_in_silence(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link of 10 kB/s has the time to answer all requests that run together."""
    together = requests.REQUESTS * remote.MAX_PIECES * 2**20
    assert requests.PATIENCE["timeout"] > timedelta(seconds=together / 1e4)
    bucket.put("data/s/shards/x", bytes(PIECE))
    monkeypatch.setitem(requests.PATIENCE, "read_timeout", timedelta(seconds=patience(SLOW / 2)))
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=0.2))
    remote._store.cache_clear()
    for how, failures in (("dripping", 0), ("slow", requests.TRIES)):
        file, count = remote.RemoteFile(S3 / "shards/x"), bucket.server.count
        file._name = how  # in the cache
        bucket.server.spoil(1, how)
        with pytest.raises(StoreFailure, match="it does not answer") if failures else nullcontext():
            assert next(file.read([(0, PIECE)])) == bytes(PIECE)
        assert bucket.server.count >= count + max(failures, 1)
        bucket.server.spoil(0)


def test_reads_within_reads_share_one_limit_of_requests(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "MAX_PIECES", 1)
    keys = [f"data/s/shards/{i}" for i in range(10)]
    for i, key in enumerate(keys):
        bucket.put(key, bytes([i]) * 8 * PIECE)
    files = [remote.RemoteFile(Path("s3://bucket") / key) for key in keys]
    wait_until(lambda: not bucket.server.crowd.now, 60, "requests of another test")
    bucket.server.meanwhile = lambda _: time.sleep(0.1)
    bucket.server.crowd.most = 0
    try:
        read = remote.at_once(S3, lambda file: next(file.read([(0, 8 * PIECE)])), files)
    finally:
        bucket.server.meanwhile = lambda _: None
    assert [set(data) for data in read] == [{i} for i in range(10)]
    assert bucket.server.crowd.most <= requests.REQUESTS


def test_read_fails_in_bounded_time_when_the_store_dies(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = witnessed(S3)
    monkeypatch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=0.5))
    remote._store.cache_clear()
    bucket.server.spoil(1)
    start = time.monotonic()
    with pytest.raises(StoreFailure, match=r"Cannot read s3://bucket/data/s/.* \(503 Service Unavailable\)"):
        read_rows(S3, rows)
    assert time.monotonic() - start < patience(15)


@pytest.mark.parametrize(
    ("url", "environment", "kind", "sentence"),
    [
        ("s3://bucket/data/none", {}, UserError, "There is no split at s3://bucket/data/none"),
        ("s3://nobody/data/s", {}, UserError, "There is no bucket 'nobody': check s3://nobody/data/s"),
        ("s3://nobody/levels.parquet", {}, UserError, "There is no bucket 'nobody': check s3://nobody/levels.parquet"),
        ("s3://bucket/data/s", {"AWS_ENDPOINT_URL": f"http://{HOST}:1"}, StoreFailure, r"\(it does not answer\)"),
        ("hf://models/user/name", {}, UserError, "hf://models/user/name/manifest is not the URL of a dataset"),
        ("s3://bucket/data/s", {"LEVELPROOF_CACHE_GB": "much"}, UserError, "LEVELPROOF_CACHE_GB is 'much'"),
    ],
)
def test_read_explains_missing_splits_and_stores(
    bucket: Bucket,
    monkeypatch: pytest.MonkeyPatch,
    url: str,
    environment: dict,
    kind: type[LevelproofError],
    sentence: str,
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(kind, match=sentence):
        require_manifest(Path(url))


def test_read_explains_missing_credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", f"http://{HOST}:1")  # the endpoint for credentials on Amazon's machines
    with pytest.raises(UserError, match=r"no credentials to read s3://.*AWS_ACCESS_KEY_ID.*AWS_SKIP_SIGNATURE"):
        read_manifest(S3)


def test_read_explains_denied_access(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(lambda *_: Answer(403, {}, b"<Error><Code>AccessDenied</Code></Error>")) as server:
        for name, value in {**KEYS, "endpoint_url": server.url}.items():
            monkeypatch.setenv(f"AWS_{name}".upper(), value)
        with pytest.raises(UserError, match="does not let you read s3://bucket"):
            read_manifest(S3)


def test_google_store_reads_as_the_folder(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(split, tmp_path / "gs/bucket/s")
    with serving(bucket_of(tmp_path / "gs")) as server:
        account = {"client_email": "", "private_key": "", "private_key_id": "", "disable_oauth": True}
        (tmp_path / "account.json").write_text(json.dumps(account | {"gcs_base_url": server.url}))
        monkeypatch.setenv("GOOGLE_SERVICE_ACCOUNT", str(tmp_path / "account.json"))
        require_same(Path("gs://bucket/s"), split)


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["--rows", "8"]),
        pytest.param(["--density", "witness", "--key-every", "64"], marks=pytest.mark.campaign),
        pytest.param(["--density", "resume"], marks=pytest.mark.campaign),
    ],
    ids=["sealed", "witness", "resume"],
)
def test_open_split_survives_a_seal(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    """The manifest is listed again and names new shards, of any density."""
    source = split if words[0] == "--rows" else played_split(tmp_path / "played")
    copy = Path(shutil.copytree(source, tmp_path / "s3/bucket/data/s"))
    with serving(bucket_of(tmp_path / "s3")) as server:
        for name, value in {**KEYS, "endpoint_url": server.url}.items():
            monkeypatch.setenv(f"AWS_{name}".upper(), value)
        opened, before = witnessed(S3), sorted((copy / "shards").iterdir())
        assert command(["seal", str(copy), *words], tmp_path).returncode == 0
        assert not set(before) & set((copy / "shards").iterdir())
        found, true = read_rows(S3, opened), read_rows(source, witnessed(source))
        assert all(same_bits(found[name], true[name]).all() for name in true)


def test_read_stops_at_the_maximum_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For a split's note, lease and events."""
    (tmp_path / "s").mkdir()
    note_job(tmp_path / "s", made_job(), ["levelproof", "generate"], [(0, 7)])
    lock, renewals = tmp_path / "s" / WRITER_LOCK, count()
    lock.touch()

    def answers(*request: Any) -> Answer:
        if request[1].endswith(WRITER_LOCK):
            lock.write_text(json.dumps({"writer": "somebody", "renewals": next(renewals)}))
        return files_of(tmp_path)(*request)

    (tmp_path / "s/run.jsonl").write_text('{"time": 1.0, "event": "started"}\n')
    with serving(answers) as server:
        there = Path(f"{server.url}/s")
        assert read_note(there).intact
        assert is_leased(there, print)
        assert len(events_of(there / "run.jsonl")) == 1
        for module in (job_note, leases, event_files):
            monkeypatch.setattr(module, "MAX_BYTES", 20)
        with pytest.raises(NoteError, match="OSError"):
            read_note(there)
        assert not is_leased(there, print)
        assert events_of(there / "run.jsonl") == []


def test_read_explains_wrong_sizes_from_a_server() -> None:
    def answers(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if path.endswith("index.txt"):
            return Answer(200, {}, b"000000000000-000000000001.parquet\n")
        return Answer(200, {"Content-Length": str(2**60)} if method == "HEAD" else {}, b"")

    with serving(answers) as server, pytest.raises(Failure, match=r"parquet is damaged"):
        read_manifest(Path(f"{server.url}/s"))


@pytest.mark.campaign
def test_processes_share_a_cache_and_survive_kills(bucket: Bucket, split: Path) -> None:
    code = (
        "import sys, hashlib\nfrom pathlib import Path\nfrom levelproof.pipeline.read.rows import read_rows\n"
        "from levelproof.pipeline.store.manifest import read_manifest\nsplit = Path(sys.argv[1])\n"
        "table = read_manifest(split).table\nprint('ready', flush=True)\n"
        "found = read_rows(split, table.filter(table['shard'].is_valid()))\n"
        "print(hashlib.sha256(b''.join(found[name].tobytes() for name in sorted(found))).hexdigest())"
    )

    def begin(there: Path | str) -> subprocess.Popen[str]:
        words = [sys.executable, "-c", code, str(there)]
        return subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})

    end = lambda process: process.communicate(timeout=patience(120))[0]
    true = end(begin(split))
    bucket.server.spoil(5)
    for delay in (0.0, 0.05):
        processes = [begin("s3://bucket/data/s") for _ in range(3)]
        assert line_of(processes[0], processes[0].stdout) == "ready\n"
        time.sleep(delay)
        processes[0].kill()
        processes[0].communicate()
        assert [end(process) for process in processes[1:]] == [true, true]
    assert end(begin("s3://bucket/data/s")) == true


def test_split_on_a_web_server_reads_as_its_folder(split: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(split, tmp_path / "www" / "s"))
    with serving(files_of(tmp_path / "www")) as server:
        there = Path(f"{server.url}/s")
        with pytest.raises(UserError, match=r"needs manifest/index\.txt, which `levelproof seal`"):
            read_manifest(there)
        assert command(["seal", str(folder)], tmp_path).returncode == 0
        assert command(["seal", str(folder)], tmp_path).returncode == 0
        names = (folder / "manifest/index.txt").read_text().splitlines()
        assert names == [path.name for path in fragment_paths(folder)]
        assert sorted(entry.name for entry in (folder / "manifest").iterdir()) == [*names, "index.txt"]
        require_same(there, folder)
        server.log.clear()
        forget()
        require_same(there, folder)
        assert [line for line in server.log if line.startswith("GET") and "index.txt" not in line] == []
        server.spoil(3, "cut")
        forget()
        shutil.rmtree(os.environ["LEVELPROOF_CACHE_DIR"])
        require_same(there, folder)


def test_status_on_a_web_server_that_denies_dotfiles_is_that_of_the_folder(split: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(split, tmp_path / "s"))
    write_index(folder)
    files = files_of(tmp_path)
    with serving(lambda *request: Answer(403, {}, b"") if "/." in request[1] else files(*request)) as server:
        there, here = (command(["status", str(path)], tmp_path) for path in (Path(f"{server.url}/s"), folder))
        assert there.returncode == 0, there.stderr
        assert there.stdout == here.stdout.replace(str(folder), f"{server.url}/s")


def test_quoted_url_of_a_web_server_is_quoted_once(split: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(split, tmp_path / "www/my data/100%/s"))
    write_index(folder)
    with serving(files_of(tmp_path / "www")) as server:
        require_same(Path(f"{server.url}/my%20data/100%25/s"), folder)
        assert {line.split()[1].partition("/s/")[0] for line in server.log} == {"/my%20data/100%25"}


def test_revision_of_the_hub_with_a_slash_is_quoted_once(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(split, tmp_path / "repository/1M/s")
    monkeypatch.setenv("HF_TOKEN", "secret")
    with serving(hub_of(tmp_path / "repository", "user/name", "secret", 2, "refs%2Fpr%2F1")) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        require_same(Path("hf://datasets/user/name@refs%2Fpr%2F1/1M/s"), split)


def test_damaged_index_of_a_web_server_is_refused(split: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(split, tmp_path / "s"))
    write_index(folder)
    index = folder / MANIFEST / "index.txt"
    whole = index.read_bytes()
    with serving(files_of(tmp_path)) as server:
        changed = whole.replace(b"-", b"_", 1), whole.replace(b"\n", b"/", 1), whole + b"../../x.parquet"
        for damaged in whole[:-20], *changed:
            index.write_bytes(damaged)
            with pytest.raises(Failure, match=r"s/manifest/index.txt is damaged, because '.*' names no fragment"):
                read_manifest(Path(f"{server.url}/s"))


def test_index_for_web_servers_follows_the_split(split: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(split, tmp_path / "s"))
    index, (gone, *_) = folder / MANIFEST / "index.txt", fragment_paths(folder)
    with taken(folder, print):
        pass
    assert not index.exists(), "it had none before"
    write_index(folder)
    old = index.read_bytes()
    with pytest.raises(UserError), taken(folder, print):
        raise UserError("another configuration")
    assert index.read_bytes() == old
    with serving(files_of(tmp_path)) as server:
        there = Path(f"{server.url}/s")
        with taken(folder, print):
            gone.unlink()
            words = f"/s/manifest/index.txt names {gone.name}, which is not there: run `levelproof seal`"
            for reads in read_manifest, examine:
                with pytest.raises(Failure, match=re.escape(words)):
                    reads(there)
        assert read_manifest(there, []).level_ids.tolist() == read_manifest(folder, []).level_ids.tolist()
        gone = fragment_paths(folder)[0]
        with pytest.raises(KeyboardInterrupt), taken(folder, print):
            stop_without(gone)
        assert read_manifest(there, []).level_ids.tolist() == read_manifest(folder, []).level_ids.tolist()


def stop_without(fragment: Path) -> None:
    fragment.unlink()
    raise KeyboardInterrupt


def test_names_that_leave_the_folder_of_a_web_server_are_not_found() -> None:
    for name in ("%2e%2e/x", "shards/%2E%2E/x", "a%0Ab"):
        with pytest.raises(FileNotFoundError):
            remote.place(Path(f"http:/localhost:1/data/{name}"))


def test_requests_that_wait_for_a_turn_fail_with_the_one_that_has_it() -> None:
    """A silent store would otherwise be asked by one after another, each as patient as the first."""
    turns, asked = requests.Turns(1), list[str]()

    def refused(path: Path, error: type[StoreFailure]) -> None:
        asked.append(path.name)
        time.sleep(0.1)
        raise error(f"{path.name} failed")

    def ask(path: Path, error: type[StoreFailure] = requests.StoreSilent) -> None:
        requests.ask(path, lambda: refused(path, error), turns=turns)

    paths = [Path(f"s3:/bucket/{number}") for number in range(40)]
    with pytest.raises(StoreFailure, match="failed"):
        remote.at_once(paths[0], ask, paths)
    assert len(asked) <= 2, "those of other threads that waited, and those that were queued, are not made"
    asked.clear()
    with ThreadPoolExecutor(4) as threads:
        each = [threads.submit(ask, path, StoreFailure) for path in paths[:4]]
        assert {str(one.exception()) for one in each} == {f"{number} failed" for number in range(4)}
    assert len(asked) == 4, "an answer, even a refusal, says nothing of other requests"


def test_split_on_the_hub_reads_as_its_folder(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(split, tmp_path / "repository" / "1M" / "s")
    there = Path("hf://datasets/user/name/1M/s")
    with serving(hub_of(tmp_path / "repository", "user/name", "secret", page=2)) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("HF_HOME", str(tmp_path))
        with pytest.raises(UserError, match="set HF_TOKEN"):
            read_manifest(there)
        (tmp_path / "token").write_text("secret\n")
        forget()
        server.spoil(4)
        require_same(there, split)
        server.spoil(0)
        server.log.clear()
        forget()
        require_same(there, split)
        assert [line for line in server.log if "/resolve/" in line] == []
        with pytest.raises(UserError, match="There is no split at hf://datasets/user/name/2M/s"):
            require_manifest(Path("hf://datasets/user/name/2M/s"))


def test_files_below_explains_cut_off_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    """With chunked encoding, a response that ends early raises HTTPException instead of OSError."""
    with serving(lambda *_: Answer(200, {"Transfer-Encoding": "chunked"}, b"ff\r\n[")) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        with pytest.raises(StoreFailure, match=r"The hub does not answer at .*IncompleteRead"):
            read_manifest(Path("hf://datasets/user/name/1M/s"))
        assert len(server.log) == hub.ATTEMPTS


def test_commands_that_read_accept_urls_and_others_refuse_them(bucket: Bucket, split: Path, tmp_path: Path) -> None:
    there, here = (json.loads(command(["inspect", str(path), "--json"], tmp_path).stdout) for path in (S3, split))
    assert there.pop("split") == "s3://bucket/data/s"
    assert here.pop("split") == str(split)
    assert there == here
    status = [command(["status", str(path)], tmp_path).stdout for path in (S3, split)]
    assert status[0] == status[1].replace(str(split), "s3://bucket/data/s")
    refused = command(["verify", "s3://bucket/data/s", "--repair"], tmp_path)
    assert_refused(refused, 2, "copy it with `aws s3 sync` first")
    assert_refused(command(["card", "s3://bucket/data/s"], tmp_path), 2, "name its file with -o")


def test_forked_processes_are_refused(tmp_path: Path) -> None:
    """A forked process lacks its parent's threads, so it would wait forever, and its parent for it."""
    code = (
        "import os\nfrom pathlib import Path\nfrom levelproof.pipeline.store import remote\n"
        "remote.place(Path('s3://bucket/data'))\n"
        "child = os.fork()\n"
        "try:\n    remote.bytes_of(Path('s3://bucket/data')) if not child else os.waitpid(child, 0)\n"
        "except Exception as error:\n    print(error, flush=True)\n    os._exit(1)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=patience(60)
    )
    assert "multiprocessing_context='forkserver'" in done.stdout
    assert not done.stderr


def test_read_explains_missing_obstore(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(UserError, match=r'pip install -e "\.\[remote\]"'):
        read_manifest(S3)

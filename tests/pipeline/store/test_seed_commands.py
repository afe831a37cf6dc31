"""Commands on seed files, here and elsewhere, and what they say of files that were changed."""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import levelproof
from levelproof.levelgen.files.level_file import read_level_file
from levelproof.levelgen.identity.content import content_hashes
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.look import card as cards
from levelproof.pipeline.store.manifest import read_manifest, write_index
from levelproof.pipeline.store.named import open_shard
from levelproof.pipeline.store.seed.columns import CONTENT_KEY, SCHEMA, WRITTEN
from levelproof.pipeline.store.seed.packed import ENTRIES
from levelproof.pipeline.store.seed.rows import COSTS
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import assert_refused, here, run
from tests.pipeline.made import honest_split, rewrite
from tests.pipeline.servers import bucket_of, files_of, forget, hub_of, serving

INLINE = "executor=inline"
KEYS = {"ACCESS_KEY_ID": "any", "SECRET_ACCESS_KEY": "any", "REGION": "us-east-1"}

Table = dict[str, list[Any]]


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_split(tmp_path_factory.mktemp("data"), 16, 1)


@pytest.fixture(scope="module")
def seed(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("seeds") / "128k/s/part-000.parquet"
    export_seed(split, None, path)
    return path


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LEVELPROOF_CACHE_DIR", str(tmp_path / "cache"))
    forget()


def solved(seed: Path) -> int:
    """Return the row of the first solved level."""
    return read_manifest(seed, ["label"]).labels.tolist().index("solved")


def forged(seed: Path, path: Path, change: Callable[[Table, dict[bytes, Any]], Any]) -> Path:
    """Write a changed copy of a seed file, with a valid digest of its bytes."""
    columns = pq.read_table(seed).to_pydict()
    about = {key: value for key, value in pq.read_metadata(seed).metadata.items() if not key.startswith(b"ARROW")}
    change(columns, about)
    rewrite(path, pa.table(columns, schema=SCHEMA), about, **WRITTEN)
    return path


def without_digest(_: Table, about: dict[bytes, Any]) -> None:
    about[CONTENT_KEY] = json.dumps(["0" * 64])


def test_seal_to_density_seed_writes_the_file_that_export_writes(split: Path, seed: Path, tmp_path: Path) -> None:
    before = sorted((path, path.stat().st_mtime_ns) for path in split.rglob("*"))
    words = ["seal", str(split), "--density", "seed", "-o", "levels.parquet"]
    done = here(words, tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "levels.parquet").read_bytes() == seed.read_bytes()
    assert sorted((path, path.stat().st_mtime_ns) for path in split.rglob("*")) == before
    assert_refused(here(words, tmp_path), 2, "levels.parquet already exists")


def test_commands_that_write_leave_a_folder_of_seed_files_as_it_is(seed: Path, tmp_path: Path) -> None:
    whole, folder = seed.read_bytes(), seed.parent
    words = ["generate", f"out={folder.parents[1]}", "levels=1", "executor=inline"]
    for command in (["seal", str(seed)], ["seal", str(folder)], words):
        done = here(command, tmp_path)
        assert_refused(done, 2, "has seed files, which no command changes", "`levelproof grow`")
    assert [*folder.iterdir()] == [seed]
    assert seed.read_bytes() == whole


@pytest.mark.slow
def test_verify_finds_no_fault_in_a_seed_file_and_every_change_of_its_bytes(seed: Path, tmp_path: Path) -> None:
    findings = examine(seed)
    assert (findings.wrong, findings.levels) == ({}, 16)
    assert findings.witnesses == findings.same_bits > 1
    whole, changed, group = seed.read_bytes(), tmp_path / "changed.parquet", pq.read_metadata(seed).row_group(0)
    for column in map(group.column, range(1, group.num_columns)):  # ids and the footer are checked on opening
        at = column.data_page_offset + column.total_compressed_size // 2
        changed.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        (sentence,) = examine(changed).wrong
        assert sentence == f"The seed file {changed} is not what was written: its bytes have changed."


def test_verify_of_a_folder_names_a_cut_off_file_and_examines_the_others(seed: Path, tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_bytes(seed.read_bytes()[:-100])
    shutil.copy(seed, tmp_path / "b.parquet")
    findings = examine(tmp_path)
    assert list(findings.wrong) == [
        f"The seed file {tmp_path / 'a.parquet'} is not what was written: its bytes have changed."
    ]
    assert findings.levels == 16


def test_verify_names_the_level_of_a_changed_checksum_or_witness(seed: Path, tmp_path: Path) -> None:
    row = solved(seed)

    def checksum(columns: Table, _: Any) -> None:
        columns["checksum"][row] ^= 1

    def witness(columns: Table, _: Any) -> None:
        packed = columns["witness"][row]
        at = next(i for i, byte in enumerate(packed) if byte >= ENTRIES)  # its first run, which then has another value
        columns["witness"][row] = packed[:at] + bytes([ENTRIES + (packed[at] - ENTRIES) ^ 1]) + packed[at + 1 :]

    level_id = read_manifest(seed, []).level_ids[row]
    for change in (checksum, witness):
        path = forged(seed, tmp_path / f"{change.__name__}.parquet", change)
        (sentence,) = examine(path).wrong
        assert sentence.startswith(f"Level {level_id} has "), change.__name__
        done = here(["verify", str(path)], tmp_path)
        assert (done.returncode, "1 problem." in done.stdout) == (1, True)


def test_verify_and_grow_report_levels_that_a_sampler_makes_otherwise(seed: Path, tmp_path: Path) -> None:
    path = forged(seed, tmp_path / "drifted.parquet", without_digest)
    assert list(examine(path).wrong) == [f"Levels 0 to 15 of {path} differ from those that it was written from."]
    done = here(["grow", str(path), "-o", "128k/s", INLINE], tmp_path)
    assert_refused(done, 1, "In 1 row group, this sampler makes other levels", "use the levelproof that wrote it")


def test_seed_files_and_what_is_grown_from_them_are_not_repaired(
    seed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert here(["grow", str(seed), "--out=~/128k/s", INLINE], tmp_path).returncode == 0  # shells leave this ~ alone
    chunk = next(path for path in (tmp_path / "128k/s/shards").rglob("*") if path.is_file() and "c" in path.parts)
    chunk.write_bytes(bytes(len(chunk.read_bytes())))
    drifted = forged(seed, tmp_path / "drifted.parquet", without_digest)
    for source, told in ("128k/s", "delete it and run `levelproof grow` again"), (str(drifted), "copy it again from"):
        done = here(["verify", source], tmp_path)
        assert (done.returncode, "Next:" in done.stdout) == (1, False), done.stderr
        assert_refused(here(["verify", source, "--repair", INLINE], tmp_path), 2, told)


@pytest.mark.slow
def test_gallery_show_and_export_of_a_seed_file_are_those_of_its_split(split: Path, seed: Path, tmp_path: Path) -> None:
    level_id = str(read_manifest(seed, []).level_ids[solved(seed)])

    def written(source: str) -> tuple[Any, ...]:
        """Return what the commands write of a source."""
        out = Path(tempfile.mkdtemp(dir=tmp_path))
        shown = here(["show", source, level_id, "-o", "level.svg"], out)
        for words in (["gallery", source, "-o", "site"], ["export", source, level_id, "-o", "level.json"]):
            done = here(words, out)
            assert done.returncode == 0, done.stderr
        pages = [out / "site/data" / name for name in ("worlds/0.js", *(f"levels/0/{i}.js" for i in range(16)))]
        level = read_level_file(out / "level.json").level
        film = (out / "level.svg").read_text()
        return shown.stdout, film, [motion(page.read_text()) for page in pages], content_hashes(level)

    with serving(files_of(seed.parent)) as server:
        theirs, ours, there = map(written, (str(split), str(seed), f"{server.url}/{seed.name}"))
    assert theirs[0].startswith(f"level.svg: level {level_id} of size s, solved in ")
    assert theirs == ours == there


def test_costs_that_seeds_leave_out_are_not_shown_as_zero(seed: Path, tmp_path: Path) -> None:
    done = here(["inspect", str(seed), "--columns", "level_id,env_steps", "--limit", "1"], tmp_path)
    assert done.stdout.splitlines()[-1].split() == [str(read_manifest(seed, []).level_ids[0]), "-"]
    assert here(["gallery", str(seed), "-o", "site"], tmp_path).returncode == 0
    page = (tmp_path / "site/data/levels/0/0.js").read_text()
    row = json.loads(page[page.index(",") + 1 : page.rindex(")")])["row"]
    assert [row[name] for name in COSTS] == [None] * len(COSTS)


def motion(page: str) -> Any:
    """Return what a data file of a gallery shows of worlds and motion; seeds have no actions without an effect."""
    value = json.loads(page[page.index(",") + 1 : page.rindex(")")])
    return value if isinstance(value, list) else {k: v for k, v in value.items() if k not in ("row", "actions")}


@pytest.mark.slow
def test_regenerate_labels_the_levels_of_a_seed_file_again(seed: Path, tmp_path: Path) -> None:
    words = ["budget=5k", "procedure=label", "where=label IN ('trivial', 'unsolvable')", INLINE]
    with serving(files_of(seed.parent)) as server:
        done = here(["regenerate", f"manifest={server.url}/{seed.name}", *words], tmp_path)
    assert done.returncode == 0, done.stderr
    kept = ["level_id", "label", "label_reason", "content_hash", "steps_to_goal"]
    again, before = (read_manifest(path, kept).table.select(kept) for path in (tmp_path / "data/5k/s", seed))
    known = [row for row in before.to_pylist() if row["label"] in ("trivial", "unsolvable")]
    assert known
    assert again.to_pylist() == known


def test_seed_file_by_url_is_inspected_read_and_verified(seed: Path, tmp_path: Path) -> None:
    with serving(files_of(seed.parent)) as server:
        url = f"{server.url}/{seed.name}"
        there, ours = levelproof.open(url), levelproof.open(seed)
        assert there.fingerprint == ours.fingerprint
        words: dict[str, Any] = {"batch_size": 3, "seed": 0, "observation": None}
        for a, b in zip(there.episode_batches(**words), ours.episode_batches(**words), strict=True):
            assert (a.level_id.tolist(), a.steps.tolist()) == (b.level_id.tolist(), b.steps.tolist())
            np.testing.assert_array_equal(a.action, b.action)
        inspected = [json.loads(here(["inspect", str(source), "--json"], tmp_path).stdout) for source in (url, seed)]
        assert [facts.pop("split") for facts in inspected] == [url, str(seed)]
        shown = [{name: value for name, value in facts.items() if "bytes" not in name} for facts in inspected]
        assert shown[0] == shown[1]
        for command in ("verify", "inspect"):
            assert_refused(here([command, f"{url}.x.parquet"], tmp_path), 1, f"There is no seed file {url}.x.parquet:")
        done = here(["verify", url], tmp_path)
        assert (done.returncode, " 0 problems." in done.stdout) == (0, True), done.stderr
        facts = json.loads(here(["diff", url, str(seed), "--json"], tmp_path).stdout)
        assert (facts["settings"], facts["levels"], facts["only"]) == ({}, 16, [0, 0])


@pytest.fixture
def published(split: Path, seed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder `bucket/levels` with a split and its seed file; cards have small previews."""
    monkeypatch.setattr(cards, "SAMPLE", 2)
    folder = tmp_path / "bucket/levels"
    shutil.copytree(split, folder / "128k/s")
    shutil.copy(seed, folder / "seeds.parquet")
    write_index(folder / "128k/s")
    return folder


def carded(words: list[str], folder: Path) -> str:
    """Write a card; return the last line that the command prints."""
    done = here(["card", *words], folder)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_card_of_a_seed_file_on_a_web_server_is_that_of_its_folder(published: Path, tmp_path: Path) -> None:
    with serving(files_of(published.parent)) as server:
        url, own = f"{server.url}/levels", ["-o", "levels/README.md"]
        assert carded([f"{url}/seeds.parquet", *own], tmp_path) == f"Next:  copy them to {url}"
        for words, told in (
            ([f"{url}/seeds.parquet"], "name its file with -o, as in -o card/README"),
            ([f"{url}/128k/s", "-o", "x/README.md"], "copy it with `wget -r` first"),
            ([f"{url}/seeds.parquet", str(published / "128k/s"), "-o", "x/README.md"], "is not below"),
        ):
            assert_refused(here(["card", *words], tmp_path), 2, told)
    assert carded([str(published / "seeds.parquet")], tmp_path).startswith("Next:  hf upload")
    assert (tmp_path / "levels/README.md").read_text() == (published / "README.md").read_text()


def test_card_of_a_split_in_a_store_is_that_of_its_folder(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(bucket_of(tmp_path)) as server:
        for name, value in {**KEYS, "ENDPOINT_URL": server.url}.items():
            monkeypatch.setenv(f"AWS_{name}", value)
        told = carded(["s3://bucket/levels/128k/s", "-o", "s3/README.md"], tmp_path)
        assert told == "Next:  copy them to s3://bucket/levels"
    with serving(hub_of(published, "user/name", "secret", page=2)) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("HF_TOKEN", "secret")
        told = carded(["hf://datasets/user/name/128k/s", "-o", "hub/README.md", "--name", "levels"], tmp_path)
        assert told == "Next:  copy them to hf://datasets/user/name"
    carded([str(published / "128k/s")], tmp_path)
    written = [
        {
            file.relative_to(folder).as_posix(): file.read_bytes()
            for file in [folder / "README.md", *folder.glob("figures/*"), *folder.glob("preview/*")]
        }
        for folder in (published, tmp_path / "s3", tmp_path / "hub")
    ]
    assert len(written[0]) > 2
    assert written[0] == written[1] == written[2]


def test_seed_file_at_the_root_of_a_store_opens_without_a_list_and_anew(
    seed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside it there may be any number of files, and users may be allowed to read, but not to list."""
    bucket = tmp_path / "store/bucket"
    bucket.mkdir(parents=True)
    unlike = lambda columns, _: columns["checksum"].__setitem__(solved(seed), columns["checksum"][solved(seed)] ^ 1)
    versions = [seed, forged(seed, tmp_path / "other.parquet", unlike)]

    def require_each_version_read(url: str) -> None:
        for version in versions:
            shutil.copy(version, bucket / "levels.parquet")
            assert levelproof.open(url).fingerprint == levelproof.open(version).fingerprint
            there, here = (open_shard(place, "levels.parquet", "s") for place in (Path(url), version))
            assert there.checksum.tolist() == here.checksum.tolist()  # pyright: ignore[reportAttributeAccessIssue]

    with serving(bucket_of(tmp_path / "store")) as server:
        for name, value in {**KEYS, "ENDPOINT_URL": server.url}.items():
            monkeypatch.setenv(f"AWS_{name}", value)
        require_each_version_read("s3://bucket/levels.parquet")
        assert not [line for line in server.log if "list-type" in line]
    with serving(files_of(bucket)) as server:
        require_each_version_read(f"{server.url}/levels.parquet")
    with serving(hub_of(bucket, "user/name", "secret", page=2)) as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        monkeypatch.setenv("HF_TOKEN", "secret")
        require_each_version_read("hf://datasets/user/name/levels.parquet")
        assert not [line for line in server.log if "recursive=true" in line]


@pytest.mark.campaign
def test_ray_workers_grow_what_one_process_grows(seed: Path, tmp_path: Path) -> None:
    for folder, *words in (["ray", "executor=ray", "workers=2"], ["inline", INLINE]):
        done = run(["grow", str(seed), "-o", f"{folder}/128k/s", *words], tmp_path)
        assert done.returncode == 0, done.stderr
    plain = [
        read_manifest(tmp_path / f"{name}/128k/s").table.drop_columns(["shard", "row"]) for name in ("ray", "inline")
    ]
    assert plain[0].to_pylist() == plain[1].to_pylist()
    assert not examine(tmp_path / "ray/128k/s").wrong

"""Forged splits: each lie is found, by levels made again, labels worked out again, and witnesses replayed."""

import itertools
import json
import shutil
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from levelproof.experts.labels import WITNESSED, Label
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.pipeline.errors import StoreFailure
from levelproof.pipeline.store import remote
from levelproof.pipeline.store.checksums import digests_of, with_own
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.layout import MANIFEST, unit_name
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest, write_index
from levelproof.pipeline.store.schema import DIGESTS_KEY
from levelproof.pipeline.store.shard import Shard, write_shard
from levelproof.pipeline.verify import evidence
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.made import honest_split, made_job
from tests.pipeline.servers import files_of, serving

pytestmark = pytest.mark.slow
UNIT, UNITS = 8, 6

Row = dict[str, Any]


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = honest_split(tmp_path_factory.mktemp("data"), UNIT, UNITS)
    assert set(read_manifest(path, ["label"]).labels) == set(Label)
    return path


@pytest.fixture
def split(honest: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(honest, tmp_path / "s"))


def forge(split: Path, change: Callable[[Row], None] = lambda row: None, level_ids: list[int] | None = None) -> None:
    """Change rows, and write their fragments with every checksum, as if all were right."""
    for path in fragment_paths(split):
        table = pq.read_table(path)
        rows = table.to_pylist()
        for row in rows:
            if level_ids is None or row["level_id"] in level_ids:
                change(row)
        names = {row["shard"] for row in rows if row["shard"] and (split / row["shard"]).exists()}
        digests = {DIGESTS_KEY: json.dumps({name: digests_of(split / name) for name in names})}
        whole = pa.BufferOutputStream()
        forged = pa.Table.from_pylist(rows, schema=table.schema.with_metadata(table.schema.metadata | digests))
        pq.write_table(forged, whole, write_page_checksum=True)
        path.write_bytes(with_own(whole.getvalue().to_pybytes()))


def of_label(split: Path, *labels: Label) -> list[Row]:
    return [row for row in read_manifest(split).table.to_pylist() if row["label"] in labels]


def neighbours(split: Path) -> tuple[Row, Row]:
    """Two levels of one shard."""
    rows = of_label(split, *WITNESSED)
    return next((a, b) for a, b in itertools.pairwise(rows) if a["shard"] == b["shard"])


def exchange_worlds(split: Path, a: Row, b: Row) -> None:
    path = split / a["shard"]
    shard = Shard(path)
    order = np.arange(len(shard.level_ids))
    order[[a["row"], b["row"]]] = b["row"], a["row"]
    arrays = shard.read(order)
    shutil.rmtree(path)
    write_shard(path, shard.level_ids, arrays)
    forge(split)


def of_another_stack(row: Row) -> None:
    row["device"] = "cpu: of another kind"


def assert_told(split: Path, *sentences: str) -> None:
    wrong = examine(split).sentences
    assert len(wrong) == len(sentences), wrong
    for sentence, told in zip(sentences, sorted(wrong), strict=True):
        assert sentence in told


def test_an_honest_split_has_nothing_wrong(honest: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its small shards are replayed together, in as few blocks as they fit in."""
    counts: list[int] = []
    counted = lambda level, action, rules: counts.append(action.shape[-1]) or replay(level, action, rules)
    monkeypatch.setattr(evidence, "replay", counted)
    found = examine(honest)
    assert found.sentences == []
    assert (found.levels, found.shards) == (UNIT * UNITS, len(read_manifest(honest).shards))
    assert found.witnesses == found.same_bits == len(of_label(honest, *WITNESSED))
    assert counts == [found.witnesses]


def test_an_honest_split_on_a_web_server_has_nothing_wrong(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It lists no files; those that fragments name are looked at."""
    monkeypatch.setattr(remote, "_cache", lambda: remote.PieceCache(tmp_path / "cache", 10**9))
    write_index(split)
    shard = split / sorted(read_manifest(split, ["shard"]).shards)[0]
    with serving(files_of(split.parent)) as server:
        found = examine(Path(f"{server.url}/{split.name}"))
        assert found.sentences == []
        assert found.witnesses == found.same_bits == len(of_label(split, *WITNESSED))
        with (shard / "zarr.json").open("a") as file:
            file.write(" ")
        (sentence,) = examine(Path(f"{server.url}/{split.name}")).sentences
        assert f"{shard.name}/zarr.json is not what was committed" in sentence


def test_a_server_that_gives_out_is_no_damage(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever was to be read next."""
    write_index(split)
    monkeypatch.setitem(remote.RETRIES, "retry_timeout", timedelta(seconds=0.2))
    remote._store.cache_clear()
    with serving(files_of(split.parent)) as server:
        for share in (1.0, 0.3, 0.5, 0.7, 0.95):
            cache = remote.PieceCache(tmp_path / str(share), 10**9)
            monkeypatch.setattr(remote, "_cache", lambda cache=cache: cache)
            if share == 1.0:
                assert not examine(Path(f"{server.url}/{split.name}")).sentences
                requests = server.count
                continue
            last = server.count + share * requests
            server.meanwhile = lambda number, last=last: server.spoil(int(number > last))
            with pytest.raises(StoreFailure, match="503"):
                examine(Path(f"{server.url}/{split.name}"))
            server.spoil(0)


@pytest.mark.parametrize("adapts", [False, True])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_worlds_moved_under_each_other_s_ids(split: Path, adapts: bool, elsewhere: bool) -> None:
    """Whether or not their rows are moved as well, and on whatever stack they say that they were made."""
    a, b = neighbours(split)
    exchange_worlds(split, a, b)
    if adapts:
        for row, other in ((a, b), (b, a)):
            kept = {name: row[name] for name in ("level_id", "row", "shard")}
            forge(split, lambda of, new=other | kept: of.update(new), [row["level_id"]])
    if elsewhere:
        forge(split, of_another_stack)
    what = "another world in its shard" if not adapts else "has not the content hash and the signature"
    assert_told(split, *sorted(f"Level {row['level_id']} has {what.removeprefix('has ')}" for row in (a, b)))


@pytest.mark.parametrize("label", [Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL])
@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_row_relabelled_unsolvable(split: Path, label: Label, elsewhere: bool) -> None:
    level_id = of_label(split, label)[0]["level_id"]
    reason = of_label(split, Label.UNSOLVABLE)[0]["label_reason"]
    change = {"label": "unsolvable", "label_reason": reason, "shard": None, "row": None, "steps_to_goal": None}
    forge(split, lambda row: row.update(change), [level_id])
    if elsewhere:
        forge(split, of_another_stack)
    proper = "it should be trivial" if label is Label.TRIVIAL else "nothing proves that"
    assert_told(split, f"Level {level_id} is unsolvable, and {proper}.")


@pytest.mark.parametrize(("label", "other"), [("unsolvable", "unsolved"), ("trivial", "solved")])
def test_a_label_that_hides_what_is_known(split: Path, label: str, other: str) -> None:
    level_id = of_label(split, Label(label))[0]["level_id"]
    forge(split, lambda row: row.update(label=other), [level_id])
    assert_told(split, f"Level {level_id} is {other}, and it should be {label}.")


def test_identities_exchanged(split: Path) -> None:
    a, b = of_label(split, Label.UNSOLVED)[:2]
    for row, other, name in ((a, b, "content_hash"), (b, a, "signature")):
        forge(split, lambda of, name=name, other=other: of.update({name: other[name]}), [row["level_id"]])
    sentence = "Level {} has not the content hash and the signature of the level that its id makes."
    assert_told(split, *sorted(sentence.format(row["level_id"]) for row in (a, b)))


def test_other_lies_of_rows(split: Path) -> None:
    solved, trivial, unsolved = (of_label(split, label)[0] for label in (Label.SOLVED, Label.TRIVIAL, Label.UNSOLVED))
    forge(split, lambda row: row.update(steps_to_goal=row["steps_to_goal"] + 1), [solved["level_id"]])
    forge(split, lambda row: row.update(label_reason="a feeling"), [trivial["level_id"]])
    forge(split, lambda row: row.update(failed_by_noop=not row["failed_by_noop"]), [unsolved["level_id"]])
    last = of_label(split, Label.UNSOLVED)[-1]["level_id"]
    forge(split, lambda row: row.update(size="m"), [last])
    told = {
        solved["level_id"]: "reaches the goal in ",
        trivial["level_id"]: "is trivial for another reason than its row has",
        unsolved["level_id"]: "by doing nothing, the manifest says otherwise",
        last: "is of size m, its split of s",
    }
    assert_told(split, *(told[i] for i in sorted(told, key=lambda i: f"Level {i} ")))


def test_rows_of_shards_that_are_not_theirs(split: Path) -> None:
    a, b = neighbours(split)
    forge(split, lambda row: row.update(row=b["row"]), [a["level_id"]])
    assert_told(
        split, f"Level {a['level_id']} is said to be row {b['row']} of {a['shard']}, which has level {b['level_id']}"
    )
    forge(split, lambda row: row.update(row=10**6), [a["level_id"]])
    assert_told(split, "which has level None there")


def test_a_record_that_differs_in_one_bit(split: Path) -> None:
    row = of_label(split, Label.SOLVED)[0]
    shard = Shard(split / row["shard"])
    arrays = shard.read()
    arrays["record/reward"].view(np.uint32)[7, row["row"]] ^= 1
    shutil.rmtree(shard.path)
    write_shard(shard.path, shard.level_ids, arrays)
    forge(split)
    assert_told(split, f"Level {row['level_id']} has a witness that does not replay: its reward differs.")
    forge(split, of_another_stack)
    assert_told(split)


def test_of_a_damaged_fragment_no_more_levels_are_lost_than_one_has(
    split: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever its name and the note say."""
    monkeypatch.setattr("levelproof.pipeline.verify.verify.MAX_ROWS", 100)
    (split / MANIFEST / f"{unit_name(0, MAX_LEVEL_ID)}.parquet").write_bytes(b"PAR1")
    assert len(examine(split).lost) <= 102
    note_job(split, made_job(), ["levelproof", "generate"], [(0, MAX_LEVEL_ID)])
    assert len(examine(split).lost) <= 102


def test_a_hostile_shard_is_one_sentence_and_the_others_are_looked_at(split: Path) -> None:
    row = of_label(split, Label.SOLVED)[0]
    shard = Shard(split / row["shard"])
    arrays = shard.read()
    arrays["level/model/joint_a"][:] = 200
    shutil.rmtree(shard.path)
    write_shard(shard.path, shard.level_ids, arrays)
    forge(split)
    found = examine(split)
    (sentence,) = found.sentences
    assert "its field level/model/joint_a has numbers that size s cannot have" in sentence
    assert 0 < found.witnesses == len(of_label(split, *WITNESSED)) - len(shard.level_ids)
    for name in ("/etc", "../../elsewhere", row["shard"]):
        if name == row["shard"]:
            shutil.rmtree(split / "shards")
        forge(split, lambda row, name=name: row.update(shard=name), [row["level_id"]])
        assert all(sentence.startswith(("The manifest of ", "The shard ")) for sentence in examine(split).sentences)

"""Untrusted shards: each is refused in one sentence before any of it is used."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import zarr
from zarr.codecs import GzipCodec

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.layout import data_path
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.store.named import open_shard
from levelproof.pipeline.store.shard import Shard, stored_bytes, write_shard
from tests.pipeline.made import made_fields, made_split

LEVELS = [5, 9, 12]
NAME = "shards/000000000005-000000000012-0123abcd.zarr"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / NAME
    write_shard(path, LEVELS, made_fields("s", len(LEVELS)))
    return path


@pytest.fixture
def shard(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / NAME))


def refused(path: Path) -> str:
    with pytest.raises(Failure) as raised:
        Shard(path).read()
    sentence = str(raised.value)
    assert sentence.startswith("The shard ")
    assert "\n" not in sentence
    assert len(sentence) < 600
    return sentence


def field(table: list[dict[str, Any]], name: str) -> dict[str, Any]:
    return next(entry for entry in table if entry["name"] == name)


FIELDS: dict[str, Callable[[list[dict[str, Any]]], Any]] = {
    "type": lambda table: field(table, "level/role").update(dtype="float64"),
    "object type": lambda table: field(table, "level/role").update(dtype="object"),
    "larger": lambda table: field(table, "record/state/position").update(shape=[200, 2]),
    "huge": lambda table: field(table, "record/state/position").update(shape=[2**40, 2**40]),
    "negative": lambda table: field(table, "record/state/position").update(shape=[-7, -2]),
    "flat": lambda table: field(table, "level/model/vertices").update(shape=[40]),
    "shape that is a number": lambda table: field(table, "level/model/vertices").update(shape=7),
    "beyond the end": lambda table: field(table, "record/reward").update(first=10**9),
    "before the start": lambda table: field(table, "record/reward").update(first=-1),
    "another array": lambda table: field(table, "level/role").update(array="lvl32"),
    "no array": lambda table: field(table, "level/role").update(array="../../secret"),
    "another name": lambda table: field(table, "level/role").update(name="level/rule"),
    "unknown key": lambda table: field(table, "level/role").update(colour="red"),
    "missing": lambda table: table.pop(),
    "twice": lambda table: table.append(table[-1]),
    "one too many": lambda table: table.append(table[-1] | {"name": "record/extra"}),
    "a thousand bodies": lambda table: field(table, "level/model/radius").update(shape=[1000]),
    "no scenery": lambda table: field(table, "level/model/n_vertices").update(shape=[2]),
    "one circle more": lambda table: field(table, "level/model/radius").update(shape=[3]),
    "empty table": lambda table: table.clear(),
    "entry that is a number": lambda table: table.insert(0, 7),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("name", FIELDS)
def test_shard_refuses_fields_that_match_no_size(shard: Path, name: str) -> None:
    document = json.loads((shard / "zarr.json").read_text())
    FIELDS[name](document["attributes"]["fields"])
    (shard / "zarr.json").write_text(json.dumps(document))
    refused(shard)


@pytest.mark.parametrize(
    "level_ids",
    [
        [],
        [5, 9],
        [5, 9, 12, 13],
        [9, 5, 12],
        [5, 9, 1e300],
        [5, 5, 12],
        [-1, 5, 9],
        [5, 9, 2**31],
        [5, 9, "12"],
        [5, 9, [12]],
        [False, True, 12],
        3,
        None,
    ],
)
def test_shard_refuses_invalid_level_ids(shard: Path, level_ids: Any) -> None:
    document = json.loads((shard / "zarr.json").read_text())
    document["attributes"]["level_ids"] = level_ids
    (shard / "zarr.json").write_text(json.dumps(document))
    refused(shard)


ARRAYS: dict[str, Callable[[np.ndarray], dict[str, Any]]] = {
    "a component less": lambda x: {"data": x[:, :-1]},
    "a level more": lambda x: {"data": np.concatenate([x, x])},
    "one axis": lambda x: {"data": x.reshape(-1), "chunks": (x.size,)},
    "another type": lambda x: {"data": x.astype(np.float64)},
    "signed": lambda x: {"data": x.view(np.int32)},
    "one chunk": lambda x: {"data": x, "chunks": x.shape},
    "another codec": lambda x: {"data": x, "compressors": [GzipCodec()]},
    "not sharded": lambda x: {"data": x, "shards": None},
}


@pytest.mark.parametrize("name", ARRAYS)
def test_shard_refuses_arrays_that_do_not_fit_the_fields(shard: Path, name: str) -> None:
    group = zarr.open_group(shard, mode="r+")
    old = group["dyn32"]
    assert isinstance(old, zarr.Array)
    change = ARRAYS[name](np.asarray(old[:]))
    shape = change["data"].shape
    settings = {"chunks": (1, *shape[1:]), "shards": shape, "compressors": old.compressors} | change
    group.create_array("dyn32", **settings, overwrite=True)
    refused(shard)


def test_shard_refuses_a_group_in_place_of_an_array(shard: Path) -> None:
    zarr.open_group(shard, mode="r+").create_group("dyn32", overwrite=True)
    refused(shard)


NUMBERS = {
    "level/model/joint_a": 7,
    "level/model/joint_b": 255,
    "level/model/thruster_body": 7,
    "level/model/n_vertices": 5,
    "level/model/collision_mode": 3,
    "level/role": 4,
    "level/motor_binding": 4,
    "level/thruster_binding": 2,
    "record/action": 3,
    "record/timestep": -1,
}


@pytest.mark.parametrize("name", NUMBERS)
def test_shard_refuses_out_of_range_indices(tmp_path: Path, name: str) -> None:
    fields = made_fields("s", len(LEVELS))
    fields[name][..., -1] = NUMBERS[name]
    path = tmp_path / NAME
    write_shard(path, LEVELS, fields)
    assert f"its field {name} has numbers that size s cannot have" in refused(path)
    Shard(path).read(fields=["level/density"])


def test_action_range_depends_on_the_binding(tmp_path: Path) -> None:
    """Motors have a third choice in an action, thrusters do not."""
    for row, good in ((0, True), (4, False)):
        fields = made_fields("s", len(LEVELS))
        fields["record/action"][:, row] = 2
        path = tmp_path / str(row) / NAME
        write_shard(path, LEVELS, fields)
        if good:
            Shard(path).read()
        else:
            refused(path)


@pytest.mark.parametrize("name", ["record/done", "level/model/active"])
def test_shard_refuses_flags_other_than_0_and_1(tmp_path: Path, name: str) -> None:
    fields = made_fields("s", len(LEVELS))
    fields[name].view(np.uint8)[..., 0] = 2
    write_shard(tmp_path / NAME, LEVELS, fields)
    refused(tmp_path / NAME)


@pytest.mark.parametrize("row", [-1, len(LEVELS), 2**40])
def test_read_refuses_missing_rows(shard: Path, row: int) -> None:
    with pytest.raises(Failure, match="it has 3 rows, but others were requested"):
        Shard(shard).read([row])


@pytest.mark.parametrize("inside", ["zarr.json", "dyn32", "dyn32/zarr.json", "dyn32/c", "dyn32/c/0/0/0"])
def test_shard_does_not_follow_links(shard: Path, tmp_path: Path, inside: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    (shard / inside).rename(elsewhere)
    before = stored_bytes(shard)
    (shard / inside).symlink_to(elsewhere)
    assert "it has links to other places" in refused(shard)
    assert stored_bytes(shard) == before


@pytest.mark.parametrize("inside", ["zarr.json", "dyn32/zarr.json", "dyn32/c/0/0/0"])
def test_shard_does_not_wait_for_a_pipe(shard: Path, inside: str) -> None:
    (shard / inside).unlink()
    os.mkfifo(shard / inside)
    refused(shard)


def test_shard_ignores_consolidated_metadata(shard: Path) -> None:
    """Zarr's consolidated metadata would describe missing arrays."""
    zarr.consolidate_metadata(shard)
    (shard / "dyn8/zarr.json").write_text("{}")
    refused(shard)


@pytest.mark.parametrize("text", ["", "[]", "{" * 100_000, '{"zarr_format": 2}', "\0"])
def test_shard_refuses_an_invalid_group(shard: Path, text: str) -> None:
    (shard / "zarr.json").write_text(text)
    refused(shard)


def test_open_shard_refuses_another_size(shard: Path) -> None:
    assert open_shard(shard.parents[1], NAME, "s").size == Shard(shard).size
    with pytest.raises(
        Failure, match=r"its levels have size s, but the manifest says m\): run `levelproof verify .* --repair`"
    ):
        open_shard(shard.parents[1], NAME, "m")


def test_field_table_matches_the_dataclasses(shard: Path) -> None:
    table = {place.name: place for place in table_for(Shard(shard).size)}
    assert table["record/state/position"].shape == (7, 2)
    assert table["level/model/vertices"].shape == (5, 4, 2)
    assert (table["record/action"].array, table["record/action"].shape) == ("act", (6,))
    assert RECORD_STEPS not in {n for place in table.values() for n in place.shape}


@pytest.mark.parametrize(
    "name",
    [
        "/etc",
        "../other/s",
        "shards/../../x",
        "shards",
        "",
        ".",
        "shards/a.zarr",
        f"{NAME}/",
        f"{NAME}/dyn32",
        f"./{NAME}",
        f"x/{NAME}",
        NAME.upper(),
        NAME.removesuffix(".zarr"),
        "experts/../" + NAME,
        f"{NAME}\n",
        "manifest/" + NAME[7:],
    ],
)
def test_data_path_refuses_names_outside_of_the_split(tmp_path: Path, name: str) -> None:
    with pytest.raises(Failure, match=r"which can be neither a shard nor experts of this split") as raised:
        data_path(tmp_path, name)
    assert "\n" not in str(raised.value)


def test_data_path_refuses_links_inside_of_the_split(tmp_path: Path) -> None:
    split, experts = tmp_path / "s", NAME.replace(".zarr", ".npz").replace("shards", "experts")
    split.mkdir()
    assert data_path(split, NAME) == split / NAME
    assert data_path(split, experts) == split / experts
    (tmp_path / "link").symlink_to(split)
    assert data_path(tmp_path / "link", NAME) == tmp_path / "link" / NAME  # the user's own
    (tmp_path / "elsewhere").mkdir()
    (split / "shards").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Failure, match="leads elsewhere through a link"):
        data_path(split, NAME)
    (split / "experts").mkdir()
    (split / experts).symlink_to("/etc")
    with pytest.raises(Failure, match="leads elsewhere through a link"):
        data_path(split, experts)


def test_commands_refuse_hostile_shards_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    split = made_split(tmp_path, [[Label.SOLVED, Label.SOLVED]])
    (name,) = read_manifest(split).shards
    fields = Shard(split / name).read() | {"level/model/joint_a": np.full((1, 2), 200, np.int32)}
    shutil.rmtree(split / name)
    write_shard(split / name, [0, 1], fields)
    for words in (["show", str(split), "0", "-o", "level.png"], ["export", str(split), "0", "-o", "level.json"]):
        assert main([*words[:-1], str(tmp_path / words[-1])]) == 1
        (sentence,) = capsys.readouterr().err.splitlines()
        assert "level/model/joint_a has numbers that size s cannot have" in sentence
    assert main(["verify", str(split)]) == 1
    out = capsys.readouterr().out
    assert out.count("level/model/joint_a has numbers that size s cannot have") == 1


def test_commands_do_not_leave_the_split(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands that measure folder sizes do not leave it, either."""
    split = made_split(tmp_path / "data", [[Label.SOLVED]])
    (tmp_path / "secret").write_bytes(b"x" * 1000)
    (path,) = fragment_paths(split)
    table = pq.read_table(path)
    for name in (str(tmp_path), "../../..", "shards/../../../.."):
        column = table.schema.get_field_index("shard")
        changed = table.set_column(column, table.schema.field(column), [[name]])
        pq.write_table(changed, path, write_page_checksum=True)
        for words in (["inspect", str(split)], ["show", str(split), "0", "-o", str(tmp_path / "level.png")]):
            assert main(words) == 1
            printed = capsys.readouterr()
            assert printed.out == ""
            (sentence,) = printed.err.splitlines()
            assert "which can be neither a shard nor experts of this split" in sentence


@pytest.mark.parametrize("number", [np.nan, np.inf, -3e38])
def test_pictures_draw_or_refuse_impossible_states(tmp_path: Path, number: float) -> None:
    split = made_split(tmp_path, [[Label.SOLVED]])
    (name,) = read_manifest(split).shards
    shard = Shard(split / name)
    fields = {name: np.full_like(x, number) if x.dtype == np.float32 else x for name, x in shard.read().items()}
    fields["record/goal"][3], fields["record/done"][3] = True, True
    shutil.rmtree(shard.path)
    write_shard(shard.path, [0], fields)
    for suffix in (".png", ".gif", ".svg"):
        assert main(["show", str(split), "0", "-o", str(tmp_path / f"level{suffix}")]) in (0, 1)
    assert main(["export", str(split), "0", "-o", str(tmp_path / "level.json")]) == 2

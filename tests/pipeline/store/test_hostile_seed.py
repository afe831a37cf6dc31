"""Untrusted seed files: each is refused in one sentence, in bounded memory, before any of it is used."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from levelproof.configs.schema import hash_of
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.errors import Failure
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.formats import CONFIG_KEY, HASH_KEY
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.seed.columns import BUDGET_KEY, CONTENT_KEY, SCHEMA, SEED_KEY, WRITTEN
from levelproof.pipeline.store.seed.packed import MAX_BYTES, unpack_witnesses
from levelproof.pipeline.store.seed.shard import SeedShard
from tests.pipeline.made import honest_split

SENTENCE = 700  # characters
PLAIN = {"compression": "none", "compression_level": None, "write_page_checksum": False}

Table = dict[str, list[Any]]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    export_seed(honest_split(folder, 16, 1), None, folder / "levels.parquet")
    return folder / "levels.parquet"


def rewrite(good: Path, path: Path, change: Callable[[Table, dict[bytes, Any]], Any], **written: Any) -> Path:
    """Write a changed copy of a seed file."""
    columns = pq.read_table(good).to_pydict()
    about: dict[bytes, Any] = {
        key: value for key, value in pq.read_metadata(good).metadata.items() if not key.startswith(b"ARROW")
    }
    change(columns, about)
    table = pa.table(columns, schema=SCHEMA).replace_schema_metadata(about)
    pq.write_table(table, path, **WRITTEN | written)
    return path


def read_everything(path: Path) -> None:
    shard = SeedShard(path)
    rows = [row for row, steps in enumerate(shard.steps) if steps]
    fields = [field for field in table_for(shard.size) if field.name == "record/goal"]
    shard.restore([(shard, rows)], fields, [range(len(rows))])
    read_manifest(path).table.to_pylist()


def refused(path: Path) -> str:
    with pytest.raises(Failure) as raised:
        read_everything(path)
    sentence = str(raised.value)
    assert "\n" not in sentence
    assert len(sentence) < SENTENCE
    return sentence


def with_first(name: str, value: Any) -> Callable[[Table, Any], None]:
    """Replace a value of the first level with a witness."""

    def change(columns: Table, _: Any) -> None:
        row = next(i for i, witness in enumerate(columns["witness"]) if witness)
        columns[name][row] = value

    return change


def with_setting(name: str, value: Any) -> Callable[[Table, dict[bytes, Any]], None]:
    """Replace a setting, and the hash of all."""

    def change(_: Table, about: dict[bytes, Any]) -> None:
        config = json.loads(about[CONFIG_KEY]) | {name: value}
        about[CONFIG_KEY], about[HASH_KEY] = json.dumps(config), hash_of(config)

    return change


CHANGES: dict[str, Callable[[Table, dict[bytes, Any]], Any]] = {
    "negative id": lambda columns, _: columns["level_id"].__setitem__(0, -1),
    "id twice": lambda columns, _: columns["level_id"].__setitem__(1, columns["level_id"][0]),
    "ids that descend": lambda columns, _: columns["level_id"].reverse(),
    "unknown label": with_first("label", "excellent"),
    "label that escapes": with_first("label", "\x1b[31msolved"),
    "label without its witness": lambda columns, _: columns.update(label=["solved"] * len(columns["label"])),
    "witness without its label": with_first("label", "unsolved"),
    "unknown source": with_first("source", "luck"),
    "witness but no checksum": with_first("checksum", None),
    "witness but no steps": with_first("steps_to_goal", None),
    "no witness": with_first("witness", None),
    "steps beyond a record": with_first("steps_to_goal", 257),
    "no step": with_first("steps_to_goal", 0),
    "endless witness": with_first("witness", bytes(MAX_BYTES + 1)),
    "run before any entry": with_first("witness", bytes([9])),
    "entry without a run": with_first("witness", bytes([1])),
    "entry twice": with_first("witness", bytes([1, 7, 1, 7])),
    "action beyond a thruster's": with_first("witness", bytes([4, 8])),
    "unknown byte": with_first("witness", bytes([0, 255])),
    "runs beyond the end": with_first("witness", bytes([0, *[6 + 3 * 82] * 5, 7])),
    "made with what is no JSON": with_first("made_with", "{"),
    "made with a list": with_first("made_with", "[]"),
    "made with a nest": with_first("made_with", "[" * 50_000),
    "made with words for numbers": with_first("made_with", '{"versions": {"jax": 3}, "engine": "one", "device": []}'),
    "version before": lambda _, about: about.update({SEED_KEY: "1"}),
    "version after": lambda _, about: about.update({SEED_KEY: "3"}),
    "no budget": lambda _, about: about.pop(BUDGET_KEY),
    "budget that escapes": lambda _, about: about.update({BUDGET_KEY: "../../etc"}),
    "no digest": lambda _, about: about.update({CONTENT_KEY: "[]"}),
    "digests of nothing": lambda _, about: about.update({CONTENT_KEY: '["abc"]'}),
    "settings without their hash": lambda _, about: about.update({CONFIG_KEY: "{}"}),
    "size of another world": with_setting("size", "99-99-99-99"),
    "size that is a number": with_setting("size", 7),
    "no task": with_setting("task", None),
    "task of another kind": with_setting("task", {"frame_skip": "often"}),
    "a billion steps per action": with_setting("task", {"frame_skip": 10**9}),
    "distribution of another kind": with_setting("distribution", [1, 2]),
    "another sampler": with_setting("sampler_version", 10**6),
    "no engine": with_setting("engine_version", None),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_changed_seed_file_is_refused_in_one_sentence(change: Any, good: Path, tmp_path: Path) -> None:
    assert str(tmp_path) in refused(rewrite(good, tmp_path / "levels.parquet", change))


def test_content_of_other_lengths_is_refused(good: Path, tmp_path: Path) -> None:
    def change(columns: Table, about: dict[bytes, Any]) -> None:
        with_setting("distribution", "files")(columns, about)
        columns["content"] = [b"short"] * len(columns["level_id"])

    assert "it does not contain levels of size s" in refused(rewrite(good, tmp_path / "x.parquet", change))


def test_compressed_bombs_are_refused_before_they_are_unpacked(good: Path, tmp_path: Path) -> None:
    def witness(columns: Table, _: Any) -> None:
        columns["witness"][0] = bytes(2**27)

    def reason(columns: Table, _: Any) -> None:
        columns["label_reason"] = ["x" * 2**23 + str(i) for i in range(len(columns["label"]))]

    def metadata(_: Table, about: dict[bytes, Any]) -> None:
        about[b"more"] = bytes(2**25)

    for change, told in (witness, "more memory"), (reason, "more memory"), (metadata, "footer"):
        path = rewrite(good, tmp_path / "bomb.parquet", change, compression_level=1)
        assert told in refused(path)


def test_lengths_that_lie_are_refused(good: Path, tmp_path: Path) -> None:
    plain = rewrite(good, tmp_path / "plain.parquet", lambda *_: None, **PLAIN)
    column = pq.read_metadata(plain).row_group(0).column(SCHEMA.get_field_index("witness"))
    first, data = column.data_page_offset, plain.read_bytes()
    refusals = []
    for at in range(first, first + 64):  # the page's header, the levels of null, and the lengths
        plain.write_bytes(data[:at] + b"\x7f" + data[at + 1 :])
        try:
            shard = SeedShard(plain)
            shard.actions([row for row, steps in enumerate(shard.steps) if steps])
        except (Failure, ValueError) as error:
            refusals.append(str(error))
    assert len(refusals) > 16
    assert not any("\n" in sentence for sentence in refusals)


def test_unpacking_random_bytes_gives_actions_or_one_error() -> None:
    rng = np.random.default_rng(0)
    unpacked, refusals = 0, set()
    for _ in range(1000):
        packed = [bytes(rng.integers(0, rng.choice([8, 30, 256]), rng.integers(0, 6)).astype(np.uint8))] * 2
        try:
            action = unpack_witnesses(packed, rng.integers(1, 257, 2))
        except ValueError as error:
            refusals.add(str(error))
            continue
        unpacked += 1
        assert ((action >= 0) & (action < np.array(CHOICES)[:, None])).all()
    assert unpacked
    assert refusals
    assert all(sentence.startswith("its witnesses ") for sentence in refusals)


def test_commands_end_in_one_sentence(good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rewrite(good, tmp_path / "levels.parquet", CHANGES["made with a nest"])
    for words in (["inspect", str(path)], ["verify", str(path)], ["grow", str(path), "-o", str(tmp_path / "128k/s")]):
        assert main(words) != 0
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        assert "The seed file" in captured.out + captured.err

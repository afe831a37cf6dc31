"""Seed files: splits as ids and witnesses, read, grown and exported again without a changed bit."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from rich.console import Console

import levelproof
from levelproof.configs.errors import readable
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label
from levelproof.experts.witness.episode import repeated_rows
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.dataset.batch import Batch
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.exchange.seed import NAMED, _require_alike, export_seed
from levelproof.pipeline.jobs.grow import _job, grow
from levelproof.pipeline.jobs.grower import Grower, grow_unit
from levelproof.pipeline.jobs.schedule import Order, WorkUnit
from levelproof.pipeline.store.contents import table_for
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.store.seed import file
from levelproof.pipeline.store.seed.columns import SCHEMA, SEEDS, WRITTEN
from levelproof.pipeline.store.seed.packed import MAX_RUN, pack_witness, unpack_witnesses
from levelproof.pipeline.store.seed.shard import SeedShard, play_seeds
from levelproof.pipeline.store.seed.worlds import pack_worlds, unpack_worlds
from levelproof.pipeline.store.shard import Unlike
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import ROOT
from tests.pipeline.made import assert_same, honest_split, made_level, made_split
from tests.pipeline.verify.forged import forge, rows_labelled

ALL = np.ones(len(CHOICES), bool)
QUIET = Console(quiet=True)
INLINE = ["executor=inline"]
COSTS = {"env_steps", "evaluation_steps", "search_steps", "episodes", "learning_curve", "best_return"}
OTHERWISE = {"shard", "row", "config_hash", "label_reason", "steps_to_first_success", "command", "seconds", *COSTS}


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_split(tmp_path_factory.mktemp("split"), 16, 3)


@pytest.fixture(scope="module")
def seed(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("seed") / "levels.parquet"
    export_seed(split, None, path)
    return path


@pytest.fixture(scope="module")
def grown(seed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("grown") / "128k/s"
    assert grow(seed, path, INLINE, QUIET) == Exit.DONE
    return path


def episode(rng: np.random.Generator) -> np.ndarray:
    """Return random actions whose runs are short or long, some entries idle."""
    steps, held = int(rng.integers(1, RECORD_STEPS + 1)), int(rng.integers(1, 2 * MAX_RUN))
    columns = [np.repeat(rng.integers(0, most, steps // held + 1), held)[:steps] for most in CHOICES]
    return np.stack(columns, 1) * (rng.random(len(CHOICES)) < 0.5)


def test_witnesses_unpack_to_the_actions_that_were_packed() -> None:
    rng = np.random.default_rng(0)
    episodes = [episode(rng) for _ in range(200)]
    packed, steps = [pack_witness(one, ALL) for one in episodes], np.array([len(one) for one in episodes])
    unpacked = unpack_witnesses(packed, steps)
    for i, one in enumerate(episodes):
        np.testing.assert_array_equal(unpacked[: len(one), :, i], one)
        assert not unpacked[len(one) :, :, i].any()


def guides_decoder() -> Callable[[bytes, int], list[list[int]]]:
    codes = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/seeds.md").read_text(), re.DOTALL | re.MULTILINE)
    (code,) = [each for each in codes if "def actions" in each]
    names: dict[str, Any] = {}
    exec(code, names)
    return names["actions"]


def test_the_ten_lines_of_the_guide_decode_a_witness() -> None:
    decode, rng = guides_decoder(), np.random.default_rng(1)
    for _ in range(100):
        one = episode(rng)
        assert decode(pack_witness(one, ALL), len(one)) == one.tolist()


def test_witness_text_says_what_the_guide_decodes() -> None:
    assert levelproof.witness_text(b"", 1) == "0: nothing"
    assert levelproof.witness_text(bytes([1, 6 + 3 * 2, 6 + 2, 5, 6 + 1]), 4) == (
        "0-1: thruster 1 on\n2-3: motor 1 backward, thruster 1 on"
    )
    entries = {f"motor {k} {way}": (k, value) for k in range(4) for value, way in ((1, "forward"), (2, "backward"))}
    entries |= {f"thruster {k} on": (4 + k, 1) for k in range(2)}
    decode, rng = guides_decoder(), np.random.default_rng(2)
    for _ in range(100):
        one = episode(rng)
        said, before = np.zeros_like(one), -1
        lines = levelproof.witness_text(packed := pack_witness(one, ALL), len(one)).splitlines()
        for line in lines:
            span, _, words = line.partition(": ")
            first, _, last = span.partition("-")
            assert int(first) == before + 1
            before = int(last or first)
            for word in words.split(", ") if words != "nothing" else ():
                entry, value = entries[word]
                said[int(first) : before + 1, entry] = value
        assert said.tolist() == decode(packed, len(one))
        assert len(lines) == 1 + (one[1:] != one[:-1]).any(1).sum(), "a run is one line"


def test_pack_witness_drops_dead_entries() -> None:
    live = np.arange(len(CHOICES)) == 4
    unpacked = unpack_witnesses([pack_witness(np.ones((9, 6), int), live)], np.array([9]))
    assert unpacked[:9, :, 0].tolist() == [[0, 0, 0, 0, 1, 0]] * 9


def test_worlds_unpack_to_every_bit_of_the_level() -> None:
    level = made_level("s", 5)
    assert_same(arrays_of(unpack_worlds(pack_worlds(level), level.size)), arrays_of(level))


def test_seed_file_opens_with_the_rows_and_first_episodes_of_its_split(split: Path, seed: Path) -> None:
    ours, theirs = levelproof.open(seed), levelproof.open(split)
    assert (ours.rules, ours.size) == (theirs.rules, theirs.size)
    assert ours.fingerprint == theirs.fingerprint
    rows = ours._trajectories
    before = rows.fingerprint
    del rows.fingerprint
    rows.table = rows.table.set_column(
        rows.table.column_names.index("steps_to_goal"), "steps_to_goal", pc.add(rows.table["steps_to_goal"], 1)
    )
    assert rows.fingerprint != before, "other witnesses of the same levels are other trajectories"
    ours = levelproof.open(seed)
    indices, steps = np.arange(len(ours)), ours.manifest["steps_to_goal"].to_numpy()
    a, b = (data.read(indices, fields=["level", "record"]) for data in (ours, theirs))
    for name, values in b.fields.items():
        for i in indices:
            some = slice(None) if name.startswith("level/") else slice(steps[i])
            if name != "record/action":  # those of dead entries are 0
                assert a.fields[name][i][some].tobytes() == values[i][some].tobytes(), name
    first = np.arange(RECORD_STEPS)[:, None] < steps
    np.testing.assert_array_equal(
        np.where(first, a.goal.T, False), np.arange(RECORD_STEPS)[:, None] == steps - 1, "the end of the first episode"
    )
    np.testing.assert_array_equal(a.observation[0, : steps[0]], b.observation[0, : steps[0]])


def test_seed_records_repeat_their_first_episode(seed: Path) -> None:
    data = levelproof.open(seed)
    batch = data.read(np.arange(len(data)), fields=["record"], observation=None)
    steps = data.manifest["steps_to_goal"].to_numpy()
    for name, values in batch.fields.items():
        first = values[np.arange(RECORD_STEPS) < steps[:, None]]
        assert_same({name: first[repeated_rows(steps)]}, {name: values})


@pytest.mark.parametrize(
    ("kind", "length", "first"),
    [
        ("symbolic_flat", None, 0),
        ("symbolic_flat", 9, [0, 250, 30]),  # the second is padded
        ("symbolic_flat", None, [0, 3, 250]),
        pytest.param("symbolic_entity", None, 0, marks=pytest.mark.slow),
        pytest.param("symbolic_flat_padded", 9, [0, 250, 30], marks=pytest.mark.slow),
        pytest.param("pixels", 3, [0, 255, 30], marks=pytest.mark.slow),
        pytest.param("pixels", None, 0, marks=pytest.mark.slow),
    ],
)
def test_seeds_read_as_the_split_that_they_grow_into(
    seed: Path, grown: Path, kind: str, length: int | None, first: int | list[int]
) -> None:
    fields = ["level", "record/state", "record/timestep"]
    ours, theirs = (levelproof.open(path).read([4, 0, 4], length, first, fields, kind) for path in (seed, grown))
    assert_same_batch(ours, theirs)


def assert_same_batch(ours: Batch, theirs: Batch) -> None:
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
        assert isinstance(a, np.ndarray)
        assert (a.dtype, a.shape) == (b.dtype, b.shape), path
        np.testing.assert_array_equal(a, b, str(path))


@pytest.mark.parametrize(
    ("length", "prefetch", "more"),
    [
        (None, None, {}),
        (None, 5, {"process_index": 1, "process_count": 2}),
        (100, 3, {"subset": "train"}),
        pytest.param(20, None, {}, marks=pytest.mark.slow),  # shorter than most first episodes
    ],
)
def test_batches_of_seeds_are_those_of_the_split_that_they_grow_into(
    seed: Path, grown: Path, length: int | None, prefetch: int | None, more: dict[str, Any]
) -> None:
    """Two epochs, whose last batches are padded; from the third batch on."""
    fields = ["record/timestep", "record/goal", "level"]
    chosen: dict[str, Any] = {"seed": 2, "epochs": 2, "length": length, "fields": fields, **more}
    theirs = [*levelproof.open(grown).batches(8, **chosen)]
    before = levelproof.open(seed).batches(8, **chosen, prefetch=prefetch)
    first = [next(before), next(before)]
    rest = levelproof.open(seed).batches(8, **chosen, prefetch=prefetch, start=before.state())
    ours = [*first, *rest]
    assert not ours[-1].mask.any(1).all(), "windows that pad the last batch"
    for a, b in zip(ours, theirs, strict=True):
        assert_same_batch(a, b)


def test_seed_manifest_has_the_columns_of_its_split(split: Path, seed: Path) -> None:
    ours, theirs = read_manifest(seed).table, read_manifest(split).table
    assert ours.schema == theirs.schema
    for name in set(theirs.column_names) - OTHERWISE:
        assert ours[name].to_pylist() == theirs[name].to_pylist(), name
    chosen = read_manifest(seed, ["content_hash", "row"], [3, 20]).table
    assert chosen.to_pylist() == ours.take([3, 20]).select(["level_id", "content_hash", "row"]).to_pylist()


def test_grown_split_is_sound_and_exports_to_the_same_bytes(seed: Path, grown: Path, tmp_path: Path) -> None:
    findings = examine(grown)
    assert not findings.wrong
    assert findings.witnesses == findings.same_bits > 10
    export_seed(grown, None, tmp_path / "again.parquet")
    assert (tmp_path / "again.parquet").read_bytes() == seed.read_bytes()
    differing = {"shard", "row"}
    ours, theirs = (read_manifest(path).table.drop_columns([*differing]) for path in (grown, seed))
    assert ours.to_pylist() == theirs.to_pylist()


def test_grow_continues_and_takes_a_folder_of_parts(seed: Path, split: Path, grown: Path, tmp_path: Path) -> None:
    parts = tmp_path / "parts"
    export_seed(split, "level_id < 20", parts / "part-000.parquet")
    export_seed(split, "level_id >= 20", parts / "part-001.parquet")
    assert levelproof.open(parts).fingerprint == levelproof.open(seed).fingerprint
    out = tmp_path / "128k/s"
    assert grow(parts / "part-000.parquet", out, [*INLINE, "density=witness"], QUIET) == Exit.DONE
    assert len(read_manifest(out).level_ids) == 20
    assert grow(parts, out, [*INLINE, "density=witness"], QUIET) == Exit.DONE
    kept = ["level_id", "label", "content_hash", "label_reason", "config_hash"]
    assert read_manifest(out, kept).table.to_pylist() == read_manifest(grown, kept).table.to_pylist()
    before = [path.stat().st_mtime_ns for path in fragment_paths(out)]
    assert grow(parts, out, [*INLINE, "density=witness"], QUIET) == Exit.DONE
    assert [path.stat().st_mtime_ns for path in fragment_paths(out)] == before


def test_levels_are_read_from_their_file_alone(
    seed: Path, split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once the ids of a folder's files are known; workers ask for a unit's levels at a time."""
    export_seed(split, "level_id < 20", tmp_path / "part-000.parquet")
    export_seed(split, "level_id >= 20", tmp_path / "part-001.parquet")
    ids, opened = read_manifest(seed, []).level_ids, list[str]()
    read_manifest(tmp_path, ["row"], ids)
    bounded = file.bounded
    monkeypatch.setattr(file, "bounded", lambda path, kind: opened.append(path.name) or bounded(path, kind))
    late = ids[ids >= 20][1:2]
    assert read_manifest(tmp_path, ["row"], [-1, *late, 2**40]).level_ids.tolist() == late.tolist()
    assert opened == ["part-001.parquet"]
    shutil.copy(tmp_path / "part-000.parquet", tmp_path / "part-001.parquet")
    assert not len(read_manifest(tmp_path, ["row"], late).level_ids), "the file was rewritten"


def rewritten(seed: Path, path: Path, **columns: Any) -> Path:
    """Write a copy of a seed file in which these columns are others."""
    table = pq.read_table(seed)
    for name, values in columns.items():
        at = SCHEMA.get_field_index(name)
        table = table.set_column(at, SCHEMA.field(at), pa.array(values, SCHEMA.field(at).type))
    with pq.ParquetWriter(path, SCHEMA, **WRITTEN) as writer:
        writer.write_table(table)
        stored = pq.read_metadata(seed).metadata
        writer.add_key_value_metadata({key: value for key, value in stored.items() if key != b"ARROW:schema"})
    return path


@pytest.mark.slow
def test_grow_leaves_out_levels_whose_bits_differ(
    seed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = pq.read_table(seed)
    sums = table["checksum"].to_pylist()
    wrong = pc.index(table["label"], "solved").as_py()
    sums[wrong] ^= 1
    path, out = rewritten(seed, tmp_path / "wrong.parquet", checksum=sums), tmp_path / "128k/s"
    assert grow(path, out, INLINE, Console(stderr=True)) == Exit.FAILED
    assert len(read_manifest(out).level_ids) == table.num_rows - 1
    assert not examine(out).wrong, "levels that were left out are not missing"
    told = " ".join(capsys.readouterr().err.split())
    assert "Left out: 1 level," in told
    assert f"(level {table['level_id'][wrong]})" in told
    for read in (levelproof.open(path).__getitem__, levelproof.open(path).episodes):
        with pytest.warns(levelproof.EngineDiffers):
            read(0)


def test_unit_whose_ends_were_left_out_is_committed_beside_what_it_had(split: Path, tmp_path: Path) -> None:
    seed, out = tmp_path / "right.parquet", tmp_path / "128k/s"
    export_seed(split, "label = 'solved'", seed)
    ids, sums = (pq.read_table(seed)[name].to_pylist() for name in ("level_id", "checksum"))
    wrong = rewritten(seed, tmp_path / "wrong.parquet", checksum=[sums[0] ^ 1, *sums[1:-1], sums[-1] ^ 1])
    for path, units, kept in (wrong, [ids, ids], ids[1:-1]), (seed, [[ids[0], ids[-1]]], ids):
        out.mkdir(parents=True, exist_ok=True)
        for unit in units:
            grow_unit(_job(path, out, INLINE, read_manifest(path, []).config or {}), out, WorkUnit(tuple(unit)))
        assert read_manifest(out).level_ids.tolist() == kept
    assert len(fragment_paths(out)) == 2


def test_unit_that_was_committed_without_a_report_is_counted(seed: Path, tmp_path: Path) -> None:
    """As if the worker had died between commit and report: the driver orders the unit again."""
    manifest, out = read_manifest(seed, ["label"]), tmp_path / "128k/s"
    out.mkdir(parents=True)
    job, unit = _job(seed, out, INLINE, manifest.config or {}), WorkUnit(tuple(manifest.level_ids.tolist()))
    first, again = (grow_unit(job, out, unit) for _ in range(2))
    assert again.levels == first.levels == len(unit.level_ids)
    assert again.solved == first.solved > 0
    assert again.fragment == first.fragment


def test_worker_that_does_not_find_the_seed_file_ends_the_job(seed: Path, tmp_path: Path) -> None:
    """As on a machine of a cluster that lacks the file, or has an older one."""
    manifest, out = read_manifest(seed, []), tmp_path / "128k/s"
    out.mkdir(parents=True)
    known, unknown = int(manifest.level_ids[0]), 10**6
    for path, ids, missing in (tmp_path / "none.parquet", [known], known), (seed, [known, unknown], unknown):
        job = replace(_job(seed, out, INLINE, manifest.config or {}), level_files=str(path))
        (outcome,) = Grower(job, out).work(Order([WorkUnit(tuple(ids))]), 0).outcomes
        assert outcome.summary is None
        assert f"does not find level {missing} in the seed files at {path}: put them into a folder" in outcome.fatal


def test_the_file_with_an_invalid_row_is_named(seed: Path, tmp_path: Path) -> None:
    rows = read_manifest(seed, ["label"]).table
    labels = rows.column("label").to_pylist()
    other = tmp_path / "other.parquet"
    other.write_bytes(seed.read_bytes())
    solved, unsolved = ([labels.index(label)] for label in (Label.SOLVED, Label.UNSOLVED))
    parts = [(SeedShard(seed), solved), (SeedShard(other), unsolved)]
    with pytest.raises(Failure, match=f"{other} is damaged .it has no witness for a level that should have one"):
        play_seeds(parts, [[0], [1]], ["level/state/position"])


def test_a_setting_of_jax_is_not_reported_as_damage(seed: Path) -> None:
    shard = SeedShard(seed)
    with jax.enable_x64(True):
        for read in (lambda: shard.restore([(shard, [0])], table_for(shard.size), [[0]]), lambda: read_manifest(seed)):
            with pytest.raises(ValueError, match="jax_enable_x64 is on"):
                read()


def test_grow_refuses_another_name_and_foreign_settings(seed: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="-o data/128k/s"):
        grow(seed, tmp_path / "256k/s", INLINE, QUIET)
    with pytest.raises(UserError, match="does not accept size=m"):
        grow(seed, tmp_path / "128k/s", ["size=m"], QUIET)
    with pytest.raises(UserError, match="There is no seed file at"):
        grow(tmp_path / "none.parquet", tmp_path / "128k/s", INLINE, QUIET)


def test_export_refuses_a_row_that_its_episode_belies(split: Path, tmp_path: Path) -> None:
    forged, out = Path(shutil.copytree(split, tmp_path / "forged")), tmp_path / "no.parquet"
    (solved, *_) = rows_labelled(forged, Label.SOLVED)
    forge(forged, lambda row: row.update(steps_to_goal=row["steps_to_goal"] + 1), [solved["level_id"]])
    sentence = f"The first episode of level {solved['level_id']} does not end at the goal as its row says"
    with pytest.raises(Failure, match=sentence):
        export_seed(forged, None, out)
    assert not out.exists()


def test_export_refuses_more_levels_than_a_seed_file_may_have(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("levelproof.pipeline.exchange.seed.SEEDS", replace(SEEDS, max_rows=3))
    with pytest.raises(UserError, match=r"at most 3 levels, not \d+: write several files to one folder"):
        export_seed(split, None, tmp_path / "all.parquet")


def test_condition_that_leaves_out_levels_that_differ_is_shown_whole(tmp_path: Path) -> None:
    for count, shown in (NAMED, True), (NAMED + 1, False):
        ids = list(range(MAX_LEVEL_ID - count, MAX_LEVEL_ID))
        with pytest.raises(Failure) as error:
            _require_alike([Unlike(tmp_path, ids, ids, count)], "label = 'solved'")
        condition = f"(label = 'solved') AND level_id NOT IN ({', '.join(map(str, ids))})"
        assert (condition in readable(str(error.value))) == shown


def test_export_refuses_settings_that_no_seed_file_can_have(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skipping, out = made_split(tmp_path / "skipping", [[Label.SOLVED]], "task.frame_skip=100"), tmp_path / "no.parquet"
    with pytest.raises(UserError, match=r"task.frame_skip is 100, and seed files have at most 64\): export it to"):
        export_seed(skipping, None, out)
    monkeypatch.setattr("levelproof.configs.schema.SAMPLER_VERSION", 99)
    with pytest.raises(UserError, match="but this levelproof has version 99: export it"):
        export_seed(split, None, out)
    assert not out.exists()

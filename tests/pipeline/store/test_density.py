"""Densities: each restores the same bits, and recomputed states are checked against checksums and key frames."""

import errno
import json
import shutil
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from levelproof.configs.compose import compose_job
from levelproof.configs.errors import ConfigError
from levelproof.configs.schema import KEYS_EVERY
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.steps import EnvSteps
from levelproof.experts.witness import resume
from levelproof.experts.witness.resume import checksum, timesteps
from levelproof.experts.witness.witness import Record, replay
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store import density, seal
from levelproof.pipeline.store.contents import blank_row, table_for
from levelproof.pipeline.store.density import CHECKSUM, key_rows, task_states
from levelproof.pipeline.store.fields import arrays_of, same_bits, tree_of
from levelproof.pipeline.store.formats import Encoding, field_table
from levelproof.pipeline.store.layout import split_path
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.store.merge import Place
from levelproof.pipeline.store.packing import pack, unpack
from levelproof.pipeline.store.shard import EngineDiffers, Shard, read_together, stored_bytes, write_shard
from levelproof.pipeline.store.split import writing
from tests.pipeline.made import assert_same, made_fields, made_job, made_verdict

IDS = [5, 9, 12, 13]
NAME = "shards/000000000005-000000000013-0123abcd.zarr"
WITNESS = Encoding("witness")
FREE = ("record/action", "record/done", "record/goal", "record/timestep", "level/role", "level/state/position")


@cache
def played(size: str = "s", rules: TaskParams = DEFAULT_RULES) -> dict[str, np.ndarray]:
    """Return every field of simulated records of random play, with episodes of many lengths."""
    count = len(IDS)
    levels = jax.tree.map(np.asarray, sample_levels(np.arange(count, dtype=np.int32), SIZES[size], Distribution()))
    action = np.repeat(np.random.default_rng(3).integers(0, 2, (32, 6, count)), 8, axis=0).astype(np.int32)
    return arrays_of(levels, "level/") | arrays_of(replay(levels, action, rules), "record/")


def write(folder: Path, encoding: Encoding, fields: dict[str, np.ndarray] | None = None) -> Shard:
    path = folder / encoding.density / NAME
    write_shard(path, IDS, fields or played(), encoding)
    return Shard(path)


@pytest.fixture(autouse=True)
def engine_warnings_fail_tests() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", EngineDiffers)
        yield


def changed(shard: Shard, change: Callable[[dict[str, np.ndarray]], None]) -> Shard:
    """Change a shard's stored numbers and write it with valid checksums."""
    table = table_for(shard.size, shard.encoding)
    group = zarr.open_group(shard.path, mode="r+")
    packed = {name: np.asarray(group[name][:]) for name in shard.arrays}  # type: ignore[index]
    mask = {"witness": blank_row(shard.size, table)} if "witness" in packed else {}
    packed |= {name: packed[name] ^ mask[name] for name in mask}
    stored = {name: np.moveaxis(x, 0, -1).copy() for name, x in unpack(packed, table).items()}
    change(stored)
    for name, values in pack(stored, table).items():
        group[name][:] = values ^ mask.get(name, values.dtype.type(0))  # type: ignore[index]
    return Shard(shard.path)


def test_played_records_cover_the_difficult_cases() -> None:
    done, contacts = played()["record/done"], played()["record/state/contact_active"]
    assert done.any()
    assert not done.all(1).any()
    assert contacts.any()
    _, there = key_rows(done, 32)
    assert 0 < there.sum() < there.size


@pytest.mark.parametrize("encoding", [Encoding("resume"), WITNESS, Encoding("witness", 8), Encoding("witness", 256)])
def test_every_density_restores_every_bit(tmp_path: Path, encoding: Encoding) -> None:
    """A full shard written from the result has the same files as the original."""
    full, other = write(tmp_path, Encoding()), write(tmp_path, encoding)
    assert Shard(other.path).encoding == encoding
    assert_same(other.read(), played())
    assert stored_bytes(other.path) < stored_bytes(full.path)
    write_shard(tmp_path / "back.zarr", IDS, other.read())
    assert files(tmp_path / "back.zarr") == files(full.path)


def files(shard: Path) -> dict[str, bytes]:
    return {str(path.relative_to(shard)): path.read_bytes() for path in shard.rglob("*") if path.is_file()}


@pytest.mark.campaign
@pytest.mark.parametrize("size", ["m", "l"])
@pytest.mark.parametrize("encoding", [Encoding("resume"), WITNESS], ids=lambda encoding: encoding.density)
def test_every_density_restores_every_bit_of_larger_levels(tmp_path: Path, size: str, encoding: Encoding) -> None:
    assert_same(write(tmp_path, encoding, played(size)).read(), played(size))


@pytest.mark.parametrize("density", ["full", "resume", "witness"])
def test_read_returns_the_requested_rows_and_fields(tmp_path: Path, density: Any) -> None:
    shard = write(tmp_path, Encoding(density))
    assert_same(
        shard.read([2, 0, 2], FREE), {name: played()[name][..., [2, 0, 2]] for name in played() if name in FREE}
    )
    wanted = ("record/reward", "record/state/position")
    assert_same(shard.read([3], wanted), {name: played()[name][..., [3]] for name in played() if name in wanted})
    nothing = shard.read([])
    assert {name: x.shape for name, x in nothing.items()} == {name: (*x.shape[:-1], 0) for name, x in played().items()}


def test_read_does_not_start_the_engine_for_stored_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards = [write(tmp_path, Encoding("resume")), write(tmp_path, WITNESS)]

    def start(*_: Any) -> None:
        raise AssertionError("the engine was started")

    monkeypatch.setattr(density, "resume", start)
    for shard in shards:
        shard.read(fields=FREE)
    shards[0].read(fields=[name for name in played() if name.startswith("record/state/")])
    with pytest.raises(AssertionError, match="was started"):
        shards[1].read(fields=["record/reward"])


def test_read_records_contacts_only_on_request(tmp_path: Path, monkeypatch: Any) -> None:
    shard, asked = write(tmp_path, WITNESS), []
    monkeypatch.setattr(density, "resume", lambda *words: asked.append(words[-1]) or resume.resume(*words))
    shard.read(fields=["record/state/position", "record/action"])
    assert asked == [{"state/position"}]


def test_read_together_mixes_densities(tmp_path: Path) -> None:
    full, resumed, witness = (write(tmp_path, Encoding(density)) for density in ("full", "resume", "witness"))
    arrays = read_together([(witness, [1]), (full, [0, 3]), (resumed, [2]), (witness, [2])])
    assert_same(
        {name: np.moveaxis(x, 0, -1) for name, x in arrays.items()},
        {name: x[..., [1, 0, 3, 2, 2]] for name, x in played().items()},
    )


def ulp(stored: dict[str, np.ndarray], name: str, key: int, level: int) -> None:
    """Change one number of the last body to the next float."""
    x = stored[name][key, ..., level]
    flat = x.reshape(-1).view(np.uint32).copy()
    flat[np.flatnonzero(flat)[-1]] += 1
    stored[name][key, ..., level] = flat.view(x.dtype).reshape(x.shape)


@pytest.fixture
def keyed() -> tuple[int, int]:
    """Return a level with a key frame, and the frame's row."""
    at, there = key_rows(played()["record/done"], 32)
    level = int(np.flatnonzero(there[0])[0])
    return level, int(at[0, level])


def test_read_warns_of_differing_states_and_resets_at_key_frames(tmp_path: Path, keyed: tuple[int, int]) -> None:
    """The stored key frame differs from the engine's state by one unit in the last place."""
    level, row = keyed
    here, warning = played()["record/state/position"], f"for level {IDS[level]} from step {row} on"
    shard = changed(write(tmp_path, WITNESS), lambda stored: ulp(stored, "key/state/position", 0, level))
    for fields in (None, ["record/state/position"]):  # with any request
        with pytest.warns(EngineDiffers, match=rf"1 of 4 levels of the shard .*, {warning}"):
            positions = shard.read(fields=fields)["record/state/position"]
        differs = positions.view(np.uint32) != here.view(np.uint32)
        assert not np.delete(differs, level, -1).any()
        assert not differs[:row].any()
        assert differs[row].sum() == 1  # the key frame is returned as stored
        assert differs[row + 1 :].any()  # and the engine continues from it
        np.testing.assert_allclose(positions[row + 1], here[row + 1], atol=1e-4)
    assert shard.unlike([0, 1, 2, 3]).tolist() == [row if i == level else -1 for i in range(4)]
    shard.read([level], ["record/done"])  # no simulation, no warning


def test_read_warns_of_a_differing_checksum(tmp_path: Path) -> None:
    def change(stored: dict[str, np.ndarray]) -> None:
        stored[CHECKSUM][3, 2] ^= 1

    shard = changed(write(tmp_path, WITNESS), change)
    with pytest.warns(EngineDiffers, match=f"for level {IDS[2]} from step 96 on"):
        assert_same(shard.read(), played())


def test_read_warns_of_differing_episode_ends(tmp_path: Path) -> None:
    """The stored ends are returned, whatever the engine computes."""
    for encoding, run in ((Encoding("resume"), 1), (WITNESS, 32)):
        shard = write(tmp_path, encoding)
        done = played()["record/done"]
        level = int(np.flatnonzero(done.any(0))[0])
        row = int(done[:, level].argmax())

        def change(stored: dict[str, np.ndarray], row: int = row, level: int = level) -> None:
            stored["record/done"][row, level] = False

        shard = changed(shard, change)
        assert shard.unlike([level])[0] == row // run * run
        with pytest.warns(EngineDiffers):
            assert not shard.read()["record/done"][row, level]


def test_checksum_depends_on_every_bit_of_a_state() -> None:
    states = task_states(played(), "record/state/", played()["record/timestep"])
    rows = np.arange(256)[:, None]
    before = checksum(states, rows)
    rng = np.random.default_rng(0)
    for x in jax.tree.leaves(states):
        for _ in range(20):
            at = tuple(rng.integers(0, n) for n in x.shape)
            for bit in range(8 * x.itemsize if x.dtype != bool else 1):
                raw = x.view(f"u{x.itemsize}")
                raw[at] ^= 1 << bit
                changes = np.argwhere(checksum(states, rows) != before) if bit in (0, 31) else None
                assert changes is None or changes.tolist() == [[at[0], at[-1]]]
                raw[at] ^= 1 << bit


def test_checksum_follows_the_docs() -> None:
    """Word by word, in Python's integers."""
    states = task_states(played(), "record/state/", played()["record/timestep"])
    row, level, total = 7, 1, 0
    words = np.concatenate([
        np.atleast_1d(x[row, ..., level]).reshape(-1).view(np.uint32) if x.dtype == np.float32
        else np.atleast_1d(x[row, ..., level]).reshape(-1).astype(np.uint32)
        for x in jax.tree.leaves(states)
    ])  # fmt: skip
    for i, word in enumerate(words.tolist()):
        h = word ^ ((row * len(words) + i) * 0x9E3779B9 % 2**32)
        h = (h ^ h >> 16) * 0x85EBCA6B % 2**32
        h = (h ^ h >> 13) * 0xC2B2AE35 % 2**32
        total += h ^ h >> 16
    assert checksum(states, np.arange(256)[:, None])[row, level] == total % 2**32


def test_timesteps_follow_from_episode_ends() -> None:
    assert same_bits(timesteps(played()["record/done"]), played()["record/timestep"]).all()


@pytest.mark.parametrize("density", ["resume", "witness"])
def test_write_shard_refuses_records_that_cannot_be_recomputed(tmp_path: Path, density: Any) -> None:
    """Such records come from another machine, or have been changed."""
    fields = {name: x.copy() for name, x in played().items()}
    fields["record/reward"][200, 2] += 1
    with pytest.raises(Failure, match=f"cannot recompute record/reward of level 12, .*density={density} leaves"):
        write(tmp_path, Encoding(density), fields)
    assert not (tmp_path / density).exists()


@pytest.mark.campaign
def test_read_recomputes_with_the_shards_rules(tmp_path: Path) -> None:
    rules = TaskParams(frame_skip=3, max_timesteps=40, dense_reward_scale=0.5)
    fields = played("s", rules)
    with pytest.raises(Failure, match="cannot recompute"):
        write(tmp_path, WITNESS, fields)
    assert_same(write(tmp_path, replace(WITNESS, rules=rules), fields).read(), fields)


ABOUT: dict[str, dict[str, Any]] = {
    "density full": {"density": "full"},
    "density resume": {"density": "resume"},
    "unknown density": {"density": "dense"},
    "density in a list": {"density": ["witness"]},
    "another key_every": {"key_every": 16},
    "key_every 0": {"key_every": 0},
    "key_every as a float": {"key_every": 32.0},
    "key_every as a string": {"key_every": "32"},
    "key_every beyond the record": {"key_every": 512},
    "env steps that never end": {"task": {"frame_skip": 10**9}},
    "frame_skip as a string": {"task": {"frame_skip": "2"}},
    "task that is a number": {"task": 7},
    "task with an unknown setting": {"task": {"gravity": 1.0}},
}


@pytest.fixture(scope="module")
def witness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("good"), WITNESS).path


@pytest.mark.parametrize("name", ABOUT)
def test_shard_refuses_invalid_encodings(witness: Path, tmp_path: Path, name: str) -> None:
    path = Path(shutil.copytree(witness, tmp_path / NAME))
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"] |= ABOUT[name]
    (path / "zarr.json").write_text(json.dumps(document))
    with pytest.raises(Failure) as raised:
        Shard(path).read()
    sentence = str(raised.value)
    assert sentence.startswith("The shard ")
    assert "\n" not in sentence
    assert len(sentence) < 600


def test_shard_refuses_arrays_of_wrong_shapes(witness: Path, tmp_path: Path) -> None:
    """Whatever the field table says: one key frame too few, or checksums of other runs."""
    for cut in (4, -4):
        path = Path(shutil.copytree(witness, tmp_path / str(cut) / NAME))
        group = zarr.open_group(path, mode="r+")
        data = np.asarray(group["witness"][:])  # type: ignore[index]
        data = data[:, :cut] if cut < 0 else np.pad(data, [(0, 0), (0, cut)])
        blosc = BloscCodec(cname="zstd", clevel=9, shuffle="noshuffle", typesize=1)
        group.create_array("witness", data=data, chunks=(1, data.shape[1]), shards=data.shape,
                           compressors=[blosc, Crc32cCodec()], overwrite=True)  # fmt: skip
        with pytest.raises(Failure, match="does not have the shape and type that its fields need"):
            Shard(path).read(fields=["record/action"])


def test_read_terminates_on_impossible_states(tmp_path: Path) -> None:
    """Numbers that no engine produces, in key frames too."""

    def change(stored: dict[str, np.ndarray]) -> None:
        for name, x in stored.items():
            if x.dtype == np.float32:
                x.reshape(-1).view(np.uint32)[:] = made[name] if name in made else np.uint32(0x7FC00001)

    made = {name: x.reshape(-1).view(np.uint32) for name, x in made_fields("s", len(IDS)).items() if x.dtype == "f4"}
    shard = changed(write(tmp_path, WITNESS), change)
    with pytest.warns(EngineDiffers):
        shard.read()


def test_field_tables_have_no_overlaps_in_any_encoding() -> None:
    for encoding in (Encoding(), Encoding("resume"), *(Encoding("witness", every) for every in KEYS_EVERY)):
        table = table_for(SIZES["m"], encoding)
        for array in dict.fromkeys(field.array for field in table):
            ends = np.cumsum([0] + [field.extent for field in table if field.array == array])
            assert [field.first for field in table if field.array == array] == ends[:-1].tolist()
    assert field_table(made_fields("m")) == list(table_for(SIZES["m"]))


def test_density_does_not_change_the_config_hash() -> None:
    jobs = [compose_job(words) for words in ([], ["density=witness", "key_every=8"])]
    assert jobs[0].density == "full"
    assert jobs[0].hash == jobs[1].hash
    with pytest.raises(ConfigError, match="key_every is 33: choose one of 2, 4"):
        compose_job(["density=witness", "key_every=33"])
    with pytest.raises(ConfigError, match=r"task.frame_skip is 65: above 64, use density=full"):
        compose_job(["density=witness", "task.frame_skip=65"])


def test_state_fields_match_those_of_records() -> None:
    """Checksums cover these fields, in the order of the dataclasses."""
    record = tree_of(Record, played(), "record/")
    states = task_states(played(), "record/state/", played()["record/timestep"])
    assert list(arrays_of(states)) == [
        *(f"state/{name}" for name in arrays_of(record.state)),
        "timestep",
        "last_distance",
    ]
    assert isinstance(tree_of(Level, played(), "level/"), Level)


def test_convert_writes_a_few_levels_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps the order of the places, whatever the densities of their shards."""
    monkeypatch.setattr(seal, "CONVERTED", 2)
    witness, full = write(tmp_path, WITNESS), write(tmp_path, Encoding())
    places = [Place(shard.path, row, IDS[row]) for shard, row in ((full, 0), (witness, 1), (witness, 2))]
    paths = iter(tmp_path / f"{i}.zarr" for i in range(9))
    converted = list(seal.convert(places, "resume", 32, lambda: next(paths)))
    assert [[place.level_id for place in group] for group in converted] == [IDS[:2], IDS[2:3]]
    for place in (place for group in converted for place in group):
        shard = Shard(place.shard)
        assert (shard.encoding.density, shard.level_ids[place.row]) == ("resume", place.level_id)
        i = IDS.index(place.level_id)
        assert_same(shard.read([place.row]), {name: x[..., i : i + 1] for name, x in played().items()})


def test_convert_refuses_differing_states(tmp_path: Path, keyed: tuple[int, int]) -> None:
    """The stored states cannot be recomputed on this machine."""
    level, row = keyed
    shard = changed(write(tmp_path, WITNESS), lambda stored: ulp(stored, "key/state/position", 0, level))
    with pytest.raises(Failure, match=f"states that differ from the stored ones for 1 of 1 .* {row} on: read"):
        list(seal.convert([Place(shard.path, level, IDS[level])], "full", 32, lambda: tmp_path / "new.zarr"))
    assert not (tmp_path / "new.zarr").exists()


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """Return a split of two units, each with two of the records."""
    fields, job = played(), made_job(str(tmp_path / "data"), "size=s")
    path = split_path(job.out, job.budget, job.size)
    path.mkdir(parents=True)
    for ids in ((0, 1), (2, 3)):
        mine = {name: x[..., ids] for name, x in fields.items()}
        level, record = tree_of(Level, mine, "level/"), tree_of(Record, mine, "record/")
        verdicts = [made_verdict(), made_verdict()]
        commit(job, path, WorkUnit(ids), UnitResult(np.array(ids), level, record, verdicts, EnvSteps()))
    return path


def levelproof(*words: object) -> int:
    return main([str(word) for word in words])


def assert_whole(split: Path, density: str) -> None:
    rows = read_manifest(split).table
    assert rows["level_id"].to_pylist() == [0, 1, 2, 3]
    assert_same(read_rows(split, rows), played())
    assert {Shard(split / name).encoding.density for name in rows["shard"].to_pylist()} == {density}
    shards = {f"shards/{path.name}" for path in (split / "shards").iterdir()}
    assert shards == set(rows["shard"].to_pylist())  # and no other shards exist
    assert len(fragment_paths(split)) == len(read_manifest(split).fragments)


def test_seal_converts_a_split_and_back(split: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert levelproof("seal", split, "--rows", 2, "--density", "witness", "--key-every", 16) == 0
    assert_whole(split, "witness")
    (fragment, *_) = read_manifest(split).fragments
    assert fragment.densities == {"density=witness key_every=16"}
    other = made_job(str(split.parents[1]))
    with pytest.raises(UserError, match="has density=witness key_every=16"), writing(other, print):
        pass
    assert levelproof("seal", split, "--rows", 2, "--density", "witness", "--key-every", 16) == 0
    assert "there was nothing to seal" in capsys.readouterr().out
    assert levelproof("seal", split, "--density", "full") == 0
    assert_whole(split, "full")
    assert levelproof("seal", split, "--density", "witness", "--key-every", 5) == 2
    assert "--key-every is 5: choose one of 2, 4" in capsys.readouterr().err


@pytest.mark.parametrize("step", ["write_shard", "merge_shards", "write_fragment"])
def test_failed_conversion_changes_nothing(split: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(seal, step, fail)
    assert levelproof("seal", split, "--density", "resume") == 1
    assert_whole(split, "full")


def test_seal_unifies_a_split_of_two_densities(split: Path) -> None:
    first, _ = read_manifest(split, []).fragments
    seal.seal(split, [seal.Piece.of(first)], density=("resume", 32))
    rows = read_manifest(split).table
    assert_same(read_rows(split, rows), played())
    assert levelproof("seal", split, "--density", "witness") == 0
    assert_whole(split, "witness")

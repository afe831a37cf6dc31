"""Fuzzing targets, one per reader: each writes one mutated input, reads it, and checks what it read.

Readers reject inputs with the exceptions in `Refused`; any other exception is a finding.
"""

import json
import os
import shutil
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from io import BytesIO
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import google_crc32c
import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numcodecs import blosc  # pyright: ignore[reportAttributeAccessIssue]

from levelproof.configs.compose import _parse, compose_job
from levelproof.configs.convert import plain, typed
from levelproof.configs.errors import ConfigError
from levelproof.configs.numbers import parse_count
from levelproof.configs.schema import JobConfig
from levelproof.experts.labels import Label
from levelproof.experts.networks.saved import PolicyError
from levelproof.experts.training.slots import begin
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.files.entries import LevelFileError
from levelproof.levelgen.files.level_file import LevelFile, flaws, read_level_file, to_document, write_level_file
from levelproof.levelgen.identity.keys import MAX_LEVEL_ID
from levelproof.levelgen.level import size_of
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import LevelproofError
from levelproof.pipeline.read.kinetix.folder import open_folder, read_trajectories
from levelproof.pipeline.read.kinetix.zarr2 import BLOSC, FormatError
from levelproof.pipeline.store import bounds, hub, remote
from levelproof.pipeline.store.checkpoints import load_experts, save_experts
from levelproof.pipeline.store.contents import check_numbers, table_for
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.formats import Encoding
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.job_note import NoteError, note_job, read_note
from levelproof.pipeline.store.layout import BEGUN, DATA, FRAGMENT, JOB, MANIFEST, entries
from levelproof.pipeline.store.manifest import changes_text, differences, fragment_paths, read_manifest
from levelproof.pipeline.store.origins import place_of
from levelproof.pipeline.store.pieces import PieceCache
from levelproof.pipeline.store.shard import Shard, write_shard
from tests.pipeline.hostile.mutations import (
    mutate_bytes,
    mutate_document,
    mutate_json,
    mutate_word,
    put,
    random_value,
    remove,
)
from tests.pipeline.hostile.policies import policies
from tests.pipeline.hostile.seeds import seeds
from tests.pipeline.hostile.tables import mutate_parquet
from tests.pipeline.made import made_job, made_split, played_split
from tests.pipeline.read.kinetix.folder import GOLDEN

Target = Callable[[Random], None]
Refused = (LevelproofError, LevelFileError, ConfigError, FormatError, NoteError, PolicyError)
ENDS = (FormatError, NoteError)  # whose messages are ends of sentences


def require_possible(arrays: dict[str, np.ndarray], size: Any) -> None:
    """Check that indices are in range and flags are 0 or 1."""
    check_numbers({name: np.moveaxis(x, -1, 0) for name, x in arrays.items()}, size)
    for name, values in arrays.items():
        assert values.dtype != bool or not (np.ascontiguousarray(values).view(np.uint8) > 1).any(), name


def level_files(folder: Path) -> Target:
    """Level files, and links or pipes in their place."""
    level = jax.tree.map(np.asarray, sample_levels(np.array([3], np.int32), size_of("s")))
    document, path = to_document(LevelFile(level, TaskParams())), folder / "level.json"

    def target(random: Random) -> None:
        remove(path)
        put(path, mutate_json(document, random), random)
        level = read_level_file(path)
        require_possible(arrays_of(level.level, "level/"), level.level.size)
        assert all(np.isfinite(x).all() for x in arrays_of(level.level).values())
        assert not any(np.asarray(bad).any() for bad, _, _ in flaws(level.level))
        if random.random() < 0.02:
            write_level_file(level, folder / "again.json")

    return target


def kinetix_folders(folder: Path) -> Target:
    """Folders of the reference: metadata, chunks, and values in chunks."""
    source = GOLDEN / "s"
    chunks = {file.relative_to(source): file.read_bytes() for file in source.rglob("*") if file.is_file()}
    raw = {name: BLOSC.decode(data) for name, data in chunks.items() if not name.name.startswith(".")}

    shutil.copytree(source, folder / "theirs")

    def target(random: Random) -> None:
        names = random.sample(sorted(chunks), random.choice((1, 1, 2)))
        try:
            read(names, random)
        finally:
            for name in names:
                remove(folder / "theirs" / name)
                (folder / "theirs" / name).write_bytes(chunks[name])

    def read(names: list[Path], random: Random) -> None:
        for name in names:
            path, data = folder / "theirs" / name, chunks[name]
            path.unlink()
            if name.name.startswith("."):
                put(path, mutate_json(json.loads(data), random), random)
            elif random.random() < 0.5:
                put(path, mutate_bytes(data, random), random)
            else:
                decoded = bytearray(raw[name])
                for _ in range(random.choice((1, 3, 50))):
                    decoded[random.randrange(min(len(decoded), 3000))] = random.randrange(256)
                put(path, blosc.compress(bytes(decoded), b"zstd", 1, 0), random)
        opened = open_folder(folder / "theirs")
        for array in [array for array in opened.arrays if array.path.name in {name.parts[0] for name in names}]:
            trajectories = read_trajectories(array, 0, min(array.rows, 3))
            valid = [i for i, reason in enumerate(trajectories.wrong) if not reason]
            level = jax.tree.map(lambda x: x[..., valid], trajectories.level)  # noqa: B023
            require_possible(arrays_of(level, "level/"), opened.size)
            assert all(np.isfinite(x).all() for x in arrays_of(level).values())

    return target


SHARD = "shards/000000000000-000000000001-0123abcd.zarr"


def shards(folder: Path, density: str) -> Target:
    """Shards: metadata, chunk files, and chunks with valid checksums."""
    source = played_split(folder / "played")
    (name,) = (path.name for path in (source / "shards").iterdir())
    rows = Shard(source / "shards" / name).read([0, 1])
    encoding, good, path = Encoding(density), folder / "good" / SHARD, folder / "read" / SHARD  # type: ignore[arg-type]
    write_shard(good, [0, 1], rows, encoding)
    shutil.copytree(good, path)
    files = {file.relative_to(good): file.read_bytes() for file in good.rglob("*") if file.is_file()}
    fields = [field.name for field in table_for(size_of("s"))]
    stored = [field.name for field in table_for(size_of("s"), encoding) if field.name in fields]

    def target(random: Random) -> None:
        name = random.choice(sorted(files))
        try:
            remove(path / name)
            changed = mutate_file(name.name, files[name], random)
            put(path / name, changed, random)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about a differing engine
                shard = Shard(path)
                wanted = stored if random.random() < 0.9 else fields
                arrays = shard.read(range(min(2, len(shard.level_ids))), wanted)
            require_possible(arrays, shard.size)
            assert 0 <= shard.level_ids[0] <= shard.level_ids[-1] <= MAX_LEVEL_ID
        finally:
            remove(path / name)
            (path / name).write_bytes(files[name])

    return target


def mutate_file(name: str, data: bytes, random: Random) -> bytes:
    """Change a file of a shard."""
    if name == "zarr.json":
        return mutate_json(json.loads(data), random)
    if random.random() < 0.3:
        return mutate_bytes(data, random)
    index = np.frombuffer(data[-36:-4], "<u8").reshape(2, 2).copy()
    chunks = [data[first : first + length] for first, length in index.tolist()]
    if random.random() < 0.4:  # a false index
        index.reshape(-1)[random.randrange(4)] = random.choice(
            (0, 1, len(data), 2**32, 2**63, 2**64 - 1, len(chunks[0]))
        )
        body = data[:-36]
    else:
        i = random.randrange(2)
        chunk = chunks[i][:-4]
        if random.random() < 0.3:
            chunk = mutate_bytes(chunk, random)
        else:
            decoded = bytearray(blosc.decompress(chunk))
            for _ in range(random.choice((1, 3, 100))):
                decoded[random.randrange(len(decoded))] = random.choice((0, 1, 2, 7, 127, 255))
            chunk = blosc.compress(bytes(decoded), b"zstd", 1, random.choice((0, 1)), typesize=random.choice((1, 4)))
        chunks[i] = chunk + google_crc32c.value(chunk).to_bytes(4, "little")
        index[:, 1] = [len(chunk) for chunk in chunks]
        index[:, 0] = [0, len(chunks[0])]
        body = b"".join(chunks)
    footer = index.tobytes()
    return body + footer + google_crc32c.value(footer).to_bytes(4, "little")


def fragments(folder: Path) -> Target:
    """Fragments: footers, pages, metadata and rows; page checksums are valid, or not verified."""
    split = made_split(folder, [[Label.SOLVED, Label.UNSOLVED, Label.SOLVED]])
    (path,) = fragment_paths(split)
    data, table = path.read_bytes(), pq.read_table(path)
    in_groups = BytesIO()
    pq.write_table(pa.concat_tables([table] * 20), in_groups, row_group_size=7, write_page_checksum=True)
    bodies = [data, in_groups.getvalue()]

    def target(random: Random) -> None:
        remove(path)
        put(path, mutate_parquet(bodies, table, {}, random), random)
        checked = {**bounds.READ_OPTIONS, "page_checksum_verification": random.random() < 0.3}
        with patch.object(bounds, "READ_OPTIONS", checked):
            if path.is_symlink() or not path.is_file():
                assert not fragment_paths(split)
                return
            fragment, rows = read_fragment(path, None, np.array([1]) if random.random() < 0.3 else None)
            rows.to_pylist()
            changes_text(differences(fragment.config, {}))
            manifest = read_manifest(split, ["label", "shard", "experts"], compact=random.random() < 0.5)
            manifest.counts(np.ones(len(manifest.level_ids), bool))
            assert set(manifest.labels) <= {*Label}

    return target


def notes(folder: Path) -> Target:
    """Job notes, and file names in the folders of a split."""
    note_job(folder, made_job(), ["levelproof", "generate"], [(0, 7), (9, 9)])
    document, path = json.loads((folder / JOB).read_text()), folder / JOB
    names = [".000000000000-000000000001-0123abcd.begun", "000000000000-000000000001.parquet"]
    (folder / MANIFEST).mkdir()

    def target(random: Random) -> None:
        marked = folder / MANIFEST / "mark"
        with suppress(OSError, ValueError):
            marked = folder / MANIFEST / mutate_word(random.choice(names), random).replace("/", "_")
            put(marked, b"", random)
        try:
            for pattern in (FRAGMENT, BEGUN, DATA):
                for entry in entries(folder, MANIFEST, pattern, os.DirEntry.is_file):
                    assert not entry.is_symlink()
                    assert entry.is_file()
        finally:
            with suppress(OSError, ValueError):
                remove(marked)
        remove(path)
        put(path, mutate_json(document, random), random)
        if not path.exists():
            return
        note = read_note(folder)
        assert note.command.isprintable() or not note.command
        assert (note.level_ids[:, 0] <= note.level_ids[:, 1]).all()

    return target


def origins(folder: Path) -> Target:
    """Origins: the `file` of a row."""
    shutil.copytree(GOLDEN / "s", folder / "theirs")

    def target(random: Random) -> None:
        file = mutate_word(f"{folder}/theirs/{random.choice(('first', 'second'))}#1", random)
        if random.random() < 0.5:
            file = mutate_word(file, random)
        place = place_of(file)
        if place is not None:
            assert str(place) == file
            opened = open_folder(place.folder)
            read_trajectories(opened.array(place.array), 0, 1)

    return target


def checkpoints(folder: Path) -> Target:
    """Checkpoints of experts: archives, their arrays, and headers."""
    job = made_job("data", "expert.width=8", "expert.environments=24", "expert.attempts=8")
    ids, path, good = np.arange(2, dtype=np.int32), folder / "experts.npz", folder / "good.npz"
    levels = sample_levels(ids, size_of("s"), job.distribution)
    shapes = begin.eval_shape(levels, ids, no_success(len(ids)), job.expert)
    begun = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    save_experts(good, {i: KeptExpert(jax.tree.map(lambda x, i=i: x[i], begun), [0.0]) for i in range(2)})
    data = good.read_bytes()
    with np.load(good) as file:
        arrays = {name: file[name] for name in file.files}

    def mutated(random: Random) -> bytes:
        if random.random() < 0.4:
            return mutate_bytes(data, random)
        name, sink = random.choice([*arrays, "level_id", "curve"]), BytesIO()
        if random.random() < 0.5:
            with zipfile.ZipFile(sink, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
                for member, values in arrays.items():
                    part = BytesIO()
                    np.save(part, values)
                    raw = part.getvalue()
                    archive.writestr(
                        f"{member}.npy", mutate_bytes(raw[:300], random) + raw[300:] if member == name else raw
                    )
            return sink.getvalue()
        changed = {
            0: lambda x: x.astype(np.float64),
            1: lambda x: x.reshape(-1),
            2: lambda x: x[:1],
            3: lambda x: np.array(random_value(random), dtype=object),
            4: lambda x: np.full(x.shape, random.choice((-1, 2**31 - 1, 127))).astype(x.dtype),
            5: lambda x: np.array(7),
        }[random.randrange(6)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            np.savez(sink, **{**arrays, name: changed(arrays[name])})
        return sink.getvalue()

    def target(random: Random) -> None:
        remove(path)
        put(path, mutated(random), random)
        for level_id, kept in load_experts(path, job).items():
            assert type(level_id) is int
            assert 0 <= level_id <= MAX_LEVEL_ID
            assert isinstance(kept.curve, list)

    return target


def listings(folder: Path) -> Target:
    """Listings by a web server and the hub."""
    hub_files = [
        {"type": "file", "oid": "0123", "size": 77, "path": "1M/s/manifest/000000000000-000000000001.parquet"},
        {"type": "directory", "oid": "0124", "size": 0, "path": "1M/s/manifest"},
    ]
    index = b"000000000000-000000000001.parquet\n000000000002-000000000003.parquet\n"

    class FakeResponse:
        def __init__(self, data: bytes) -> None:
            self._data = data
            self.headers: dict[str, str] = {}

        def __enter__(self) -> "FakeResponse":
            return self

        def __exit__(self, *_: object) -> None:
            """Nothing to close."""

        def read(self, size: int = -1) -> bytes:
            return self._data if size < 0 else self._data[:size]

        def stream(self, **_: object) -> list[bytes]:
            return [self._data]

        def bytes(self) -> bytes:
            return self._data

    def target(random: Random) -> None:
        if random.random() < 0.5:
            data = mutate_json(hub_files, random)
            with patch.object(hub, "urlopen", lambda *_, **__: FakeResponse(data)), patch.object(hub, "PAUSE", 0.0):
                for path, about in remote.stored_in(Path("hf://datasets/me/levels/1M/s/manifest")).items():
                    assert ".." not in path.parts
                    assert type(about.size) is int
            return
        data = mutate_bytes(index, random)
        with patch.object(remote, "ask", lambda *_: data):
            there = Path("https://host/1M/s")
            for path in entries(there, MANIFEST, FRAGMENT, os.DirEntry.is_file):
                assert path.parent == there / MANIFEST

    return target


def pieces(folder: Path) -> Target:
    """Pieces in the cache of remote reads."""
    cache, piece = PieceCache(folder / "pieces", 10**9), bytes(range(256)) * 4
    cache.put("name-0", piece)
    path = folder / "pieces/name-0"
    data = path.read_bytes()

    def target(random: Random) -> None:
        remove(path)
        put(path, mutate_bytes(data, random), random)
        cache._checked.clear()
        found = cache.read("name-0", 3, 700)
        assert found is None or found == piece[3:700]

    return target


def overrides(folder: Path) -> Target:
    """Settings as typed, and as recorded in a split."""
    document = plain(made_job())
    settings = [
        "levels=64",
        "budget=11.5M",
        "expert.width=128",
        "distribution.joints=0.5",
        "out=my data",
        "size=3-1-0-7",
    ]

    def target(random: Random) -> None:
        setting = random.choice(settings)
        match random.randrange(20):
            case 0:
                job = compose_job([mutate_word(setting, random)])
                assert typed(JobConfig, plain(job)) == job
            case 1 | 2 | 3 | 4:
                _parse(mutate_word(setting, random)).value()
            case 5 | 6 | 7:
                assert parse_count(mutate_word("11.5M", random), "levels") > 0
            case 8 | 9:
                try:
                    size_of(mutate_word("8-8-8-4", random))
                except ValueError as error:
                    raise ConfigError(f"{error}.") from None
            case _:
                job = typed(JobConfig, mutate_document(document, random))
                assert len(job.hash) > 7

    return target


TARGETS: dict[str, Callable[[Path], Target]] = {
    "level files": level_files,
    "folders of the reference": kinetix_folders,
    "shards, full": partial(shards, density="full"),
    "shards, resume": partial(shards, density="resume"),
    "shards, witness": partial(shards, density="witness"),
    "fragments": fragments,
    "seeds": seeds,
    "notes and marks": notes,
    "origins": origins,
    "checkpoints": checkpoints,
    "listings": listings,
    "pieces": pieces,
    "settings": overrides,
    "policies": policies,
}

"""Splits and seed files with the names of the last version: they mean what they meant."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console

import levelproof
from levelproof.configs.compose import compose_job
from levelproof.configs.schema import RENAMED, decisive, hash_of
from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Exit
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.jobs.grow import grow
from levelproof.pipeline.jobs.regenerate import kept_settings
from levelproof.pipeline.look.diff import compare
from levelproof.pipeline.store.checkpoints import require_same_experts
from levelproof.pipeline.store.formats import CONFIG_KEY, HASH_KEY, VERSION_KEY
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.store.seed.columns import SEED_KEY, WRITTEN
from levelproof.pipeline.store.split import writing
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import here
from tests.pipeline.made import honest_split, made_job, made_split, renamed_before, rewrite

pytestmark = pytest.mark.slow

EARLIER = {new: old for old, new in RENAMED.items()}
OLD, NEW = "moved_success_rate", "perturbed_success_rate"
UNIT, UNITS = 16, 2
QUIET = Console(quiet=True)


def aged(split: Path, version: int = 8) -> Path:
    """Rewrite the fragments and the note of a split as an earlier version wrote them."""
    for path in fragment_paths(split):
        table = pq.read_table(path)
        about = _aged(table.schema.metadata) | {VERSION_KEY: str(version).encode()}
        at = table.schema.get_field_index("config_hash")
        hashes = pa.array([about[HASH_KEY].decode()] * table.num_rows)
        table = renamed_before(table.set_column(at, table.schema.field(at), hashes))
        rewrite(path, table if version >= 8 else table.drop(["engine"]), about)
    job: Any = SimpleNamespace(results=decisive(made_job().results, EARLIER))
    job.hash = hash_of(job.results)
    note_job(split, job, ["levelproof", "generate"], [(0, UNIT * UNITS - 1)])
    return split


def _aged(metadata: dict[bytes, bytes]) -> dict[bytes, bytes]:
    config = decisive(json.loads(metadata[CONFIG_KEY]), EARLIER)
    return metadata | {CONFIG_KEY: json.dumps(config).encode(), HASH_KEY: hash_of(config).encode()}


@pytest.fixture(scope="module")
def new(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_split(tmp_path_factory.mktemp("new"), UNIT, UNITS, experts=True)


@pytest.fixture
def old(new: Path, tmp_path: Path) -> Path:
    shutil.copytree(new, tmp_path / "128k/s")
    return aged(tmp_path / "128k/s")


@pytest.fixture(scope="module")
def seed(new: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A seed file of version 1."""
    folder = tmp_path_factory.mktemp("seed")
    export_seed(new, None, folder / "now.parquet")
    table = pq.read_table(folder / "now.parquet")
    about = _aged(pq.read_metadata(folder / "now.parquet").metadata) | {SEED_KEY: b"1"}
    del about[b"ARROW:schema"]
    path, before = folder / "before.parquet", renamed_before(table.replace_schema_metadata(None))
    options = WRITTEN | {"use_dictionary": [OLD if name == NEW else name for name in WRITTEN["use_dictionary"]]}
    with pq.ParquetWriter(path, before.schema, **options) as writer:
        writer.write_table(before)
        writer.add_key_value_metadata(about)
    return path


@pytest.mark.parametrize("version", [7, 8])
def test_old_manifest_has_todays_names(new: Path, old: Path, version: int) -> None:
    aged(old, version)
    ours, theirs = (read_manifest(split).table for split in (new, old))
    assert OLD in pq.read_schema(fragment_paths(old)[0]).names
    assert ours.schema == theirs.schema
    differing = {"engine"} if version == 7 else set()
    assert ours.drop_columns([*differing]).to_pylist() == theirs.drop_columns([*differing]).to_pylist()
    assert read_manifest(old, [NEW], [3, 20], compact=True).table.column_names == ["level_id", NEW]


def test_old_name_in_a_fragment_of_today_is_damage(old: Path) -> None:
    for path in fragment_paths(old):
        table = pq.read_table(path)
        pq.write_table(table.replace_schema_metadata(table.schema.metadata | {VERSION_KEY: b"9"}), path)
    with pytest.raises(levelproof.LevelproofError, match="is damaged"):
        read_manifest(old)


def test_old_split_continues(old: Path) -> None:
    job = made_job(str(old.parents[1]))
    with writing(job, print) as (split, manifest):
        assert (split, manifest.config, manifest.config_hash) == (old, job.results, job.hash)
    require_same_experts(made_job("data", "budget=1M", f"continue_from={old}"))
    assert here(["generate", f"levels={UNIT * UNITS}", f"out={old.parents[1]}"], old).stdout.startswith("Nothing to do")


def test_old_split_verifies_seals_and_equals_the_new_one(new: Path, old: Path) -> None:
    findings = examine(old)
    assert not findings.wrong
    assert findings.config == made_job().results
    facts = compare(new, old)
    assert (facts["settings"], facts["levels"], facts["only"]) == ({}, UNIT * UNITS, [0, 0])
    rows = read_manifest(old).table.drop_columns(["shard", "row"]).to_pylist()
    assert here(["seal", str(old)], old).returncode == 0
    (sealed,) = fragment_paths(old)
    assert NEW in pq.read_schema(sealed).names
    assert read_manifest(old).table.drop_columns(["shard", "row"]).to_pylist() == rows
    assert not examine(old).wrong


def test_regenerate_keeps_settings_with_old_names(tmp_path: Path) -> None:
    words = ["expert.perturbed_attempts=4", "search.new_action=0.4", "stop.robustness=0"]
    split = aged(made_split(tmp_path, [[Label.SOLVED]], *words))
    kept = kept_settings(read_manifest(split).config or {}, [])
    assert set(words) <= set(kept)
    assert compose_job([*kept, "budget=128k"]).hash == made_job("data", *words).hash


def test_old_seeds_open_and_grow(new: Path, seed: Path, tmp_path: Path) -> None:
    assert OLD in pq.read_schema(seed).names
    ours, theirs = levelproof.open(new, columns=[NEW]), levelproof.open(seed, columns=[NEW])
    assert ours.fingerprint == theirs.fingerprint
    assert ours.manifest[NEW].to_pylist() == theirs.manifest[NEW].to_pylist()
    assert not compare(new, seed)["settings"].keys() - {"witness"}
    out = tmp_path / "128k/s"
    assert grow(seed, out, ["executor=inline"], QUIET) == Exit.DONE
    assert not examine(out).wrong
    export_seed(out, None, tmp_path / "again.parquet")
    assert (tmp_path / "again.parquet").read_bytes() == (seed.parent / "now.parquet").read_bytes()
    aged(out)  # a split grown by the last version continues
    assert grow(seed, out, ["executor=inline"], QUIET) == Exit.DONE

"""Seed files without their levels: labels and witnesses by content hash, and the levels added again."""

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
from levelproof.configs.schema import FROM_FILES
from levelproof.levelgen.files.level_file import LevelFile, read_level_file, write_level_file
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.exchange.levels_elsewhere import add_levels
from levelproof.pipeline.exchange.seed import export_seed
from levelproof.pipeline.jobs.grow import grow
from levelproof.pipeline.learn import published
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.store.seed.columns import SCHEMA
from levelproof.pipeline.store.seed.worlds import pack_worlds
from levelproof.pipeline.store.seed.write import seed_bytes
from levelproof.pipeline.verify.verify import examine
from tests.levelgen.variants import renumbered
from tests.pipeline.made import honest_split
from tests.pipeline.servers import files_of, forget, serving

COUNT = 16


def one(levels: Level, i: int) -> Level:
    return jax.tree.map(lambda x: np.asarray(x)[..., i : i + 1], levels)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Level files, one of them of another size, one no level."""
    folder = tmp_path_factory.mktemp("files")
    levels = sample_levels(np.arange(COUNT), SIZES["s"])
    for i in range(COUNT):
        path = folder / "some" / f"level-{i}.json"
        path.parent.mkdir(exist_ok=True)
        write_level_file(LevelFile(one(levels, i), DEFAULT_RULES), path)
    write_level_file(LevelFile(one(sample_levels(np.arange(1), SIZES["m"]), 0), DEFAULT_RULES), folder / "m.json")
    (folder / "other.json").write_text("{}")
    return folder


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the seed file that a job on the level files would have exported: their rows and witnesses are true."""
    path = tmp_path_factory.mktemp("whole") / "whole.parquet"
    split = honest_split(path.parent / "data", COUNT, 1)
    export_seed(split, None, path.parent / "sampled.parquet")
    columns: dict[str, Any] = pq.read_table(path.parent / "sampled.parquet").to_pydict()
    levels = sample_levels(np.arange(COUNT), SIZES["s"])
    hashes = content_hashes(levels)
    columns["level_id"] = [level_id_for(one) for one in hashes]
    columns["content"] = pack_worlds(levels)
    columns["file"] = [str(folder / "some" / f"level-{i}.json") for i in range(COUNT)]
    order = np.argsort(columns["level_id"])
    table = pa.table(columns, schema=SCHEMA).take(order)
    config = {**(read_manifest(split, []).config or {}), "distribution": FROM_FILES}
    path.write_bytes(seed_bytes([(table, [hashes[i] for i in order])], config, "128k"))
    return path


@pytest.fixture(scope="module")
def lacking(whole: Path) -> Path:
    path = whole.parent / "lacking.parquet"
    assert main(["export", str(whole), "--format", "seed", "--without-levels", "-o", str(path)]) == 0
    return path


def test_file_without_levels_keeps_everything_else(whole: Path, lacking: Path) -> None:
    table, before = pq.read_table(lacking), pq.read_table(whole)
    assert table.column("content").null_count == COUNT
    others = [name for name in SCHEMA.names if name not in ("content", "file")]
    assert table.select(others).equals(before.select(others))
    assert sorted(table.column("file").to_pylist()) == sorted(f"level-{i}.json" for i in range(COUNT))
    assert lacking.stat().st_size < whole.stat().st_size


@pytest.mark.slow
def test_levels_are_added_again_from_files_of_any_name(
    whole: Path, lacking: Path, folder: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for i, path in enumerate(sorted(folder.rglob("*.json"))):
        (moved / f"{i}.json").write_bytes(path.read_bytes())
    again = tmp_path / "again.parquet"
    assert main(["export", str(lacking), "--format", "seed", "--levels", str(moved), "-o", str(again)]) == 0
    others = [name for name in SCHEMA.names if name != "file"]
    assert pq.read_table(again).select(others).equals(pq.read_table(whole).select(others))
    findings = examine(again)
    assert (findings.wrong, findings.levels) == ({}, COUNT)
    data = levelproof.open(again)
    batch = data.read(range(len(data)), observation=None)
    assert batch.goal.any(1).all()
    files = [Path(file) for file in pq.read_table(again)["file"].to_pylist()]
    assert {file.parent for file in files} == {moved}
    grown = tmp_path / "grown/128k/s"
    assert grow(again, grown, ["executor=inline"], Console(quiet=True)) == Exit.DONE
    assert not examine(grown).wrong, "levels without a witness are read from their files"


def test_add_levels_takes_the_copy_that_the_witness_solves(
    whole: Path, lacking: Path, folder: Path, tmp_path: Path
) -> None:
    """Content hashes do not depend on the order of bodies, and what a witness does may."""
    files, again, rng = tmp_path / "files", tmp_path / "again.parquet", np.random.default_rng(0)
    files.mkdir()
    for path in (folder / "some").iterdir():
        other = renumbered(jax.tree.map(np.array, read_level_file(path).level), rng)
        write_level_file(LevelFile(other, DEFAULT_RULES), files / f"0-{path.name}")
    with pytest.raises(Failure, match=r"The witness of level \d+ does not solve .*0-level-\d+.json, though"):
        add_levels(lacking, files, again)
    for path in (folder / "some").iterdir():
        (files / f"1-{path.name}").write_bytes(path.read_bytes())
    add_levels(lacking, files, again)
    assert (examine(again).wrong, examine(whole).wrong) == ({}, {})
    witnessed = pq.read_table(again).filter(pc.is_valid(pq.read_table(again)["witness"]))
    assert sum("/1-" in file for file in witnessed["file"].to_pylist()) > 1


def with_files(whole: Path, path: Path, files: list[str]) -> Path:
    """Write a copy of a seed file whose rows name these level files."""
    table = pq.read_table(whole)
    table = table.set_column(table.column_names.index("file"), "file", pa.array(files))
    hashes = read_manifest(whole, ["content_hash"]).table["content_hash"].to_pylist()
    path.write_bytes(seed_bytes([(table, hashes)], read_manifest(whole, []).config or {}, "128k"))
    return path


def test_export_without_levels_takes_relative_paths_and_refuses_records(whole: Path, tmp_path: Path) -> None:
    absolute, relative = ([f"{start}/{i}.json" for i in range(COUNT // 2)] for start in ("/some/levels", "below"))
    mixed, out = with_files(whole, tmp_path / "mixed.parquet", absolute + relative), tmp_path / "out.parquet"
    export_seed(mixed, None, out, with_levels=False)
    assert pq.read_table(out)["file"].to_pylist() == [f"{i}.json" for i in range(COUNT // 2)] + relative
    records = with_files(whole, tmp_path / "records.parquet", [f"/theirs/first#{i}" for i in range(COUNT)])
    with pytest.raises(UserError, match=r"are imported records \(/theirs/first#0 is one\).*leave out --without-levels"):
        export_seed(records, None, tmp_path / "none.parquet", with_levels=False)


def test_commands_say_where_the_levels_come_from(
    lacking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("inspect", "verify"):
        assert main([command, str(lacking)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert f"`levelproof export {lacking} --format seed --levels FOLDER -o whole.parquet`" in said
    with pytest.raises(UserError, match="does not contain its levels"):
        levelproof.open(lacking).read([0])
    assert main(["grow", str(lacking), "-o", str(tmp_path / "grown/128k/s")]) == 2
    assert "does not contain its levels" in capsys.readouterr().err
    assert not (tmp_path / "grown").exists()


def test_handmade_means_those_of_the_reference_and_a_path_means_a_folder(
    lacking: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where an earlier command has made a folder of that name."""
    monkeypatch.setattr(published, "handmade_folder", lambda: folder)
    monkeypatch.chdir(tmp_path)
    Path("handmade").mkdir()
    words = ["export", str(lacking), "--format", "seed", "-o", "whole.parquet", "--levels"]
    assert main([*words, "./handmade"]) == 2
    assert "handmade lacks the files of 16 of the " in capsys.readouterr().err
    assert main([*words, "handmade"]) == 0


def test_command_of_a_row_behind_a_url_names_the_url(whole: Path) -> None:
    forget()
    with serving(files_of(whole.parent)) as server:
        url = f"{server.url}/{whole.name}"
        commands = read_manifest(Path(url), ["command"]).table["command"].to_pylist()
    assert f"manifest={url} " in commands[0]


def test_folder_that_lacks_a_level_is_refused(lacking: Path, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "some").mkdir()
    for path in sorted((folder / "some").iterdir())[1:]:
        (tmp_path / "some" / path.name).write_bytes(path.read_bytes())
    for there, count in (tmp_path / "some", 1), (tmp_path / "nothing", COUNT):
        with pytest.raises(UserError, match=rf"lacks the files of {count} of the {COUNT} levels"):
            add_levels(lacking, there, tmp_path / "again.parquet")
    assert not (tmp_path / "again.parquet").exists()


def test_other_levels_with_the_same_ids_are_refused(whole: Path, folder: Path, tmp_path: Path) -> None:
    """The digest of all content hashes tells them apart."""
    table = pq.read_table(whole)
    table = table.set_column(table.column_names.index("content"), "content", pa.nulls(COUNT, pa.binary()))
    other = tmp_path / "other.parquet"
    other.write_bytes(seed_bytes([(table, ["c1:0"] * COUNT)], read_manifest(whole, []).config or {}, "128k"))
    with pytest.raises(Failure, match="The levels in these files differ from those"):
        add_levels(other, folder, tmp_path / "again.parquet")


def test_options_that_make_no_sense_are_refused(
    whole: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sampled, out = whole.parent / "sampled.parquet", ["-o", str(tmp_path / "x.parquet")]
    seed = ["--format", "seed"]
    for source, words, told in (
        (whole, ["--format", "minari", "--without-levels"], "are for --format seed"),
        (whole, [*seed, "--without-levels", "--levels", str(folder)], "leave out --where and --without-levels"),
        (sampled, [*seed, "--without-levels"], "leave out --without-levels"),
        (sampled, [*seed, "--levels", str(folder)], "leave out --levels"),
        (tmp_path, [*seed, "--levels", str(folder)], "is not one seed file"),
        (whole, [*seed, "--levels", str(folder)], "has its levels"),
        (whole, [*seed, "--levels", str(folder), "-o", str(whole)], "already exists"),
    ):
        assert main(["export", str(source), *out, *words]) == 2
        assert told in capsys.readouterr().err

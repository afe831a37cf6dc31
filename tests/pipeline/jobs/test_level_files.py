"""Level files instead of random levels: one split per size, on which every command works without the sampler."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from levelproof.configs.compose import compose_job
from levelproof.configs.errors import ConfigError
from levelproof.experts.labels import Label
from levelproof.levelgen.files.level_file import LevelFile, read_level_file, write_level_file
from levelproof.levelgen.identity.content import content_hashes, level_id_for
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.jobs.schedule import WorkUnit, plan_units
from levelproof.pipeline.jobs.unit import failure
from levelproof.pipeline.look.inspect import survey
from levelproof.pipeline.look.query import RowQuery
from levelproof.pipeline.look.status import read_status
from levelproof.pipeline.read.level_files import LevelUnavailable, level_at, level_file_paths, levels_below
from levelproof.pipeline.read.levels import levels_of
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest, require_manifest
from levelproof.pipeline.store.origins import Origin
from levelproof.pipeline.store.shard import Shard, write_shard
from levelproof.pipeline.verify.verify import examine
from tests.experts.search.worlds import switchback
from tests.pipeline.command import assert_refused, here, run
from tests.pipeline.made import assert_same, lasting
from tests.pipeline.verify.forged import assert_reported, forge, rows_labelled

pytestmark = pytest.mark.slow

WORDS = ["procedure=label", "budget=5k", "executor=inline", "unit=4"]
IDS = TRIVIAL, UNSOLVABLE = 1, 16  # of size s: the first gets a shard, the second does not


def still() -> Level:
    """Return a level of another size in which nothing acts, so that few programs are compiled for that size."""
    level = switchback()
    level.model.thruster_active[...] = False
    return level


def write(folder: Path, level_id: int, name: str, rules: TaskParams | None = None) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    level = jax.tree.map(np.asarray, sample_levels([level_id], SIZES["s"]))
    write_level_file(LevelFile(level, rules or TaskParams()), path)
    return path


def rows_of(split: Path) -> dict[str, dict]:
    """Return the rows by the names of their files."""
    return {Path(row["file"]).name: row for row in read_manifest(split).table.to_pylist()}


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with level files of two sizes below `mine`, and the splits that `generate` made of them."""
    folder = tmp_path_factory.mktemp("files")
    write(folder / "mine", TRIVIAL, "a.json")
    write(folder / "mine", TRIVIAL, "deeper/copy.json")
    write(folder / "mine", UNSOLVABLE, "deeper/b c.json")
    write_level_file(LevelFile(still(), TaskParams()), folder / "mine/larger.json")
    write(folder / "mine", 1, "rules.json", rules=replace(TaskParams(), frame_skip=4))
    (folder / "mine/bad.json").write_text("{")
    done = here(["generate", "level_files=mine", *WORDS], folder)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    messages = done.stderr.splitlines()
    assert any("copy.json has the same level as" in line and "a.json" in line for line in messages)
    assert any(line.startswith("Cannot use the level file") and "bad.json: it is not JSON" in line for line in messages)
    assert any(
        "rules.json: its rules differ from this command's" in line and "rules.json task.frame_skip=4 and an" in line
        for line in messages
    )
    assert messages[-1] == "2 of the level files in mine were left out, for the reasons above."
    return folder


@pytest.fixture
def folder(once: Path, tmp_path: Path) -> Path:
    """Return a copy of `once`; its rows name the original's files."""
    return Path(shutil.copytree(once, tmp_path / "files"))


def test_rows_have_the_file_and_an_id_from_the_content(once: Path) -> None:
    rows = rows_of(once / "data/5k/s")
    assert {name: row["label"] for name, row in rows.items()} == {"a.json": "trivial", "b c.json": "unsolvable"}
    assert rows_of(once / "data/5k/7-2-1-2").keys() == {"larger.json"}
    for row in rows.values():
        assert row["content_hash"] == content_hashes(read_level_file(Path(row["file"])).level)[0]
        assert row["level_id"] == level_id_for(row["content_hash"])
        assert Path(row["file"]).is_absolute()
    ids = [row["level_id"] for row in rows.values()]
    assert ids != list(IDS), "files do not contain the sampler's ids"
    assert len(read_manifest(once / "data/5k/s").fragments) == 1, "ids far apart share a unit"


def test_world_of_another_engine_matches_its_hash(folder: Path) -> None:
    """Its id does not make it again, and its signature holds no friction."""
    split = folder / "data/5k/s"
    forge(split, lambda row: row.update(device="gpu: of some kind"))
    assert_reported(split)
    shard = Shard(split / rows_labelled(split, Label.TRIVIAL)[0]["shard"])
    arrays = shard.read()
    arrays["level/model/friction"] = arrays["level/model/friction"] * np.float32(0.5)
    shutil.rmtree(shard.path)
    write_shard(shard.path, shard.level_ids, arrays)
    forge(split)
    assert_reported(split, "has an id, a content hash or a signature that differs from the level in its shard or file")


def test_second_run_does_nothing_after_the_files_have_moved(folder: Path) -> None:
    (folder / "mine").rename(folder / "elsewhere")
    before = rows_of(folder / "data/5k/s")
    done = here(["generate", "level_files=elsewhere", *WORDS], folder)
    assert done.stdout.count("Nothing to do") == 2
    write(folder / "elsewhere", 2, "more.json")
    done = here(["generate", "level_files=elsewhere", *WORDS], folder)
    assert done.stdout.count("Nothing to do") == 1
    after = rows_of(folder / "data/5k/s")
    assert after.keys() - before.keys() == {"more.json"}
    assert repr([after[name] for name in before]) == repr(list(before.values()))
    assert not examine(folder / "data/5k/s").wrong


def test_command_of_a_row_labels_its_file_again(once: Path, tmp_path: Path) -> None:
    row = rows_of(once / "data/5k/s")["b c.json"]
    done = here([*shlex.split(row["command"])[1:], "executor=inline"], tmp_path)
    assert done.returncode == 0, done.stderr
    (again,) = lasting(tmp_path / "data/5k/s")
    assert repr(again) == repr(
        next(labelled for labelled in lasting(once / "data/5k/s") if labelled["level_id"] == row["level_id"])
    )


def test_verify_checks_every_level_against_its_file(once: Path, folder: Path) -> None:
    split = folder / "data/5k/s"
    findings = examine(split)
    assert (findings.levels, findings.witnesses, findings.sentences) == (2, 1, [])
    (shard,) = (split / "shards").iterdir()
    chunk = next(path for path in shard.rglob("lvl32/c/*/*") if path.is_file())
    raw = bytearray(chunk.read_bytes())
    raw[len(raw) // 2] ^= 1
    chunk.write_bytes(raw)
    assert any("is missing or damaged" in sentence for sentence in examine(split).wrong)


def test_repair_reads_lost_levels_from_their_files(folder: Path) -> None:
    """A missing shard is restored; a damaged fragment is not, because only its rows name the files."""
    split = folder / "data/5k/s"
    before, (shard,) = lasting(split), (split / "shards").iterdir()
    shutil.rmtree(shard)
    done = here(["verify", str(split), "--repair", "executor=inline"], folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not examine(split).wrong
    assert lasting(split) == before
    fragment_paths(split)[0].write_bytes(b"PAR1")
    done = here(["verify", str(split), "--repair", "executor=inline"], folder)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "because no row names their level files" in done.stdout


def test_level_without_shard_and_file_is_reported_as_lost(tmp_path: Path) -> None:
    file = write(tmp_path / "mine", UNSOLVABLE, "b.json")
    assert here(["generate", f"level_files={file}", *WORDS], tmp_path).returncode == 0
    split = tmp_path / "data/5k/s"
    row = rows_of(split)["b.json"]
    assert here(["export", str(split), str(row["level_id"]), "-o", "out.json"], tmp_path).returncode == 0
    assert content_hashes(read_level_file(tmp_path / "out.json").level) == [row["content_hash"]]
    write(tmp_path / "mine", TRIVIAL, "b.json")
    assert any("cannot be rebuilt" in text and "no longer contains the level" in text for text in examine(split).wrong)
    file.unlink()
    assert any("cannot be rebuilt" in text and "No such file" in text for text in examine(split).wrong)
    assert_refused(
        here(["show", str(split), str(row["level_id"]), "-o", "x.png"], tmp_path), 1, "b.json", "put it back"
    )
    again = ["regenerate", f"manifest={split}", "budget=8k", "executor=inline"]
    assert_refused(here(again, tmp_path), 2, "b.json", "its file is missing")


def test_unreadable_level_file_is_fatal(tmp_path: Path) -> None:
    with pytest.raises(LevelUnavailable) as error:
        level_at(Origin("c1:0", str(tmp_path / "gone.json"), "s"))
    assert "all machines share" in failure(tmp_path, WorkUnit((0,)), error.value).fatal


def test_regenerate_reads_levels_from_shards_and_files(once: Path, tmp_path: Path) -> None:
    split = once / "data/5k/s"
    done = here(["regenerate", f"manifest={split}", "budget=8k", "executor=inline"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert not examine(tmp_path / "data/8k/s").wrong
    before, after = rows_of(split), rows_of(tmp_path / "data/8k/s")
    for name, row in before.items():
        same = ("level_id", "file", "content_hash", "label", "label_reason", "steps_to_goal")
        assert [after[name][column] for column in same] == [row[column] for column in same]


def test_commands_work_on_a_split_of_level_files(once: Path, tmp_path: Path) -> None:
    split = once / "data/5k/s"
    facts = survey(split, RowQuery("file LIKE '%a.json'"))
    assert (facts["levels"], facts["distribution"]) == (1, None)
    assert here(["inspect", str(split)], tmp_path).stdout.count("level files") == 1
    assert json.loads(here(["inspect", str(split), "--json"], tmp_path).stdout)["levels"] == 2
    assert read_status(split)["done"] == read_status(split)["wanted"] == 2
    for row in rows_of(split).values():
        done = here(["show", str(split), str(row["level_id"]), "-o", "level.png"], tmp_path)
        assert done.returncode == 0, done.stderr
    done = here(["card", str(split), "-o", "../README.md"], split)
    assert done.returncode == 0, done.stderr
    assert "| level files |" in (once / "data/5k/README.md").read_text()
    done = here(["export", str(split), "--format", "parquet", "-o", str(tmp_path / "levels")], tmp_path)
    assert done.stdout.startswith(f"{tmp_path / 'levels'}: 2 levels. "), done.stderr


def test_seed_file_of_level_files_has_their_content_and_grows_without_them(tmp_path: Path) -> None:
    """A split finds a level without a witness by its file alone, so the files come back in between."""
    write(tmp_path / "mine", TRIVIAL, "a.json")
    write(tmp_path / "mine", UNSOLVABLE, "b.json")
    assert here(["generate", "level_files=mine", *WORDS], tmp_path).returncode == 0
    split, seed, grown = tmp_path / "data/5k/s", tmp_path / "levels.parquet", tmp_path / "grown/5k/s"
    assert here(["export", str(split), "--format", "seed", "-o", str(seed)], tmp_path).returncode == 0
    before = require_manifest(split)
    levels, columns = arrays_of(levels_of(before, before.table)), ["level_id", "label", "content_hash", "file"]
    shutil.move(tmp_path / "mine", tmp_path / "gone")
    done = here(["grow", str(seed), "-o", str(grown), "executor=inline"], tmp_path)
    assert done.returncode == 0, done.stderr
    again = ["regenerate", f"manifest={seed}", "budget=8k", "out=again", "executor=inline"]
    assert here(again, tmp_path).returncode == 0
    after = require_manifest(seed)
    assert_same(arrays_of(levels_of(after, after.table)), levels)
    findings = examine(seed)
    assert (findings.levels, findings.witnesses, findings.wrong) == (2, 1, {})
    shutil.move(tmp_path / "gone", tmp_path / "mine")
    for source in (grown, tmp_path / "again/8k/s"):
        after = require_manifest(source)
        assert after.table.select(columns).equals(before.table.select(columns))
        assert_same(arrays_of(levels_of(after, after.table)), levels)
        assert not examine(source).wrong
    assert here(["export", str(grown), "--format", "seed", "-o", "again.parquet"], tmp_path).returncode == 0
    assert (tmp_path / "again.parquet").read_bytes() == seed.read_bytes()


def test_generate_rejects_wrong_settings_and_folders_of_level_files(folder: Path) -> None:
    for word in ("size=s", "levels=3", "first_level=1", "distribution=free", "distribution.motor_chance=1"):
        with pytest.raises(ConfigError, match="is for random levels"):
            compose_job(["level_files=mine", word])
    generate = ["generate", *WORDS]
    assert_refused(here([*generate, "levels=1"], folder), 2, "distribution was files, now absent", "out=NAME")
    assert_refused(here([*generate, "level_files=nowhere"], folder), 2, "There is no folder of level files at nowhere")
    (folder / "empty").mkdir()
    assert_refused(here([*generate, "level_files=empty"], folder), 2, "There is no level file in empty")
    assert_refused(here([*generate, "level_files=mine/bad.json"], folder), 2, "None of the level files")


def test_two_levels_with_one_id_are_reported(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("levelproof.pipeline.read.level_files.level_id_for", lambda _: 7)
    write(tmp_path / "two", TRIVIAL, "a.json")
    write(tmp_path / "two", UNSOLVABLE, "b.json")
    listing = levels_below(tmp_path / "two", compose_job([f"level_files={tmp_path}"]))
    assert list(listing.levels["s"]) == [7]
    assert "b.json: its level id collides with that of" in listing.refused[0]
    row = rows_of(folder / "data/5k/s")["a.json"]
    monkeypatch.setattr("levelproof.pipeline.read.level_files.level_id_for", lambda _: row["level_id"])
    done = here(["generate", f"level_files={tmp_path / 'two/b.json'}", *WORDS], folder)
    assert_refused(done, 2, "happen to have the same id", "out=NAME")


def test_plan_units_group_level_files_whatever_their_ids() -> None:
    origins = {i: Origin(f"c1:{i}", f"{i}.json", "s") for i in range(0, 1000, 100)}
    units = list(plan_units(sorted(origins), {300}, 4, origins))
    assert [len(unit.level_ids) for unit in units] == [4, 4, 1]
    assert all([origin.file for origin in unit.origins] == [f"{i}.json" for i in unit.level_ids] for unit in units)


@pytest.mark.campaign
def test_ray_workers_read_level_files_and_no_process_with_jax_forks(once: Path, tmp_path: Path) -> None:
    words = ["generate", f"level_files={once / 'mine'}", *WORDS, "executor=ray", "workers=1", "unit=1"]
    done = run(words, tmp_path)
    assert done.returncode == 2, done.stderr
    assert "fork" not in done.stderr
    assert rows_of(tmp_path / "data/5k/s").keys() == rows_of(once / "data/5k/s").keys()


def test_files_of_splits_and_policies_below_the_folder_are_not_level_files(folder: Path) -> None:
    """Such as one that an earlier run of the same command wrote there."""
    (folder / "data").rename(folder / "mine/data")
    (folder / "mine/agent").mkdir()
    for name in ("config.json", "run.json", "policy.safetensors"):  # of a policy
        (folder / "mine/agent" / name).touch()
    names = {path.name for path in level_file_paths(folder / "mine")}
    assert names == {"a.json", "copy.json", "b c.json", "larger.json", "rules.json", "bad.json"}

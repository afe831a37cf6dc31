"""`levelproof import`: the reference's trajectories become a split on which every command works."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks import oracle
from levelproof.experts.witness.witness import replay, succeeds
from levelproof.levelgen.files.level_file import read_level_file
from levelproof.levelgen.identity.content import content_hashes
from levelproof.pipeline.jobs import imported as module
from levelproof.pipeline.look.status import read_status
from levelproof.pipeline.read.kinetix.folder import Trajectories
from levelproof.pipeline.read.kinetix.zarr2 import StoredArray
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store import seal
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import assert_refused, here
from tests.pipeline.read.kinetix.folder import GOLDEN, OTHERS, SOLVED, to_ours, trajectories_in

ROWS = SOLVED + OTHERS
NAMES = [*(f"first#{i}" for i in range(ROWS // 2)), *(f"second#{i}" for i in range(ROWS - ROWS // 2))]


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the golden trajectories of size s (`theirs`) and the split imported from them."""
    folder = tmp_path_factory.mktemp("imported")
    shutil.copytree(GOLDEN / "s", folder / "theirs")
    done = here(["import", "theirs", "-o", "data/1M/s"], folder)
    assert done.returncode == 0, done.stderr
    assert f"data/1M/s: {ROWS} levels of" in done.stdout
    assert "% reach the goal here." in done.stdout
    assert "levelproof inspect data/1M/s" in done.stdout
    return folder


@pytest.fixture
def folder(once: Path, tmp_path: Path) -> Path:
    """Return a copy of `once`; its rows name the original's trajectories."""
    return Path(shutil.copytree(once, tmp_path / "copy"))


def rows_of(split: Path) -> list[dict]:
    return read_manifest(split).table.to_pylist()


def test_import_makes_a_row_with_the_source_of_every_trajectory(once: Path) -> None:
    rows = rows_of(once / "data/1M/s")
    assert [row["level_id"] for row in rows] == list(range(ROWS))
    assert [row["file"] for row in rows] == [f"{once}/theirs/{name}" for name in NAMES]
    level, _ = to_ours(trajectories_in(once / "theirs"))
    assert [row["content_hash"] for row in rows] == content_hashes(level)
    assert {(row["size"], row["budget"], row["env_steps"]) for row in rows} == {("s", "1M", 0)}


def test_import_labels_levels_by_replaying_the_actions(once: Path) -> None:
    split = once / "data/1M/s"
    level, record = to_ours(trajectories_in(once / "theirs"))
    again = replay(level, record.action)
    whole = succeeds(np.asarray(again.done), np.asarray(again.goal))
    rows, table = rows_of(split), read_manifest(split).table
    assert [row["label"] in ("solved", "trivial") for row in rows][:SOLVED] == whole[:SOLVED].tolist()
    assert {row["label"] for row in rows} == {"solved", "trivial", "unsolved"}
    assert any("first imported episode, repeated" in row["label_reason"] for row in rows)
    for i, row in enumerate(rows):
        if row["label"] == "unsolved":
            assert (row["shard"], row["witness"], row["steps_to_goal"]) == (None, None, None)
            assert "do not reach the goal" in row["label_reason"]
            continue
        kept = read_rows(split, table.slice(i, 1))
        assert row["witness"] == ("nothing" if row["label"] == "trivial" else "import")
        if row["label"] == "trivial":
            assert not kept["record/action"].any()
        elif whole[i]:
            np.testing.assert_array_equal(kept["record/action"][..., 0], record.action[..., i])
        else:
            assert "first imported episode, repeated" in row["label_reason"]
            steps = row["steps_to_goal"]
            np.testing.assert_array_equal(kept["record/action"][:steps, :, 0], record.action[:steps, :, i])
            np.testing.assert_array_equal(kept["record/action"][steps, :, 0], record.action[0, :, i])


def test_verify_checks_every_imported_level(once: Path) -> None:
    findings = examine(once / "data/1M/s")
    assert (findings.levels, findings.witnesses, findings.sentences) == (ROWS, findings.same_bits, [])
    (once / "theirs").rename(once / "theirs.gone")
    try:
        (wrong,) = examine(once / "data/1M/s").wrong  # the unsolved level's world is stored nowhere else
    finally:
        (once / "theirs.gone").rename(once / "theirs")
    assert "cannot be rebuilt" in wrong


def test_commands_work_on_an_imported_split(once: Path, tmp_path: Path) -> None:
    split = once / "data/1M/s"
    rows = rows_of(split)
    unsolved = next(row for row in rows if row["label"] == "unsolved")
    assert read_status(split)["done"] == read_status(split)["wanted"] == ROWS
    assert json.loads(here(["inspect", str(split), "--json"], tmp_path).stdout)["levels"] == ROWS
    assert here(["show", str(split), str(unsolved["level_id"]), "-o", "level.png"], tmp_path).returncode == 0
    assert here(["export", str(split), str(unsolved["level_id"]), "-o", "level.json"], tmp_path).returncode == 0
    assert content_hashes(read_level_file(tmp_path / "level.json").level) == [unsolved["content_hash"]]
    assert here(["export", str(split), "--format", "kinetix", "-o", "k"], tmp_path).returncode == 0
    assert len(trajectories_in(tmp_path / "k")) == sum(row["label"] == "solved" for row in rows)


def test_other_jobs_cannot_write_to_an_imported_split(folder: Path) -> None:
    generate = ["generate", "budget=1M", "executor=inline", "levels=1"]
    assert_refused(here(generate, folder), 2, "distribution was import, now absent", "out=NAME")
    shutil.copytree(folder / "theirs", folder / "others")
    (folder / "others/first").rename(folder / "others/third")
    again = ["import", "others", "-o", "data/1M/s"]
    assert_refused(here(again, folder), 2, "theirs/first#0", "others/second#0", "one folder makes one split")


@pytest.mark.campaign
def test_repair_rejects_an_imported_split(folder: Path) -> None:
    split = folder / "data/1M/s"
    shutil.rmtree(next((split / "shards").iterdir()))
    before = sorted(path for path in split.rglob("*"))
    done = here(["verify", str(split), "--repair", "executor=inline"], folder)
    assert_refused(done, 2, "was imported", f"levelproof import FOLDER -o {split}")
    assert "affects levels" in done.stdout
    assert sorted(path for path in split.rglob("*")) == before


@pytest.mark.slow
def test_regenerate_labels_imported_levels_at_another_budget(once: Path, tmp_path: Path) -> None:
    words = [f"manifest={once / 'data/1M/s'}", "budget=5k", "executor=inline"]
    done = here(["regenerate", *words, "where=label != 'solved'"], tmp_path)
    assert done.returncode == 0, done.stderr
    before = [row for row in rows_of(once / "data/1M/s") if row["label"] != "solved"]
    after = rows_of(tmp_path / "data/5k/s")
    same = ("level_id", "content_hash", "file")
    assert [[row[name] for name in same] for row in after] == [[row[name] for name in same] for row in before]
    assert not examine(tmp_path / "data/5k/s").wrong
    row = after[-1]
    (tmp_path / "again").mkdir()
    done = here([*shlex.split(row["command"])[1:], "executor=inline"], tmp_path / "again")
    assert done.returncode == 0, done.stderr
    of_the_run = ("shard", "row", "seconds")
    assert rows_of(tmp_path / "again/data/5k/s")[0] | {name: row[name] for name in of_the_run} == row
    shutil.rmtree(next((tmp_path / "data/5k/s/shards").iterdir()))
    done = here(["verify", str(tmp_path / "data/5k/s"), "--repair", "executor=inline"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert [row["command"] for row in rows_of(tmp_path / "data/5k/s")] == [row["command"] for row in after]


@pytest.mark.parametrize("density", ["full", "witness"])
def test_import_continues_after_a_stop(
    density: str, once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the split was sealed to another density in between."""
    committed, commit = [], module.commit

    def once_only(job, split, unit, *rest) -> None:
        if committed:
            raise KeyboardInterrupt
        commit(job, split, unit, *rest)
        committed.append(unit.name)

    words = ["import", str(once / "theirs"), "-o", "data/1M/s"]
    with monkeypatch.context() as patch:
        patch.setattr(module, "commit", once_only)
        done = here(words, tmp_path)
    assert done.returncode == 130
    assert "run the same command to continue" in done.stderr
    assert read_status(tmp_path / "data/1M/s")["done"] < ROWS == read_status(tmp_path / "data/1M/s")["wanted"]
    if density != "full":
        sealing = ["seal", "data/1M/s", "--density", density, "--key-every", "64"]
        assert here(sealing, tmp_path).returncode == 0
    done = here(words, tmp_path)
    assert "1 of 2 units are already there" in done.stderr, done.stderr
    want, got = (rows_of(path / "data/1M/s") for path in (once, tmp_path))
    same = [name for name in want[0] if name not in ("shard", "command", "learning_curve")]
    assert [[row[name] for name in same] for row in got] == [[row[name] for name in same] for row in want]


def test_import_continues_once_a_damaged_chunk_is_mended(once: Path, tmp_path: Path) -> None:
    theirs = Path(shutil.copytree(once / "theirs", tmp_path / "theirs"))
    words = ["import", "theirs", "-o", "data/1M/s"]
    (theirs / "second/0.0").write_bytes(b"")
    done = here(words, tmp_path)
    assert_refused(done, 1, "Cannot continue with theirs: ", "second/0.0", "then run the same command")
    shutil.copy(once / "theirs/second/0.0", theirs / "second")
    done = here(words, tmp_path)
    assert "1 of 2 units are already there" in done.stderr, done.stderr
    want, got = (rows_of(path / "data/1M/s") for path in (once, tmp_path))
    same = [name for name in want[0] if name not in ("shard", "file", "command", "learning_curve")]
    assert [[row[name] for name in same] for row in got] == [[row[name] for name in same] for row in want]


def test_import_of_a_folder_that_has_grown_or_shrunk_is_refused(
    once: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows were added to its last array since: the unit that ends with it would count as done."""
    fewer = Path(shutil.copytree(once / "theirs", tmp_path / "theirs"))
    about = json.loads((fewer / "second/.zarray").read_text())
    (fewer / "second/.zarray").write_text(json.dumps(about | {"shape": [about["shape"][0] - 1, 256]}))
    assert here(["import", "theirs", "-o", "data/1M/s"], tmp_path).returncode == 0
    (fewer / "second/.zarray").write_text(json.dumps(about))
    done = here(["import", "theirs", "-o", "data/1M/s"], tmp_path)
    assert_refused(done, 2, "theirs has other trajectories than when data/1M/s was imported", "import it elsewhere")
    assert here(["seal", "data/1M/s"], tmp_path).returncode == 0
    assert_refused(here(["import", "theirs", "-o", "data/1M/s"], tmp_path), 2, "has other trajectories than when")
    (fewer / "second/.zarray").write_text(json.dumps(about | {"shape": [1, 256]}))
    assert_refused(here(["import", "theirs", "-o", "data/1M/s"], tmp_path), 2, "has other trajectories than when")


def test_sealed_import_whose_last_record_was_left_out_is_complete(
    once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sealed fragment is named after its last row, so its unit seems to have grown."""
    read = module.read_trajectories

    def without_last(array: StoredArray, first: int, last: int) -> Trajectories:
        found = read(array, first, last)
        if array.path.name == "second" and last == array.rows:
            found.wrong[-1] = "it is impossible"
        return found

    monkeypatch.setattr(module, "read_trajectories", without_last)
    words = ["import", str(once / "theirs"), "-o", "data/1M/s"]
    for _ in range(2):
        done = here(words, tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"{ROWS - 1} levels of" in done.stdout
        assert here(["seal", "data/1M/s"], tmp_path).returncode == 0
    assert [fragment.sealed for fragment in read_manifest(tmp_path / "data/1M/s").fragments] == [True]


def test_a_row_that_an_array_lacks_is_no_level(once: Path, tmp_path: Path) -> None:
    words = ["generate", f"level_files={once}/theirs/second#{ROWS}", "budget=5k", "executor=inline"]
    done = here(words, tmp_path)
    assert_refused(done, 2, "can be used")
    assert f"its array second has {ROWS - ROWS // 2} rows, so no row {ROWS}" in done.stderr


def test_regenerate_names_a_missing_folder(folder: Path) -> None:
    moved = folder / "moved"
    shutil.copytree(folder, moved)
    words = ["regenerate", "manifest=moved/data/1M/s", "budget=5k", "executor=inline", "where=label = 'unsolved'"]
    gone = Path(rows_of(moved / "data/1M/s")[0]["file"]).parent
    gone.rename(gone.with_name("away"))
    try:
        done = here(words, folder)
    finally:
        gone.with_name("away").rename(gone)
    assert_refused(done, 2, f"its folder is missing: put the imported folder {gone} back.")


def test_import_reports_and_skips_invalid_records(once: Path, tmp_path: Path) -> None:
    """The array is uncompressed and has an additional axis; the reference reads such arrays as well."""
    made = trajectories_in(once / "theirs")
    plain = np.dtype([(name, made.dtype[name].base, made.dtype[name].shape[1:]) for name in made.dtype.names or ()])
    made = made.view(plain).copy()
    made["action"][1, 200, 0] = 3
    made["env_state/polygon/position"][2, 0, 4, 0] = np.nan
    made["env_state/joint/a_index"][3, 0] = 99
    made["env_state/timestep"][4, 0] = 7
    path = tmp_path / "odd/array"
    path.mkdir(parents=True)
    (path.parent / ".zgroup").write_text('{"zarr_format": 2}')
    about = {"zarr_format": 2, "shape": [ROWS, 256, 1], "chunks": [ROWS, 256, 1], "compressor": None, "order": "C"}
    fields = [[name, plain[name].base.str, list(plain[name].shape)] for name in plain.names or ()]
    (path / ".zarray").write_text(json.dumps(about | {"dtype": fields, "fill_value": None, "filters": None}))
    (path / "0.0.0").write_bytes(made.tobytes())
    done = here(["import", "odd", "-o", "data/1M/s"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"{ROWS - 4} levels of" in done.stdout
    assert "4 were left out." in done.stdout
    messages = [line for line in done.stderr.splitlines() if line.startswith("Left out:")]
    assert len(messages) == module.REPORTED
    assert "odd/array#1, its actions are not actions of this task." in messages[0]
    assert "#2, its polygon/position has a value that is not a finite 32-bit number." in messages[1]
    assert "#3, its model/joint_a has values out of range for this size." in messages[2]
    assert [row["level_id"] for row in rows_of(tmp_path / "data/1M/s")] == [0, 5, 6]
    assert read_status(tmp_path / "data/1M/s")["wanted"] == ROWS - 4
    want = [rows_of(once / "data/1M/s")[i]["content_hash"] for i in (0, 5, 6)]
    assert [row["content_hash"] for row in rows_of(tmp_path / "data/1M/s")] == want


def test_unit_without_a_usable_record_does_not_stop_sealing(
    once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = module.read_trajectories

    def spoilt(array, first, last):
        trajectories = read(array, first, last)
        return trajectories._replace(wrong=["spoilt"] * (last - first)) if array.path.name == "first" else trajectories

    monkeypatch.setattr(module, "read_trajectories", spoilt)
    monkeypatch.setattr(seal, "ROWS", 2)
    done = here(["import", str(once / "theirs"), "-o", "data/1M/s"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Not sealed" not in done.stderr
    assert len(rows_of(tmp_path / "data/1M/s")) == ROWS - ROWS // 2


def test_import_requires_a_split_named_by_budget_and_size(once: Path, tmp_path: Path) -> None:
    words = ["import", str(once / "theirs"), "-o"]
    assert_refused(here([*words, "data/1M/m"], tmp_path), 2, "levels of size s", "-o data/1M/s")
    assert_refused(here([*words, "data/much/s"], tmp_path), 2, "budget is 'much'", "-o data/1M/s")
    assert_refused(here(["import", "nothing", "-o", "data/1M/s"], tmp_path), 2, "there is no .zgroup in")
    done = here(["import", "s3://bucket/theirs", "-o", "data/1M/s"], tmp_path)
    assert_refused(done, 2, "To import it, s3://bucket/theirs must be a folder on this machine")
    (tmp_path / "the\nirs").symlink_to(once / "theirs")
    done = here(["import", "the\nirs", "-o", "data/1M/s"], tmp_path)
    assert_refused(done, 2, "characters that terminals cannot show, so rename it")
    (tmp_path / "the\nirs").unlink()
    assert not list(tmp_path.iterdir())


@pytest.mark.campaign
def test_import_reads_folders_that_the_reference_wrote(reference: Path, tmp_path: Path) -> None:
    """Most episodes that reach the goal there do so here; golden folders cover other sizes."""
    solved, others = 24, 4
    file = oracle.sampled_levels(reference, "s")
    words = [tmp_path / "s", file, "--size", "s", "--levels", 128, "--solved", solved, "--others", others]
    oracle.run_script(reference, "trajectories", words, "play levels with the reference")
    done = here(["import", "s", "-o", "data/1M/s"], tmp_path)
    assert done.returncode == 0, done.stderr
    rows = rows_of(tmp_path / "data/1M/s")
    assert len(rows) == solved + others
    reached = [row["label"] in ("solved", "trivial") for row in rows[:solved]]
    assert not examine(tmp_path / "data/1M/s").wrong
    print(f"{np.mean(reached):.1%} of {len(reached)}")
    assert np.mean(reached) >= 0.8

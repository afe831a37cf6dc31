"""The command line: help, errors and answers. Start and exit are tested in a separate process."""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest

from levelproof.pipeline.cli import main
from levelproof.pipeline.jobs.inline import Handle
from levelproof.pipeline.store import seal
from levelproof.pipeline.store.event_files import events_of, runs_in
from levelproof.pipeline.store.layout import data_paths, made_within
from levelproof.pipeline.store.locks import only_writer
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest
from levelproof.pipeline.version import __version__
from tests.pace import patience
from tests.pipeline.command import ROOT, TINY, assert_refused, here, run
from tests.pipeline.made import lasting

COMMANDS = [command.__name__.rpartition(".")[2].rstrip("_") for command in main.COMMANDS]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a real, tiny split `data/5k/s`, which tests must not change."""
    folder = tmp_path_factory.mktemp("made")
    done = here(["generate", *TINY], folder)
    assert done.returncode == 0, done.stderr
    assert "4/4 levels" in done.stderr
    (events,) = map(events_of, runs_in(folder / "data/5k/s"))
    assert [*events[-1]["workers"]] == [Handle(0).host], "so small a job starts no workers"
    return folder


@pytest.fixture
def split(made: Path, tmp_path: Path) -> Path:
    """A copy of the split, which tests may damage."""
    shutil.copytree(made / "data", tmp_path / "data")
    return tmp_path / "data/5k/s"


def solved_level(split: Path) -> int:
    manifest = read_manifest(split)
    return int(manifest.level_ids[manifest.labels == "solved"][0])


def test_help_imports_no_heavy_packages_and_lists_every_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPROFILEIMPORTTIME", "1")
    done = run(["--help"], tmp_path)
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "levelproof.pipeline.cli.main" in imported
    assert not {"jax", "numpy", "ray", "pyarrow"} & imported
    assert done.returncode == 0
    assert all(command in done.stdout for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(capsys: pytest.CaptureFixture[str], command: str) -> None:
    with pytest.raises(SystemExit, match="0"):
        main.main([command, "--help"])
    assert re.search(rf"examples?:\s+levelproof {command} ", capsys.readouterr().out)


def test_version_prints_the_version(tmp_path: Path) -> None:
    done = run(["--version"], tmp_path)
    assert (done.returncode, done.stdout) == (0, f"levelproof {__version__}\n")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ["procedure=never"],
            ["there is no procedure never", "choose one of default, label, masters, published, thorough"],
        ),
        (["stop=budget"], ["stop is 'budget', but must be a group of settings"]),
        (["levls=5"], ["no setting levls", "did you mean levels?"]),
    ],
)
def test_generate_rejects_a_wrong_setting_in_one_sentence(
    tmp_path: Path, arguments: list[str], expected: list[str]
) -> None:
    assert_refused(here(["generate", *arguments], tmp_path), 2, *expected)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [[], ["generat"], ["inspect"], ["show"], ["inspect", "x", "--rows", "a"]])
def test_invalid_command_prints_the_usage(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main.main(arguments)
    assert capsys.readouterr().err.startswith("usage: levelproof")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["generate", "--size", "m"], "There is no option --size: write settings as NAME=VALUE, as in size=m"),
        (["generate", "-o", "x"], "There is no option -o: write settings as NAME=VALUE, as in out=FOLDER"),
        (["train", "out=x"], "write -o FOLDER, not out=FOLDER"),
        (["train", "size=m", "-o", "y", "seed=1", "--cores", "2"], "There is no option --cores: write settings as"),
        (["clone", "x", "--width", "9"], "NAME=VALUE, as in train.updates=3500"),
        (["grow", "x", "-o", "y", "--density", "full"], "NAME=VALUE, as in density=witness"),
        (["inspect", "x", "--were", "a"], "There is no option --were: --help lists the options"),
        (["--debug", "generate"], "--debug comes after the command, as in levelproof generate --debug"),
        (["show", "x", "-o", "y.svg", "z"], "There is no argument z: --help lists them"),
        (["show", "x", "-o", "y.svg", "9" * 5000], "There is no argument 9999"),
        (["inspect", "x" * 300], f"Cannot use {'x' * 200}... (File name too long): check the path"),
        (["sample", "level_files=x"], "sample draws random levels"),
        (["verify", "--repair"], "No split was given"),
        (["verify", "--repair", "executor=inline", "x"], "There is no split at x"),
        (["verify", "--repair", "x", "y"], "Verify one split at a time: name one, not 2"),
        (["inspect", "x", "--csv", "--against", "y"], "--against has no effect with --csv: leave one of them out"),
        (["inspect", "x", "--plot", "y.svg", "--limit", "3"], "--limit has no effect with --plot"),
        (["play", "--size", "2-0-0-0"], "leave no room for the 4 polygons of the scenery"),
        (["play", "x.json", "--size", "l"], "--size is for an empty level: leave it out, or x.json"),
        (["verify", "x", "--repair", "workers=many"], "workers"),
        (["export", "x", "--format", "seed"], "name the file to write with -o, as in -o levels.parquet"),
        (["seal", "x", "--density", "seed"], "name the file to write with -o, as in -o levels.parquet"),
        (["seal", "x", "--density", "seed", "-o", "y.parquet", "--rows", "9"], "writes one file: leave it out"),
        (["seal", "x", "--density", "witness", "-o", "y.parquet"], "-o applies only to --density seed"),
        (["generate", "out=gcs://bucket/x"], "gcs:/bucket/x/128k/s looks like a URL"),
        (["status", "ftp://host/split"], "ftp:/host/split looks like a URL"),
        (["show", "x", "7", "-o", "s3://bucket/level.gif"], "This command cannot write to s3://bucket/level.gif"),
        (["inspect", "x", "--plot", "gs://bucket/plot.svg"], "This command cannot write to gs://bucket/plot.svg"),
    ],
)
def test_unknown_options_and_urls_are_not_taken_for_folders(tmp_path: Path, arguments: list[str], message: str) -> None:
    assert_refused(here(arguments, tmp_path), 2, message)
    assert not list(tmp_path.iterdir())


def test_arguments_may_follow_options(split: Path) -> None:
    """argparse leaves over those that are optional."""
    done = here(["export", "data/5k/s", "-o", "level.json", str(solved_level(split))], split.parents[2])
    assert done.returncode == 0, done.stderr
    done = here(["export", "data/5k/s", str(solved_level(split))], split.parents[2])
    assert_refused(done, 2, "level.json already exists: name the file to write with -o, as in -o level-")
    done = here(["card", "data/5k/s", "--license", "mit", "data/5k/s"], split.parents[2])
    assert "There is no argument" not in done.stderr
    done = here(["plan", "size=s", "--json", "levels=six"], split.parents[2])
    assert_refused(done, 2, "write a whole number")


def test_parts_of_a_split_and_impossible_ids_are_named(split: Path) -> None:
    done = here(["inspect", "data/5k/s/manifest"], split.parents[2])
    assert_refused(done, 2, "is parquet, but not a seed file: open the whole split, data/5k/s")
    done = here(["show", "data/5k/s", "9" * 20], split.parents[2])
    assert_refused(done, 2, f"There is no level {'9' * 20} in data/5k/s")
    done = here(
        ["inspect", "data/5k/s", "--csv", "--columns", "label,level_id,label", "--limit", "1"], split.parents[2]
    )
    assert done.stdout.splitlines()[0] == "label,level_id"


def test_inspect_rejects_a_folder_of_splits(made: Path) -> None:
    for above in ("data", "."):
        assert_refused(here(["inspect", above], made), 2, f"{above} is not a split", "name one of them, such as")


def test_later_command_keeps_earlier_levels_wanted(split: Path) -> None:
    """Levels that the later command did not request count as missing once they are lost."""
    folder = split.parent.parent.parent
    settings = [setting for setting in TINY if not setting.startswith("levels=")]
    assert here(["generate", *settings, "levels=1", "executor=inline"], folder).returncode == 0
    assert json.loads(here(["status", "data/5k/s", "--json"], folder).stdout)["wanted"] == 4
    for fragment in fragment_paths(split)[1:]:
        for path in made_within(data_paths(split), fragment):
            shutil.rmtree(path)
        fragment.unlink()
    done = here(["verify", "data/5k/s", "--json"], folder)
    assert done.returncode == 1
    found = json.loads(done.stdout)
    assert found["missing"] == [[1, 3]]
    assert len(found["wrong"]) == 1, "that they are missing, and nothing else"


@pytest.mark.parametrize(
    "command",
    ["inspect data/1k/s", "status data/1k/s", "verify data/1k/s", "show data/1k/s 0", "seal data/1k/s",
     "regenerate manifest=data/1k/s budget=1M"],
)  # fmt: skip
def test_commands_name_a_missing_split(tmp_path: Path, command: str) -> None:
    assert_refused(here(command.split(), tmp_path), 2, "no split at data/1k/s")


@pytest.mark.skipif(os.getuid() == 0, reason="root may write anywhere")
def test_generate_names_an_output_folder_without_permission(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir(mode=0o500)
    assert_refused(here(["generate", *TINY], tmp_path), 2, "Cannot write to data/5k/s", "Permission denied")


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    done = run(["status", "nowhere", "--debug"], tmp_path)
    assert done.returncode != 0
    assert "Traceback" in done.stderr


def test_generate_does_nothing_when_all_levels_exist(made: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in made.rglob("*") if path.suffix in (".parquet", ".zarr")}
    done = here(["generate", *TINY], made)
    assert done.returncode == 0
    assert "Nothing to do: the split already has 4 levels" in done.stdout
    assert "levelproof inspect data/5k/s" in done.stdout
    assert before == {path: path.stat().st_mtime_ns for path in made.rglob("*") if path.suffix in (".parquet", ".zarr")}


@pytest.mark.parametrize("command", [["generate", *TINY], ["inspect", "data/5k/s"], ["status", "data/5k/s"]])
def test_commands_name_a_damaged_fragment(split: Path, command: list[str]) -> None:
    fragment_paths(split)[1].write_bytes(b"PAR1 and then nothing")
    done = here(command, split.parents[2])
    assert_refused(done, 1, "000000000001-000000000001.parquet is damaged", "verify data/5k/s --repair")


@pytest.mark.campaign
def test_generate_remakes_a_deleted_fragment_with_the_same_rows(split: Path) -> None:
    before = lasting(split)
    fragment_paths(split)[1].unlink()
    done = here(["generate", *TINY, "executor=inline"], split.parents[2])
    assert done.returncode == 0, done.stderr
    assert "3 are already there" in done.stderr
    assert repr(lasting(split)) == repr(before)


def test_verify_passes_a_sound_split_and_names_a_damaged_shard(split: Path) -> None:
    done = here(["verify", "data/5k/s", "--json"], split.parents[2])
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    kept = read_manifest(split).table.column("shard")
    assert facts["witnesses"] == facts["same_bits"] == len(kept) - kept.null_count > 0
    assert facts["wrong"] == []
    shard = split / sorted(read_manifest(split).shards)[0]
    file = shard / "dyn32/c/0/0/0"
    file.write_bytes(file.read_bytes()[:-200] + bytes(200))
    done = here(["verify", "data/5k/s"], split.parents[2])
    assert done.returncode == 1
    assert f"{shard.name} is missing or damaged" in done.stdout
    assert "Traceback" not in done.stderr


def test_inspect_shows_the_contents_of_a_split(made: Path) -> None:
    manifest = read_manifest(made / "data/5k/s")
    done = here(["inspect", "data/5k/s"], made)
    assert done.returncode == 0, done.stderr
    for word in ("solved of undecided levels", "steps to goal", "bytes per transition", "level_id", "solved"):
        assert word in done.stdout
    facts = json.loads(here(["inspect", "data/5k/s", "--json", "--rows", "2"], made).stdout)
    assert facts["levels"] == 4
    assert facts["labels"]["solved"] == manifest.labels.tolist().count("solved")
    assert [row["level_id"] for row in facts["rows"]] == [0, 1]
    assert facts["bytes_per_transition"] > 0


def test_inspect_takes_a_condition_and_rejects_an_invalid_one(made: Path) -> None:
    facts = json.loads(
        here(["inspect", "data/5k/s", "--json", "--where", "level_id >= 2 -- the last two"], made).stdout
    )
    assert facts["levels"] == 2
    done = here(["inspect", "data/5k/s", "--where", "no_such_column = 1"], made)
    assert_refused(done, 2, "no_such_column", "columns level_id, content_hash")
    done = here(["inspect", "data/5k/s", "--where", "label IN (SELECT content FROM read_text('/etc/passwd'))"], made)
    assert_refused(done, 2, "Cannot use the condition")


def test_status_shows_the_progress_of_a_split(split: Path) -> None:
    facts = json.loads(here(["status", "data/5k/s", "--json"], split.parents[2]).stdout)
    assert (facts["wanted"], facts["done"], facts["running"], facts["quarantined"]) == (4, 4, False, [])
    fragment_paths(split)[0].unlink()
    text = here(["status", "data/5k/s"], split.parents[2]).stdout
    assert "3 of 4 levels committed" in text
    assert "To resume: levelproof generate levels=4 unit=1 budget=5k\n" in text


def test_full_disk_stops_generate_with_one_sentence_and_no_partial_files(tmp_path: Path) -> None:
    """A file size limit replaces the full disk: with both, a write fails partway."""
    limit = 8_000  # bytes; more than the job note, less than the experts, which are written next
    command = ["generate", "levels=4", "unit=4", "budget=5k", "keep_experts=true", "executor=inline"]

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        done = here(command, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert_refused(done, 1, "Cannot write to data/5k/s", "run the same command again")
    assert fragment_paths(tmp_path / "data/5k/s") == []
    assert here(command, tmp_path).returncode == 0
    assert len(read_manifest(tmp_path / "data/5k/s").level_ids) == 4
    data = {path.stem for folder in ("shards", "experts") for path in (tmp_path / "data/5k/s" / folder).iterdir()}
    assert len(data) == 1


def test_failing_unit_is_given_up_until_other_units_commit_its_levels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> NoReturn:
        raise ZeroDivisionError("a bug")

    command = ["generate", "levels=2", "budget=5k", "executor=inline"]
    with monkeypatch.context() as patched:
        patched.setattr("levelproof.pipeline.jobs.unit.sample_levels", broken)
        done = here([*command, "unit=2"], tmp_path)
    assert done.returncode == 3, done.stderr
    assert done.stderr.count("trying again") == 2
    assert "given up" in done.stderr
    split = tmp_path / "data/5k/s"
    (note,) = (split / "quarantine").iterdir()
    assert str(note.relative_to(tmp_path)) in done.stdout
    assert "Failed 3 times" in note.read_text()
    assert "Given up: levels 0 to 1, for the reason in " in here(["status", str(split)], tmp_path).stdout
    assert here([*command, "unit=1"], tmp_path).returncode == 0
    assert not list((split / "quarantine").iterdir())
    assert "Given up" not in here(["status", str(split)], tmp_path).stdout


def test_pipe_closed_before_a_short_output_is_not_an_error(tmp_path: Path) -> None:
    command = f"{sys.executable} -m levelproof columns steps | true; exit ${{PIPESTATUS[0]}}"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=patience(1800),
    )
    assert (done.returncode, done.stderr) == (0, "")


def answers(split: Path) -> dict[str, object]:
    """Return what commands report about a split, except its size in bytes."""
    folder, name, level = split.parents[2], "data/5k/s", str(solved_level(split))
    facts = json.loads(here(["inspect", name, "--where", "level_id < 4", "--json"], folder).stdout)
    rows = [row | {"shard": bool(row["shard"]), "row": None} for row in facts.pop("rows")]
    for command in ["show", name, level, "-o", "level.svg"], ["export", name, level, "-o", "level.json"]:
        assert here(command, folder).returncode == 0
    files = [(folder / file).read_bytes() for file in ("level.svg", "level.json")]
    facts = {name: fact for name, fact in facts.items() if "bytes" not in name}
    return {"facts": facts, "rows": rows, "files": files, "status": here(["status", name], folder).stdout}


def test_sealed_split_gives_the_same_answers_and_grows(split: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, before = split.parents[2], answers(split)
    done = here(["seal", "data/5k/s", "--rows", "3"], folder)
    assert "merged 4 fragments into 2; it has 4 levels in 2 fragments now" in done.stdout, done.stderr
    assert answers(split) == before
    assert "there was nothing to seal" in here(["seal", "data/5k/s", "--rows", "3"], folder).stdout
    assert (
        "Nothing to do: the split already has 4 levels" in here(["generate", *TINY, "executor=inline"], folder).stdout
    )
    monkeypatch.setattr(seal, "ROWS", 3)
    done = here(["generate", *TINY, "levels=6", "executor=inline"], folder)
    assert done.returncode == 0, done.stderr
    assert [fragment.rows for fragment in read_manifest(split).fragments] == [3, 3], "it seals as it goes"
    assert answers(split) | {"status": ""} == before | {"status": ""}
    verified = here(["verify", "data/5k/s"], folder)
    assert verified.returncode == 0, verified.stdout


def test_seal_rejects_invalid_arguments_and_damaged_splits(tmp_path: Path, split: Path) -> None:
    assert_refused(here(["seal", "data/5k/s", "--rows", "0"], tmp_path), 2, "--rows a number from 1")
    assert_refused(here(["seal", "data/5k/s", "--key-every", "16"], tmp_path), 2, "applies only to --density witness")
    with only_writer(split, print):
        assert_refused(here(["seal", "data/5k/s"], tmp_path), 2, "Another", "is writing to data/5k/s")
    shard = split / sorted(read_manifest(split).shards)[0]
    (shard / "act/c/0/0/0").write_bytes(b"x")
    before = sorted(split.rglob("*"))
    assert_refused(here(["seal", "data/5k/s"], tmp_path), 1, "missing or damaged", shard.name)
    assert sorted(split.rglob("*")) == before

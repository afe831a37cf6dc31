"""Level files: exported from a real split, and read by commands, hostile ones included."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.experts.witness.witness import Record, replay, succeeds
from levelproof.levelgen.files.level_file import MAX_BYTES, LevelFile, read_level_file, write_level_file
from levelproof.levelgen.level import SIZES, concatenate_levels
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.cli.main import main
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.exchange.level_json import export
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.layout import SHARDS
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.shard import Shard
from tests.levelgen.opened import open_in_reference
from tests.pipeline.made import PLAYED, made_job
from tests.trees import assert_same


@pytest.fixture(scope="module")
def file(split, tmp_path_factory) -> Path:
    """A good level file."""
    path = tmp_path_factory.mktemp("file") / "level.json"
    export(split, 0, path)
    return path


def level_with(split: Path, label: str) -> dict[str, Any]:
    return next(row for row in require_manifest(split).table.to_pylist() if row["label"] == label)


@pytest.mark.parametrize("label", ["solved", "unsolved"])
def test_export_writes_the_level_that_its_id_makes(split, tmp_path, capsys, label) -> None:
    level_id, out = level_with(split, label)["level_id"], tmp_path / "new" / "level.JSON"
    assert main(["export", str(split), str(level_id), "-o", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: level {level_id} of size s, for Kinetix\n"
    job = made_job()
    file = read_level_file(out)
    assert_same(file.level, sample_levels(np.array([level_id]), SIZES["s"], job.distribution))
    assert file.rules == job.task


def test_witness_solves_the_exported_level(split, tmp_path) -> None:
    row = level_with(split, "solved")
    export(split, row["level_id"], tmp_path / "level.json")
    file = read_level_file(tmp_path / "level.json")
    action = tree_of(Record, Shard(split / row["shard"]).read([row["row"]]), "record/").action
    replayed = replay(file.level, action, file.rules)
    assert succeeds(np.asarray(replayed.done), np.asarray(replayed.goal)).all()


def test_reference_opens_exported_levels(reference, split, tmp_path) -> None:
    files = [tmp_path / f"{label}.json" for label in ("solved", "unsolved")]
    for path in files:
        export(split, level_with(split, path.stem)["level_id"], path)
    theirs = open_in_reference(reference, files, tmp_path / "out.npz").levels()
    assert_same(concatenate_levels([read_level_file(path).level for path in files]), theirs)


def test_export_rejects_invalid_arguments(split, tmp_path) -> None:
    with pytest.raises(UserError, match=rf"^There is no level {PLAYED} in .*64 levels, from 0 to 63\.$"):
        export(split, PLAYED, tmp_path / "level.json")
    with pytest.raises(UserError, match=r"its name must end in \.json\.$"):
        export(split, 0, tmp_path / "level.npz")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"^Cannot write .*: choose another file with -o"):
        export(split, 0, tmp_path / "file" / "level.json")


def test_export_reports_a_damaged_shard(split, tmp_path, capsys) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(split, copy)
    row = level_with(copy, "solved")
    shutil.rmtree(copy / SHARDS)
    assert main(["export", str(copy), str(row["level_id"]), "-o", str(tmp_path / "level.json")]) == 1
    assert "is missing or damaged" in capsys.readouterr().err


def test_show_draws_a_level_file(split, tmp_path, capsys) -> None:
    file = tmp_path / "level.json"
    export(split, 1, file)  # trivial after a few steps, so films are short
    capsys.readouterr()
    for suffix in (".png", ".gif", ".mp4", ".svg"):
        assert main(["show", str(file), "-o", str(tmp_path / f"level{suffix}")]) == 0
    still, *films = capsys.readouterr().out.splitlines()
    description = "level.json, a level of size s: no witness of a level file is shown, so this is"
    assert still.endswith(f"{description} its initial world")
    assert all(f"{description} what doing nothing does (" in film for film in films)
    assert (tmp_path / "level.gif").read_bytes().startswith(b"GIF8")
    assert "doing nothing · 0.0 s" in (tmp_path / "level.svg").read_text()


def error_of(capsys, arguments: list[str]) -> str:
    assert main(arguments) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert sentence.startswith("Error: ")
    assert sentence.endswith((".", ")"))
    return sentence


def test_show_takes_an_id_with_a_split_and_not_with_a_level_file(file, split, capsys) -> None:
    assert "leave out the id 3" in error_of(capsys, ["show", str(file), "3"])
    assert "Add its id, such as 0" in error_of(capsys, ["show", str(split)])
    assert "There is no split at" in error_of(capsys, ["show", "nothing"])
    assert "Cannot read the level file nothing.json" in error_of(capsys, ["show", "nothing.json"])


def test_show_rejects_hostile_level_files_in_one_sentence(file, tmp_path, capsys) -> None:
    text, path = file.read_text(), tmp_path / "hostile.json"
    document = json.loads(text)
    million = document | {"static_env_params": document["static_env_params"] | {"num_circles": 10**6}}
    for hostile, expected in {
        "": "is not JSON",
        "[" * MAX_BYTES: "nested too deeply",
        "[]" * MAX_BYTES: "no level needs more than 4,000,000",
        json.dumps(million): "num_circles is 1000000",
        text.replace('"radius": 0.0', '"radius": NaN', 1): "polygon[0].radius is NaN",
        text.replace('"a_index": ', '"a_index": 9', 1): "joint[0].a_index is 9",
        text.replace('"role": 0', '"role": "red"', 1): 'polygon[0].role is "red"',
    }.items():
        path.write_text(hostile)
        sentence = error_of(capsys, ["show", str(path), "-o", str(tmp_path / "level.png")])
        assert expected in sentence
        assert f"the level file {path}: " in sentence
    assert not (tmp_path / "level.png").exists()


def test_show_draws_a_level_with_extreme_values(file, tmp_path) -> None:
    """Extreme values within bounds need no more memory or time than others."""
    level = read_level_file(file).level
    far = jax.tree.map(lambda x: np.full_like(x, 1000.0) if x.dtype == np.float32 else x, level)
    still = level.model.inverse_mass * 0
    model = dataclasses.replace(far.model, inverse_mass=still, inverse_inertia=still)
    state = dataclasses.replace(far.state, velocity=level.state.velocity, angular_velocity=still)
    write_level_file(LevelFile(dataclasses.replace(far, model=model, state=state), TaskParams()), tmp_path / "far.json")
    for suffix in (".png", ".gif", ".svg"):
        assert main(["show", str(tmp_path / "far.json"), "-o", str(tmp_path / f"far{suffix}")]) == 0

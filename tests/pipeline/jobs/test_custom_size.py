"""A dataset of a custom size and a preset distribution, on which every command works; and sheets of sampled levels."""

import shlex
from pathlib import Path

import pytest
from PIL import Image

from levelproof.pipeline.exchange.level_json import export
from levelproof.pipeline.look.inspect import inspect, survey
from levelproof.pipeline.look.query import RowQuery
from levelproof.pipeline.look.show import show
from levelproof.pipeline.look.status import read_status
from levelproof.pipeline.store.manifest import read_manifest
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import assert_same_content

SIZE = "5-3-2-2"
SPLIT = f"data/5k/{SIZE}"

pytestmark = pytest.mark.campaign


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a tiny real split of this size: levels 5 to 8; even a long search does not solve level 8."""
    folder = tmp_path_factory.mktemp("custom")
    words = [f"size={SIZE}", "distribution=free", "first_level=5", "levels=4", "budget=5k", "executor=inline"]
    done = here(["generate", *words], folder)
    assert done.returncode == 0, done.stderr
    assert f"of size {SIZE}" in done.stderr
    return folder


def test_manifest_names_size_and_distribution(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = read_manifest(made / SPLIT).table.to_pylist()
    assert [row["size"] for row in rows] == [SIZE] * 4
    assert rows[0]["command"] == f"levelproof generate size={SIZE} budget=5k distribution=free first_level=5 levels=1"
    inspect(made / SPLIT, RowQuery(limit=0), False)
    name, digest = survey(made / SPLIT)["distribution"].values()
    assert name == "free"
    assert f"free ({digest})" in capsys.readouterr().out


@pytest.mark.parametrize("size", ["4-2-0-1", "6-0-1-1", "5-2-1-0"])
def test_sizes_without_joints_thrusters_or_circles_generate_verify_and_export(tmp_path: Path, size: str) -> None:
    done = here(["generate", f"size={size}", "levels=4", "unit=4", "budget=5k", "executor=inline"], tmp_path)
    assert done.returncode == 0, done.stderr
    done = here(["verify", f"data/5k/{size}"], tmp_path)
    assert done.returncode == 0, done.stdout
    for kind in "kinetix", "minari":
        done = here(["export", f"data/5k/{size}", "--format", kind, "-o", kind], tmp_path)
        assert done.returncode == 0, done.stderr
    done = here(["import", "kinetix", "-o", f"again/5k/{size}"], tmp_path)
    assert done.returncode == 0, done.stderr


def test_commands_work_on_a_custom_size(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    split, level, picture = made / SPLIT, made / "level.json", made / "level.png"
    facts = read_status(split)
    assert (facts["wanted"], facts["done"]) == (4, 4)
    findings = examine(split)
    assert findings.witnesses > 0
    assert findings.sentences == []
    rows = {row["shard"] is not None: row["level_id"] for row in read_manifest(split).table.to_pylist()}
    assert rows.keys() == {True, False}
    for level_id in rows.values():
        show(split, level_id, picture)
        assert f"level {level_id} of size {SIZE}" in capsys.readouterr().out
    export(split, rows[False], level)
    show(level, None, picture)
    assert f"a level of size {SIZE}" in capsys.readouterr().out


def test_command_of_a_row_reproduces_the_row(made: Path) -> None:
    row = next(row for row in read_manifest(made / SPLIT).table.to_pylist() if row["shard"])
    words = shlex.split(row["command"])[1:]
    done = here([*words, "executor=inline", "out=again"], made)
    assert done.returncode == 0, done.stderr
    assert_same_content(made / SPLIT, made / "again" / "5k" / SIZE, [row["level_id"]])


def test_generate_rejects_another_distribution_in_the_same_folder(made: Path) -> None:
    done = here(["generate", f"size={SIZE}", "levels=4", "budget=5k", "executor=inline"], made)
    assert_refused(done, 2, "distribution.max_fixed_chance was 0", "out=NAME")


def test_sample_draws_a_sheet(tmp_path: Path) -> None:
    done = here(
        ["sample", "size=6-2-1-1", "distribution=clutter", "levels=7", "first_level=3", "-o", "a/b.png"], tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "a/b.png: levels 3 to 9 of size 6-2-1-1, distribution clutter"
    with Image.open(tmp_path / "a/b.png") as sheet:
        assert sheet.size[0] == 5 * 220
        assert len(sheet.getcolors(1 << 20) or []) > 10


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["-o", "sheet.gif"], "must end in .png"),
        (["levels=101"], "a sheet has room for at most 100"),
        (["size=7"], "choose one of s, m, l"),
        (["distribution=messy"], "there is no distribution messy"),
        (["levels=1", "-o", "/dev/null/sheet.png"], "Cannot write /dev/null/sheet.png"),
    ],
)
def test_sample_names_the_mistake(tmp_path: Path, words: list[str], sentence: str) -> None:
    assert_refused(here(["sample", *words], tmp_path), 2, sentence)

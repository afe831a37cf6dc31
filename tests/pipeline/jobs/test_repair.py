"""What is damaged or missing is made again bit for bit, and what is sound is not touched."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from pipeline.jobs.seal import seal_split
from pipeline.read.verify import examine
from pipeline.store.fields import same_bits
from pipeline.store.layout import JOB
from pipeline.store.manifest import fragment_paths, read_manifest
from pipeline.store.shard import Shard
from tests.pipeline.command import here
from tests.pipeline.read.test_damage import files_of, flip

pytestmark = pytest.mark.slow
COMMAND = ["generate", "levels=6", "unit=2", "budget=5k", "executor=inline", "keep_experts=true"]
SPLIT = Path("data/5k/s")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    done = here(COMMAND, folder)
    assert done.returncode == 0, done.stderr
    assert not examine(folder / SPLIT).wrong
    return folder / SPLIT


@pytest.fixture(scope="module")
def sealed(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first two units in one fragment."""
    split = tmp_path_factory.mktemp("sealed") / "s"
    shutil.copytree(whole, split)
    last = fragment_paths(split)[-1]
    away = last.rename(split.parent / last.name)
    seal_split(split, None, Console(quiet=True))
    away.rename(last)
    return split


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[Path], Path]:
    return lambda split: Path(shutil.copytree(split, tmp_path / "elsewhere"))


def content(split: Path) -> tuple[str, dict[int, dict[str, np.ndarray]]]:
    """The rows but for where their data is, and the fields of every witness."""
    rows = read_manifest(split).table.to_pylist()
    fields = {row["level_id"]: Shard(split / row["shard"]).read([row["row"]]) for row in rows if row["shard"]}
    places = ("shard", "row", "experts")
    return repr([{k: bool(v) if k in places else v for k, v in (row | {"row": 0}).items()} for row in rows]), fields


def assert_as_before(split: Path, before: Path) -> None:
    (rows, fields), (rows_before, fields_before) = content(split), content(before)
    assert rows == rows_before
    assert fields.keys() == fields_before.keys()
    for level_id, arrays in fields.items():
        assert all(same_bits(x, fields_before[level_id][name]).all() for name, x in arrays.items())
    assert not examine(split).wrong
    named = read_manifest(split).named
    assert {f"shards/{path.name}" for path in (split / "shards").iterdir()} == named["shard"]
    assert {f"experts/{path.name}" for path in (split / "experts").iterdir()} == named["experts"]


def repaired(split: Path) -> str:
    done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def untouched(split: Path, fragment: Path) -> set[tuple[Path, int, int]]:
    """Files that this fragment commits, as the file system knows them."""
    files = [fragment, *(file for file, levels in files_of(split).items() if levels & files_of(split)[fragment])]
    return {(file, file.stat().st_ino, file.stat().st_mtime_ns) for file in files}


def test_several_damages_are_repaired_together(whole: Path, copied: Callable[[Path], Path]) -> None:
    """A chunk of a shard, a fragment that cannot be read, and the note; the third unit stays as it is."""
    split, chance = copied(whole), random.Random(0)
    first, second, third = fragment_paths(split)
    kept = untouched(split, third)
    shard = next(path for path in (split / "shards").iterdir() if path.name.startswith(first.stem))
    flip(shard / "dyn32/c/0/0/0", chance)
    second.write_bytes(b"PAR1")
    (split / JOB).unlink()
    told = repaired(split)
    assert str(second) in told
    assert str(shard) in told
    assert untouched(split, third) == kept
    assert_as_before(split, whole)
    assert "nothing" not in repaired(split)

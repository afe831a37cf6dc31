"""`verify --repair` regenerates what is damaged or missing bit for bit, and leaves sound files untouched."""

import random
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from levelproof.pipeline.jobs import repair as repairing
from levelproof.pipeline.jobs.seal import seal_split
from levelproof.pipeline.store import mend
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import JOB, WRITER_LOCK, new_attempt
from levelproof.pipeline.store.manifest import begin_fragment, fragment_paths, read_manifest, write_fragment
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import assert_refused, here, run
from tests.pipeline.made import assert_same_content
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
    """Return a copy of `whole` with its first two units sealed into one fragment."""
    split = tmp_path_factory.mktemp("sealed") / "s"
    shutil.copytree(whole, split)
    last = fragment_paths(split)[-1]
    away = last.rename(split.parent / last.name)
    seal_split(split, None, Console(quiet=True))
    away.rename(last)
    return split


@pytest.fixture(scope="module")
def witness(sealed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of `sealed` with records stored at density "witness"."""
    split = tmp_path_factory.mktemp("witness") / "s"
    shutil.copytree(sealed, split)
    seal_split(split, 2, Console(quiet=True), "witness")
    return split


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[Path], Path]:
    return lambda split: Path(shutil.copytree(split, tmp_path / "elsewhere"))


def assert_as_before(split: Path, before: Path, deleted: bool = False) -> None:
    """Check that the split equals `before`; if a fragment was `deleted`, its data files may stay."""
    assert_same_content(split, before)
    kept, kept_before = ([bool(x) for x in read_manifest(at).table["experts"].to_pylist()] for at in (split, before))
    assert kept == kept_before
    assert not examine(split).wrong
    named = read_manifest(split).named
    for folder, column in ("shards", "shard"), ("experts", "experts"):
        there = {f"{folder}/{path.name}" for path in (split / folder).iterdir()}
        assert there == named[column] or (deleted and there > named[column])


def repaired(split: Path) -> str:
    done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def untouched(split: Path, fragment: Path) -> set[tuple[Path, int, int]]:
    """Return the files that this fragment commits, with their inodes and times."""
    files = [fragment, *(file for file, levels in files_of(split).items() if levels & files_of(split)[fragment])]
    return {(file, file.stat().st_ino, file.stat().st_mtime_ns) for file in files}


def data_files(split: Path) -> set[tuple[Path, int]]:
    """Return all files with their times, without those that any repair writes: the note and the writer's lock."""
    files = (file for file in split.rglob("*") if file.name not in (JOB, WRITER_LOCK) and file.is_file())
    return {(file, file.stat().st_mtime_ns) for file in files}


def test_repair_restores_a_shard_a_fragment_and_the_note_at_once(whole: Path, copied: Callable[[Path], Path]) -> None:
    """A chunk of a shard is damaged, a fragment is unreadable, and the note is missing; the third unit is sound."""
    split, rng = copied(whole), random.Random(0)
    first, second, third = fragment_paths(split)
    kept = untouched(split, third)
    shard = next(path for path in (split / "shards").iterdir() if path.name.startswith(first.stem))
    flip(shard / "dyn32/c/0/0/0", rng)
    second.write_bytes(b"PAR1")
    (split / JOB).unlink()
    output = repaired(split)
    assert str(second) in output
    assert str(shard) in output
    assert untouched(split, third) == kept
    assert_as_before(split, whole)
    before = data_files(split)
    assert " 0 problems." in repaired(split)
    assert data_files(split) == before


@pytest.mark.campaign
def test_repair_runs_on_ray_workers(whole: Path, copied: Callable[[Path], Path]) -> None:
    """Two workers, forked from a process that has not started JAX."""
    split = copied(whole)
    for path in fragment_paths(split)[:2]:
        path.write_bytes(b"PAR1")
    done = run(["verify", str(split), "--repair", "workers=2", "unit=1"], split.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert_as_before(split, whole)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["whole", "sealed", "witness"])
def test_repair_restores_each_kind_of_file(
    kind: str, whole: Path, copied: Callable[[Path], Path], request: pytest.FixtureRequest
) -> None:
    """Flip bits in the first fragment and in each kind of its data files, then delete them; repair after each kind."""
    split, rng = copied(request.getfixturevalue(kind)), random.Random(3)
    for kinds in ("zarr.json", "c", "npz", "parquet", "json", "gone"):
        last = fragment_paths(split)[-1]
        kept = untouched(split, last)
        files = [file for file, levels in files_of(split).items() if levels & files_of(split)[fragment_paths(split)[0]]]
        chosen = [file for file in files if kinds in (file.name, file.suffix[1:], *file.relative_to(split).parts)]
        if kinds == "json":
            chosen = [split / JOB]
        for file in chosen or [fragment_paths(split)[0]]:
            if kinds == "gone":
                file.unlink()
            else:
                flip(file, rng)
        repaired(split)
        assert untouched(split, last) == kept
        assert_as_before(split, whole, deleted=kinds == "gone")


class Killed(BaseException):
    """Simulates the death of the process."""


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["whole", "sealed"])
def test_repair_continues_after_a_kill_at_any_step(
    kind: str, whole: Path, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kill it before and after each step that writes to the disk."""
    original, rng = request.getfixturevalue(kind), random.Random(4)
    steps = [(repairing, name) for name in ("note_job", "take_out", "taken", "generate")]
    steps += [(mend, name) for name in ("begin_fragment", "merge_shards", "disown", "write_fragment")]
    for number, (module, name) in enumerate(steps):
        for after in (False, True):
            split = Path(shutil.copytree(original, tmp_path / f"{number}-{after}"))
            first = fragment_paths(split)[0]
            shards = [path for path in (split / "shards").iterdir() if path.name.startswith(first.stem)]
            flip(shards[0] / "dyn32/c/0/0/0", rng)
            fragment_paths(split)[-1].write_bytes(b"PAR1")
            done = getattr(module, name)

            def die(*args: Any, done: Any = done, after: bool = after, **kwargs: Any) -> None:
                if after:
                    done(*args, **kwargs)
                raise Killed

            with monkeypatch.context() as patched:
                patched.setattr(module, name, die)
                with suppress(Killed):  # some repairs skip this step
                    repaired(split)
            repaired(split)
            assert_as_before(split, whole)


@pytest.mark.campaign
def test_repair_reports_and_keeps_levels_of_another_stack(copied: Callable[[Path], Path], whole: Path) -> None:
    split = copied(whole)
    (path, *_) = fragment_paths(split)
    fragment, rows = read_fragment(path)
    column = rows.schema.get_field_index("device")
    rows = rows.set_column(column, rows.schema.field(column), [["cpu: of another kind"] * rows.num_rows])
    attempt = new_attempt(split, path.stem)
    begin_fragment(attempt)
    write_fragment(attempt, rows, fragment.config_hash, fragment.config)
    names = [name for name in rows.column("shard").to_pylist() if name]
    (split / names[0] / "dyn32/c/0/0/0").write_bytes(b"")
    before = data_files(split)
    done = here(["verify", str(split), "--repair", "executor=inline"], split.parent)
    assert done.returncode == 1
    assert "Not regenerated: level" in done.stdout
    assert "made with other versions or on another device (cpu: of another kind)" in done.stdout
    assert data_files(split) == before


@pytest.mark.parametrize(("words", "device"), [([], "cpu"), (["device=gpu"], "gpu")])
def test_repair_examines_on_the_device_that_makes_what_is_lost(
    words: list[str], device: str, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(repairing, "in_another_process", lambda function, *given: asked.append(given) or examine(whole))
    assert repairing.repair(whole, words, Console(stderr=True)) == 0
    assert asked == [(whole, device)]


@pytest.mark.parametrize("word", ["size=m", "budget=1M", "out=x", "nonsense"])
def test_repair_rejects_settings_that_decide_results(word: str, tmp_path: Path) -> None:
    done = here(["verify", str(tmp_path), "--repair", word], tmp_path)
    assert_refused(done, 2, "A repair uses the settings of its split", "executor, workers, unit")

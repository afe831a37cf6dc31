"""Damage of every kind is found, wherever in a split it is, and named with the levels that it hits."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from levelproof.configs.schema import Density
from levelproof.pipeline.jobs.seal import seal_split
from levelproof.pipeline.store.layout import JOB
from levelproof.pipeline.store.locks import nobody_commits
from levelproof.pipeline.store.manifest import fragment_paths, read_fragment
from levelproof.pipeline.store.mend import take_out
from levelproof.pipeline.verify.findings import Findings
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import here
from tests.pipeline.made import honest_split

pytestmark = pytest.mark.slow
FLIPS = 1000
LESS = ("resume", "witness")


@pytest.fixture(scope="module")
def unsealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_split(tmp_path_factory.mktemp("unsealed"), 4, 6)


@pytest.fixture(scope="module")
def mixed(unsealed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four units in two sealed fragments, and two units that came later."""
    split, later = tmp_path_factory.mktemp("mixed") / "s", tmp_path_factory.mktemp("later")
    shutil.copytree(unsealed, split)
    kept = fragment_paths(split)[4:]
    for path in kept:
        path.rename(later / path.name)
    seal_split(split, 8, Console(quiet=True))
    for path in kept:
        (later / path.name).rename(path)
    assert len(fragment_paths(split)) == 4
    return split


def converted(split: Path, folder: Path, density: Density) -> Path:
    """Three sealed fragments, whose shards store less."""
    shutil.copytree(split, folder / "s")
    seal_split(folder / "s", 8, Console(quiet=True), density, 16)
    return folder / "s"


@pytest.fixture(scope="module")
def resume(unsealed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return converted(unsealed, tmp_path_factory.mktemp("resume"), "resume")


@pytest.fixture(scope="module")
def witness(unsealed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return converted(unsealed, tmp_path_factory.mktemp("witness"), "witness")


def files_of(split: Path) -> dict[Path, set[int]]:
    """All that is committed, and the levels that each file is there for."""
    files: dict[Path, set[int]] = {split / JOB: set()}
    for fragment in fragment_paths(split):
        rows = read_fragment(fragment, ["level_id", "shard", "experts"])[1].to_pylist()
        files[fragment] = {row["level_id"] for row in rows}
        for row in rows:
            for name in filter(None, (row["shard"], row["experts"])):
                for file in [split / name, *(split / name).rglob("*")]:
                    if file.is_file():
                        files.setdefault(file, set()).add(row["level_id"])
    return files


def flip(file: Path, random: random.Random) -> None:
    content = bytearray(file.read_bytes())
    content[random.randrange(len(content))] ^= random.randrange(1, 256)
    file.write_bytes(content)


def hit(found: Findings) -> set[int]:
    return {level_id for level_ids in found.wrong.values() for level_id in level_ids}


def assert_named(found: Findings, split: Path, file: Path, levels: set[int]) -> None:
    """Nothing but this file is damaged: all of its levels are named, or of its trajectories some."""
    assert found.sentences
    if file.name == JOB:
        assert f"The file {file} is" in found.sentences[0]
    named = hit(found)
    if "c" in file.relative_to(split).parts:
        assert named
        assert named <= levels
    else:
        assert named == levels


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[Path], Path]:
    return lambda split: Path(shutil.copytree(split, tmp_path / "s"))


def assert_all_named(
    split: Path, files: dict[Path, set[int]], change: Callable[[Path], None], some: list[Path]
) -> None:
    """A change of some files is seen in each of them, and what is hit is what they hold; they are put back."""
    before = {file: file.read_bytes() for file in some}
    for file in some:
        change(file)
    found = examine(split)
    for file, data in before.items():
        file.write_bytes(data)
    assert (split / JOB not in some) or any(f"{split / JOB}" in sentence for sentence in found.sentences)
    named = hit(found)
    assert named <= set[int]().union(*(files[file] for file in some))
    for file in set(some) - {split / JOB}:
        assert named & files[file], file
        assert "c" in file.relative_to(split).parts or files[file] <= named, file


@pytest.mark.parametrize("kind", ["unsealed", "mixed", *LESS])
def test_flips_in_many_files_at_once(kind: str, copied: Callable[[Path], Path], request: pytest.FixtureRequest) -> None:
    """One in each of ten; what is hit is what they hold, and what they do not is looked at nevertheless."""
    split, chance = copied(request.getfixturevalue(kind)), random.Random(0)
    assert not examine(split).wrong
    files = files_of(split)
    chosen = [*chance.sample(sorted(files.keys() - {split / JOB}), 9), split / JOB]
    assert_all_named(split, files, lambda file: flip(file, chance), chosen)


def spoil(file: Path, chance: random.Random) -> None:
    """A byte is another one, or the file is shorter, longer, empty, or all zeros."""
    data = file.read_bytes()
    match chance.randrange(8):
        case 0:
            file.write_bytes(data[: chance.randrange(len(data))])
        case 1:
            file.write_bytes(data + bytes([chance.randrange(256)]))
        case 2:
            file.write_bytes(b"")
        case 3:
            file.write_bytes(bytes(len(data)))
        case _:
            flip(file, chance)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", LESS)
def test_a_thousand_damages_of_splits_that_store_less(
    kind: str, copied: Callable[[Path], Path], request: pytest.FixtureRequest
) -> None:
    """In ten files at a time."""
    split, chance = copied(request.getfixturevalue(kind)), random.Random(5)
    files = files_of(split)
    for _ in range(FLIPS // 2 // 10):
        chosen = chance.sample(sorted(files), 10)
        assert_all_named(split, files, lambda file: spoil(file, chance), chosen)
    assert not examine(split).wrong


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["unsealed", "mixed"])
def test_each_of_a_thousand_flips(kind: str, request: pytest.FixtureRequest) -> None:
    """A fifth of them alone, so that nothing else may be named; the others in four files at a time."""
    split, chance = request.getfixturevalue(kind), random.Random(1)
    files = files_of(split)
    for _ in range(FLIPS // 10):
        file = chance.choice(sorted(files))
        before = file.read_bytes()
        try:
            flip(file, chance)
            assert_named(examine(split), split, file, files[file])
        finally:
            file.write_bytes(before)
    for _ in range(FLIPS // 10):
        assert_all_named(split, files, lambda file: flip(file, chance), chance.sample(sorted(files), 4))
    assert not examine(split).wrong


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["unsealed", "mixed"])
def test_each_file_cut_off_lengthened_or_gone(kind: str, request: pytest.FixtureRequest) -> None:
    split, chance = request.getfixturevalue(kind), random.Random(2)
    for file, levels in sorted(files_of(split).items()):
        before = file.read_bytes()
        for after in (before[: chance.randrange(len(before))], before[:-1], before + b"\0", b"", None):
            if after is None:
                file.unlink()
            else:
                file.write_bytes(after)
            found = examine(split)
            file.write_bytes(before)
            if file.suffix == ".parquet" and after is None:
                missing = {i for first, last in found.missing for i in range(first, last + 1)}
                assert hit(found) | missing == levels
            else:
                assert_named(found, split, file, levels)


def exchange(a: Path, b: Path) -> None:
    other = a.with_name("other")
    a.rename(other)
    b.rename(a)
    other.rename(b)


@pytest.mark.parametrize("kind", ["unsealed", "mixed", *(pytest.param(x, marks=pytest.mark.campaign) for x in LESS)])
def test_what_is_exchanged(kind: str, copied: Callable[[Path], Path], request: pytest.FixtureRequest) -> None:
    """Two shards, two fragments, two files of chunks; and a file that was not there."""
    split = copied(request.getfixturevalue(kind))
    fragments, shards = fragment_paths(split), sorted((split / "shards").iterdir())
    files = files_of(split)
    chunks = [min(file for file in shard.glob("*/c/**/*") if file.is_file()) for shard in shards[1:3]]
    for a, b in (shards[:2], fragments[:2], chunks):
        exchange(a, b)
        found = examine(split)
        exchange(a, b)
        levels = set[int]().union(*(of for file, of in files.items() if {a, b} & {file, *file.parents}))
        assert hit(found) == levels, (a, b)
    (shards[0] / "more").touch()
    assert examine(split).sentences == [
        f"The file {shards[0]}/more is not what was committed ({_hits(files[shards[0] / 'zarr.json'])})."
    ]


def _hits(levels: set[int]) -> str:
    from levelproof.pipeline.verify.findings import _levels

    return _levels(levels)


def test_what_is_missing(copied: Callable[[Path], Path], unsealed: Path) -> None:
    split = copied(unsealed)
    files = files_of(split)
    first, second = fragment_paths(split)[:2]
    first.unlink()
    shard = next(path for path in sorted((split / "shards").iterdir()) if path.name.startswith(second.stem))
    levels = files[shard / "zarr.json"]
    shutil.rmtree(shard)
    found = examine(split)
    assert found.missing == [] or set(range(*found.missing[0])) <= files[first]
    assert hit(found) | {i for a, b in found.missing for i in range(a, b + 1)} == files[first] | levels
    (split / JOB).unlink()
    assert any("nobody knows which levels" in sentence for sentence in examine(split).sentences)


def test_a_seal_and_a_repair_keep_the_digests_of_experts(tmp_path: Path) -> None:
    """They neither read the experts nor take damage for the truth."""
    split = honest_split(tmp_path, 4, 2, experts=True)
    first, second = sorted((split / "experts").iterdir())
    committed = {name: of for path in fragment_paths(split) for name, of in read_fragment(path)[0].digests.items()}
    data = bytearray(first.read_bytes())
    data[len(data) // 2] ^= 1
    first.write_bytes(data)
    (split / "experts").rename(tmp_path / "away")
    seal_split(split, 8, Console(quiet=True))
    (tmp_path / "away").rename(split / "experts")
    (path,) = fragment_paths(split)
    names = {f"experts/{file.name}" for file in (first, second)}
    assert {name: read_fragment(path)[0].digests[name] for name in names} == {name: committed[name] for name in names}
    done = here(["verify", str(split)], tmp_path)
    assert done.returncode == 1
    assert f"The file {first} is not what was committed" in done.stdout
    with nobody_commits(split, print):
        take_out(split, [4], [], [])
    (path,) = fragment_paths(split)
    fragment, rows = read_fragment(path)
    assert 4 not in rows.column("level_id").to_pylist()
    assert {name: fragment.digests[name] for name in names} == {name: committed[name] for name in names}

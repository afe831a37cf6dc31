"""`examine` on damaged splits: it finds any damage in any file, and names the levels affected."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from levelproof.configs.schema import Density
from levelproof.pipeline.jobs.seal import seal_split
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.layout import JOB
from levelproof.pipeline.store.locks import without_commits
from levelproof.pipeline.store.manifest import fragment_paths, write_index
from levelproof.pipeline.store.mend import take_out
from levelproof.pipeline.verify.findings import Findings
from levelproof.pipeline.verify.verify import examine
from tests.pipeline.command import here
from tests.pipeline.made import honest_split

pytestmark = pytest.mark.slow
FLIPS = 1000
SPARSE = ("resume", "witness")


@pytest.fixture(scope="module")
def unsealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_split(tmp_path_factory.mktemp("unsealed"), 4, 6)


@pytest.fixture(scope="module")
def mixed(unsealed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sealed fragments of four units, and two units added later."""
    split, later = tmp_path_factory.mktemp("mixed") / "s", tmp_path_factory.mktemp("later")
    shutil.copytree(unsealed, split)
    kept = fragment_paths(split)[4:]
    for path in kept:
        path.rename(later / path.name)
    seal_split(split, 8, Console(quiet=True))
    for path in kept:
        (later / path.name).rename(path)
    write_index(split)
    assert len(fragment_paths(split)) == 4
    return split


def converted(split: Path, folder: Path, density: Density) -> Path:
    """Copy a split and seal it into three fragments at a lower density."""
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
    """Map each committed file to the levels that depend on it."""
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


def damaged_levels(findings: Findings) -> set[int]:
    return {level_id for level_ids in findings.wrong.values() for level_id in level_ids}


def assert_named(findings: Findings, split: Path, file: Path, levels: set[int]) -> None:
    """Check that only this file's levels are named: all of them, or some if the file stores trajectories."""
    assert findings.sentences
    if file.name == JOB:
        assert f"The file {file} is" in findings.sentences[0]
    named = damaged_levels(findings)
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
    """Change some files, check that `examine` names levels of each and no others, and restore the files."""
    before = {file: file.read_bytes() for file in some}
    for file in some:
        change(file)
    findings = examine(split)
    for file, data in before.items():
        file.write_bytes(data)
    assert (split / JOB not in some) or any(f"{split / JOB}" in sentence for sentence in findings.sentences)
    named = damaged_levels(findings)
    assert named <= set[int]().union(*(files[file] for file in some))
    for file in set(some) - {split / JOB}:
        assert named & files[file], file
        assert "c" in file.relative_to(split).parts or files[file] <= named, file


@pytest.mark.parametrize("kind", ["unsealed", "mixed", *SPARSE])
def test_examine_finds_flips_in_ten_files_at_once(
    kind: str, copied: Callable[[Path], Path], request: pytest.FixtureRequest
) -> None:
    """Damage in one file does not hide damage in another."""
    split, rng = copied(request.getfixturevalue(kind)), random.Random(0)
    assert not examine(split).wrong
    files = files_of(split)
    chosen = [*rng.sample(sorted(files.keys() - {split / JOB}), 9), split / JOB]
    assert_all_named(split, files, lambda file: flip(file, rng), chosen)


def spoil(file: Path, rng: random.Random) -> None:
    """Change a byte, shorten, lengthen, empty or zero the file."""
    data = file.read_bytes()
    match rng.randrange(8):
        case 0:
            file.write_bytes(data[: rng.randrange(len(data))])
        case 1:
            file.write_bytes(data + bytes([rng.randrange(256)]))
        case 2:
            file.write_bytes(b"")
        case 3:
            file.write_bytes(bytes(len(data)))
        case _:
            flip(file, rng)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", SPARSE)
def test_examine_finds_damage_at_lower_densities(
    kind: str, copied: Callable[[Path], Path], request: pytest.FixtureRequest
) -> None:
    split, rng = copied(request.getfixturevalue(kind)), random.Random(5)
    files = files_of(split)
    for _ in range(FLIPS // 2 // 10):
        chosen = rng.sample(sorted(files), 10)
        assert_all_named(split, files, lambda file: spoil(file, rng), chosen)
    assert not examine(split).wrong


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["unsealed", "mixed"])
def test_examine_finds_each_of_a_thousand_flips(kind: str, request: pytest.FixtureRequest) -> None:
    """Flip a fifth of them alone, so that no other level may be named; the others in four files at a time."""
    split, rng = request.getfixturevalue(kind), random.Random(1)
    files = files_of(split)
    for _ in range(FLIPS // 10):
        file = rng.choice(sorted(files))
        before = file.read_bytes()
        try:
            flip(file, rng)
            assert_named(examine(split), split, file, files[file])
        finally:
            file.write_bytes(before)
    for _ in range(FLIPS // 10):
        assert_all_named(split, files, lambda file: flip(file, rng), rng.sample(sorted(files), 4))
    assert not examine(split).wrong


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["unsealed", "mixed"])
def test_examine_finds_each_truncated_lengthened_or_missing_file(kind: str, request: pytest.FixtureRequest) -> None:
    split, rng = request.getfixturevalue(kind), random.Random(2)
    for file, levels in sorted(files_of(split).items()):
        before = file.read_bytes()
        for after in (before[: rng.randrange(len(before))], before[:-1], before + b"\0", b"", None):
            if after is None:
                file.unlink()
            else:
                file.write_bytes(after)
            findings = examine(split)
            file.write_bytes(before)
            if file.suffix == ".parquet" and after is None:
                missing = {i for first, last in findings.missing for i in range(first, last + 1)}
                assert damaged_levels(findings) | missing == levels
            else:
                assert_named(findings, split, file, levels)


def exchange(a: Path, b: Path) -> None:
    other = a.with_name("other")
    a.rename(other)
    b.rename(a)
    other.rename(b)


@pytest.mark.parametrize("kind", ["unsealed", "mixed", *(pytest.param(x, marks=pytest.mark.campaign) for x in SPARSE)])
def test_examine_finds_exchanged_and_extra_files(
    kind: str, copied: Callable[[Path], Path], request: pytest.FixtureRequest
) -> None:
    """Exchange two shards, two fragments and two chunk files; then add a file."""
    split = copied(request.getfixturevalue(kind))
    fragments, shards = fragment_paths(split), sorted((split / "shards").iterdir())
    files = files_of(split)
    chunks = [min(file for file in shard.glob("*/c/**/*") if file.is_file()) for shard in shards[1:3]]
    for a, b in (shards[:2], fragments[:2], chunks):
        exchange(a, b)
        findings = examine(split)
        exchange(a, b)
        levels = set[int]().union(*(ids for file, ids in files.items() if {a, b} & {file, *file.parents}))
        assert damaged_levels(findings) == levels, (a, b)
    (shards[0] / "more").touch()
    assert examine(split).sentences == [
        f"The file {shards[0]}/more is not what was committed ({_hits(files[shards[0] / 'zarr.json'])})."
    ]


def _hits(levels: set[int]) -> str:
    from levelproof.pipeline.verify.findings import _levels

    return _levels(levels)


def test_examine_finds_missing_files(copied: Callable[[Path], Path], unsealed: Path) -> None:
    split = copied(unsealed)
    files = files_of(split)
    first, second = fragment_paths(split)[:2]
    first.unlink()
    shard = next(path for path in sorted((split / "shards").iterdir()) if path.name.startswith(second.stem))
    levels = files[shard / "zarr.json"]
    shutil.rmtree(shard)
    findings = examine(split)
    assert damaged_levels(findings) | {i for a, b in findings.missing for i in range(a, b + 1)} == files[first] | levels
    (split / JOB).unlink()
    assert any("the last command requested are unknown" in sentence for sentence in examine(split).sentences)


def test_seal_and_repair_keep_the_digests_of_experts(tmp_path: Path) -> None:
    """Neither reads the experts, so neither commits a digest of damaged ones."""
    split = honest_split(tmp_path, 4, 2, experts=True)
    first, second = sorted((split / "experts").iterdir())
    committed = {
        name: digest for path in fragment_paths(split) for name, digest in read_fragment(path)[0].digests.items()
    }
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
    with without_commits(split, print):
        take_out(split, [4], [], [])
    (path,) = fragment_paths(split)
    fragment, rows = read_fragment(path)
    assert 4 not in rows.column("level_id").to_pylist()
    assert {name: fragment.digests[name] for name in names} == {name: committed[name] for name in names}

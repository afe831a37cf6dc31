"""Duplicate levels: in a split, between splits, and among level files."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from levelproof.experts.labels import Label
from levelproof.levelgen.files.level_file import LevelFile, read_level_file, write_level_file
from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.identity.signature import signatures
from levelproof.levelgen.level import Level, concatenate_levels
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.look.duplicates import between, comparison_of_source, describe, hash_strings, within
from levelproof.pipeline.look.inspect import survey
from levelproof.pipeline.look.query import RowQuery
from levelproof.pipeline.store.layout import split_path
from levelproof.pipeline.store.manifest import require_manifest
from tests.levelgen.opened import handmade_levels
from tests.levelgen.variants import edited, more_room, one, renamed, renumbered, turned
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import made_job, made_result

NONE = {"levels": 0, "pairs": []}
COUNT = 12
COPY, NUDGED = 9, 10  # level 9 is level 3 renumbered; level 10 is level 5 with one body displaced


def table(*rows: tuple[int | str, str, str, str]) -> pa.Table:
    """A table of names, content hashes and both halves of the signature."""
    names, contents, *halves = zip(*rows, strict=True)
    return pa.table({"name": names, "content_hash": contents, "signature": list(zip(*halves, strict=True))})


LEVELS = table((0, "a", "x", "p"), (1, "b", "x", "q"), (2, "a", "x", "p"), (3, "c", "y", "q"), (4, "d", "z", "r"))


def test_within_pairs_each_level_with_its_first_duplicate() -> None:
    assert within(LEVELS, 10) == {
        "same": {"levels": 1, "pairs": [[2, 0]]},
        "near": {"levels": 2, "pairs": [[1, 0], [3, 1]]},  # one half each; near counts contents, not levels
    }
    assert within(LEVELS.slice(3), 10) == {"same": NONE, "near": NONE}
    assert within(LEVELS.slice(0, 0), 10) == {"same": NONE, "near": NONE}


def test_between_counts_same_levels_only_as_same() -> None:
    others = table(("file b", "a", "x", "p"), ("file a", "a", "x", "p"), ("file c", "e", "x", "r"))
    assert between(LEVELS, others, 10) == {
        "same": {"levels": 2, "pairs": [[0, "file a"], [2, "file a"]]},
        "near": {"levels": 2, "pairs": [[1, "file a"], [4, "file c"]]},
    }
    assert between(LEVELS, others, 1)["same"] == {"levels": 2, "pairs": [[0, "file a"]]}
    assert between(LEVELS, others.slice(0, 0), 10) == {"same": NONE, "near": NONE}


def test_describe_names_an_example() -> None:
    assert describe(within(LEVELS, 1)) == "1 same (such as 2 and 0), 2 near (such as 1 and 0)"
    assert describe(within(LEVELS, 0)) == "1 same, 2 near"


def test_within_handles_100_000_levels() -> None:
    """Every third level is a copy of the one before."""
    contents = [str(i - i % 3 // 2) for i in range(100_000)]
    many = table(*((i, contents[i], f"x{contents[i]}", f"y{contents[i]}") for i in range(100_000)))
    duplicates = within(many, 2)
    assert duplicates == {"same": {"levels": 33_333, "pairs": [[2, 1], [5, 4]]}, "near": NONE}


def test_hash_strings_depends_on_the_string_alone() -> None:
    texts = ["", "a", "b", "ab", "a\0", "c1:0123456789abcdef", "c1:0123456789abcdee", "n" * 600, "m" + "n" * 599]
    alone = [hash_strings(pa.chunked_array([[text]]))[0] for text in texts]
    assert len(set(alone)) == len(texts)
    assert hash_strings(pa.chunked_array([texts[:4], texts[4:], texts])).tolist() == [*alone, *alone]
    assert hash_strings(pa.chunked_array([], pa.string())).tolist() == []


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A split of sampled levels and two planted duplicates; labels and records are invented."""
    rng = np.random.default_rng(0)
    levels = [one("s", i) for i in range(COUNT)]
    levels[COPY] = renumbered(levels[3], rng)
    place = np.array(levels[5].state.position)
    place[np.flatnonzero(levels[5].model.active)[-1]] += 1e-4
    levels[NUDGED] = edited(levels[5], state={"position": place})
    return committed(tmp_path_factory.mktemp("data"), levels)


def committed(folder: Path, levels: list[Level]) -> Path:
    job = made_job(str(folder), "size=s", f"levels={len(levels)}")
    path, ids = split_path(job.out, job.budget, job.size), list(range(len(levels)))
    path.mkdir(parents=True)
    result = dataclasses.replace(made_result(ids, [Label.SOLVED] * len(ids)), levels=concatenate_levels(levels))
    commit(job, path, WorkUnit(tuple(ids)), result)
    return path


def test_commit_writes_each_levels_hash_and_signature(split: Path) -> None:
    for row in require_manifest(split).table.to_pylist():
        if row["level_id"] not in (COPY, NUDGED):
            level = one("s", row["level_id"])
            assert [row["content_hash"]] == content_hashes(level)
            assert [row["signature"]] == signatures(level)


def test_survey_finds_planted_duplicates(split: Path) -> None:
    facts = survey(split, RowQuery(limit=3))
    assert facts["duplicates"] == {
        "same": {"levels": 1, "pairs": [[COPY, 3]]},
        "near": {"levels": 1, "pairs": [[NUDGED, 5]]},
    }
    assert facts["against"] == {}
    assert survey(split, RowQuery("level_id != 3"))["duplicates"]["same"] == NONE


def test_inspect_finds_duplicates_in_splits_files_and_folders(split: Path, tmp_path: Path) -> None:
    other, folder = committed(tmp_path / "other", [one("s", 40), one("s", 3)]), tmp_path / "handmade"
    (folder / "deep").mkdir(parents=True)
    seven = folder / "deep" / "seven.json"
    write_level_file(LevelFile(one("s", 7), TaskParams()), seven)
    write_level_file(LevelFile(one("m", 7), TaskParams()), folder / "other.json")
    arguments = [word for path in (other, folder, seven) for word in ("--against", str(path))]
    facts = json.loads(here(["inspect", str(split), *arguments, "--json", "--rows", "0"], tmp_path).stdout)
    assert facts["duplicates"]["same"] == {"levels": 1, "pairs": []}
    facts = json.loads(here(["inspect", str(split), *arguments, "--json"], tmp_path).stdout)
    assert facts["against"] == {
        str(other): {"same": {"levels": 2, "pairs": [[3, 1], [COPY, 1]]}, "near": NONE},
        str(folder): {"same": {"levels": 1, "pairs": [[7, str(seven)]]}, "near": NONE},
        str(seven): {"same": {"levels": 1, "pairs": [[7, str(seven)]]}, "near": NONE},
    }
    shown = here(["inspect", str(split), *arguments], tmp_path).stdout
    assert "1 same (such as 9 and 3), 1 near (such as 10 and 5)" in shown
    assert f"duplicates in {other}: 2 same (such as 3 and 1), 0 near" in shown


def test_comparison_refuses_sources_without_levels(split: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="neither a split nor a level file"):
        comparison_of_source(tmp_path)
    with pytest.raises(UserError, match="There is no split"):
        comparison_of_source(tmp_path / "missing")
    (tmp_path / "bad.json").write_text("{}")
    assert_refused(here(["inspect", str(split), "--against", str(tmp_path)], tmp_path), 2, "bad.json")


@pytest.fixture(scope="module")
def handmade(reference: Path) -> Path:
    return handmade_levels(reference)


def test_handmade_levels_have_no_duplicates(handmade: Path) -> None:
    levels = comparison_of_source(handmade)
    assert levels.num_rows == 74
    assert within(levels, 3) == {"same": NONE, "near": NONE}
    assert between(levels, levels, 0)["same"]["levels"] == 74


def test_content_hash_ignores_order_in_handmade_levels(handmade: Path) -> None:
    """Two of them, the walkers, have legs that are exact copies in one position."""
    rng = np.random.default_rng(0)
    for path in sorted(handmade.rglob("*.json")):
        level = read_level_file(path).level
        known = content_hashes(level)
        for change in (renumbered, turned, renamed, more_room):
            level = change(level, rng)
            assert content_hashes(level) == known, (path.name, change.__name__)


def test_survey_finds_a_planted_handmade_level(handmade: Path, split: Path, tmp_path: Path) -> None:
    assert survey(split, against=[handmade])["against"][str(handmade)] == {"same": NONE, "near": NONE}
    known = next(iter(sorted(handmade.glob("s/*.json"))))
    planted = renumbered(read_level_file(known).level, np.random.default_rng(0))
    duplicates = survey(committed(tmp_path, [one("s", 0), planted]), against=[handmade])["against"][str(handmade)]
    assert duplicates == {"same": {"levels": 1, "pairs": [[1, str(known)]]}, "near": NONE}

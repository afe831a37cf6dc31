"""The benchmark of solved levels: the file, tables and plots of made-up results, and a real run."""

import json
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from benchmarks import oracle
from benchmarks.__main__ import main
from benchmarks.solved import measure as measuring
from benchmarks.solved import original, plot, tables
from benchmarks.solved.measure import measure, rows_in, work
from benchmarks.solved.results import Header, Results, count, made, merge, read, share
from benchmarks.solved.variants import VARIANTS, Variant
from benchmarks.statistics import mcnemar
from levelproof.configs.convert import flat, plain
from levelproof.experts.config import RECORD_STEPS, ExpertConfig, Rule, StopConfig
from levelproof.experts.labels import Label, Source
from levelproof.experts.procedure import Procedure
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.errors import Exit, UserError
from tests.experts.small import untouched

SMALL = ExpertConfig(
    environments=16, width=16, rehearsals=4, attempts=4, sticky_attempts=4, moved_attempts=4, slots=4
)  # fmt: skip
FIRST = 1_000_000


def header(name: str = "alone", size: str = "s", budget: int = 64_000) -> Header:
    variant = VARIANTS[name]
    return Header(name, size, budget, plain(variant.procedure))


def row(level_id: int, label: str, env_steps: int, steps: int | None = None) -> tuple[int, dict[str, Any]]:
    rate = 0.5 if label == "solved" else None
    values = {"label": label, "env_steps": env_steps, "success_rate": rate, "steps_to_goal": steps, "core_seconds": 1.5}
    values |= {"witness": "sampled" if rate else None, "evaluation_steps": 10, "scout_steps": 20, "search_steps": 30}
    values |= {"most_probable_succeeds": False}
    return level_id, values | {"versions": '{"python": "3"}', "device": "cpu: none", "date": "2026-01-01"}


@pytest.fixture
def ours() -> Results:
    """Ten levels: a trivial one, one left of the axis' begin, five solved soon or late, three never."""
    steps = (2_000, 5_000, 16_000, 16_001, 40_000, 64_000)
    rows = [row(FIRST, "trivial", 0, 3)]
    rows += [row(FIRST + i, "solved", x, 10 * i) for i, x in enumerate(steps, 1)]
    rows += [row(FIRST + i, "unsolved", 64_000) for i in (7, 8, 9)]
    return Results(header(), dict(rows))


@pytest.fixture
def theirs() -> Results:
    """The same levels; one solved that ours did not solve, four not solved that ours did."""
    labels = [
        "trivial",
        "unsolved",
        "unsolved",
        "unsolved",
        "unsolved",
        "solved",
        "solved",
        "solved",
        *["unsolved"] * 2,
    ]
    rows = [row(FIRST + i, label, 63_488, 7 if label == "solved" else None) for i, label in enumerate(labels)]
    return Results(header("reference"), dict(rows))


def cells(text: str, start: str) -> list[str]:
    """Of the line of a Markdown table that starts so."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {start} |")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_shares() -> None:
    assert share(0, 0) == "-"
    assert share(1, 2) == "50.0% (9.5 to 90.5)"
    assert mcnemar(0, 0) == 1
    assert mcnemar(4, 1) == mcnemar(1, 4) == pytest.approx(0.375)


def test_counts() -> None:
    assert [count(x) for x in (500, 4_000, 64_000, 1_000_000, 1_500_000)] == ["500", "4k", "64k", "1M", "1.5M"]


def test_an_ablation_changes_one_thing() -> None:
    for name, variant in VARIANTS.items():
        assert set(variant.against) <= set(VARIANTS) - {name}
        for base in ("alone", "default"):
            default, settings = flat(plain(VARIANTS[base].procedure)), flat(plain(variant.procedure))
            changed = {key for key, value in settings.items() if value != default[key]}
            if variant.against == (base,) and not variant.text.startswith("procedure="):
                assert 1 <= len(changed) <= 2, f"{name} changes {changed}"
    assert VARIANTS["default"].procedure == Procedure()
    reference = VARIANTS["reference"].procedure
    assert (reference.expert.horizon, reference.expert.learning_rate, reference.expert.rehearsals) == (64, 3e-4, 0)
    assert (reference.stop.rule, reference.search.env_steps) == (Rule.BUDGET, 0)


def test_the_original_is_judged_as_its_reimplementation() -> None:
    there, here = VARIANTS["original"], VARIANTS["reference"]
    expert = replace(there.procedure.expert, sticky_attempts=8, moved_attempts=8)
    assert replace(there.procedure, expert=expert) == here.procedure


def text_of(results: list[Results]) -> str:
    return "\n\n".join(table.markdown() for table in tables.tables(results))


def test_table(ours: Results, theirs: Results) -> None:
    text = text_of([theirs, ours])
    assert "**Size s, 64k env steps**, levels 1,000,000 to 1,000,009:" in text
    mean_steps = (2_000 + 5_000 + 16_000 + 16_001 + 40_000 + 4 * 64_000) / 9
    of_ours = [
        "`alone`",
        "9 of 10",
        share(6, 9),
        "100.0%",
        "100.0%",
        share(3, 9),
        f"{mean_steps + 60:,.0f}",
        "2.5",
        "0.500",
        "35",
    ]
    solved, paired = text.split("Level by level:")
    assert cells(solved, "`alone`") == of_ours
    assert cells(solved, "`reference`")[1:5] == ["9 of 10", share(3, 9), "100.0%", "100.0%"]
    assert cells(paired, "`alone`")[1:] == ["`reference`", "9", "4", "1", "0.38"]
    assert cells(paired, "`alone`, a quarter of the budget")[1:] == ["`reference`", "9", "3", "3", "1"]
    assert f"- `alone`: {VARIANTS['alone'].text}" in tables.variants_of([ours])
    assert text.index("| `reference` |") < text.index("| `alone` |")


def test_an_expert_may_reach_the_goal_where_the_witness_is_the_search_s(ours: Results) -> None:
    """By its sampled actions or its most probable ones; where it is not known of all, no share is."""
    (i, other), rows = [*ours.solved()][:2], dict(ours.rows)
    rows[i] = rows[i] | {"witness": "search", "success_rate": 0.0}

    def shares() -> list[str]:
        return cells(text_of([Results(ours.header, rows)]), "`alone`")[3:5]

    assert shares() == ["83.3%", "83.3%"]
    rows[i] |= {"most_probable_succeeds": None}
    assert shares() == ["83.3%", "-"]
    rows[i] |= {"most_probable_succeeds": True}
    assert shares() == ["83.3%", "100.0%"]
    rows[i] |= {"most_probable_succeeds": None, "success_rate": 0.1}
    assert shares() == ["83.3%", "100.0%"]
    rows[other] = rows[other] | {"witness": None}
    assert shares() == ["-", "100.0%"]


def test_a_variant_is_compared_with_several(ours: Results, theirs: Results) -> None:
    rows = [row(FIRST + 1, "solved", 63_488, 5), row(FIRST + 9, "unsolved", 63_488)]
    there = Results(header("original"), dict(rows))
    paired = text_of([ours, theirs, there]).split("Level by level:")[1]
    assert cells(paired, "`original` | `reference`")[2:] == ["2", "1", "0", "1"]
    assert cells(paired, "`alone` | `original`")[2:] == ["2", "0", "0", "1"]
    assert cells(paired, "`alone` | `reference`")[2:] == ["9", "4", "1", "0.38"]
    assert cells(paired, "`alone`, a quarter of the budget | `original`")[2:] == ["2", "0", "0", "1"]


def test_pairs_are_of_the_levels_that_both_tried(ours: Results) -> None:
    text = text_of([ours, Results(header("width_32"), dict([row(FIRST + 1, "unsolved", 64_000)]))])
    assert cells(text.split("Level by level:")[1], "`width_32`")[1:] == ["`alone`", "1", "0", "1", "1"]


class TestFile:
    def test_levels_join_those_that_are_there(self, tmp_path: Path, ours: Results, theirs: Results) -> None:
        file = tmp_path / "solved.parquet"
        assert read(file) == []
        merge(theirs, file)
        merge(Results(ours.header, dict([*ours.rows.items()][3:])), file)
        first = file.read_bytes()
        merge(Results(ours.header, dict([*ours.rows.items()][:5])), file)
        assert {each.header.name: each for each in read(file)} == {"s-64k-alone": ours, "s-64k-reference": theirs}
        merge(ours, file)
        again = file.read_bytes()
        merge(ours, file)
        assert file.read_bytes() == again != first, "the same results are the same file"

    def test_other_settings_take_the_place_of_all(self, tmp_path: Path, ours: Results) -> None:
        file = tmp_path / "solved.parquet"
        merge(ours, file)
        settings = ours.header.config | {"stop": {"rule": "halving"}}
        other = Results(replace(ours.header, config=settings), dict([row(FIRST + 20, "solved", 1_024, 5)]))
        merge(other, file)
        assert read(file) == [other]

    def test_what_was_not_noted_then_is_unknown(self, tmp_path: Path, ours: Results) -> None:
        """A file without a column that came later."""
        file = tmp_path / "solved.parquet"
        merge(ours, file)
        pq.write_table(pq.read_table(file).drop_columns(["most_probable_succeeds"]), file)
        (back,) = read(file)
        assert back.header == ours.header
        assert all(row["most_probable_succeeds"] is None for row in back.rows.values())

    def test_something_else_is_told(self, tmp_path: Path) -> None:
        file = tmp_path / "solved.parquet"
        file.write_text("no parquet")
        with pytest.raises(UserError, match="is not a file that"):
            read(file)

    def test_the_committed_results_are_all_there(self) -> None:
        results = read()
        shown = {(each.header.size, each.header.variant) for each in results}
        assert shown >= {
            (size, name) for size in ("s", "m", "l") for name in ("default", "label", "alone", "reference")
        }
        assert all(each.header.variant in VARIANTS and len(each.rows) >= 15 for each in results)
        assert made(results).startswith("2026-11-21")
        assert "on cpu: AMD EPYC; levelproof" in made(results)


def test_unsolved_falls_with_budget(ours: Results, theirs: Results) -> None:
    steps, left = plot.curve(ours)
    assert (steps[0], left[0]) == (4_000, 8)
    assert (steps[-1], left[-1]) == (64_000, 3)
    assert steps == sorted(set(steps))
    assert left == sorted(left, reverse=True)
    assert [plot.unsolved(ours, x) for x in (1_999, 2_000, 15_999, 16_000, 63_999)] == [9, 8, 7, 6, 4]
    assert cells(plot.table([ours]).markdown(), "size s")[1:] == ["9", share(3, 9)]
    assert plot.has_curve(ours)
    assert not plot.has_curve(theirs), "the whole budget for every level tells no curve"


def test_names_tell_curves_apart(ours: Results) -> None:
    halving, long = (replace(ours, header=h) for h in (header("halving"), header(budget=1_000_000)))
    assert plot.names([ours, halving]) == ["size s, alone", "size s, halving"]
    assert plot.names([ours, long]) == ["size s, 64k", "size s, 1M"]


def test_plot(ours: Results, tmp_path: Path) -> None:
    out, again = tmp_path / "one.svg", tmp_path / "two.svg"
    plot.draw([ours], out)
    plot.draw([ours], again)
    assert out.read_bytes() == again.read_bytes(), "the same results give the same plot"
    assert out.stat().st_size < 40_000
    texts = {
        "".join(text.itertext()) for text in ElementTree.parse(out).getroot().iter("{http://www.w3.org/2000/svg}text")
    }
    assert {"4k", "16k", "64k", "size s"} <= texts


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--size", "q"], "choose one of s, m, l"),
        (["--budget", "5x"], "write a whole number"),
        (["--budget", "500"], "takes 1024 env steps"),
        (["--first", "-1"], "level ids are 0 and above"),
        (["--jobs", "4000"], "cores"),
    ],
)
def test_a_mistake_gets_a_sentence(
    arguments: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["solved", "--variant", "alone", *arguments, "--results", str(tmp_path / "none.parquet")]
    assert main(words) == Exit.INPUT
    assert sentence in capsys.readouterr().err


def test_results_that_are_not_there(tmp_path: Path, ours: Results, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "solved.parquet"
    assert main(["solved", "--results", str(file)]) == Exit.INPUT
    merge(ours, file)
    assert main(["solved", "s-64k-theirs", "--results", str(file)]) == Exit.INPUT
    assert "no results of s-64k-theirs" in capsys.readouterr().err
    assert main(["solved", "s-64k-alone", "--results", str(file), "--json"]) == Exit.DONE
    (group,) = json.loads(capsys.readouterr().out)["groups"]
    assert (group["with_expert"], group["solved"], group["core_seconds"]) == (9, 6, 15)


def test_a_line_that_was_cut_off_is_done_again(tmp_path: Path) -> None:
    scratch = tmp_path / "scratch.jsonl"
    lines = [json.dumps({"level_id": i, "label": "solved"}) + "\n" for i in (4, 7)]
    scratch.write_text("".join(lines)[:-9])
    assert rows_in(scratch) == {4: {"label": "solved"}}
    assert scratch.read_text() == lines[0]
    assert rows_in(tmp_path / "none.jsonl") == {}


def test_results_under_other_settings_are_left_alone(tmp_path: Path, ours: Results) -> None:
    file = tmp_path / "solved.parquet"
    merge(ours, file)
    other = replace(ours.header, config={"expert": {}, "stop": {"rule": "solved"}})
    with pytest.raises(UserError, match="--again"):
        measure(other, VARIANTS["alone"], range(0), 1, work, file=file)


@pytest.mark.campaign
def test_a_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process dies, which leaves the lines of units that were done; the next run trains the others only."""
    variant, file, scratch = (
        Variant("small", untouched(StopConfig(rule=Rule.SOLVED), SMALL)),
        tmp_path / "solved.parquet",
        tmp_path / "scratch.jsonl",
    )
    of = Header("small", "s", 4_096, plain(variant.procedure))
    monkeypatch.setattr(measuring, "scratch_of", lambda _: scratch)
    level_id, before = row(FIRST, "solved", 7, 7)
    scratch.write_text(json.dumps({"level_id": level_id} | before) + "\n")
    measure(of, variant, range(FIRST, FIRST + 4), 1, work, file=file)
    (results,) = read(file)
    assert results.header == of
    assert list(results.rows) == list(range(FIRST, FIRST + 4))
    assert results.rows[FIRST] == before
    assert not scratch.exists()
    for level_id in range(FIRST + 1, FIRST + 4):
        trained = results.rows[level_id]
        assert trained["label"] in {"solved", "unsolved", "trivial", "unsolvable"}
        assert trained["env_steps"] <= 4_096
        assert trained["core_seconds"] > 0
    assert results.trained, "some of these levels should get an expert"
    measure(of, variant, range(FIRST, FIRST + 4), 1, work, file=file)  # nothing left to do
    assert read(file) == [results]


def shown(ends: dict[int, list[tuple[int, bool]]], first_goal: tuple[int, int] | None) -> dict[str, np.ndarray]:
    """What the reference's process writes of a level: the episodes' ends of each attempt, a success of training."""
    config = VARIANTS["original"].procedure.expert
    training = np.zeros((2, 2 * config.horizon, config.environments), bool)
    if first_goal is not None:
        training[:, *first_goal] = True
        training[:, first_goal[0] + 3, 0] = True
    flags = np.zeros((2, RECORD_STEPS, config.attempts), bool)
    for attempt, episodes in ends.items():
        for step, goal in episodes:
            flags[:, step, attempt] = True, goal
    action = np.zeros((RECORD_STEPS, config.attempts, len(CHOICES)), np.int32)
    return dict(
        zip(("trained_done", "trained_goal", "done", "goal", "action"), (*training, *flags, action), strict=True)
    )


def test_the_reference_is_judged_as_we_are() -> None:
    """An attempt succeeds when an episode ended and all that ended reached the goal; the first one is the witness."""
    config = VARIANTS["original"].procedure.expert
    ends = {0: [(9, True), (19, False)], 3: [(29, True), (49, True)], 5: [(4, True)], 6: [(255, False)]}
    verdict = original.judged(shown(ends, (66, 5)), config, False)
    assert (verdict.label, verdict.witness, verdict.steps_to_goal) == (Label.SOLVED, Source.SAMPLED, 30)
    assert verdict.success_rate == pytest.approx(2 / 7), "two of seven sampled attempts, by their first episodes"
    assert not verdict.most_probable_succeeds
    assert "all 2 of its finished episodes" in verdict.label_reason
    assert verdict.steps_to_first_success == 67 * config.environments
    assert (verdict.env_steps, verdict.episodes) == (2 * config.steps_per_update, 2)
    assert np.isnan(verdict.sticky_success_rate)


def test_a_level_without_a_good_attempt_is_unsolved() -> None:
    config = VARIANTS["original"].procedure.expert
    verdict = original.judged(shown({0: [(9, True), (19, False)]}, None), config, False)
    assert (verdict.label, verdict.witness, verdict.steps_to_goal) == (Label.UNSOLVED, None, None)
    assert verdict.success_rate == 0, "no sampled attempt had an episode that ended"
    assert verdict.steps_to_first_success is None
    assert original.judged(shown({2: [(0, True)]}, None), config, False).label is Label.SOLVED


def test_without_the_reference_there_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(oracle.PYTHON_VARIABLE, sys.executable)
    file = tmp_path / "solved.parquet"
    words = ["solved", "--variant", "original", "--levels", "2", "--jobs", "1", "--results", str(file)]
    assert main(words) == Exit.FAILED
    assert "Cannot ask the reference for its version" in capsys.readouterr().err
    assert not file.exists()


@pytest.mark.campaign
def test_the_original_runs(tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two updates of a level that gets an expert; its neighbour needs none."""
    variant, file = VARIANTS["original"], tmp_path / "solved.parquet"
    monkeypatch.setattr(measuring, "scratch_of", lambda _: tmp_path / "scratch.jsonl")
    of = Header("original", "s", 2 * 2_048, plain(variant.procedure))
    wanted = range(FIRST + 9, FIRST + 11)
    measure(of, variant, wanted, 1, original.work, file=file)
    (results,) = read(file)
    ours = next(each for each in read() if each.header.name == "s-64k-reference")
    assert list(results.rows) == list(wanted)
    assert results.trained.keys() == ours.trained.keys() & set(wanted)
    assert 0 < len(results.trained) < len(wanted), "one of these levels should get an expert, and one none"
    for level_id, found in results.rows.items():
        assert json.loads(found["versions"])["reference"]["kinetix-env"] == "3.0.2"
        if level_id not in results.trained:
            assert found["label"] == ours.rows[level_id]["label"]
            assert found["core_seconds"] == 0
            continue
        assert found["env_steps"] == 2 * 2_048
        assert (found["label"] == "solved") == (found["steps_to_goal"] is not None)
        assert (found["steps_to_goal"] or 1) <= RECORD_STEPS
        assert found["core_seconds"] > 0

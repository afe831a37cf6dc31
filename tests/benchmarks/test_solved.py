"""The benchmark of solved levels: file, tables and plots of synthetic results, and a real run."""

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
from benchmarks.solved import larger, original, plot, tables
from benchmarks.solved import measure as measuring
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
    environments=16, width=16, rehearsals=4, attempts=4, sticky_attempts=4, perturbed_attempts=4, slots=4
)  # fmt: skip
FIRST = 1_000_000


def header(name: str = "alone", size: str = "s", budget: int = 64_000) -> Header:
    variant = VARIANTS[name]
    return Header(name, size, budget, plain(variant.procedure))


def row(level_id: int, label: str, env_steps: int, steps: int | None = None) -> tuple[int, dict[str, Any]]:
    rate = 0.5 if label == "solved" else None
    values = {"label": label, "env_steps": env_steps, "success_rate": rate, "steps_to_goal": steps, "core_seconds": 1.5}
    values |= {"witness": "sampled" if rate else None, "evaluation_steps": 10, "search_steps": 50}
    values |= {"most_probable_succeeds": False}
    return level_id, values | {"versions": '{"python": "3"}', "device": "cpu: none", "date": "2026-01-01"}


@pytest.fixture
def ours() -> Results:
    """Ten levels: one trivial, one solved before the axis starts, five solved later, three never."""
    steps = (2_000, 5_000, 16_000, 16_001, 40_000, 64_000)
    rows = [row(FIRST, "trivial", 0, 3)]
    rows += [row(FIRST + i, "solved", x, 10 * i) for i, x in enumerate(steps, 1)]
    rows += [row(FIRST + i, "unsolved", 64_000) for i in (7, 8, 9)]
    return Results(header(), dict(rows))


@pytest.fixture
def theirs() -> Results:
    """The same levels; one that ours did not solve is solved, four that ours solved are not."""
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
    """Return the cells of the Markdown table row that starts with `start`."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {start} |")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_share_and_mcnemar_match_known_values() -> None:
    assert share(0, 0) == "-"
    assert share(1, 2) == "50.0% (9.5 to 90.5)"
    assert mcnemar(0, 0) == 1
    assert mcnemar(4, 1) == mcnemar(1, 4) == pytest.approx(0.375)


def test_count_shortens_numbers() -> None:
    assert [count(x) for x in (500, 4_000, 64_000, 1_000_000, 1_500_000)] == ["500", "4k", "64k", "1M", "1.5M"]


def test_variants_change_one_thing() -> None:
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


def test_original_equals_reference_except_extra_attempts() -> None:
    original_variant, reference_variant = VARIANTS["original"], VARIANTS["reference"]
    expert = replace(original_variant.procedure.expert, sticky_attempts=8, perturbed_attempts=8)
    assert replace(original_variant.procedure, expert=expert) == reference_variant.procedure


def text_of(results: list[Results]) -> str:
    return "\n\n".join(table.markdown() for table in tables.tables(results))


def test_tables_have_variants_and_pairs(ours: Results, theirs: Results) -> None:
    text = text_of([theirs, ours])
    assert "**Size s, 64k env steps**, levels 1,000,000 to 1,000,009:" in text
    mean_steps = (2_000 + 5_000 + 16_000 + 16_001 + 40_000 + 4 * 64_000) / 9
    expected = [
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
    assert cells(solved, "`alone`") == expected
    assert cells(solved, "`reference`")[1:5] == ["9 of 10", share(3, 9), "100.0%", "100.0%"]
    assert cells(paired, "`alone`")[1:] == ["`reference`", "9", "4", "1", "0.38"]
    assert cells(paired, "`alone`, a quarter of the budget")[1:] == ["`reference`", "9", "3", "3", "1"]
    assert f"- `alone`: {VARIANTS['alone'].text}" in tables.variants_of([ours])
    assert text.index("| `reference` |") < text.index("| `alone` |")


def test_tables_count_experts_that_reach_the_goal_beside_a_search_witness(ours: Results) -> None:
    """Sampled or most probable actions count; the share is unknown if any level's is."""
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


def test_tables_pair_a_variant_with_several(ours: Results, theirs: Results) -> None:
    rows = [row(FIRST + 1, "solved", 63_488, 5), row(FIRST + 9, "unsolved", 63_488)]
    third = Results(header("original"), dict(rows))
    paired = text_of([ours, theirs, third]).split("Level by level:")[1]
    assert cells(paired, "`original` | `reference`")[2:] == ["2", "1", "0", "1"]
    assert cells(paired, "`alone` | `original`")[2:] == ["2", "0", "0", "1"]
    assert cells(paired, "`alone` | `reference`")[2:] == ["9", "4", "1", "0.38"]
    assert cells(paired, "`alone`, a quarter of the budget | `original`")[2:] == ["2", "0", "0", "1"]


def test_tables_pair_levels_that_both_tried(ours: Results) -> None:
    text = text_of([ours, Results(header("width_32"), dict([row(FIRST + 1, "unsolved", 64_000)]))])
    assert cells(text.split("Level by level:")[1], "`width_32`")[1:] == ["`alone`", "1", "0", "1", "1"]


class TestFile:
    def test_merge_joins_levels_and_is_deterministic(self, tmp_path: Path, ours: Results, theirs: Results) -> None:
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
        assert file.read_bytes() == again != first, "equal results make equal files"

    def test_merge_replaces_results_from_other_settings(self, tmp_path: Path, ours: Results) -> None:
        file = tmp_path / "solved.parquet"
        merge(ours, file)
        settings = ours.header.config | {"stop": {"rule": "halving"}}
        other = Results(replace(ours.header, config=settings), dict([row(FIRST + 20, "solved", 1_024, 5)]))
        merge(other, file)
        assert read(file) == [other]

    def test_read_fills_missing_columns_with_none(self, tmp_path: Path, ours: Results) -> None:
        """The file lacks a column that was added later."""
        file = tmp_path / "solved.parquet"
        merge(ours, file)
        pq.write_table(pq.read_table(file).drop_columns(["most_probable_succeeds"]), file)
        (back,) = read(file)
        assert back.header == ours.header
        assert all(row["most_probable_succeeds"] is None for row in back.rows.values())

    def test_read_rejects_a_file_it_did_not_write(self, tmp_path: Path) -> None:
        file = tmp_path / "solved.parquet"
        file.write_text("no parquet")
        with pytest.raises(UserError, match="is not a file that"):
            read(file)

    def test_read_finds_all_committed_results(self) -> None:
        results = read()
        shown = {(each.header.size, each.header.variant) for each in results}
        assert shown >= {
            (size, name) for size in ("s", "m", "l") for name in ("default", "label", "alone", "reference")
        }
        assert all(each.header.variant in VARIANTS and len(each.rows) >= 15 for each in results)
        assert made(results).startswith("2026-11-21")
        assert "on cpu: AMD EPYC; levelproof" in made(results)


def test_curve_falls_with_budget(ours: Results, theirs: Results) -> None:
    steps, remaining = plot.curve(ours)
    assert (steps[0], remaining[0]) == (4_000, 8)
    assert (steps[-1], remaining[-1]) == (64_000, 3)
    assert steps == sorted(set(steps))
    assert remaining == sorted(remaining, reverse=True)
    assert [plot.unsolved(ours, x) for x in (1_999, 2_000, 15_999, 16_000, 63_999)] == [9, 8, 7, 6, 4]
    assert cells(plot.table([ours]).markdown(), "size s")[1:] == ["9", share(3, 9)]
    assert plot.has_curve(ours)
    assert not plot.has_curve(theirs), "levels that use the whole budget have no curve"


def test_names_distinguish_curves(ours: Results) -> None:
    halving, long = (replace(ours, header=h) for h in (header("halving"), header(budget=1_000_000)))
    assert plot.names([ours, halving]) == ["size s, alone", "size s, halving"]
    assert plot.names([ours, long]) == ["size s, 64k", "size s, 1M"]


def test_draw_is_deterministic_and_small(ours: Results, tmp_path: Path) -> None:
    out, again = tmp_path / "one.svg", tmp_path / "two.svg"
    plot.draw([ours], out)
    plot.draw([ours], again)
    assert out.read_bytes() == again.read_bytes(), "equal results make equal plots"
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
def test_main_explains_invalid_arguments(
    arguments: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["solved", "--variant", "alone", *arguments, "--results", str(tmp_path / "none.parquet")]
    assert main(arguments) == Exit.INPUT
    assert sentence in capsys.readouterr().err


def test_main_explains_missing_results(tmp_path: Path, ours: Results, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "solved.parquet"
    assert main(["solved", "--results", str(file)]) == Exit.INPUT
    merge(ours, file)
    assert main(["solved", "s-64k-theirs", "--results", str(file)]) == Exit.INPUT
    assert "no results of s-64k-theirs" in capsys.readouterr().err
    assert main(["solved", "s-64k-alone", "--results", str(file), "--json"]) == Exit.DONE
    (group,) = json.loads(capsys.readouterr().out)["groups"]
    assert (group["with_expert"], group["solved"], group["core_seconds"]) == (9, 6, 15)


def test_rows_in_removes_an_incomplete_line(tmp_path: Path) -> None:
    scratch = tmp_path / "scratch.jsonl"
    lines = [json.dumps({"level_id": i, "label": "solved"}) + "\n" for i in (4, 7)]
    scratch.write_text("".join(lines)[:-9])
    assert rows_in(scratch) == {4: {"label": "solved"}}
    assert scratch.read_text() == lines[0]
    assert rows_in(tmp_path / "none.jsonl") == {}


def test_measure_keeps_results_from_other_settings(tmp_path: Path, ours: Results) -> None:
    file = tmp_path / "solved.parquet"
    merge(ours, file)
    other = replace(ours.header, config={"expert": {}, "stop": {"rule": "solved"}})
    with pytest.raises(UserError, match="--again"):
        measure(other, VARIANTS["alone"], range(0), 1, work, file=file)


@pytest.mark.campaign
def test_measure_resumes_a_stopped_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dead process leaves the lines of finished units; the next run trains only the others."""
    variant, file, scratch = (
        Variant("small", untouched(StopConfig(rule=Rule.SOLVED), SMALL)),
        tmp_path / "solved.parquet",
        tmp_path / "scratch.jsonl",
    )
    header_ = Header("small", "s", 4_096, plain(variant.procedure))
    monkeypatch.setattr(measuring, "scratch_of", lambda _: scratch)
    level_id, before = row(FIRST, "solved", 7, 7)
    scratch.write_text(json.dumps({"level_id": level_id} | before) + "\n")
    measure(header_, variant, range(FIRST, FIRST + 4), 1, work, file=file)
    (results,) = read(file)
    assert results.header == header_
    assert list(results.rows) == list(range(FIRST, FIRST + 4))
    assert results.rows[FIRST] == before
    assert not scratch.exists()
    for level_id in range(FIRST + 1, FIRST + 4):
        trained = results.rows[level_id]
        assert trained["label"] in {"solved", "unsolved", "trivial", "unsolvable"}
        assert trained["env_steps"] <= 4_096
        assert trained["core_seconds"] > 0
    assert results.trained, "some of these levels should get an expert"
    measure(header_, variant, range(FIRST, FIRST + 4), 1, work, file=file)  # nothing is missing
    assert read(file) == [results]


def shown(ends: dict[int, list[tuple[int, bool]]], first_goal: tuple[int, int] | None) -> dict[str, np.ndarray]:
    """Make the arrays that the reference's process writes, from attempts' episode ends and a training success."""
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


def test_judged_applies_our_rules_to_the_reference() -> None:
    """An attempt succeeds if an episode ended and all that ended reached the goal; the first success is the witness."""
    config = VARIANTS["original"].procedure.expert
    ends = {0: [(9, True), (19, False)], 3: [(29, True), (49, True)], 5: [(4, True)], 6: [(255, False)]}
    verdict = original.judged(shown(ends, (66, 5)), config, False)
    assert (verdict.label, verdict.witness, verdict.steps_to_goal) == (Label.SOLVED, Source.SAMPLED, 30)
    assert verdict.success_rate == pytest.approx(2 / 7), "two of seven sampled attempts succeed in their first episodes"
    assert not verdict.most_probable_succeeds
    assert "all 2 of its finished episodes" in verdict.label_reason
    assert verdict.steps_to_first_success == 67 * config.environments
    assert (verdict.env_steps, verdict.episodes) == (2 * config.steps_per_update, 2)
    assert np.isnan(verdict.sticky_success_rate)


def test_judged_is_unsolved_without_a_successful_attempt() -> None:
    config = VARIANTS["original"].procedure.expert
    verdict = original.judged(shown({0: [(9, True), (19, False)]}, None), config, False)
    assert (verdict.label, verdict.witness, verdict.steps_to_goal) == (Label.UNSOLVED, None, None)
    assert verdict.success_rate == 0, "no sampled attempt had an episode that ended"
    assert verdict.steps_to_first_success is None
    assert original.judged(shown({2: [(0, True)]}, None), config, False).label is Label.SOLVED


@pytest.mark.slow
def test_main_explains_a_missing_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(oracle.PYTHON_VARIABLE, sys.executable)
    file = tmp_path / "solved.parquet"
    arguments = ["solved", "--variant", "original", "--levels", "2", "--jobs", "1", "--results", str(file)]
    assert main(arguments) == Exit.FAILED
    assert "Cannot ask the reference for its version" in capsys.readouterr().err
    assert not file.exists()


@pytest.mark.campaign
def test_original_trains_a_level(tmp_path: Path, reference: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train a level for two updates; its neighbour needs no expert."""
    variant, file = VARIANTS["original"], tmp_path / "solved.parquet"
    monkeypatch.setattr(measuring, "scratch_of", lambda _: tmp_path / "scratch.jsonl")
    header_ = Header("original", "s", 2 * 2_048, plain(variant.procedure))
    level_ids = range(FIRST + 9, FIRST + 11)
    measure(header_, variant, level_ids, 1, original.work, file=file)
    (results,) = read(file)
    ours = next(each for each in read() if each.header.name == "s-64k-reference")
    assert list(results.rows) == list(level_ids)
    assert results.trained.keys() == ours.trained.keys() & set(level_ids)
    assert 0 < len(results.trained) < len(level_ids), "one of these levels should get an expert, and one none"
    for level_id, result in results.rows.items():
        assert json.loads(result["versions"])["reference"]["kinetix-env"] == "3.0.2"
        if level_id not in results.trained:
            assert result["label"] == ours.rows[level_id]["label"]
            assert result["core_seconds"] == 0
            continue
        assert result["env_steps"] == 2 * 2_048
        assert (result["label"] == "solved") == (result["steps_to_goal"] is not None)
        assert (result["steps_to_goal"] or 1) <= RECORD_STEPS
        assert result["core_seconds"] > 0


def test_larger_samples_have_enough_levels_to_quote() -> None:
    rows = larger.larger_samples().rows
    assert {row[0] for row in rows} == {"s", "m", "l"}
    for _, _, levels, _, undecided, solved, *_ in rows:
        total, few = (int(cell.split()[0].replace(",", "")) for cell in (levels, undecided))
        assert tables.ENOUGH <= few < total
        low, high = (float(x) for x in solved.partition("(")[2].rstrip(")").split(" to "))
        assert high - low < 6.2  # as wide as it gets with ENOUGH levels


def test_defaults_are_compared_level_by_level() -> None:
    """On the levels of the report: today's solve more of l, and no fewer of s and m but by chance."""
    report = larger.paired()
    assert [row[0] for row in report.rows] == ["s", "m", "l"]
    solved = {(row[0], row[3]): row for row in larger.larger_samples().rows if "id" in row[2]}
    for size, _, undecided, lost, gained, p in report.rows:
        now, before = (solved[size, when] for when in (larger.NOW, larger.BEFORE))
        assert now[4] == before[4] == undecided
        assert float(p) < 0.001 if size == "l" else float(p) > 0.01
        assert int(lost) < int(gained) or size != "l"

"""The benchmark of solved levels: statistics, files that go on, tables and plots of made-up files, and a real run."""

import importlib
import json
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from benchmarks import oracle
from benchmarks.solved import __main__ as command
from benchmarks.solved import original, plot, tables
from benchmarks.solved.measure import measure, rows_there, work
from benchmarks.solved.results import Header, count, header_of, mcnemar, read, read_all, share, wilson
from benchmarks.solved.variants import REFERENCE, VARIANTS, Variant
from configs.convert import plain
from experts.config import RECORD_STEPS, ExpertConfig, Rule, StopConfig
from experts.labels import Label, Source
from levelgen.task.actions import CHOICES
from pipeline.errors import UserError

SMALL = ExpertConfig(
    environments=16, width=16, rehearsals=4, attempts=4, sticky_attempts=4, moved_attempts=4, slots=4
)  # fmt: skip
FIRST = 1_000_000


def header(name: str = "ours", size: str = "s", budget: int = 64_000) -> Header:
    variant = VARIANTS[name]
    return Header(name, size, budget, {"expert": plain(variant.expert), "stop": plain(variant.stop)})


def row(level_id: int, label: str, env_steps: int, steps: int | None = None) -> dict[str, Any]:
    rate = 0.5 if label == "solved" else None
    return {"level_id": level_id, "label": label, "env_steps": env_steps, "success_rate": rate, "steps_to_goal": steps,
            "cpu_s": 1.5, "wall_s": 2.0}  # fmt: skip


def made_up(file: Path, of: Header, rows: list[dict[str, Any]]) -> Path:
    lines = [header_of(of, {"python": "3"}, "cpu: none"), *rows]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return file


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    """Ten levels: a trivial one, one left of the axis' begin, five solved soon or late, three never."""
    steps = (2_000, 5_000, 16_000, 16_001, 40_000, 64_000)
    rows = [row(FIRST, "trivial", 0, 3)]
    rows += [row(FIRST + i, "solved", x, 10 * i) for i, x in enumerate(steps, 1)]
    rows += [row(FIRST + i, "unsolved", 64_000) for i in (7, 8, 9)]
    return made_up(tmp_path / "ours.jsonl", header(), rows)


@pytest.fixture
def reference(tmp_path: Path) -> Path:
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
    return made_up(tmp_path / "reference.jsonl", header("reference"), rows)


def cells(text: str, start: str) -> list[str]:
    """Of the line of a Markdown table that starts so."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {start} |")]
    return [cell.strip() for cell in line.strip("|").split("|")]


@pytest.mark.parametrize(("k", "n"), [(0, 10), (10, 10), (3, 7), (211, 512), (1, 1)])
def test_wilson_is_scipys(k: int, n: int) -> None:
    assert wilson(k, n) == pytest.approx(tuple(binomtest(k, n).proportion_ci(method="wilson")), abs=1e-6)


def test_wilson_of_nothing_says_nothing() -> None:
    assert wilson(0, 0) == (0, 1)
    assert share(0, 0) == "-"
    assert share(1, 2) == "50.0% (9.5 to 90.5)"


@pytest.mark.parametrize(("one", "other"), [(1, 0), (3, 3), (4, 1), (0, 12), (60, 31)])
def test_mcnemar_is_an_exact_binomial_test(one: int, other: int) -> None:
    assert mcnemar(one, other) == pytest.approx(binomtest(one, one + other).pvalue)


def test_mcnemar_without_a_difference() -> None:
    assert mcnemar(0, 0) == 1


def test_counts() -> None:
    assert [count(x) for x in (500, 4_000, 64_000, 1_000_000, 1_500_000)] == ["500", "4k", "64k", "1M", "1.5M"]


def test_an_ablation_changes_one_thing() -> None:
    default = plain(ExpertConfig()) | plain(StopConfig())
    for name, variant in VARIANTS.items():
        settings = plain(variant.expert) | plain(variant.stop)
        changed = {key for key, value in settings.items() if value != default[key]}
        if name not in ("original", "reference", "ours"):
            assert len(changed) == 1, f"{name} changes {changed}"
        assert set(variant.against) <= set(VARIANTS) - {name}
    assert VARIANTS["ours"].expert == ExpertConfig()
    reference = VARIANTS["reference"]
    assert (reference.expert.horizon, reference.expert.learning_rate, reference.expert.rehearsals) == (64, 3e-4, 0)
    assert reference.stop.rule == Rule.BUDGET


def test_the_reference_has_the_hyperparameters_of_its_users(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(oracle.SCRIPTS)
    theirs = importlib.import_module("ppo")
    names = {
        "WIDTH": "width",
        "EPOCHS": "epochs",
        "MINIBATCHES": "minibatches",
        "RATE": "learning_rate",
        "ADAM_EPSILON": "adam_epsilon",
        "MAX_NORM": "max_gradient_norm",
        "DISCOUNT": "discount",
        "LAMBDA": "gae_lambda",
        "CLIP": "clip",
        "VALUE_WEIGHT": "value_weight",
        "ENTROPY_WEIGHT": "entropy_weight",
        "DENSE_REWARD": "dense_reward_scale",
    }
    assert {name: getattr(theirs, name) for name in names} == {name: getattr(REFERENCE, x) for name, x in names.items()}
    assert theirs.CHOICES == CHOICES
    there, here = VARIANTS["original"], VARIANTS["reference"]
    assert replace(there.expert, sticky_attempts=8, moved_attempts=8) == here.expert
    assert there.stop == here.stop


def test_table(ours: Path, reference: Path) -> None:
    text = tables.tables(read_all([reference, ours]))
    assert "**Size s, 64k env steps**, levels 1,000,000 to 1,000,009:" in text
    mean_steps = (2_000 + 5_000 + 16_000 + 16_001 + 40_000 + 4 * 64_000) / 9
    of_ours = ["`ours`", "9 of 10", share(6, 9), share(3, 9), f"{mean_steps:,.0f}", "2.5", "0.500", "35"]
    solved, paired = text.split("Level by level:")
    assert cells(solved, "`ours`") == of_ours
    assert cells(solved, "`reference`")[1:4] == ["9 of 10", share(3, 9), "-"]
    assert cells(paired, "`ours`")[1:] == ["`reference`", "9", "4", "1", "0.38"]
    assert cells(paired, "`ours`, a quarter of the budget")[1:] == ["`reference`", "9", "3", "3", "1"]
    assert f"- `ours`: {VARIANTS['ours'].text}" in text
    assert text.index("| `reference` |") < text.index("| `ours` |")


def test_a_variant_is_compared_with_several(tmp_path: Path, ours: Path, reference: Path) -> None:
    rows = [row(FIRST + 1, "solved", 63_488, 5), row(FIRST + 9, "unsolved", 63_488)]
    there = made_up(tmp_path / "original.jsonl", header("original"), rows)
    paired = tables.tables(read_all([ours, reference, there])).split("Level by level:")[1]
    assert cells(paired, "`original` | `reference`")[2:] == ["2", "1", "0", "1"]
    assert cells(paired, "`ours` | `original`")[2:] == ["2", "0", "0", "1"]
    assert cells(paired, "`ours` | `reference`")[2:] == ["9", "4", "1", "0.38"]
    assert cells(paired, "`ours`, a quarter of the budget | `original`")[2:] == ["2", "0", "0", "1"]


def test_pairs_are_of_the_levels_that_both_tried(tmp_path: Path, ours: Path) -> None:
    other = made_up(tmp_path / "o.jsonl", header("width_32"), [row(FIRST + 1, "unsolved", 64_000)])
    text = tables.tables(read_all([ours, other]))
    assert cells(text.split("Level by level:")[1], "`width_32`")[1:] == ["`ours`", "1", "0", "1", "1"]


def test_files_of_one_variant_are_one(tmp_path: Path, ours: Path) -> None:
    more = made_up(tmp_path / "more.jsonl", header(), [row(FIRST + 20, "solved", 1_024, 5)])
    (both,) = read_all([ours, more])
    assert len(both.rows) == 11
    settings = header().config | {"stop": {"rule": "halving"}}
    other = made_up(tmp_path / "other.jsonl", replace(header(), config=settings), [])
    with pytest.raises(UserError, match="has other settings"):
        read_all([ours, other])


def test_unsolved_falls_with_budget(ours: Path) -> None:
    (results,) = plot.checked(read_all([ours]))
    steps, left = plot.curve(results)
    assert (steps[0], left[0]) == (4_000, 8)
    assert (steps[-1], left[-1]) == (64_000, 3)
    assert steps == sorted(set(steps))
    assert left == sorted(left, reverse=True)
    assert [plot.unsolved(results, x) for x in (1_999, 2_000, 15_999, 16_000, 63_999)] == [9, 8, 7, 6, 4]
    assert cells(plot.table([results]), "size s")[1:] == ["9", share(3, 9)]


def test_names_tell_curves_apart(ours: Path, tmp_path: Path) -> None:
    rows = [row(FIRST, "unsolved", 64_000)]
    halving = made_up(tmp_path / "h.jsonl", header("halving"), rows)
    long = made_up(tmp_path / "l.jsonl", header(budget=1_000_000), rows)
    assert plot.names(read_all([ours, halving])) == ["size s, ours", "size s, halving"]
    assert plot.names(read_all([ours, long])) == ["size s, 64k", "size s, 1M"]


def test_plot(ours: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, document = tmp_path / "unsolved.svg", tmp_path / "experts.md"
    document.write_text(f"a\n<!-- {plot.MARK} -->\nold\n<!-- end of {plot.MARK} -->\nb\n")
    monkeypatch.setattr(sys, "argv", ["solved", "plot", str(ours), "--out", str(out), "--write", str(document)])
    assert command.main() == 0
    again = out.read_bytes()
    assert len(again) < 40_000
    texts = {
        "".join(text.itertext()) for text in ElementTree.fromstring(again).iter("{http://www.w3.org/2000/svg}text")
    }
    assert {"4k", "16k", "64k", "size s"} <= texts
    assert "| size s | 9 |" in document.read_text()
    assert command.main() == 0
    assert out.read_bytes() == again, "the same files give the same plot"


def test_a_whole_budget_tells_no_curve(reference: Path) -> None:
    with pytest.raises(UserError, match="does not tell when"):
        plot.checked(read_all([reference]))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["run", "--size", "q"], "choose one of s, m, l"),
        (["run", "--budget", "5x"], "write a whole number"),
        (["run", "--budget", "500"], "one update takes 1024 env steps"),
        (["run", "--first", "-1"], "level ids are 0 and above"),
        (["run", "--jobs", "4000", "--out", "none.jsonl"], "cores"),
        (["table", "none.jsonl"], "cannot be read"),
        (["table", __file__], "is not a file that"),
    ],
)
def test_a_mistake_gets_a_sentence(
    arguments: list[str], sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["solved", *arguments])
    assert command.main() == 2
    assert sentence in capsys.readouterr().err


def test_a_line_that_was_cut_off_is_done_again(ours: Path) -> None:
    text = ours.read_text()
    ours.write_text(text[:-9])
    assert sorted(rows_there(ours, header())) == list(range(FIRST, FIRST + 9))
    assert ours.read_text() == text[: text.rindex("\n", 0, -1) + 1]


def test_a_file_of_something_else_is_left_alone(ours: Path) -> None:
    with pytest.raises(UserError, match="under other settings"):
        rows_there(ours, header(budget=128_000))


@pytest.mark.slow
def test_a_run_goes_on(tmp_path: Path) -> None:
    variant = Variant("small", SMALL)
    of = Header("small", "s", 4_096, {"expert": plain(variant.expert), "stop": plain(variant.stop)})
    out = tmp_path / "folder" / "small.jsonl"
    measure(of, variant, range(FIRST, FIRST + 2), out, 1, work)
    before = out.read_text()
    measure(of, variant, range(FIRST, FIRST + 4), out, 1, work)
    assert out.read_text().startswith(before)
    results = read(out)
    assert results.header == of
    assert list(results.rows) == list(range(FIRST, FIRST + 4))
    for row in results.rows.values():
        assert row["label"] in {"solved", "unsolved", "trivial", "unsolvable"}
        assert row["env_steps"] <= 4_096
        assert min(row["cpu_s"], row["wall_s"]) > 0
    assert results.trained, "some of these levels should get an expert"
    measure(of, variant, range(FIRST, FIRST + 4), out, 1, work)  # nothing left to do
    assert read(out) == results


def shown(ends: dict[int, list[tuple[int, bool]]], first_goal: tuple[int, int] | None) -> dict[str, np.ndarray]:
    """What the reference's process writes of a level: the episodes' ends of each attempt, a success of training."""
    config = VARIANTS["original"].expert
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
    config = VARIANTS["original"].expert
    ends = {0: [(9, True), (19, False)], 3: [(29, True), (49, True)], 5: [(4, True)], 6: [(255, False)]}
    verdict = original.judged(shown(ends, (66, 5)), config, False)
    assert (verdict.label, verdict.witness, verdict.steps_to_goal) == (Label.SOLVED, Source.SAMPLED, 30)
    assert verdict.success_rate == 3 / 4
    assert not verdict.most_probable_succeeds
    assert "all 2 of its finished episodes" in verdict.label_reason
    assert verdict.steps_to_first_success == 67 * config.environments
    assert (verdict.env_steps, verdict.episodes) == (2 * config.steps_per_update, 2)
    assert np.isnan(verdict.sticky_success_rate)


def test_a_level_without_a_good_attempt_is_unsolved() -> None:
    config = VARIANTS["original"].expert
    verdict = original.judged(shown({0: [(9, True), (19, False)]}, None), config, False)
    assert (verdict.label, verdict.witness, verdict.steps_to_goal) == (Label.UNSOLVED, None, None)
    assert np.isnan(verdict.success_rate), "no sampled attempt had an episode that ended"
    assert verdict.steps_to_first_success is None
    assert original.judged(shown({2: [(0, True)]}, None), config, False).label is Label.SOLVED


def test_without_the_reference_there_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(oracle.PYTHON_VARIABLE, sys.executable)
    out = tmp_path / "original.jsonl"
    words = ["run", "--variant", "original", "--levels", "2", "--jobs", "1", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["solved", *words])
    assert command.main() == 1
    assert "Cannot ask the reference for its version" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_the_original_runs(tmp_path: Path, reference: Path) -> None:
    """Two updates of a level that gets an expert; its neighbour needs none."""
    variant = VARIANTS["original"]
    of = Header("original", "s", 2 * 2_048, {"expert": plain(variant.expert), "stop": plain(variant.stop)})
    out = tmp_path / "original.jsonl"
    wanted = range(FIRST + 9, FIRST + 11)
    measure(of, variant, wanted, out, 1, original.work)
    head = json.loads(out.read_text().splitlines()[0])
    assert head["versions"]["reference"]["kinetix-env"] == "3.0.2"
    results, ours = read(out), read(command.RESULTS / "s-64k-reference.jsonl")
    assert list(results.rows) == list(wanted)
    assert results.trained.keys() == ours.trained.keys() & set(wanted)
    assert 0 < len(results.trained) < len(wanted), "one of these levels should get an expert, and one none"
    for level_id, row in results.rows.items():
        known = ours.rows[level_id]
        assert list(row) == list(known), "the same fields in the same order"
        if level_id not in results.trained:
            spent = {"cpu_s": 0.0, "wall_s": 0.0}
            assert row == known | spent
            continue
        assert row["env_steps"] == 2 * 2_048
        assert (row["label"] == "solved") == (row["witness"] is not None) == (row["steps_to_goal"] is not None)
        assert (row["steps_to_goal"] or 1) <= RECORD_STEPS
        assert (row["steps_to_first_success"] or 1) <= row["env_steps"]
        assert row["witness"] != "most probable" or row["most_probable_succeeds"]
        assert row["sticky_success_rate"] is row["moved_success_rate"] is None
        assert min(row["cpu_s"], row["wall_s"]) > 0
    before = out.read_text()
    measure(of, variant, wanted, out, 1, original.work)  # nothing left to do
    assert out.read_text() == before

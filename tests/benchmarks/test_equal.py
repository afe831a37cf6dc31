"""The benchmark of learners at equal cost, on policies that train for seconds."""

import json
from argparse import Namespace
from pathlib import Path

import pytest

from benchmarks import equal
from benchmarks.__main__ import parser
from benchmarks.cloning import SAMPLED
from benchmarks.equal import RATE, SECONDS, STEPS, UPDATES, run, searched, split_of
from levelproof import Failure, UserError
from levelproof.pipeline.learn.evaluate import SOLVED

KEPT = (
    *("equal", "--ways", "from scratch, evolve", "--core-seconds", "3600", "--seeds", "2", "--levels", "40k"),
    *("--updates", "7000", "--cloning", "mirror=true", "pool=60000"),
)
TINY = ("ppo.environments=64", "ppo.horizon=32", "ppo.minibatches=4")


def test_search_of_a_stopped_run_is_refused(tmp_path: Path) -> None:
    args = parser("equal").parse_args(["equal", "--folder", str(tmp_path)])
    split_of(args, 0).mkdir(parents=True)
    with pytest.raises(Failure, match="remove it, so that its search counts as a whole"):
        searched(args, 0)


def test_page_is_made_of_finished_runs(tmp_path: Path) -> None:
    args = parser("equal").parse_args([*KEPT, "--only-finished"])
    rows = run(args).tables[0].rows
    assert ["from scratch, evolve", "0", "316,145,664"] in [[row[0], row[1], row[3]] for row in rows]
    args.finished = tmp_path
    with pytest.raises(UserError, match="has none of these runs"):
        run(args)


def test_page_has_the_longest_run_within_its_core_seconds(tmp_path: Path) -> None:
    args = parser("equal").parse_args([*KEPT, "--only-finished"])
    kept = next(args.finished.glob("from-scratch-evolve-s-0-*"))
    shorter = json.loads(kept.read_text())
    shorter |= {"core_seconds": 1800.0, "looks": shorter["looks"][:-1]}
    shorter["curve"][-1][STEPS] = 24_000_000
    (tmp_path / kept.name.replace("s-0-", "s-0-f")).write_text(json.dumps(shorter))
    (tmp_path / kept.name).write_text(kept.read_text())
    args.finished = tmp_path
    for limit, steps, after in (3600.0, "316,145,664", "after 3,600"), (1800.0, "24,000,000", "after 1,800"):
        args.core_seconds = limit
        table, by_cost = run(args).tables
        assert table.rows[0][3] == steps
        assert by_cost.head[-1] == after


def test_run_is_never_measured_later_than_planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that continues a shorter one keeps what that measured, and skips what it is already beyond."""

    def trained(args: Namespace, policy: Path, way: str, start: str, seed: int, limit: float) -> list[dict[str, float]]:
        policy.mkdir(exist_ok=True)
        line = {UPDATES: 1, STEPS: int(10 * limit), SECONDS: limit - 1, RATE: 0.5}
        (policy / "metrics.jsonl").write_text(json.dumps(line) + "\n")
        return [line]

    monkeypatch.setattr(equal, "trained", trained)
    monkeypatch.setattr(equal, "pace", lambda args: equal.PACE)
    monkeypatch.setattr(equal, "kept", lambda file, *_: {SOLVED: {SAMPLED: {"once": {"rate": file.name}}}})
    args = parser("equal").parse_args(["equal", "--folder", str(tmp_path)])
    planned = {}
    for args.core_seconds in (200, 400, 600):
        looks = equal.measured(args, "from scratch", 0)["looks"]
        planned[args.core_seconds] = [look["planned"] for look in looks]
        assert all(look[SECONDS] == look["planned"] - 1 for look in looks)
    assert planned == {200: [50, 100, 200], 400: [50, 100, 200, 400], 600: [50, 100, 200, 400, 600]}
    args.core_seconds, kept = 200, {file: file.read_text() for file in tmp_path.glob("*after*")}
    with pytest.raises(UserError, match="has a run of more than 200 core-seconds: choose another --folder"):
        equal.measured(args, "from scratch", 0)
    assert {file: file.read_text() for file in tmp_path.glob("*after*")} == kept


def test_run_begun_too_late_for_a_look_is_measured_at_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(args: Namespace, policy: Path, way: str, start: str, seed: int, limit: float) -> list[dict[str, float]]:
        return [{UPDATES: 6, STEPS: 10, SECONDS: max(limit, 60.0), RATE: 0.5}]

    monkeypatch.setattr(equal, "trained", trained)
    monkeypatch.setattr(equal, "pace", lambda args: equal.PACE)
    monkeypatch.setattr(equal, "kept", lambda *_: {SOLVED: {SAMPLED: {"once": {"rate": 0.5}}}})
    args = parser("equal").parse_args(["equal", "--folder", str(tmp_path), "--core-seconds", "200"])
    assert [look[SECONDS] for look in equal.measured(args, "from scratch", 0)["looks"]] == [100, 200]


def test_first_updates_do_not_count_as_starting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first line may come after several updates; a command takes 30 seconds to start, an update 10."""
    asked = []

    def command(*words: str | Path) -> None:
        asked.append(int(next(str(word) for word in words if "env_steps" in str(word)).partition("=")[2]))

    def lines_of(_: Path) -> list[dict[str, float]]:
        updates = [5, *(steps // 524_288 for steps in asked)] if asked else []
        return [{UPDATES: each, STEPS: each * 524_288, SECONDS: 30.0 + 10 * each} for each in updates]

    monkeypatch.setattr(equal, "command", command)
    monkeypatch.setattr(equal, "lines_of", lines_of)
    args = parser("equal").parse_args(["equal", "--folder", str(tmp_path)])
    equal.trained(args, tmp_path, "levels, clone, reinforcement", "builtin:s", 0, 300)
    assert asked[0] == 6 * 524_288
    assert asked[-1] == (6 + (300 - 90 - 40) // 10) * 524_288


def test_core_seconds_scale_with_the_pace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Core-seconds are those of PACE: what was searched here at half of it counts half, and training has the rest."""
    limits = []

    def trained(args: Namespace, policy: Path, way: str, start: str, seed: int, limit: float) -> list[dict[str, float]]:
        limits.append(limit)
        return [{UPDATES: 1, STEPS: 10, SECONDS: limit - 2, RATE: 0.5}]

    monkeypatch.setattr(equal, "trained", trained)
    monkeypatch.setattr(equal, "pace", lambda args: equal.PACE / 2)
    monkeypatch.setattr(equal, "searched", lambda args, seed: 100.0)
    monkeypatch.setattr(equal, "kept", lambda *_: {SOLVED: {SAMPLED: {"once": {"rate": 0.5}}}})
    args = parser("equal").parse_args(["equal", "--folder", str(tmp_path), "--core-seconds", "200"])
    told = equal.measured(args, "levels, reinforcement on these levels", 0)
    assert told["before"] == 50
    assert limits == [2 * (100 - 50), 2 * (200 - 50)]
    assert [look[SECONDS] for look in told["looks"]] == [99, 199]
    assert told["curve"][-1][SECONDS] == 149


def test_pace_is_that_after_compiling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines, commands = [{STEPS: 60, SECONDS: 90.0}, {STEPS: 80, SECONDS: 91.0}, {STEPS: 110, SECONDS: 95.0}], []
    monkeypatch.setattr(equal, "command", lambda *words: commands.append(words))
    monkeypatch.setattr(equal, "lines_of", lambda _: lines)
    for _ in range(2):
        assert equal.pace(parser("equal").parse_args(["equal", "--folder", str(tmp_path)])) == 10
    ((*words, _),) = commands
    assert words[-2:] == ["ppo.env_steps=7864320", "-o"], "fifteen updates, measured once a folder"


@pytest.mark.campaign
def test_ways_end_at_the_same_core_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(equal, "pace", lambda args: equal.PACE)
    words = ["equal", "--ways", "from scratch", "levels, clone, reinforcement", "--core-seconds", "200"]
    words += ["--levels", "64", "--updates", "2", "--measured", "8", "--folder", str(tmp_path / "kept")]
    args = parser("equal").parse_args([*words, "--finished", str(tmp_path / "finished"), "--set", *TINY])
    report = run(args)
    names = [row[0] for row in report.tables[0].rows]
    assert names[:3] == ["from scratch", "levels, clone", "levels, clone, reinforcement"]
    scratch, tuned = report.results
    assert scratch["before"] == 0 < tuned["before"] < 200
    for each in report.results:
        first, last = each["curve"][0][SECONDS], each["curve"][-1][SECONDS]
        assert 200 - 2 * first - 10 < each["before"] + last < 210, "all stop where more would exceed the limit"
        spent = [look[SECONDS] for look in each["looks"]]
        assert spent == sorted(spent)
        assert spent[-1] == each["before"] + last
        assert each["looks"][-1]["solved"] == each["sealed"]["labelled solved"]["policy, sampled"]["once"]
    assert len(scratch["looks"]) == 3, "at a quarter, at half and at the end"
    for name, draw in report.plots.items():
        draw(tmp_path / name)
        assert (tmp_path / name).read_text().rstrip().endswith("</svg>")
    assert run(args).results == report.results, "finished training and evaluations are kept"
    (tmp_path / "kept").rename(tmp_path / "gone")
    assert run(args).results == report.results, "finished runs outlive their policies"

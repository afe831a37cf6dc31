"""Races: arithmetic, processes, and real runs at tiny sizes."""

import argparse
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import oracle, race
from benchmarks.__main__ import main
from benchmarks.contest import Entry, Score, compete
from benchmarks.levels import load_levels
from benchmarks.race import OURS, shares, summary
from benchmarks.reference import actions
from benchmarks.reference.actions import sticky_actions
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.errors import Exit, Failure, UserError
from levelproof.pipeline.runtime import own_cores
from tests.pace import patience

ROOT = Path(__file__).parent.parent.parent


class TestArithmetic:
    @pytest.mark.parametrize(("count", "cores"), [(1024, 2), (5, 4), (1, 8), (7, 1), (64, 16)])
    def test_shares_are_even_and_complete(self, count, cores) -> None:
        split = shares(count, range(cores))
        sizes = [share.count for share in split]
        assert [share.first for share in split] == list(np.cumsum([0, *sizes])[:-1])
        assert sum(sizes) == count
        assert max(sizes) - min(sizes) <= 1
        assert len(split) == min(count, cores)
        assert len({share.core for share in split}) == len(split)

    def test_actions_are_sticky_and_cover_their_choices(self) -> None:
        assert actions.CHOICES == CHOICES, "as the reference's scripts have it"
        action = sticky_actions(200, 50)
        assert action.shape == (200, 6, 50)
        for entry, choices in enumerate(CHOICES):
            assert set(np.unique(action[:, entry])) == set(range(choices))
        changes = (action[1:] != action[:-1]).mean((0, 2))
        expected = 0.1 * (1 - 1 / np.array(CHOICES))
        np.testing.assert_allclose(changes, expected, rtol=0.1)
        np.testing.assert_array_equal(action, sticky_actions(200, 50))

    def test_load_levels_wraps_around(self, level_file) -> None:
        levels = load_levels(str(level_file), 14, 4)
        whole = load_levels(str(level_file), 0, 16)
        for part in ("role", "density", "motor_binding"):
            np.testing.assert_array_equal(getattr(levels, part), getattr(whole, part)[..., [14, 15, 0, 1]])

    @staticmethod
    def scores() -> list[Score]:
        def score(name: str, rates: list[float], compile_seconds: float) -> Score:
            return Score(Entry(name, [], {}, 100), compile_seconds, rates, goals=3, episodes=4)

        return [score(OURS, [90, 110, 100], 5), score("slow", [3, 4, 9], 20), score("fast", [10, 11, 9], 30)]

    def test_summary_takes_the_references_faster_way(self) -> None:
        result = summary("s", {"lanes": 8}, self.scores())
        assert (result.ours, result.reference, result.ratio) == (100, 10, 10)
        assert result.reference_way == "fast"
        assert result.spread[OURS] == [90, 110]
        assert result.compile_ratio == 0.25
        assert result.goal_share == {OURS: 0.75, "slow": 0.75, "fast": 0.75}

    def test_tables_have_rates_and_details(self) -> None:
        results = [summary("s", {"lanes": 8}, self.scores())]
        assert race.rates(results).rows == [["s", "100", "4", "25", "10", "10"]]
        assert race.details(results).rows[0] == ["s", OURS, "90 to 110", "5.0", "75.0%"]

    def test_run_reports_non_finite_numbers_as_fault(self, monkeypatch) -> None:
        scores = self.scores()
        scores[0].finite = False
        monkeypatch.setattr(race, "compete", lambda *_: scores)
        monkeypatch.setenv(oracle.PYTHON_VARIABLE, sys.executable)
        monkeypatch.setattr(oracle, "versions", lambda _: {"jax": "0"})
        args = argparse.Namespace(size=["s"], repeats=1)
        assert "of size s is not finite" in race.run("A race", args, lambda _: [], {}).fault


class TestProcesses:
    """Real processes that speak the protocol of `serve`."""

    HEAD = "from benchmarks.reference.serve import serve\n"

    @staticmethod
    def entry(name: str, *programs: str) -> Entry:
        environment = dict(os.environ) | {"PYTHONPATH": str(ROOT)}
        return Entry(name, [[sys.executable, "-c", program] for program in programs], environment, steps=100)

    def test_compete_runs_entries_in_turns_and_processes_together(self, tmp_path, capsys) -> None:
        def program(name: str, seconds: float) -> str:
            log = f"open({str(tmp_path / 'log')!r}, 'a').write({name!r})"
            answer = {"seconds": seconds, "goal": 1, "done": 2, "finite": True}
            return f"{self.HEAD}print('noise')\nserve({{'compile_seconds': 7}}, lambda: ({log}, {answer!r})[1])"

        a = self.entry("a", program("a", 2.0), program("a", 4.0))
        b = self.entry("b", program("b", 10.0))
        first, second = compete([a, b], repeats=2)
        assert first.rates == [25, 25]  # the slower process ends the run
        assert second.rates == [10, 10]
        assert (first.goals, first.episodes, first.compile_seconds) == (4, 8, 7)
        assert (tmp_path / "log").read_text() == "aabaab"
        assert "a: compiling" in capsys.readouterr().err

    @pytest.mark.parametrize("program", ["raise SystemExit('no such thing')", "import sys; sys.exit('no such thing')"])
    def test_compete_reports_a_process_that_dies_early(self, program) -> None:
        with pytest.raises(Failure, match=r"ended early \(no such thing\)"):
            compete([self.entry("a", program)], repeats=1)

    def test_compete_reports_a_process_that_dies_in_a_run(self) -> None:
        program = f"{self.HEAD}serve({{'compile_seconds': 0}}, lambda: 1 / 0)"
        with pytest.raises(Failure, match="ZeroDivisionError"):
            compete([self.entry("a", program)], repeats=1)


class TestInput:
    @pytest.mark.parametrize(
        "arguments", [["physics", "--lanes", "0"], ["experts", "--levels", "-1"], ["physics", "--repeats", "0"]]
    )
    def test_check_rejects_counts_below_one(self, arguments, capsys) -> None:
        assert main(arguments) == Exit.INPUT
        assert re.search(r"--\w+ is -?\d, but must be at least 1\.$", capsys.readouterr().err)

    def test_check_rejects_a_missing_level_file(self, capsys) -> None:
        assert main(["physics", "--level-file", "nowhere.npz"]) == Exit.INPUT
        assert "The file nowhere.npz does not exist" in capsys.readouterr().err

    def test_oracle_python_rejects_a_missing_program(self, monkeypatch) -> None:
        monkeypatch.setenv(oracle.PYTHON_VARIABLE, "/nowhere/python")
        with pytest.raises(UserError, match="is not a program"):
            oracle.oracle_python()

    def test_versions_names_the_missing_package(self, monkeypatch, level_file, capsys) -> None:
        """The message is the reference's process's, which lacks the package."""
        monkeypatch.setenv(oracle.PYTHON_VARIABLE, sys.executable)
        with pytest.raises(Failure, match=r"kinetix"):
            oracle.versions(oracle.oracle_python())

    @pytest.mark.campaign
    def test_oracle_python_reports_a_missing_network(self, monkeypatch, tmp_path, capsys) -> None:
        """Make a real environment whose pip cannot reach an index."""
        monkeypatch.delenv(oracle.PYTHON_VARIABLE, raising=False)
        monkeypatch.setenv("LEVELPROOF_CACHE_DIR", str(tmp_path))
        for name, value in {
            "INDEX_URL": "http://127.0.0.1:9/simple",
            "RETRIES": "0",
            "CONFIG_FILE": os.devnull,
        }.items():
            monkeypatch.setenv(f"PIP_{name}", value)
        for name in ("PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
            monkeypatch.delenv(name, raising=False)
        with pytest.raises(Failure, match=r"Cannot install kinetix-env==3\.0\.2 .*check the network"):
            oracle.oracle_python()
        assert "about two minutes" in capsys.readouterr().err
        assert not (tmp_path / "reference" / "ready").exists()


@pytest.mark.campaign
@pytest.mark.parametrize(
    "arguments",
    [
        ["physics", "--lanes", "6", "--steps", "4", "--block", "4"],
        ["experts", "--levels", "2", "--environments", "4", "--horizon", "8", "--updates", "1"],
    ],
    ids=["physics", "experts"],
)
def test_tiny_race_runs_for_real(reference, level_file, arguments) -> None:
    """Run as a user would, pinned to one core if possible, so that the reference's only variant is one process."""
    pin = f"hasattr(os, 'sched_setaffinity') and os.sched_setaffinity(0, {{{own_cores()[0]}}})"
    code = f"import os, sys; {pin}; from benchmarks.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", code, *arguments, "--repeats", "2", "--level-file", str(level_file), "--json"]
    environment = dict(os.environ) | {oracle.PYTHON_VARIABLE: str(reference)}
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, env=environment, check=False, timeout=patience(1800)
    )
    assert done.returncode == Exit.DONE, done.stderr
    document = json.loads(done.stdout)
    assert document["bench"] == arguments[0]
    assert document["ours"] > 0
    assert document["reference"] > 0
    assert document["ratio"] == pytest.approx(document["ours"] / document["reference"], rel=0.01)
    assert document["finite"] is True
    assert document["reference_way"].startswith("reference, ")
    assert len(document["runs"][OURS]) == 2
    assert document["versions"]["reference"]["kinetix-env"] == "3.0.2"
    assert all(seconds > 0 for seconds in document["compile_seconds"].values())

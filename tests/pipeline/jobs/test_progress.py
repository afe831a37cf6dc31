"""Progress of a job: the counts, the estimates, and how they are shown."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from levelproof.experts.steps import EnvSteps, Totals
from levelproof.pipeline.jobs import progress
from levelproof.pipeline.jobs.progress import Board, Tally
from levelproof.pipeline.jobs.schedule import Round, Summary, WorkUnit
from levelproof.pipeline.store import progress_bar
from levelproof.pipeline.words import duration, number

UNIT = WorkUnit(tuple(range(16)))


def tally(done: int = 0) -> Tally:
    return Tally(levels=64, done=done, solved=done // 2)


def test_tally_share_grows_with_decided_levels() -> None:
    now = tally()
    assert now.share == 0
    now.running[UNIT] = Totals(8_000, 7.5, 3)
    assert now.share == pytest.approx(7.5 / 64)
    assert (now.decided, now.solved_so_far) == (7, 3)
    now.running[UNIT] = Totals(9_000, 16, 3)
    assert now.share == pytest.approx(16 / 64)
    now.ended(UNIT, Summary(levels=16, solved=5, spent=EnvSteps(trained=16_000)))
    assert (now.share, now.done, now.solved_so_far) == (pytest.approx(16 / 64), 16, 5)


def test_tally_discards_the_progress_of_a_failed_attempt() -> None:
    now = tally()
    now.running[UNIT] = Totals(8_000, 8.0, 3)
    now.ended(UNIT, None)
    assert (now.share, now.solved_so_far) == (0, 0)


def board_at(now: Tally, time: list[float]) -> tuple[Board, io.StringIO]:
    """Return a board that prints to a string, and whose clock reads `time[0]`."""
    text = io.StringIO()
    return Board(now, Console(file=text), clock=lambda: time[0]), text


def test_board_estimates_exclude_compiling() -> None:
    now, time = tally(), [0.0]
    board, text = board_at(now, time)
    for second in range(100):
        time[0] = float(second)
        board.refresh(0.0)
        assert text.getvalue().endswith("compiling\n")
    for second in range(100, 111):
        time[0] = float(second)
        now.running[UNIT] = Totals((second - 99) * 800, (second - 99) * 0.8, 0)
        board.refresh(0.0)
    assert text.getvalue().endswith("800 env steps/s · about 69 s left\n")  # (64 - 8.8) / 0.8


def test_board_counts_programs_while_they_compile() -> None:
    now = tally()
    board, text = board_at(now, [0.0])
    now.compiled = 7, 19
    board.refresh(0.0)
    now.compiled = 19, 19
    board.refresh(0.0)
    first, second = text.getvalue().splitlines()
    assert first.endswith("compiling, 7 of 19 programs")
    assert second.endswith("compiling")


def test_board_pace_excludes_levels_of_earlier_runs() -> None:
    now = tally(done=32)
    assert now.share == 0.5
    board, text = board_at(now, [10.0])
    board.refresh()
    assert text.getvalue() == "32/64 levels · 16 solved · 0 env steps/s · compiling\n"


def test_board_keeps_its_pace_during_a_pause() -> None:
    """An evaluation may take longer than the averaging period of the pace."""
    now, time = tally(), [0.0]
    board, text = board_at(now, time)
    for steps in (100, 200):
        time[0] += 1.0
        now.running[UNIT] = Totals(steps, steps / 100, 0)
        board.refresh()
    time[0] += 1000.0
    board.refresh(0.0)
    assert "100 env steps/s · about 62 s left" in text.getvalue().splitlines()[-1]


def test_board_has_no_pace_without_workers() -> None:
    now, time = tally(), [0.0]
    board, text = board_at(now, time)
    seen: list[tuple[float, float | None]] = []
    board.watchers.append(lambda rate, left: seen.append((rate, left)))
    for steps in (100, 200):
        time[0] += 1.0
        now.running[UNIT] = Totals(steps, steps / 100, 0)
        board.refresh(0.0)
    board.refresh(0.0, working=False)
    assert seen[1:] == [(100.0, 62.0), (0.0, None)]
    assert text.getvalue().endswith("· 0 env steps/s · ...\n")


def test_board_takes_no_pace_from_two_moments() -> None:
    now, time = tally(), [0.0]
    board, text = board_at(now, time)
    for steps, at in (100, 0.0), (9_000, 0.001), (10_100, 2.0):
        time[0] = at
        now.running[UNIT] = Totals(steps, steps / 1000, 0)
        board.refresh(0.0)
    first, second, third = text.getvalue().splitlines()
    assert "· 0 env steps/s" in first
    assert "· 0 env steps/s" in second
    assert "· 5,000 env steps/s" in third


def test_board_prints_few_lines_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress_bar, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    text = io.StringIO()
    board = Board(tally(), Console(file=text))
    with board.shown():
        board.refresh()
        board.refresh()
        for first in range(0, 64, 4):
            board.ended(WorkUnit(tuple(range(first, first + 4))), Summary(4, 1, EnvSteps(trained=4_000)))
    lines = text.getvalue().splitlines()
    assert len(lines) == 2  # not one for every refresh, nor for every commit where they come fast
    assert "0/64 levels" in lines[0]
    assert lines[1] == "64/64 levels · 16 solved · done"


def test_board_prints_a_commit_once_the_last_line_is_old(monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.StringIO()
    board = Board(tally(), Console(file=text))
    monkeypatch.setattr(progress, "LINE_AFTER", 0.0)
    board.refresh()
    board.ended(UNIT, Summary(16, 5, EnvSteps(trained=16_000)))
    assert "16/64 levels · 5 solved" in text.getvalue().splitlines()[1]


def test_board_says_once_that_experts_cannot_be_saved() -> None:
    text = io.StringIO()
    board = Board(tally(), Console(file=text))
    for why in ("", "no space", "no space"):
        board.follow(Round([], {}, 0, unsaved=why))
    (line,) = text.getvalue().splitlines()
    assert line == "Unfinished experts cannot be saved (no space): if this run is stopped, they start again."


def test_tally_text_says_writing_until_all_levels_are_committed() -> None:
    now = Tally(levels=16, done=0, solved=0)
    now.running[UNIT] = Totals(16_000, 16.0, 5)
    assert now.text(0.0, None) == "16/16 levels · 5 solved · writing"


def test_board_shows_the_groups_that_are_left_to_seal() -> None:
    board, text = board_at(Tally(levels=16, done=16, solved=5), [0.0])
    board.sealing(0)
    assert not text.getvalue(), "nothing was left"
    board.sealing(2)
    assert text.getvalue() == "16/16 levels · 5 solved · sealing, 2 groups of fragments left\n"


def test_board_shows_a_bar_on_a_terminal() -> None:
    text = io.StringIO()
    board = Board(tally(), Console(file=text, force_terminal=True, width=160))
    with board.shown():
        board.ended(UNIT, Summary(16, 5, EnvSteps(trained=16_000)))
    assert "16/64 levels · 5 solved" in text.getvalue()


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (89, "89 s"), (90, "2 min"), (5400, "1.5 h")])
def test_duration_picks_a_unit(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.38251, "0.383"),
        (12.0, "12"),
        (999.4, "999"),
        (999.6, "1,000"),
        (12_345.6, "12,346"),
        (-2e6, "-2,000,000"),
    ],
)
def test_number_keeps_three_digits(value: float, text: str) -> None:
    assert number(value) == text

"""The folder of a run: what is never overwritten."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import levelproof
from levelproof.experts.networks.saved import WEIGHTS
from levelproof.levelgen.level import size_of
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.learn import run as writer
from levelproof.pipeline.learn.clone import COURSE
from levelproof.pipeline.learn.folder import (
    CHECKPOINT,
    MADE_BY,
    RUN,
    continued,
    keep_run,
    note_in,
    require_same_run,
    stacks_in,
    tell_done,
    with_stack,
    write_note,
    writing_run,
)
from levelproof.pipeline.learn.metrics import METRICS, Metrics
from levelproof.pipeline.store.layout import WRITER_LOCK

STATE = {"step": np.int32(3)}


def test_policy_without_its_checkpoint_is_not_begun_again(tmp_path: Path) -> None:
    assert continued(tmp_path, STATE) is STATE
    keep_run(tmp_path, levelproof.load_policy("builtin:s"), STATE)
    assert continued(tmp_path, {"step": np.int32(0)}) == STATE
    (tmp_path / CHECKPOINT).unlink()
    with pytest.raises(UserError, match=f"has a policy, but no {CHECKPOINT}: put it back"):
        continued(tmp_path, STATE)


def test_checkpoint_is_written_before_the_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("levelproof.pipeline.learn.folder.save_policy", killed)
    with pytest.raises(KeyboardInterrupt):
        keep_run(tmp_path, levelproof.load_policy("builtin:s"), STATE)
    assert continued(tmp_path, {"step": np.int32(0)}) == STATE


def test_weights_that_are_not_finite_replace_nothing(tmp_path: Path) -> None:
    policy = levelproof.load_policy("builtin:s")
    diverged = replace(policy, params=jax.tree.map(lambda x: x * np.nan, policy.params))
    with pytest.raises(Failure, match="The weights have diverged"):
        keep_run(tmp_path, diverged, STATE)
    assert list(tmp_path.iterdir()) == []
    keep_run(tmp_path, policy, STATE)
    before = shutil.copytree(tmp_path, tmp_path.with_name("before"))
    with pytest.raises(Failure, match="no checkpoint was overwritten"):
        keep_run(tmp_path, diverged, STATE)
    for path in before.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_run_that_saved_nothing_gives_way_to_other_settings(tmp_path: Path) -> None:
    write_note(tmp_path, {"settings": {"seed": 0}, MADE_BY: []})
    require_same_run(tmp_path, {"settings": {"seed": 1}})
    (tmp_path / CHECKPOINT).touch()
    with pytest.raises(UserError, match="seed was 0, now 1"):
        require_same_run(tmp_path, {"settings": {"seed": 1}})


def test_run_continues_wherever_its_levels_and_its_start_are(tmp_path: Path) -> None:
    def note(folder: str, levels: str, start: str = "5e") -> dict[str, Any]:
        settings = {"start": f"{folder}policy", "levels": levels}
        facts = {"levels": levels, "content": "7a"}
        return {"splits": [{"split": f"{folder}s", "ids": "9c"}], "settings": settings, "levels": facts, "start": start}

    (tmp_path / CHECKPOINT).touch()
    write_note(tmp_path, note("", "mine"))
    require_same_run(tmp_path, note("/moved/", "/moved/mine"))
    for other in note("", "mine", start="00"), note("", "uniform"):
        with pytest.raises(UserError, match="has a run with other settings or levels"):
            require_same_run(tmp_path, other)
    write_note(tmp_path, note("", "uniform"))
    with pytest.raises(UserError, match="levels was uniform, now learnability"):
        require_same_run(tmp_path, note("", "learnability"))


@pytest.mark.parametrize(("size", "command"), [(None, "'my policy'"), ("m", "'my policy' --size m")])
def test_next_command_names_the_only_size_that_a_policy_plays(size: str | None, command: str) -> None:
    told = list[str]()
    tell_done(Path("my policy"), size_of(size) if size else None, told.append)
    assert told == [f"The policy is in my policy. Next: levelproof evaluate {command}"]


def test_what_a_killed_command_left_is_removed(tmp_path: Path) -> None:
    out = tmp_path / "policy"
    out.mkdir()
    for name in (f".{CHECKPOINT}.123", f".{RUN}.123", f".{METRICS}.123", f"{WEIGHTS}.tmp", "mine.123"):
        (out / name).touch()
    with writing_run(out) as require_ours:
        require_ours()
    assert {path.name for path in out.iterdir()} == {"mine.123", WRITER_LOCK}


def test_metrics_drop_a_half_written_line_and_later_ones(tmp_path: Path) -> None:
    lines = ['{"bc/updates": 1}', '{"bc/updates": 2}', '{"bc/updates": 3}', '{"bc/upd']
    (tmp_path / METRICS).write_text("\n".join(lines))
    with Metrics(tmp_path, COURSE, "none", {}, 2, print, lambda: None) as kept:
        assert kept.last == {"bc/updates": 2}
    assert (tmp_path / METRICS).read_text() == "".join(f"{line}\n" for line in lines[:2])


def test_run_that_another_stack_began_continues_and_says_so(tmp_path: Path) -> None:
    told = list[str]()
    (tmp_path / CHECKPOINT).touch()
    here = with_stack({"settings": {"seed": 0}, MADE_BY: []}, told.append)
    assert with_stack(here, told.append) == here
    assert not told
    (stack,) = here[MADE_BY]
    write_note(tmp_path, other := {"settings": {"seed": 0}, MADE_BY: [stack | {"jax": "0.9"}]})
    require_same_run(tmp_path, {"settings": {"seed": 0}})
    assert stacks_in(tmp_path) == other[MADE_BY]
    assert with_stack(other, told.append)[MADE_BY] == [*other[MADE_BY], stack]
    assert told == [
        "This run was last trained with jax 0.9, so its policy may differ from that of an uninterrupted run."
    ]
    with pytest.raises(UserError, match=r"has a run with other settings or levels \(seed was 0, now 1\): repeat"):
        require_same_run(tmp_path, {"settings": {"seed": 1}})
    with pytest.raises(UserError, match=r"levels \(the levels or the start differ\): repeat"):
        require_same_run(tmp_path, {"settings": {"seed": 0}, "start": "5e"})
    for damage in ("5", "[]", '{"cores": "two"}', "{"):
        (tmp_path / RUN).write_text(damage)
        with pytest.raises(Failure, match=r"Cannot read .*run\.json"):
            note_in(tmp_path)
    for damage in ("jax", ["jax"], {"jax": "0.9"}):
        write_note(tmp_path, {"seed": 0, MADE_BY: damage})
        with pytest.raises(Failure, match=r"run\.json is damaged \(made_by\)"):
            stacks_in(tmp_path)


@pytest.mark.parametrize("trains", [False, True])
def test_a_stack_is_noted_once_it_has_trained(trains: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noted, told, before = list[Any](), list[str](), [{"jax": "0.9"}]
    monkeypatch.setattr(writer, "keep_run", lambda out, policy, state: noted.append(policy.made_by))
    (tmp_path / CHECKPOINT).touch()
    write_note(tmp_path, {"seed": 0, MADE_BY: before})
    policy_of: Any = lambda note, state: SimpleNamespace(size=None, made_by=note[MADE_BY])

    def advance(run: writer.Run[None]) -> None:
        assert stacks_in(tmp_path) == before
        run.keep(None, {COURSE.step: 1, "bc/loss": 0.5}, "bc/loss", "train.learning_rate")

    begin = lambda: writer.Begun(None, 0, trains, advance)
    log = "none" if trains else "a logger"
    writer.make_policy(tmp_path, {"seed": 0}, COURSE, log, begin, policy_of, told.append)
    assert noted[-1] == stacks_in(tmp_path)
    assert [len(told), len(noted[-1])] == ([2, 2] if trains else [1, 1])

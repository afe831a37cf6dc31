"""Pictures and films of a real split, whose levels solve themselves, replayed and committed like a work unit."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.witness.witness import succeeds
from levelproof.levelgen.files.level_file import LevelFile, write_level_file
from levelproof.levelgen.level import SIZES
from levelproof.levelgen.pictures.raster import draw, rasterise
from levelproof.levelgen.proofs import examine
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.levelgen.task.rules import TaskParams, advance, reset
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.look import show as show_module
from levelproof.pipeline.look.show import do_nothing, film_of, show
from levelproof.pipeline.read.levels import find_level
from levelproof.pipeline.store.manifest import require_manifest
from tests.pipeline.made import PLAYED, made_job


def level_with(split: Path, label: str) -> int:
    """Id of the last level with that label."""
    rows = [row for row in require_manifest(split).table.to_pylist() if row["label"] == label]
    return int(rows[-1]["level_id"])


@pytest.mark.parametrize("suffix", [".gif", ".PNG", ".png", ".svg"])
def test_show_draws_a_witness(split, tmp_path, capsys, suffix) -> None:
    level_id, out = level_with(split, "solved"), tmp_path / "new" / f"level{suffix}"
    show(split, level_id, out)
    output = capsys.readouterr().out
    assert output.startswith(str(out))
    assert f"level {level_id} of size s, solved in " in output
    assert output.count("\n") == 1
    steps = int(re.search(r"solved in (\d+) step", output)[1])  # type: ignore[index]
    if suffix == ".svg":
        assert out.read_text().startswith("<svg ")
        assert f'dur="{steps / 30 + 1.5:.3f}'.rstrip("0") in out.read_text()
        return
    with Image.open(out) as picture:
        if suffix.lower() == ".png":
            assert picture.size[0] == 480 * min(3, steps // 2 + 2)
        else:
            assert picture.n_frames == (steps + 1) // 2 + 1  # type: ignore[attr-defined]
            seconds = 0.0
            for number in range(picture.n_frames):  # type: ignore[attr-defined]
                picture.seek(number)
                seconds += picture.info["duration"] / 1000
            assert seconds == pytest.approx(steps / 30 + 1.5, rel=0.15)


def test_show_draws_the_initial_world_without_a_witness(split, tmp_path, capsys) -> None:
    level_id = level_with(split, "unsolved")
    show(split, level_id, tmp_path / "level.png")
    assert f"level {level_id} of size s is unsolved" in (output := capsys.readouterr().out)
    assert "there is no witness, so this is its initial world" in output
    with Image.open(tmp_path / "level.png") as picture:
        assert picture.size[0] == 480


def test_show_films_doing_nothing_without_a_witness(split, tmp_path, capsys) -> None:
    show(split, level_with(split, "unsolved"), tmp_path / "level.svg")
    assert "there is no witness, so this is what doing nothing does (" in capsys.readouterr().out
    assert (tmp_path / "level.svg").read_text().count("doing nothing · ") > 10


class TestDoingNothing:
    RULES = TaskParams()

    def test_do_nothing_ends_like_the_task(self) -> None:
        levels = sample_levels(jnp.arange(16), SIZES["s"])
        act = jax.jit(lambda now: advance(levels, now, jnp.zeros((6, 16), jnp.int32), self.RULES))
        after, ends = reset(levels), {}
        for number in range(1, 257):
            after, outcome = act(after)
            for lane in np.flatnonzero(outcome.done):
                ends.setdefault(int(lane), (number, bool(outcome.goal[lane])))
        kinds = set()
        for lane in range(16):
            one = jax.tree.map(lambda x, lane=lane: x[..., lane : lane + 1], levels)
            steps, end = do_nothing(one, self.RULES)[1]
            assert (steps, end == "goal reached") == ends[lane]
            kinds.add(end)
        assert kinds == {"goal reached", "touched red", "time is up"}

    def test_film_is_short_under_any_rules(self, tmp_path: Path) -> None:
        level = jax.tree.map(np.asarray, sample_levels(jnp.array([ends_late()]), SIZES["s"]))
        for rules in (TaskParams(frame_skip=10**6, max_timesteps=10**6), TaskParams(max_timesteps=10**6)):
            write_level_file(LevelFile(level, rules), tmp_path / "level.json")
            film = film_of(tmp_path / "level.json", None)
            assert len(film.scenes) <= RECORD_STEPS
            assert ("so this is its initial world" in film.description) == (rules.frame_skip > 2)
        assert "what doing nothing does (the first 8.5 s)" in film.description

    def test_do_nothing_ends_when_the_world_breaks_down(self) -> None:
        level = sample_levels(jnp.array([ends_late()]), SIZES["s"])
        model = replace(level.model, gravity=level.model.gravity * np.nan)
        assert do_nothing(replace(level, model=model), self.RULES)[1] == (1, "world breaks down")


def ends_late() -> int:
    """Id of a level of size s in which doing nothing lasts until time is up."""
    levels = sample_levels(jnp.arange(64), SIZES["s"])
    facts = examine(levels, TaskParams(), 256)
    return int(np.flatnonzero(~facts.reaches & ~facts.fails)[0])


def test_film_starts_with_the_resampled_level(split, tmp_path) -> None:
    """The first picture of a witness equals the level sampled from its id."""
    _, row = find_level(split, level_with(split, "solved"))
    film = film_of(split, row["level_id"])
    again = sample_levels(jnp.array([row["level_id"]], jnp.int32), SIZES["s"], made_job().distribution)
    world = (0, 40, 480, 480)
    bare = draw(again, again.state, action=np.zeros(6, np.int32)).crop(world)
    ours = rasterise(film.scenes[0]).crop(world)
    assert (np.asarray(bare) != np.asarray(ours)).any(-1).mean() < 0.02  # except running actuators


@pytest.mark.parametrize("level_id", [PLAYED, -1, 10**9])
def test_show_refuses_an_unknown_level(split, tmp_path, level_id) -> None:
    with pytest.raises(UserError, match=rf"^There is no level {level_id} in .*64 levels, from 0 to 63\.$"):
        show(split, level_id, tmp_path / "level.gif")


@pytest.mark.parametrize("name", ["level.jpg", "level", "level.gif.txt"])
def test_show_refuses_an_unknown_suffix(split, tmp_path, name) -> None:
    with pytest.raises(UserError, match=r"must end in \.gif, \.png, \.mp4, \.svg\.$"):
        show(split, 0, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_show_refuses_an_unwritable_file(split, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"^Cannot write .*: choose another file with -o"):
        show(split, 0, tmp_path / "file" / "level.gif")


def test_show_writes_mp4(split, tmp_path) -> None:
    show(split, level_with(split, "solved"), tmp_path / "level.mp4")
    assert (tmp_path / "level.mp4").read_bytes()[4:8] == b"ftyp"


def test_show_keeps_the_earlier_film_if_a_new_one_fails(split, tmp_path, monkeypatch) -> None:
    show(split, level_with(split, "solved"), tmp_path / "level.mp4")
    earlier = (tmp_path / "level.mp4").read_bytes()
    broken = tmp_path / "bin/ffmpeg"
    broken.parent.mkdir()
    broken.write_text('#!/bin/sh\nfor out; do :; done\nprintf half > "$out"\nexit 1\n')
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", f"{broken.parent}:/usr/bin:/bin")
    with pytest.raises(Failure, match="ffmpeg could not encode the film"):
        show(split, level_with(split, "solved"), tmp_path / "level.mp4")
    assert (tmp_path / "level.mp4").read_bytes() == earlier
    assert {path.name for path in tmp_path.iterdir()} == {"bin", "level.mp4"}


def test_show_mp4_needs_ffmpeg(split, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"^Cannot draw an MP4, because this machine has no ffmpeg"):
        show(split, level_with(split, "solved"), tmp_path / "other.mp4")


def test_film_of_a_witness_refuses_a_record_without_success(split, monkeypatch) -> None:
    monkeypatch.setattr(show_module, "succeeds", lambda done, goal: succeeds(done, ~goal))
    with pytest.raises(Failure, match="does not reach the goal"):
        film_of(split, level_with(split, "solved"))

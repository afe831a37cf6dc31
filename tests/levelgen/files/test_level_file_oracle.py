"""Level files against the reference, which opens all its handmade levels, and ours. Skipped if it is not installed."""

import functools
from pathlib import Path

import jax
import numpy as np
import pytest

from levelproof.levelgen.files.kinetix import level_from_kinetix
from levelproof.levelgen.files.level_file import LevelFile, read_level_file, with_known_bindings, write_level_file
from levelproof.levelgen.level import SIZES, Level, concatenate_levels
from levelproof.levelgen.sampling.sampler import Distribution, sample_levels
from levelproof.levelgen.task.rules import TaskParams, TaskState, advance
from levelproof.physics.types import Size
from tests.levelgen.opened import Played, handmade_levels, open_in_reference
from tests.trees import assert_same

pytestmark = pytest.mark.campaign
HANDMADE = {"s": 10, "m": 24, "l": 40}
STEPS = 32  # env steps played per level
OURS = 4  # sampled levels opened with the handmade ones


@pytest.fixture(scope="module")
def handmade(reference: Path) -> dict[str, list[Path]]:
    """Return the level files of the reference's installation by size."""
    folder = handmade_levels(reference)
    return {size: sorted((folder / size).glob("*.json")) for size in SIZES}


@pytest.fixture(scope="module")
def played(reference: Path, handmade, tmp_path_factory):
    """Play, for each size, the handmade levels, one of them rewritten by us, and sampled levels."""
    folder = tmp_path_factory.mktemp("levels")

    @functools.cache
    def play(size: str) -> Played:
        again = folder / f"{size}-again.json"
        write_level_file(read_level_file(handmade[size][0]), again)
        files = [*handmade[size], again, *exported(SIZES[size], folder, size)]
        return open_in_reference(reference, files, folder / f"{size}.npz", STEPS)

    return play


def exported(size: Size, folder: Path, name: str, count: int = OURS) -> list[Path]:
    """Write files of the first levels of a size."""
    levels = sample_levels(np.arange(count), size, Distribution())
    paths = [folder / f"{name}-{i}.json" for i in range(count)]
    for i, path in enumerate(paths):
        level = jax.tree.map(lambda x, i=i: np.asarray(x)[..., i : i + 1], levels)
        write_level_file(LevelFile(level, TaskParams()), path)
    return paths


def side_by_side(files: list[Path]) -> Level:
    return concatenate_levels([read_level_file(path).level for path in files])


@pytest.mark.parametrize("size", SIZES)
def test_reader_reads_every_handmade_level_with_its_rules(handmade, size) -> None:
    assert len(handmade[size]) == HANDMADE[size]
    for path in handmade[size]:
        file = read_level_file(path)
        assert file.level.size == SIZES[size]
        assert file.rules == TaskParams()


@pytest.mark.parametrize("size", SIZES)
def test_handmade_levels_survive_a_round_trip(handmade, size, tmp_path) -> None:
    for path in handmade[size]:
        file = read_level_file(path)
        write_level_file(file, tmp_path / path.name)
        again = read_level_file(tmp_path / path.name)
        assert_same(again.level, file.level)
        assert again.rules == file.rules


@pytest.mark.parametrize("size", SIZES)
def test_reference_opens_the_same_levels(played, size) -> None:
    """Bit for bit: the handmade levels as we read them, and ours as we wrote them.

    All but the bindings of inactive thrusters, to which two of the handmade levels give one that no action has.
    """
    run = played(size)
    assert len(run.files) == HANDMADE[size] + 1 + OURS
    assert_same(side_by_side(run.files), with_known_bindings(run.levels()))


@pytest.mark.parametrize("size", SIZES)
def test_file_levels_step_as_in_the_reference(played, size) -> None:
    """Takes one env step of ours from each state that the reference played."""
    run = played(size)
    steps, levels = run.arrays["action"].shape[:2]
    before = {name: values[:-1].reshape(steps * levels, *values.shape[2:]) for name, values in run.states().items()}
    after = {name: values[1:].reshape(steps * levels, *values.shape[2:]) for name, values in run.states().items()}
    level, then = level_from_kinetix(before), level_from_kinetix(after).state
    now = TaskState(level.state, before["timestep"], before["last_distance"])
    action = run.arrays["action"].reshape(steps * levels, -1).T.astype(np.int32)
    rules = read_level_file(run.files[0]).rules
    step = jax.jit(lambda level, now, action: advance(level, now, action, rules)[:2])
    ours, outcome = jax.tree.map(np.asarray, step(level, now, action))

    off = np.zeros(steps * levels)
    for name in ("position", "rotation", "velocity", "angular_velocity"):
        gap = np.abs(getattr(ours.state, name) - getattr(then, name))
        off = np.maximum(off, gap.reshape(-1, gap.shape[-1]).max(0))
    off = off.reshape(steps, levels)
    assert (off < 1e-3).mean() >= 0.995, np.sort(off.ravel())[-20:]
    assert (off < 1e-4).mean() >= 0.97
    median = dict(zip((path.stem for path in run.files), np.median(off, 0), strict=True))
    assert max(median.values()) < 1e-4, median  # no level is off throughout
    same = np.abs(outcome.reward - run.arrays["reward"].ravel()) < 1e-3
    same &= (outcome.done == run.arrays["done"].ravel()) & (outcome.goal == run.arrays["goal"].ravel())
    assert same.mean() >= 0.999


def test_reference_opens_a_custom_size(reference, tmp_path) -> None:
    files = exported(Size(polygons=7, circles=1, joints=3, thrusters=4), tmp_path, "custom", count=2)
    run = open_in_reference(reference, files, tmp_path / "out.npz")
    assert_same(side_by_side(files), run.levels())

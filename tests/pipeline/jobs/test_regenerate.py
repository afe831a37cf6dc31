"""`regenerate` on real splits: a manifest's levels at a larger budget, from the start or from saved experts."""

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from levelproof.configs.compose import compose_job
from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.jobs.regenerate import kept_settings, split_arguments
from levelproof.pipeline.store.checkpoints import load_experts, require_same_experts
from levelproof.pipeline.store.layout import new_attempt
from levelproof.pipeline.store.manifest import begin_fragment, read_manifest
from levelproof.pipeline.verify.verify import examine
from levelproof.pipeline.words import many
from tests.pipeline.command import here
from tests.pipeline.made import lasting, made_job

SHORT = ["search.env_steps=65_536", "search.variations=16_384"]  # limits are in no program
SETTINGS = ["levels=12", "stop.rule=solved", "executor=inline", *SHORT]  # so that some use their whole budget


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with data/8k/s, made with `keep_experts=true` by a worker with several units, then sealed."""
    folder = tmp_path_factory.mktemp("ladder")
    done = here(["generate", *SETTINGS, "budget=8k", "keep_experts=true", "unit=2"], folder)
    assert done.returncode == 0, done.stderr
    done = here(["seal", "data/8k/s", "--rows", "5"], folder)
    assert "merged 6 fragments into 2; it has 12 levels in 2 fragments now" in done.stdout
    return folder


def rows_of(split: Path) -> list[dict]:
    """Return the reproducible part of a manifest, as strings."""
    return [{name: str(value) for name, value in row.items()} for row in lasting(split)]


@pytest.mark.slow
def test_resumed_training_equals_uninterrupted_training(folder: Path) -> None:
    unsolved = [row["level_id"] for row in rows_of(folder / "data/8k/s") if row["label"] == Label.UNSOLVED]
    assert unsolved
    where = "where=label = 'unsolved'"
    words = ["manifest=data/8k/s", "budget=24k", where, "continue=true", "unit=1", "executor=inline"]
    done = here(["regenerate", *words], folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"data/24k/s: {many(len(unsolved), 'level')}, ")
    again = ["regenerate", "manifest=data/8k/s", "budget=24k", where, "out=through", "executor=inline"]
    assert here(again, folder).returncode == 0
    continued, through = rows_of(folder / "data/24k/s"), rows_of(folder / "through/24k/s")
    assert [row["level_id"] for row in continued] == unsolved
    assert continued == through
    assert any(int(row["env_steps"]) > 8_000 for row in through)
    assert not examine(folder / "data/24k/s").wrong
    assert f"of {many(len(unsolved), 'level')} committed" in here(["status", "data/24k/s"], folder).stdout
    assert here(again, folder).stdout.startswith("Nothing to do")


@pytest.mark.slow
def test_load_experts_restores_the_state_at_which_training_ended(folder: Path) -> None:
    job = made_job("data", *SETTINGS, "budget=8k")
    rows = read_manifest(folder / "data/8k/s").table.to_pylist()
    paths = {row["experts"] for row in rows if row["experts"]}
    assert len(paths) > 1
    experts = {i: kept for path in paths for i, kept in load_experts(folder / "data/8k/s" / path, job).items()}
    trained = {row["level_id"]: row for row in rows if row["label"] in (Label.SOLVED, Label.UNSOLVED)}
    assert experts.keys() == trained.keys()
    for level_id, kept in experts.items():
        assert int(kept.begun.training.progress.env_steps) == trained[level_id]["env_steps"]
        np.testing.assert_array_equal(np.float32(kept.curve), np.float32(trained[level_id]["learning_curve"]))
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(kept.begun.training.train_state.params))


@pytest.mark.slow
def test_require_same_experts_rejects_experts_that_cannot_be_resumed(folder: Path, tmp_path: Path) -> None:
    source = folder / "data/8k/s"

    def refused(*settings: str) -> str:
        with pytest.raises(UserError) as error:
            require_same_experts(made_job("data", *SETTINGS, f"continue_from={source}", *settings))
        return str(error.value)

    assert "give a larger budget" in refused("budget=8k")
    assert "expert.width was 32, now 64" in refused("budget=24k", "expert.width=64")
    without = tmp_path / "data"
    assert here(["generate", *SETTINGS, "levels=2", "budget=4k", f"out={without}"], tmp_path).returncode == 0
    with pytest.raises(UserError, match="kept no experts: make it in another folder with out=NAME"):
        require_same_experts(made_job("x", "budget=24k", f"continue_from={without / '4k/s'}"))


@pytest.mark.slow
def test_load_experts_names_a_damaged_file(folder: Path, tmp_path: Path) -> None:
    path = next((folder / "data/8k/s/experts").iterdir())
    copy, whole = tmp_path / "damaged", path.read_bytes()
    middle = len(whole) // 2
    for damaged in (whole[:middle], whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :], b""):
        copy.write_bytes(damaged)
        with pytest.raises(Failure, match=r"experts in .*damaged cannot be read .* leave out continue_from"):
            load_experts(copy, made_job("data", *SETTINGS, "budget=8k"))
    with pytest.raises(Failure, match=r"cannot be read \(level 999 is missing\)"):
        load_experts(path, made_job("data", *SETTINGS, "budget=8k"), [999])
    with pytest.raises(Failure, match=r"cannot be read \(.* has another shape or type\)"):
        load_experts(path, made_job("data", *SETTINGS, "budget=8k", "expert.width=64"))


@pytest.mark.slow
def test_generate_deletes_experts_of_a_dead_attempt(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "data", tmp_path / "data")
    experts = tmp_path / "data/8k/s/experts"
    named = set(experts.iterdir())
    dead = new_attempt(tmp_path / "data/8k/s", "000000000000-000000000011")
    begin_fragment(dead)
    shutil.copy(min(named), dead.experts)
    assert here(["generate", *SETTINGS, "budget=8k", "keep_experts=true"], tmp_path).returncode == 0
    assert set(experts.iterdir()) == named


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["budget=1M"], "No manifest was given"),
        (["manifest=data/8k/s"], "No budget was given"),
        (["manifest=data/8k/s", "budget=1M", "levels=5"], "levels cannot be changed"),
        (["manifest=data/8k/s", "budget=1M", "distribution=vehicles"], "distribution cannot be changed"),
        (["manifest=data/8k/s", "budget=1M", "distribution.max_size=0.5"], "distribution cannot be changed"),
        (["manifest=data/8k/s", "budget=1M", "continue=perhaps"], "continue is perhaps"),
    ],
)
def test_split_arguments_names_the_mistake(words: list[str], sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        split_arguments(words)


def test_kept_settings_omits_groups_that_a_preset_replaces() -> None:
    made = made_job("data", "procedure=label", "expert.width=64", "distribution=vehicles", "task.max_timesteps=100")
    again = lambda *settings: compose_job([*kept_settings(made.results, settings), *settings])
    same, masters = again(), again("procedure=masters")
    assert (same.procedure, same.distribution, same.task) == (made.procedure, made.distribution, made.task)
    assert masters.procedure == made_job("data", "procedure=masters").procedure
    assert (masters.distribution, masters.task) == (made.distribution, made.task)

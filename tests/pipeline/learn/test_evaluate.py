"""The command that measures policies, on the shared split, level files and sealed levels."""

import json
from pathlib import Path

import numpy as np
import pytest

from levelproof.experts.networks.over_levels import NetworkConfig, PolicyKind, initial_policy
from levelproof.experts.networks.saved import Policy, save_policy
from levelproof.levelgen.level import size_of
from levelproof.pipeline.exchange.level_json import export
from levelproof.pipeline.learn.solve_rates import interval, solve_rates
from levelproof.pipeline.store.manifest import read_manifest
from tests.pipeline.command import assert_refused, here, run


def facts(folder: Path, *words: str) -> dict:
    done = here(["evaluate", *words, "--json"], folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def policy_in(folder: Path, kind: PolicyKind, size: str | None) -> Path:
    import jax

    config = NetworkConfig(kind=kind, width=16, depth=1)
    params = initial_policy(jax.random.key(0), config, size_of(size or "5-1-1-1"))
    save_policy(folder / "policy", Policy(config, params, size and size_of(size), {}))
    return folder / "policy"


@pytest.mark.campaign
def test_command_measures_policy_and_baselines_on_a_split(split: Path, tmp_path: Path) -> None:
    policy = policy_in(tmp_path, PolicyKind.ATTENTION, None)
    words = [str(policy), "--on", str(split), "--attempts", "3", "--levels", "12"]
    measured = facts(tmp_path, *words)
    (group,) = measured["levels"]
    names = ["doing nothing", "random", "sticky random", "policy, sampled", "policy, greedy"]
    assert set(group["of"]) == {"all", "that doing nothing does not solve", "labelled solved"}
    assert all(list(players) == names for players in group["of"].values())
    assert group["of"]["that doing nothing does not solve"]["doing nothing"]["once"]["rate"] == 0
    every = group["of"]["all"]["random"]
    assert every["once"]["rate"] <= every["best"]["rate"]
    table = run(["evaluate", *words], tmp_path)
    assert "policy, greedy" in table.stdout
    assert "..." not in table.stdout
    assert max(map(len, table.stdout.splitlines())) <= 80 + len(str(split))


def test_command_measures_sealed_levels_without_a_policy(tmp_path: Path) -> None:
    (group,) = facts(tmp_path, "--levels", "16", "--attempts", "1")["levels"]
    assert group["levels"] == "sealed s"
    assert group["of"]["all"]["random"]["levels"] == 16
    assert group["of"]["all"]["random"]["worst"] is None


def test_command_names_level_files_that_it_leaves_out(split: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    export(split, int(read_manifest(split).level_ids[0]), folder / "good.json")
    (folder / "damaged.json").write_text("{")
    done = here(["evaluate", "--on", "mine", "--attempts", "1", "--json"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "damaged.json" in done.stderr
    (group,) = json.loads(done.stdout)["levels"]
    assert group["of"]["all"]["random"]["levels"] == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nowhere"], "There is no policy in nowhere"),
        (["--where", "label = 'solved'"], "name one with --on"),
        (["--attempts", "0"], "--attempts is 0"),
        (["--size", "huge"], "set --size to s, m or l"),
        (["--on", "nowhere"], "There are no levels at nowhere"),
    ],
)
def test_command_refuses(tmp_path: Path, words: list[str], sentence: str) -> None:
    assert_refused(here(["evaluate", *words], tmp_path), 2, sentence)


def test_command_refuses_a_policy_of_another_size(tmp_path: Path) -> None:
    policy = policy_in(tmp_path, PolicyKind.FLAT, "m")
    assert_refused(here(["evaluate", str(policy), "--levels", "8"], tmp_path), 2, "plays levels of size m only")


def test_intervals_are_over_levels() -> None:
    once = np.arange(100)[:, None] < 40
    assert np.allclose(interval(once), (0.3094, 0.4980), atol=1e-4)  # Wilson's, from a table
    same = np.repeat(once, 8, axis=1)  # attempts that tell nothing new narrow nothing
    low, high = interval(same)
    assert np.isclose(high - low, 2 * 1.96 * np.sqrt(0.4 * 0.6 / 99))


def test_worst_tenth_is_rated_on_other_attempts_than_chose_it() -> None:
    """Of levels that are all alike, the worst tenth is as good as the rest."""
    solved = np.random.default_rng(0).random((4000, 8)) < 0.5
    assert abs(solve_rates(solved)["worst"]["rate"] - 0.5) < 0.04
    assert solved[np.argsort(solved.mean(1))[:400]].mean() < 0.25

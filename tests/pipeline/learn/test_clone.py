"""Cloning of a policy from a small real split, and continuing after a real kill."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import is_dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import levelproof
from levelproof.configs.clone import CloneConfig
from levelproof.configs.compose import override_of
from levelproof.configs.convert import plain
from levelproof.configs.meanings import comments_in
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.imitation import ImitationConfig
from levelproof.experts.networks.over_levels import NetworkConfig
from levelproof.levelgen.level import ACTIONS
from levelproof.levelgen.task import rules as task
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.learn import clone as module
from levelproof.pipeline.learn.metrics import STEP
from tests.pipeline.command import ROOT, assert_refused, here
from tests.pipeline.made import played_split

SETTINGS = ("interval=20", "train.batch=128", "validation=0.3", "where=", "network.width=16", "network.depth=1")


def cloned(folder: Path, split: Path, *words: str) -> Path:
    out = folder / "policy"
    done = here(["clone", str(split), "-o", str(out), *SETTINGS, *words], folder)
    assert done.returncode == 0, done.stderr
    return out


def metrics(out: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def policy(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cloned(tmp_path_factory.mktemp("cloned"), split, "train.updates=200", "where=label = 'solved'")


def test_loss_falls(policy: Path) -> None:
    curve = metrics(policy)
    assert [numbers[STEP] for numbers in curve] == list(range(20, 201, 20))
    assert curve[-1]["bc/loss"] < 0.6 * curve[0]["bc/loss"]
    assert curve[-1]["bc/accuracy"] > 0.75
    assert {"bc/validation_loss", "bc/validation_accuracy", "bc/samples_per_second"} <= set(curve[-1])


def solve_share(levels: levelproof.Level, choose) -> float:
    """Return the share of levels whose first episode reaches the goal."""

    def act(now, key):
        world, open_, won = now
        world, result = task.advance(levels, world, choose(key, world), task.DEFAULT_RULES)
        return (world, open_ & ~result.done, won | (open_ & result.goal)), None

    start = task.reset(levels), jnp.ones(len(levels), bool), jnp.zeros(len(levels), bool)
    (_, _, won), _ = jax.lax.scan(act, start, jax.random.split(jax.random.key(0), RECORD_STEPS))
    return float(won.mean())


def test_policy_beats_random_play_on_levels_it_was_trained_on(policy: Path, split: Path) -> None:
    data = levelproof.open(split, where="label = 'solved'", validation=0.3)
    trained = module.in_subset(data.manifest["content_hash"].to_pylist(), "train", 0.3)
    levels = jax.tree.map(lambda x: jnp.tile(x, 8), data.levels(np.flatnonzero(trained)))
    loaded = levelproof.load_policy(policy)
    draw = lambda key, _: (jax.random.uniform(key, (ACTIONS, len(levels))) * jnp.array(CHOICES)[:, None]).astype(int)
    random = solve_share(levels, draw)
    assert solve_share(levels, lambda key, world: loaded.sample(key, levels, world)) > random + 0.05


@pytest.mark.slow
def test_run_that_was_killed_continues_bit_for_bit(split: Path, tmp_path: Path) -> None:
    words = ["train.updates=120", "pool=8", "refresh=7"]  # several rounds of levels
    (tmp_path / "whole").mkdir()
    whole = cloned(tmp_path / "whole", split, *words)
    out = tmp_path / "policy"
    command = [sys.executable, "-m", "levelproof", "clone", str(split), "-o", str(out), *SETTINGS, *words]
    killed = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL)
    while killed.poll() is None and len(metrics(out) if (out / "metrics.jsonl").exists() else []) < 2:
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    assert killed.wait() == -signal.SIGKILL, "it had ended before"
    assert cloned(tmp_path, split, *words) == out
    for name in ("policy.safetensors", "checkpoint.safetensors", "config.json"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    losses = [[numbers["bc/loss"] for numbers in metrics(folder)] for folder in (whole, out)]
    assert len(losses[1]) == 6
    assert losses[0][-3:] == losses[1][-3:]


@pytest.mark.slow
def test_splits_of_several_sizes_make_one_policy(split: Path, tmp_path: Path) -> None:
    larger = played_split(tmp_path / "larger", size="m")
    out = cloned(
        tmp_path, split, str(larger), "train.updates=20", "network.kind=invariant", "episodes=all", "log=tensorboard"
    )
    assert list((out / "log").glob("*/events*"))
    assert {f"bc/validation_loss/{path}" for path in (split, larger)} <= set(metrics(out)[-1])
    policy = levelproof.load_policy(out)
    for size in "sm":
        levels = levelproof.sample_levels(np.arange(2), size)
        assert jax.jit(policy.logits)(levels, levels.state).shape == (sum(CHOICES), 2)
    done = here(["clone", str(split), str(larger), "network.kind=flat", "where="], tmp_path)
    assert_refused(done, 2, "levels of one size")


def test_bad_input_is_refused(split: Path, policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_refused(here(["clone", "train.updates=3"], tmp_path), 2, "no split to clone")
    assert_refused(here(["clone", str(split), "train.update=3"], tmp_path), 2, "did you mean train.updates?")
    assert_refused(here(["clone", str(split), "network.width=6"], tmp_path), 2, "multiple of heads")
    assert_refused(here(["clone", str(split), "-o", str(policy)], tmp_path), 2, "other settings or levels")
    assert_refused(here(["clone", str(tmp_path / "none")], tmp_path), 2, "none")
    with pytest.raises(levelproof.PolicyError, match="There is no policy in"):
        levelproof.load_policy(tmp_path)
    first = int(levelproof.open(split).manifest["level_id"][0].as_py())
    monkeypatch.setattr(module, "SEALED", range(first, first + 2))
    with pytest.raises(levelproof.UserError, match="sealed"):
        module.source_of(split, CloneConfig(where=""))


def test_guide_lists_every_setting_with_its_default_and_meaning() -> None:
    guide = (ROOT / "docs/train.md").read_text()
    for path, cls in ("", CloneConfig), ("network.", NetworkConfig), ("train.", ImitationConfig):
        for name, comment in comments_in(cls).items():
            value = getattr(cls(), name)
            if not is_dataclass(value):
                assert f"| `{override_of(path + name, plain(value))}` | {comment.beside} |" in guide

"""The parity campaign of one size: its states and episodes, and their sources."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import oracle
from benchmarks.levels import load_levels
from benchmarks.parity.engines import Reference
from benchmarks.parity.episodes import STEPS, Block, Episodes, play_block, summed
from benchmarks.parity.onestep import OneStep, Pool, distinct, one_step, picked, pool_of
from benchmarks.parity.progress import Board
from benchmarks.parity.scenes import SCENES
from benchmarks.parity.worlds import BLOCK, joined, lanes_of
from benchmarks.reference.actions import sticky_actions
from levelproof.levelgen.batching import blocks
from levelproof.levelgen.level import SIZES, Level, Role, name_of, size_of
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.pipeline.errors import UserError

SAMPLED, HANDMADE = "sampled", "handmade"
ADVERSARIAL_SHARE, HANDMADE_SHARE = 0.4, 0.2  # of the states; the others come from sampled levels
HANDMADE_EPISODES = 0.2  # of the episodes
TIMES = (0, 1, 2, 4, 8, 16, 32, 47)  # env steps at which scenes are compared
SHORT = TIMES[-1] + 1  # env steps of a scene
Tick = Callable[..., None]  # (description of the finished block, number of blocks added)


@dataclass(frozen=True)
class SizeReport:
    size: str
    one_step: OneStep
    episodes: Episodes | None
    handmade: list[str]  # names of the handmade levels that were played


def campaign(
    python: Path,
    size: str,
    states: int,
    episodes: int,
    board: Board,
    level_file: Path | None = None,
    keep: Path | None = None,
) -> SizeReport:
    """Run the campaign of one size. Sizes without a name have no handmade levels and no episodes.

    Args:
        python: the reference's interpreter.
        size: see `levelgen.level.size_of`.
        states: approximate minimum number of states to step from.
        episodes: number of pairs of levels and actions.
        board: shows progress.
        level_file: sampled levels as the reference's arrays; None: sample them.
        keep: folder that keeps the reference's answers, so that only our side runs again.

    Raises:
        UserError: the levels of `level_file` are of another size.
        Failure: the reference's process ends early.
    """
    sampled, named = _sampled(python, size, level_file), size in SIZES
    tick = lambda what, more=0: board.tick(f"size {size}: {what}", more)
    with Reference.of(python, size, keep) as reference:
        board.more(_blocks(states) + (3 * _blocks(episodes) if named else 0))
        names, pools, parts = [], [], []
        if named:
            names, handmade = reference.handmade()
            pools, parts = _episodes(reference, _pairs(sampled, names, handmade, episodes), states, tick)
        pools.append(_scenes(reference, sampled, states, not named, tick))
        result = one_step(distinct(pool_of(pools)), reference.step, tick)
    return SizeReport(size, result, summed(size, parts) if parts else None, names)


def _sampled(python: Path, size: str, level_file: Path | None) -> Level:
    """Load levels that the reference sampled; sample ours if it lacks the size. Either kind serves the comparison."""
    if level_file is None and size not in SIZES:
        return jax.device_get(sample_levels(jnp.arange(oracle.LEVELS), size_of(size)))
    path = level_file or oracle.sampled_levels(python, size)
    with np.load(path) as file:
        count = len(file["gravity"])
    levels = load_levels(str(path), 0, count)
    if levels.size != size_of(size):
        raise UserError(f"The levels of {path} are of size {name_of(levels.size)}: --size is {size}.")
    return levels


def _pairs(sampled: Level, names: list[str], handmade: Level, count: int) -> Pool:
    """Choose levels and actions for episodes; every fifth level is handmade."""
    drawn = max(1, round(count * HANDMADE_EPISODES))
    crafted, random = np.arange(drawn) % len(names), np.arange(count - drawn) % sampled.role.shape[-1]
    origin = [f"{names[k]} (actions {lane})" for lane, k in enumerate(crafted)]
    origin += [f"sampled level {k} (actions {drawn + lane})" for lane, k in enumerate(random)]
    return Pool(
        level=joined([lanes_of(handmade, crafted), lanes_of(sampled, random)]),
        action=sticky_actions(STEPS, count),
        scene=[HANDMADE] * drawn + [SAMPLED] * (count - drawn),
        origin=origin,
    )


def _episodes(reference: Reference, pairs: Pool, states: int, tick: Tick) -> tuple[list[Pool], list[Block]]:
    """Play the pairs; pick states along the reference's rollouts."""
    rng, pools, parts = np.random.default_rng(0), [], []
    shares = {HANDMADE: HANDMADE_SHARE, SAMPLED: 1 - ADVERSARIAL_SHARE - HANDMADE_SHARE}
    for lanes in blocks(len(pairs), BLOCK):
        block = pairs.lanes(lanes)
        count = int(lanes[-1] - lanes[0]) + 1  # the last block is padded
        parts.append(play_block(block, count, reference, tick))
        for scene, share in shares.items():
            chosen = np.flatnonzero([name == scene for name in block.scene[:count]])
            if len(chosen):
                each = min(STEPS, ceil(states * share / pairs.scene.count(scene)))
                times = np.argsort(rng.random((STEPS, len(chosen))), 0)[:each]
                pools.append(picked(block.lanes(chosen), lanes_of(parts[-1].record, chosen), times))
    return pools, parts


def _scenes(reference: Reference, sampled: Level, states: int, with_sampled: bool, tick: Tick) -> Pool:
    """Pick states of adversarial scenes along short rollouts, starts included.

    All bodies are plain: others that touch at the start would end each episode at once.
    """
    rng = np.random.default_rng(1)
    each = ceil(states * ADVERSARIAL_SHARE / len(SCENES) / len(TIMES))
    available = sampled.role.shape[-1]
    chosen = lambda count: lanes_of(
        sampled, rng.permutation(np.resize(np.arange(available), max(available, count)))[:count]
    )
    levels = {name: change(chosen(each), rng) for name, change in SCENES.items()}
    if with_sampled:
        count = ceil(states * (1 - ADVERSARIAL_SHARE) / len(TIMES))
        levels[SAMPLED] = chosen(count)
    scene = [name for name, level in levels.items() for _ in range(level.role.shape[-1])]
    origin = [f"{name} {lane}" for lane, name in enumerate(scene)]
    level = joined([*levels.values()])
    level = replace(level, role=np.full_like(level.role, Role.PLAIN))
    every = Pool(level, sticky_actions(SHORT, len(scene), seed=1), scene, origin)
    pools = []
    for lanes in blocks(len(every), BLOCK):
        block, keep = every.lanes(lanes), np.arange(lanes[-1] - lanes[0] + 1)
        record = reference.play(block.level, block.level.state, block.action, record=True).states
        times = np.repeat(np.array(TIMES)[:, None], len(keep), 1)
        pools.append(picked(block.lanes(keep), lanes_of(record, keep), times))
        tick("scenes", 1)
    return pool_of(pools)


def _blocks(count: int) -> int:
    return len([*blocks(count, BLOCK)])

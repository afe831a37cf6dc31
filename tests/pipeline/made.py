"""Levels, records and unit results filled with random bits: what the files must bring back, whatever it means.

And a real split without training.
"""

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from levelproof.configs.compose import compose_job
from levelproof.configs.schema import JobConfig
from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import WITNESSED, Label, Source, Verdict
from levelproof.experts.pool.run import UnitResult
from levelproof.experts.steps import EnvSteps
from levelproof.experts.verdict.before import decide
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.experts.witness.witness import Record, replay, steps_to_goal, succeeds
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import ACTIONS, SIZES, Level
from levelproof.levelgen.sampling.sampler import sample_levels
from levelproof.physics.pairs import pairs_of
from levelproof.physics.types import MAX_VERTICES, Size
from levelproof.pipeline.jobs.schedule import WorkUnit
from levelproof.pipeline.jobs.unit import commit
from levelproof.pipeline.store.columns import OF_THE_RUN
from levelproof.pipeline.store.contents import highest
from levelproof.pipeline.store.fields import arrays_of, tree_of
from levelproof.pipeline.store.job_note import note_job
from levelproof.pipeline.store.layout import split_path
from levelproof.pipeline.store.manifest import fragment_paths, read_manifest

T = TypeVar("T")
PLAYED = 64  # levels of `played_split`
SPENT = EnvSteps()


def made(kind: type, size: Size, count: int, rng: np.random.Generator, *, time: bool = False) -> Any:
    """An instance of a dataclass of arrays for `count` levels, by the shapes in its annotations.

    Floats have any bits: NaN, infinities, -0.0 and denormals included. Integers are at most 255.
    """
    counts = {"body": size.bodies, "polygon": size.polygons, "circle": size.circles, "joint": size.joints}
    counts |= {"thruster": size.thrusters, "vertex": MAX_VERTICES, "contact": pairs_of(size).contacts}
    counts |= {"lane": count, "level": count, "2": 2, "6": ACTIONS, "256": RECORD_STEPS}
    values = {}
    for name, hint in get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            values[name] = made(hint, size, count, rng, time=kind is Record)
            continue
        shape = tuple(counts[word] for word in hint.dim_str.split())
        shape = (RECORD_STEPS, *shape) if time else shape
        values[name] = _random(str(hint.dtypes), shape, rng)
    return kind(**values)


def _random(dtypes: str, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    if "bool" in dtypes:
        return rng.random(shape) < 0.5
    if "float" in dtypes:
        return rng.integers(0, 2**32, shape, np.uint32).view(np.float32)
    return rng.integers(0, 256, shape, np.int32)


def made_level(size: str = "s", count: int = 3, seed: int = 0) -> Level:
    return _possible(made(Level, SIZES[size], count, np.random.default_rng(seed)), size, "level/")


def made_record(size: str = "s", count: int = 3, seed: int = 0) -> Record:
    return _possible(made(Record, SIZES[size], count, np.random.default_rng(seed)), size, "record/")


def made_fields(size: str = "s", count: int = 3, seed: int = 0) -> dict[str, np.ndarray]:
    """What a shard holds of them."""
    return arrays_of(made_level(size, count, seed), "level/") | arrays_of(made_record(size, count, seed), "record/")


def _possible(tree: T, size: str, path: str) -> T:
    """The same with integers that a size can have."""
    most = highest(SIZES[size])
    arrays = arrays_of(tree, path)
    arrays |= {name: np.minimum(x, most[name]).astype(x.dtype) for name, x in arrays.items() if name in most}
    return tree_of(type(tree), arrays, path)


def made_verdict(label: Label = Label.SOLVED, **changes: Any) -> Verdict:
    solved = label is Label.SOLVED
    verdict = Verdict(
        label=label,
        label_reason="made for a test",
        failed_by_noop=False,
        witness=Source.SAMPLED if solved else None,
        success_rate=1.0 if solved else float("nan"),
        most_probable_succeeds=False,
        sticky_success_rate=0.5 if solved else float("nan"),
        moved_success_rate=0.75 if solved else float("nan"),
        steps_to_goal=17 if solved else None,
        portability=0.875 if solved else None,
        steps_to_first_success=640 if solved else None,
        env_steps=4096,
        learning_curve=[float("nan"), 0.5],
        best_return=1.5 if solved else float("-inf"),
        episodes=40,
    )
    return dataclasses.replace(verdict, **changes)


def made_result(level_ids: list[int], labels: list[Label], size: str = "s") -> UnitResult:
    """Random bits, not a solution: for what writes and reads, not for what replays."""
    count = len(level_ids)
    verdicts = [made_verdict(label) for label in labels]
    return UnitResult(np.array(level_ids), made_level(size, count), made_record(size, count), verdicts, SPENT)


def made_job(out: str = "data", *overrides: str) -> JobConfig:
    return compose_job([f"out={out}", "executor=inline", *overrides])


def played_split(folder: Path, held: int = 16) -> Path:
    """A real split in `folder`: levels of size s under random actions, each held for so many steps; what reaches the
    goal is `solved`."""
    job = made_job(str(folder), "size=s", f"levels={PLAYED}")
    ids = np.arange(PLAYED, dtype=np.int32)
    levels = jax.tree.map(np.asarray, sample_levels(jnp.asarray(ids), SIZES["s"], job.distribution))
    rng = np.random.default_rng(0)
    action = np.repeat(rng.integers(0, 2, (RECORD_STEPS // held, 6, PLAYED)), held, axis=0).astype(np.int32)
    record = replay(levels, action, job.task)
    solved = succeeds(np.asarray(record.done), np.asarray(record.goal))
    assert 1 < solved.sum() < PLAYED
    verdicts = [made_verdict(Label.SOLVED if good else Label.UNSOLVED) for good in solved]
    path = split_path(job.out, job.budget, job.size)
    path.mkdir(parents=True)
    note_job(path, job, ["levelproof", "generate"], [(0, PLAYED - 1)])
    commit(
        job,
        path,
        WorkUnit(tuple(int(i) for i in ids)),
        UnitResult(ids.astype(np.int64), levels, record, verdicts, SPENT),
    )
    return path


def honest_split(folder: Path, unit: int, units: int, *, experts: bool = False) -> Path:
    """A split without training in which everything is true: random actions solve what they solve.

    With `experts` each unit keeps some, of which nothing but their file is real.
    """
    job, ids = made_job(str(folder), "size=s"), np.arange(unit * units)
    levels = jax.tree.map(np.asarray, sample_levels(jnp.asarray(ids), SIZES["s"], job.distribution))
    before, failed = decide(levels, job.task)
    action = np.repeat(np.random.default_rng(0).integers(0, 2, (16, 6, len(ids))), 16, axis=0).astype(np.int32)
    action[..., [verdict is not None for verdict in before]] = 0
    record = replay(levels, action, job.task)
    solved, steps = succeeds(record.done, record.goal), steps_to_goal(record.done)
    verdicts = [
        known or made_verdict(Label.SOLVED if solved[i] else Label.UNSOLVED, failed_by_noop=bool(failed[i]))
        for i, known in enumerate(before)
    ]
    path = split_path(job.out, job.budget, job.size)
    path.mkdir(parents=True)
    note_job(path, job, ["levelproof", "generate"], [(0, len(ids) - 1)])
    for lanes in ids.reshape(units, unit):
        told = [
            dataclasses.replace(verdicts[i], steps_to_goal=int(steps[i]) if verdicts[i].label in WITNESSED else None)
            for i in lanes
        ]
        weights: Any = {"weights": np.arange(4.0)}
        kept = {int(i): KeptExpert(weights, [0.5]) for i in lanes if experts}
        result = UnitResult(lanes, take(levels, lanes), take(record, lanes), told, SPENT, kept)
        commit(job, path, WorkUnit(tuple(lanes.tolist())), result)
    return path


def lasting(split: Path) -> list[dict[str, Any]]:
    """What two runs of a job agree in: every row, without what tells of its run, and whether there is data."""
    rows = read_manifest(split).table.to_pylist()
    return [{k: v for k, v in row.items() if k not in OF_THE_RUN} | {"data": bool(row["shard"])} for row in rows]


def made_split(folder: Path, units: Sequence[Sequence[Label]], *words: str) -> Path:
    """A split of units with these labels, level ids one after another; random bits in every level and record."""
    job = made_job(str(folder), "size=s", *words)
    path, first = split_path(job.out, job.budget, job.size), 0
    path.mkdir(parents=True)
    for labels in units:
        ids = list(range(first, first + len(labels)))
        commit(job, path, WorkUnit(tuple(ids)), made_result(ids, list(labels)))
        first += len(labels)
    note_job(path, job, ["levelproof", "generate"], [(0, first - 1)])
    return path


def commit_copy(source: Path, number: int, split: Path) -> None:
    """Commit to `split` a unit that another one of the same configuration has, by its number there."""
    fragment = fragment_paths(source)[number]
    for folder in ("manifest", "shards"):
        (split / folder).mkdir(parents=True, exist_ok=True)
    for shard in (source / "shards").glob(f"{fragment.stem}-*"):
        shutil.copytree(shard, split / "shards" / shard.name)
    shutil.copy(fragment, split / "manifest")

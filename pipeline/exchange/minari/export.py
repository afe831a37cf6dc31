"""A split as a Minari dataset: `minari.load_dataset` opens it, and what trains on such datasets trains on it.

Spaces and metadata are written by the library; episodes by h5py, as the library lays them out, but compressed: most of
an observation is constant within a level. Memory is that of a few records.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from levelproof.experts.witness.witness import Record
from levelproof.levelgen.level import MOTOR_BINDINGS, Level, size_of
from levelproof.levelgen.task.actions import CHOICES
from levelproof.levelgen.task.observe.flat import LIMIT, feature_count
from levelproof.levelgen.task.rules import TaskParams
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.exchange.minari.episodes import BLOCK, ActionKind, Episode, episodes_of
from levelproof.pipeline.read.levels import rules_of
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.read.select import SOLVED, witnessed
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import new_folder
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.shown import shown
from levelproof.pipeline.version import __version__
from levelproof.pipeline.words import many

if TYPE_CHECKING:
    import h5py
    from gymnasium.spaces import Space

NAMESPACE = "levelproof"
FILE = "main_data.hdf5"  # Minari's name
COMPRESSED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
BLOCKS = 2 * BLOCK  # records in memory at a time
NUMBERS = f"numpy.stack(numpy.unravel_index(action, {CHOICES}), -1)"


def export_minari(split: Path, where: str | None, out: Path, kind: ActionKind = ActionKind.MULTI_DISCRETE) -> None:
    """Write the witnesses of the levels for which a condition holds to a new folder of Minari datasets, and say so.

    Raises:
        UserError: no split, no such level, a condition that DuckDB cannot use, `out` is there already, or the packages
            of the extra `minari` are not installed.
        Failure: the split is damaged.
    """
    rows = witnessed(split, where or SOLVED)
    rules = rules_of(require_manifest(split, [], [rows.column("level_id")[0].as_py()]))
    budget, size = (rows.column(name)[0].as_py() for name in ("budget", "size"))
    name = size if kind == ActionKind.MULTI_DISCRETE else f"{size}-{kind}"
    dataset_id = f"{NAMESPACE}/{budget}/{name}-v0"
    prepare_jax()
    with new_folder(out) as folder:
        data = (folder / dataset_id / "data").absolute()  # Minari loses its way in relative ones
        storage = _new_storage(data, size, kind)
        episodes, steps = _write(data / FILE, _episodes(split, rows, rules, kind))
        storage.update_metadata(
            {
                "dataset_id": dataset_id,
                "minari_version": _minari().__version__,
                "total_episodes": episodes,
                "total_steps": steps,
                "dataset_size": float(storage.get_size()),
                "author": {f"levelproof {__version__}"},
                "algorithm_name": "PPO experts of one level each, random play and search; replayed",
                "description": f"Witnesses of {many(rows.num_rows, 'level')} of size {size}, made with a budget of "
                f"{budget} env steps a level. infos has success, level_id, and which entries of an action do "
                "something. " + (f"Six entries of an action: {NUMBERS}" if kind == ActionKind.COMBINED else ""),
            }
        )
    print(
        f"{out}: {many(episodes, 'episode')} of {many(rows.num_rows, 'level')}, {many(steps, 'step')}.\n"
        f'Next:  MINARI_DATASETS_PATH={out} and, in Python, minari.load_dataset("{dataset_id}")'
    )


def _episodes(split: Path, rows: pa.Table, rules: TaskParams, kind: ActionKind) -> Iterator[Episode]:
    for first in shown(range(0, rows.num_rows, BLOCKS), "records"):
        some = rows.slice(first, BLOCKS)
        fields = read_rows(split, some)
        level, record = tree_of(Level, fields, "level/"), tree_of(Record, fields, "record/")
        yield from episodes_of(some.column("level_id").to_numpy(), level, record, rules, kind)


def _minari() -> Any:
    try:
        import h5py
        import minari
    except ImportError:
        raise UserError('Minari datasets need two more packages: run `pip install "minari[hdf5]"`.') from None
    del h5py
    return minari


def _new_storage(data: Path, size: str, kind: ActionKind) -> Any:
    """Minari's own, with spaces and without episodes."""
    _minari()
    from gymnasium.spaces import Box
    from minari.dataset.minari_storage import MinariStorage

    data.mkdir(parents=True)
    seen = Box(-LIMIT, LIMIT, (feature_count(size_of(size)),), np.float32)
    return MinariStorage.new(data, observation_space=seen, action_space=_actions(kind), data_format="hdf5")


def _actions(kind: ActionKind) -> "Space":
    from gymnasium.spaces import Box, Discrete, MultiDiscrete

    if kind == ActionKind.MULTI_DISCRETE:
        return MultiDiscrete(list(CHOICES))
    if kind == ActionKind.COMBINED:
        return Discrete(int(np.prod(CHOICES)))
    low = np.repeat(np.array([-1, 0], np.float32), [MOTOR_BINDINGS, len(CHOICES) - MOTOR_BINDINGS])
    return Box(low, np.ones(len(CHOICES), np.float32))


def _write(path: Path, episodes: Iterator[Episode]) -> tuple[int, int]:
    """How many episodes and steps."""
    import h5py

    count = steps = 0
    with h5py.File(path, "w", libver="v110", track_order=True) as file:
        for count, episode in enumerate(episodes, 1):
            group = file.create_group(f"episode_{count - 1}")
            group.attrs.update(id=count - 1, total_steps=len(episode.rewards), level_id=episode.level_id)
            for name in ("observations", "actions", "rewards", "terminations", "truncations"):
                _put(group, name, getattr(episode, name))
            _put_infos(group.create_group("infos"), episode)
            steps += len(episode.rewards)
    return count, steps


def _put_infos(group: "h5py.Group", episode: Episode) -> None:
    """An entry for each observation, as Minari's collector has them: the first is that of the reset."""
    seen = len(episode.observations)
    _put(group, "success", np.append(False, episode.success))
    _put(group, "level_id", np.full(seen, episode.level_id, np.int64))
    _put(group, "action_mask", np.broadcast_to(episode.action_mask, (seen, len(episode.action_mask))))


def _put(group: "h5py.Group", name: str, values: np.ndarray) -> None:
    group.create_dataset(name, data=values, chunks=values.shape, **COMPRESSED)

"""Export to a Minari dataset, which `minari.load_dataset` opens.

Minari writes spaces and metadata. h5py writes episodes in Minari's layout, compressed, because most of an observation
is constant within a level. Memory holds a few records at a time.
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
from levelproof.pipeline.read.level_files import rule_settings
from levelproof.pipeline.read.levels import rules_of
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.read.select import SOLVED, select_witnessed
from levelproof.pipeline.runtime import prepare_jax
from levelproof.pipeline.store.created import new_folder
from levelproof.pipeline.store.fields import tree_of
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.store.progress_bar import shown_blocks
from levelproof.pipeline.urls import quoted
from levelproof.pipeline.version import __version__
from levelproof.pipeline.words import many

if TYPE_CHECKING:
    import h5py
    from gymnasium.spaces import Space

NAMESPACE = "levelproof"
FILE = "main_data.hdf5"  # name that Minari expects
COMPRESSION = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
READ_ROWS = 2 * BLOCK  # records in memory at a time
UNRAVEL = f"numpy.stack(numpy.unravel_index(action, {CHOICES}), -1)"


def export_minari(split: Path, where: str | None, out: Path, kind: ActionKind) -> None:
    """Write witnesses that meet the condition (None: solved) to a new folder of Minari datasets; print a summary.

    Raises:
        UserError: the split does not exist, the condition is invalid, no level qualifies, `out` exists, or the packages
            of the extra `minari` are not installed.
        Failure: the split is damaged.
    """
    prepare_jax()
    rows = select_witnessed(split, where or SOLVED)
    rules = rules_of(require_manifest(split, [], [rows.column("level_id")[0].as_py()]))
    own = f"The rules differ from the defaults: {' '.join(other)}. " if (other := rule_settings(rules)) else ""
    budget, size = (rows.column(name)[0].as_py() for name in ("budget", "size"))
    name = size if kind == ActionKind.MULTI_DISCRETE else f"{size}-{kind}"
    dataset_id = f"{NAMESPACE}/{budget.replace('.', '_')}/{name}-v0"  # Minari's names have no dots
    with new_folder(out) as folder:
        data = (folder / dataset_id / "data").absolute()  # Minari mishandles relative paths
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
                "algorithm_name": "PPO experts of one level each, and search; replayed",
                "description": f"Witnesses of {many(rows.num_rows, 'level')} of size {size}, made with a budget of "
                f"{budget} env steps per level. {own}infos has success, level_id, and which entries of an action "
                "do something. " + (f"Six entries of an action: {UNRAVEL}" if kind == ActionKind.COMBINED else ""),
            }
        )
    if own:
        print(own.rstrip())
    print(
        f"{out}: {many(episodes, 'episode')} of {many(rows.num_rows, 'level')}, {many(steps, 'step')}.\n"
        f'Next:  MINARI_DATASETS_PATH={quoted(out)} and, in Python, minari.load_dataset("{dataset_id}")'
    )


def _episodes(split: Path, rows: pa.Table, rules: TaskParams, kind: ActionKind) -> Iterator[Episode]:
    for first in shown_blocks(rows.num_rows, READ_ROWS, "records"):
        block = rows.slice(first, READ_ROWS)
        fields = read_rows(split, block)
        level, record = tree_of(Level, fields, "level/"), tree_of(Record, fields, "record/")
        yield from episodes_of(block.column("level_id").to_numpy(), level, record, rules, kind)


def _minari() -> Any:
    try:
        import h5py
        import minari
    except ImportError:
        raise UserError('Minari datasets need two more packages: run `pip install "minari[hdf5]"`.') from None
    del h5py
    return minari


def _new_storage(data: Path, size: str, kind: ActionKind) -> Any:
    """Create a Minari storage with spaces and without episodes."""
    _minari()
    from gymnasium.spaces import Box
    from minari.dataset.minari_storage import MinariStorage

    data.mkdir(parents=True)
    observations = Box(-LIMIT, LIMIT, (feature_count(size_of(size)),), np.float32)
    return MinariStorage.new(data, observation_space=observations, action_space=_actions(kind), data_format="hdf5")


def _actions(kind: ActionKind) -> "Space":
    from gymnasium.spaces import Box, Discrete, MultiDiscrete

    if kind == ActionKind.MULTI_DISCRETE:
        return MultiDiscrete(list(CHOICES))
    if kind == ActionKind.COMBINED:
        return Discrete(int(np.prod(CHOICES)))
    low = np.repeat(np.array([-1, 0], np.float32), [MOTOR_BINDINGS, len(CHOICES) - MOTOR_BINDINGS])
    return Box(low, np.ones(len(CHOICES), np.float32))


def _write(path: Path, episodes: Iterator[Episode]) -> tuple[int, int]:
    """Write episodes; return the numbers of episodes and steps."""
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
    """Write infos with one entry per observation, as Minari's collector does: the first belongs to the reset."""
    length = len(episode.observations)
    _put(group, "success", np.append(False, episode.success))
    _put(group, "level_id", np.full(length, episode.level_id, np.int64))
    _put(group, "action_mask", np.broadcast_to(episode.action_mask, (length, len(episode.action_mask))))


def _put(group: "h5py.Group", name: str, values: np.ndarray) -> None:
    group.create_dataset(name, data=values, chunks=values.shape, **COMPRESSION)

"""Trained experts on disk, from which a larger budget continues: one numpy archive per unit."""

import socket
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import IO, TypeVar
from zipfile import ZIP_STORED, ZipFile

import jax
import numpy as np
from jaxtyping import Float

from levelproof.configs.schema import JobConfig
from levelproof.experts.config import Rule
from levelproof.experts.labels import BY_EXPERT
from levelproof.experts.training.slots import ExpertState, begin
from levelproof.experts.verdict.judge import KeptExpert
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.batching import stacked
from levelproof.levelgen.identity.keys import level_id_array
from levelproof.levelgen.level import size_of
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.owned import WRITABLE_BY_OTHERS, require_own
from levelproof.pipeline.store.disk import flush, regular
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.layout import EXPERTS, MANIFEST, data_path
from levelproof.pipeline.store.manifest import changes_text, differences, read_manifest, require_manifest
from levelproof.pipeline.store.remote import require_folder

COPY = "make a copy of your own of the split that continue_from names, or leave continue_from out"
RESTART = "leave out continue_from to train them from the start"
T = TypeVar("T")


class SourceUnseen(Failure):
    """A worker does not find the split that `continue_from` names, or the seed files that it grows."""


def save_experts(path: Path, experts: Mapping[int, KeptExpert]) -> None:
    """Write experts, by level id, durably.

    Raises:
        OSError: the write fails.
    """
    rows = [experts[level_id] for level_id in sorted(experts)]
    begun, curves = stacked(row.begun for row in rows), stacked_curves(rows)
    path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
    with open(path, "xb", opener=regular) as file:
        np.savez(
            file, allow_pickle=False, level_id=np.array(sorted(experts)), curve=curves, **arrays_of(begun, "begun/")
        )
    path.chmod(path.stat().st_mode & ~WRITABLE_BY_OTHERS)
    flush(path)


def load_experts(
    path: Path, job: JobConfig, wanted: Iterable[int] = (), without: str = RESTART
) -> dict[int, KeptExpert]:
    """Load all experts of a checkpoint, by level id; `without` ends the message if they cannot be read.

    Raises:
        UserError: other users can write to it.
        Failure: it is damaged or missing, lacks a level of `wanted`, or another version of this program wrote it.
    """
    require_own(path, COPY)
    try:
        if not path.is_file():
            raise ValueError("it is not a file" if path.exists() else "it is missing")
        require_plain(path, path.stat().st_size)
        with np.load(path, allow_pickle=False) as file:  # whole files only: each array has a checksum
            arrays = {name: file[name] for name in file.files}
        level_ids, curves = arrays.pop("level_id"), arrays.pop("curve")
        if (level_ids.dtype, level_ids.ndim, curves.ndim, len(curves)) != (np.int64, 1, 2, len(level_ids)):
            raise ValueError("its level ids or curves are invalid")
        level_id_array(level_ids)  # checks their bounds
        if lacking := set(wanted) - set(level_ids.tolist()):
            raise ValueError(f"level {min(lacking)} is missing")
        begun = unstacked(arrays, "begun/", begun_like(job), len(level_ids))
    except Exception as error:  # numpy and zipfile raise many kinds
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise Failure(f"The experts in {path} cannot be read ({reason}): {without}.") from error
    return {i: kept(expert, curve) for i, expert, curve in zip(level_ids.tolist(), begun, curves, strict=True)}


def stacked_curves(experts: Sequence[KeptExpert]) -> Float[np.ndarray, "expert update"]:
    """Stack the experts' learning curves, padded with NaN."""
    curves = np.full((len(experts), max(len(expert.curve) for expert in experts)), np.nan, np.float32)
    for row, expert in zip(curves, experts, strict=True):
        row[: len(expert.curve)] = expert.curve
    return curves


def kept(begun: ExpertState, curve: Float[np.ndarray, " update"]) -> KeptExpert:
    """Return an expert with its learning curve, without the padding of `stacked_curves`."""
    return KeptExpert(begun, curve[: int(begun.training.course.updates)].tolist())


def unstacked(arrays: Mapping[str, np.ndarray], path: str, like: T, count: int) -> list[T]:
    """Split stacked arrays into `count` trees such as `like`. Raises ValueError or KeyError if they do not fit."""
    leaves = []
    for name, one in arrays_of(like, path).items():
        stacked = arrays[name]
        if stacked.shape != (count, *one.shape) or stacked.dtype != one.dtype:
            raise ValueError(f"{name} has another shape or type")
        leaves.append(stacked)
    return [jax.tree.unflatten(jax.tree.structure(like), [leaf[i] for leaf in leaves]) for i in range(count)]


@lru_cache(maxsize=8)
def begun_like(job: JobConfig) -> ExpertState:
    """Return zeros with the shapes and types of an expert of this job."""
    level = empty_level(size_of(job.size), 1)
    like = jax.eval_shape(lambda level: begin(level, np.zeros(1, np.int32), no_success(1), job.expert), level)
    return jax.tree.map(lambda x: np.zeros(x.shape[1:], x.dtype), like)


def require_plain(file: Path | IO[bytes], size: int) -> None:
    """Raise ValueError if an archive is compressed or declares more than `size` bytes, as experts never do."""
    with ZipFile(file) as archive:
        parts = archive.infolist()
    if any(part.compress_type != ZIP_STORED for part in parts) or sum(part.file_size for part in parts) > size:
        raise ValueError("it is compressed, which experts never are")


def experts_for(job: JobConfig, level_ids: Sequence[int]) -> dict[int, KeptExpert]:
    """Load the experts of the split `job.continue_from` that can continue on these levels; other levels get new ones.

    An expert that solved its level starts over, because it would end the same with any larger budget. It continues if
    experts use their whole budget, or if only the last evaluation solved the level. Whether the expert solved it
    follows from the witness or, if the witness is from a search around the expert's own, from the expert's course.

    Raises:
        SourceUnseen: this process does not find that split.
        Failure: a checkpoint is damaged.
    """
    if not job.continue_from:
        return {}
    source = Path(job.continue_from).expanduser()
    rows = _kept_in(source, level_ids)
    paths: dict[str, set[int]] = {}
    for level_id in level_ids:
        witness, path = rows.get(level_id, ("", None))
        if path and (witness not in BY_EXPERT or job.stop.rule == Rule.BUDGET):
            paths.setdefault(path, set()).add(level_id)
    unsolved: dict[int, KeptExpert] = {}
    for path, ids in paths.items():
        experts = load_experts(data_path(source, path), job, ids)
        unsolved |= {i: experts[i] for i in ids if not experts[i].begun.training.course.solved}
    return unsolved


def _kept_in(source: Path, level_ids: Sequence[int]) -> dict[int, tuple[str | None, str | None]]:
    """Return witness and checkpoint by level id; opens only these levels' fragments, as a worker calls it per unit."""
    if not (source / MANIFEST).is_dir():
        raise SourceUnseen(
            f"The worker on {socket.gethostname()} finds no split at {source}, from which to continue: "
            "use a folder that all machines of the cluster share, or leave out continue_from."
        )
    table = read_manifest(source, ["witness", "experts"], level_ids).table
    columns = (table.column(name).to_pylist() for name in ("level_id", "witness", "experts"))
    return {level_id: (witness, path) for level_id, witness, path in zip(*columns, strict=True)}


def require_same_experts(job: JobConfig) -> None:
    """Check that experts of `job.continue_from` can continue in this job.

    Raises:
        UserError: the split kept no experts, has other settings or no smaller budget, or others can write to them.
        Failure: the split is damaged.
    """
    if not job.continue_from:
        return
    path = Path(job.continue_from).expanduser()
    require_folder(path, "continue its experts")
    source = require_manifest(path, ["experts"])
    require_own(source.split / EXPERTS, COPY)
    if source.table.column("experts").null_count == source.table.num_rows:
        raise UserError(
            f"{source.split} kept no experts: make it in another folder with out=NAME keep_experts=true, or train "
            "from the start."
        )
    config = source.config or {}
    changes = differences(config, job.results)
    changes.pop("budget", None)
    if changes:
        raise UserError(
            f"Experts of {source.split} cannot continue with different settings ({changes_text(changes)}): "
            "use the same ones, or leave out continue_from."
        )
    if config["budget"] >= job.env_steps:
        raise UserError(
            f"Experts of {source.split} had {config['budget']:,} env steps: give a larger budget than that, "
            f"not {job.budget}."
        )

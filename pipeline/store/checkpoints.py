"""Experts on the disk, so that a larger budget goes on instead of starting again: one numpy archive per unit."""

import socket
from collections.abc import Mapping, Sequence
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
from levelproof.experts.training.slots import Begun, begin
from levelproof.experts.verdict.judge import Kept
from levelproof.experts.witness.success import no_success
from levelproof.levelgen.identity.keys import level_id_array
from levelproof.levelgen.level import size_of
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.owned import OTHERS, require_own
from levelproof.pipeline.store.disk import flush, regular
from levelproof.pipeline.store.fields import arrays_of
from levelproof.pipeline.store.layout import EXPERTS, MANIFEST, data_path
from levelproof.pipeline.store.manifest import differences, read_manifest, require_manifest, told
from levelproof.pipeline.store.remote import require_folder

COPY = "make a copy of your own of the split that continue_from names, or leave continue_from out"
T = TypeVar("T")


class SourceUnseen(Failure):
    """A worker does not find the split whose experts should go on."""


def save_experts(path: Path, experts: Mapping[int, Kept]) -> None:
    """Write these experts, by level id, durably.

    Raises:
        OSError: the disk refuses.
    """
    rows = [experts[level_id] for level_id in sorted(experts)]
    begun, curves = jax.tree.map(lambda *xs: np.stack(xs), *(row.begun for row in rows)), stacked_curves(rows)
    path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
    with open(path, "xb", opener=regular) as file:
        np.savez(
            file, allow_pickle=False, level_id=np.array(sorted(experts)), curve=curves, **arrays_of(begun, "begun/")
        )
    path.chmod(path.stat().st_mode & ~OTHERS)
    flush(path)


def load_experts(path: Path, job: JobConfig) -> dict[int, Kept]:
    """All experts of a checkpoint, by level id.

    Raises:
        UserError: other users can write to it.
        Failure: it is damaged or gone, or of another version of this program.
    """
    require_own(path, COPY)
    try:
        if not path.is_file():
            raise ValueError("it is no file" if path.exists() else "it is not there")
        require_plain(path, path.stat().st_size)
        with np.load(path, allow_pickle=False) as file:  # whole files only: each array has a checksum
            arrays = {name: file[name] for name in file.files}
        level_ids, curves = arrays.pop("level_id"), arrays.pop("curve")
        if (level_ids.dtype, level_ids.ndim, curves.ndim, len(curves)) != (np.int64, 1, 2, len(level_ids)):
            raise ValueError("its level ids or curves are none")
        level_id_array(level_ids)  # within their bounds
        begun = unstacked(arrays, "begun/", begun_like(job), len(level_ids))
    except Exception as error:  # numpy and zipfile raise many kinds
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise Failure(
            f"The experts in {path} cannot be read ({reason}): leave out continue_from to train them from the start."
        ) from error
    return {i: kept(of, curve) for i, of, curve in zip(level_ids.tolist(), begun, curves, strict=True)}


def stacked_curves(experts: Sequence[Kept]) -> Float[np.ndarray, "expert update"]:
    """Their learning curves, NaN after each one's end."""
    curves = np.full((len(experts), max(len(of.curve) for of in experts)), np.nan, np.float32)
    for row, of in zip(curves, experts, strict=True):
        row[: len(of.curve)] = of.curve
    return curves


def kept(begun: Begun, curve: Float[np.ndarray, " update"]) -> Kept:
    """An expert with its own part of a row of `stacked_curves`."""
    return Kept(begun, curve[: int(begun.training.course.updates)].tolist())


def unstacked(arrays: Mapping[str, np.ndarray], path: str, like: T, count: int) -> list[T]:
    """So many trees such as `like`, out of their stacked arrays. Raises ValueError or KeyError if they are none."""
    leaves = []
    for name, one in arrays_of(like, path).items():
        known = arrays[name]
        if known.shape != (count, *one.shape) or not np.can_cast(known.dtype, one.dtype):  # a cause was a bit once
            raise ValueError(f"{name} has another shape or type")
        leaves.append(known.astype(one.dtype, copy=False))
    return [jax.tree.unflatten(jax.tree.structure(like), [leaf[i] for leaf in leaves]) for i in range(count)]


@lru_cache(maxsize=8)
def begun_like(job: JobConfig) -> Begun:
    """An expert of this job, in shapes and types."""
    level = empty_level(size_of(job.size), 1)
    like = jax.eval_shape(lambda level: begin(level, np.zeros(1, np.int32), no_success(1), job.expert), level)
    return jax.tree.map(lambda x: np.zeros(x.shape[1:], x.dtype), like)


def require_plain(file: Path | IO[bytes], size: int) -> None:
    """Raises ValueError where an archive of so many bytes is none of ours: they are not packed, no larger than that."""
    with ZipFile(file) as archive:
        parts = archive.infolist()
    if any(part.compress_type != ZIP_STORED for part in parts) or sum(part.file_size for part in parts) > size:
        raise ValueError("it is packed, and experts are not")


def experts_for(job: JobConfig, level_ids: Sequence[int]) -> dict[int, Kept]:
    """Experts of the split `job.continue_from` that can go on with these levels; others begin.

    A level that its expert solved ends the same with any larger budget, unless experts get their whole budget, or the
    last evaluation alone solved it: those begin again. The witness says that, or the expert's course where the witness
    is a search's around its own.

    Raises:
        SourceUnseen: that split is not there for this process.
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
    found: dict[int, Kept] = {}
    for path, ids in paths.items():
        experts = load_experts(data_path(source, path), job)
        found |= {i: experts[i] for i in ids if not experts[i].begun.training.course.solved}
    return found


def _kept_in(source: Path, level_ids: Sequence[int]) -> dict[int, tuple[str | None, str | None]]:
    """Witness and checkpoint of these levels: a worker asks for every unit, and reads the fragments of its levels."""
    if not (source / MANIFEST).is_dir():
        raise SourceUnseen(
            f"The worker on {socket.gethostname()} finds no split at {source}, whose experts should go on: "
            "use a folder that all machines of the cluster share, or leave out continue_from."
        )
    table = read_manifest(source, ["witness", "experts"], level_ids).table
    columns = (table.column(name).to_pylist() for name in ("level_id", "witness", "experts"))
    return {level_id: (witness, path) for level_id, witness, path in zip(*columns, strict=True)}


def require_same_experts(job: JobConfig) -> None:
    """Refuse to take experts from a split whose experts cannot go on with this job.

    Raises:
        UserError: it kept no experts, was made with other settings or a larger budget, or others can write to them.
        Failure: it is damaged.
    """
    if not job.continue_from:
        return
    path = Path(job.continue_from).expanduser()
    require_folder(path, "go on with its experts")
    source = require_manifest(path, ["experts"])
    require_own(source.split / EXPERTS, COPY)
    if source.table.column("experts").null_count == source.table.num_rows:
        raise UserError(
            f"{source.split} has kept no experts: make it in another folder, with out=NAME keep_experts=true, or train "
            "from the start."
        )
    config = source.config or {}
    changes = differences(config, job.results)
    changes.pop("budget", None)
    if changes:
        raise UserError(
            f"Experts of {source.split} cannot go on under other settings ({told(changes)}): "
            "use the same ones, or leave out continue_from."
        )
    if config["budget"] >= job.env_steps:
        raise UserError(
            f"Experts of {source.split} have had {config['budget']:,} env steps: give a larger budget than that, "
            f"not {job.budget}."
        )

"""The reference's level files: JSON, read into a level and its rules, and written from them.

The format is that of `kinetix.util.saving` 3.0.2: `env_state` has a list of objects for each of polygons, circles,
joints and thrusters; `env_params` and `static_env_params` have rules, constants and the size. Files are untrusted: the
length is checked before reading, every value has a type and bounds, and an error says where it is.

Like the reference, the reader recomputes which bodies may collide. A level starts without contacts, so a file's
contacts are not read; the reference, too, drops them when it evaluates on a level.
"""

import json
import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from levelproof.levelgen.files import entries as layout
from levelproof.levelgen.files.entries import Entry, LevelFileError, abbreviate, entries_of, item
from levelproof.levelgen.files.kinetix import MANIFOLDS, Fields, level_from_kinetix, state_to_kinetix
from levelproof.levelgen.frames import in_world
from levelproof.levelgen.level import MOTOR_BINDINGS, THRUSTER_BINDINGS, Level
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.sampling.shuffle import collision_matrix
from levelproof.levelgen.task.rules import NO_DISTANCE, TaskParams
from levelproof.physics.types import FIXED_POLYGONS, Params, Size

MAX_BYTES = 4_000_000  # of a file; the reference's own have at most 52,438
PATHS = {  # names in levelgen.files.kinetix of entries that a file keeps with a body, joint or thruster
    "role": "{}_shape_roles",
    "density": "{}_densities",
    "motor_binding": "motor_bindings",
    "thruster_binding": "thruster_bindings",
}


@dataclass(frozen=True)
class LevelFile:
    """The content of a level file: one level and the rules it is played by."""

    level: Level  # one lane, numpy arrays
    rules: TaskParams


def read_level_file(path: str | os.PathLike[str]) -> LevelFile:
    """Read a level file written by Kinetix, its editor or `write_level_file`.

    Raises:
        LevelFileError: the file cannot be read, or its level cannot be used.
    """
    path = Path(path)
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe or a device may never end
            raise LevelFileError("it is not a regular file")
        if status.st_size > MAX_BYTES:
            raise LevelFileError(f"it has {status.st_size:,} bytes, but no level needs more than {MAX_BYTES:,}")
        with path.open("rb") as file:
            return parse(file.read(MAX_BYTES))
    except OSError as error:
        raise LevelFileError(f"Cannot read the level file {path} ({error.strerror or error}).") from None
    except LevelFileError as error:
        raise LevelFileError(f"Cannot use the level file {path}: {error}.") from None


def write_level_file(file: LevelFile, path: str | os.PathLike[str]) -> None:
    """Write a level as JSON that Kinetix and its editor open; the file appears whole or not at all.

    Files do not hold the rule `faithful_padding`: readers get the default, which is the reference's physics.

    Raises:
        LevelFileError: a file cannot hold the level: it does not have exactly one lane, starts with contacts, has
            motors that run by themselves, or a value that `read_level_file` refuses.
        OSError: the file cannot be written.
    """
    text = json.dumps(to_document(file)) + "\n"
    path = Path(path)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_text(text)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def parse(text: bytes) -> LevelFile:
    """Parse a file's bytes.

    Raises:
        LevelFileError: they hold no usable level.
    """
    try:
        document = json.loads(text.decode())
    except UnicodeDecodeError:
        raise LevelFileError("it is not UTF-8 text") from None
    except RecursionError:
        raise LevelFileError("it is nested too deeply") from None
    except ValueError as error:
        raise LevelFileError(f"it is not JSON ({error})") from None
    return from_document(document)


def from_document(document: object) -> LevelFile:
    """Build a level file from its parsed JSON.

    Raises:
        LevelFileError: it holds no usable level.
    """
    world, params, static = (item(document, name, "") for name in ("env_state", "env_params", "static_env_params"))
    for name, needed in layout.STATIC_CONSTANTS.items():
        value = item(static, name, "static_env_params")
        if value != needed:
            raise LevelFileError(
                f"static_env_params.{name} is {abbreviate(value)}, but this engine supports only {abbreviate(needed)}"
            )
    size = Size(*(entry.read(static, name, "static_env_params") for name, entry in layout.COUNTS.items()))
    if size.bodies == FIXED_POLYGONS:
        raise LevelFileError("static_env_params has no room for a body besides the scenery")
    level = with_known_bindings(level_from_kinetix(_fields(world, size)))
    _check(level)
    collides: Any = np.asarray(collision_matrix(level.model))
    physics = {ours: layout.RULES[ours].read(params, theirs, "env_params") for ours, theirs in layout.PHYSICS.items()}
    task = {name: entry.read(params, name, "env_params") for name, entry in layout.TASK.items()}
    frame_skip = layout.STEPS.read(static, "frame_skip", "static_env_params")
    rules = TaskParams(frame_skip=frame_skip, physics=Params(**physics), **task)
    return LevelFile(replace(level, model=replace(level.model, collides=collides)), rules)


def to_document(file: LevelFile) -> dict[str, Any]:
    """Convert a level file to JSON objects that `from_document` and the reference read.

    Raises:
        LevelFileError: a file cannot hold the level.
    """
    level, rules, size = file.level, file.rules, file.level.size
    if (levels := level.state.rotation.shape[-1]) != 1:
        raise LevelFileError(f"these are {levels} levels, but a file holds one")
    if np.any(np.asarray(level.state.contact_active)):
        raise LevelFileError("the level starts with contacts, which a file cannot hold")
    if np.any(np.asarray(level.motor_auto) & np.asarray(level.model.joint_active)):
        raise LevelFileError("the level has a motor that runs by itself, which a file cannot express")
    if np.any(np.asarray(level.model.collides) != np.asarray(collision_matrix(level.model))):
        raise LevelFileError("its bodies collide otherwise than its joints imply, which a file cannot express")
    fields, counts = _with_points(level), dict(zip(layout.COUNTS, size, strict=True))
    physics = {theirs: getattr(rules.physics, ours) for ours, theirs in layout.PHYSICS.items()}
    document = {
        "env_state": {
            **{kind: _objects(fields, kind, entries) for kind, entries in entries_of(size).items()},
            "collision_matrix": _nested(fields["collision_matrix"][0]),
            **{kind: [layout.NO_CONTACT] * fields[f"{kind}/active"].size for kind in MANIFOLDS},
            "gravity": _nested(fields["gravity"][0]),
        },
        "env_params": {**physics, **{name: getattr(rules, name) for name in layout.TASK}, **layout.EXTRA},
        "static_env_params": {
            **counts,
            **layout.STATIC_CONSTANTS,
            "frame_skip": rules.frame_skip,
            **layout.STATIC_EXTRA,
        },
    }
    from_document(document)  # write nothing that cannot be read back
    return document


def _fields(world: object, size: Size) -> Fields:
    """Convert a world's objects to the reference's arrays; without contacts and collision matrix."""
    fields = _with_points(empty_level(size, 1))
    for (kind, entries), count in zip(entries_of(size).items(), size, strict=True):
        objects = item(world, kind, "env_state")
        if not isinstance(objects, list) or len(objects) != count:
            value = f"a list of {len(objects)}" if isinstance(objects, list) else abbreviate(objects)
            raise LevelFileError(f"env_state.{kind} is {value}, but static_env_params.num_{kind}s is {count}")
        for name, entry in entries.items():
            values = [entry.read(one, name, f"env_state.{kind}[{i}]") for i, one in enumerate(objects)]
            dtype = {float: np.float32, int: np.int32, bool: np.bool_}[entry.kind]
            fields[_path(kind, name)] = np.array(values, dtype).reshape(1, count, *entry.shape)
    return fields | {"gravity": np.array([layout.GRAVITY.read(world, "gravity", "env_state")], np.float32)}


def with_known_bindings(level: Level) -> Level:
    """Set bindings that no action has to 0 where nothing obeys them: some handmade levels' inactive thrusters."""
    known = lambda binding, active, count: np.where(active | (binding < count), binding, 0)
    return replace(
        level,
        motor_binding=known(level.motor_binding, level.model.joint_active, MOTOR_BINDINGS),
        thruster_binding=known(level.thruster_binding, level.model.thruster_active, THRUSTER_BINDINGS),
    )


def flaws(level: Level) -> Iterator[tuple[Any, str, str]]:
    """Yield (flags [row, lane], kind, reason) of flaws: what the engine cannot simulate, but no single entry shows."""
    model, state, scenery = level.model, level.state, slice(FIXED_POLYGONS)
    moves = (model.inverse_mass != 0) | (model.inverse_inertia != 0) | (state.angular_velocity != 0)
    moves |= np.any(np.asarray(state.velocity), 1)
    yield moves[scenery], "polygon", "is scenery and may move: its inverse masses and velocities must be 0"
    flat = model.active[: level.size.polygons] & (model.n_vertices < 3)
    yield flat, "polygon", "is active and has fewer than 3 vertices"
    yield model.joint_active & (model.joint_a == model.joint_b), "joint", "joins a body to itself"
    motors = model.joint_active & (level.motor_binding >= MOTOR_BINDINGS)
    yield motors, "joint", f"has a motor_binding beyond {MOTOR_BINDINGS - 1}"
    thrusters = model.thruster_active & (level.thruster_binding >= THRUSTER_BINDINGS)
    yield thrusters, "thruster", f"has a thruster_binding beyond {THRUSTER_BINDINGS - 1}"


def _check(level: Level) -> None:
    """Raise LevelFileError if the one lane has a flaw."""
    for flags, kind, reason in flaws(level):
        if len(rows := np.flatnonzero(flags)):
            raise LevelFileError(f"env_state.{kind}[{rows[0]}] {reason}")


def _objects(fields: Fields, kind: str, entries: Mapping[str, Entry]) -> list[dict[str, Any]]:
    """Return all polygons, circles, joints or thrusters as JSON objects."""
    columns = {name: fields[_path(kind, name)][0] for name in entries}
    extra = {"highlighted": False} if kind in ("polygon", "circle") else {}  # read by the reference's editor
    count = len(columns["active"])
    return [{name: _nested(column[i]) for name, column in columns.items()} | extra for i in range(count)]


def _path(kind: str, name: str) -> str:
    return PATHS.get(name, f"{{}}/{name}").format(kind)


def _nested(values: Any) -> Any:
    """Convert an array to nested objects with the keys "0", "1", ..., as in a file."""
    values = np.asarray(values)
    return {str(i): _nested(row) for i, row in enumerate(values)} if values.ndim else values.item()


def _with_points(level: Level) -> Fields:
    """Convert to the reference's arrays, with the positions of joints and thrusters that its first picture shows."""
    model, state = jax.tree.map(lambda x: np.asarray(x)[..., 0], (level.model, level.state))
    return state_to_kinetix(level, level.state, np.zeros(1), np.full(1, NO_DISTANCE)) | {
        "joint/global_position": in_world(state, model.joint_a, model.joint_anchor_a)[None],
        "thruster/global_position": in_world(state, model.thruster_body, model.thruster_position)[None],
    }

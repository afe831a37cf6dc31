"""Formats beside the manifest's columns: a fragment's metadata, a shard's encoding of records and its field table.

Readers refuse a shard of another version instead of guessing.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, get_args

import numpy as np

from levelproof.configs.convert import plain, typed
from levelproof.configs.errors import ConfigError
from levelproof.configs.schema import KEY_EVERY, KEYS_EVERY, MAX_FRAME_SKIP, Density
from levelproof.levelgen.identity.keys import SAMPLER_VERSION
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from levelproof.physics.step import ENGINE_VERSION

SHARD_VERSION = 2

# Keys of a fragment's metadata
VERSION_KEY = b"levelproof.manifest_version"
HASH_KEY = b"levelproof.config_hash"
CONFIG_KEY = b"levelproof.config"  # the settings that decide results, as JSON
DENSITIES_KEY = b"levelproof.densities"  # requested for its shards, as JSON; see `configs.schema.stored_as`
DIGESTS_KEY = b"levelproof.sha256"  # of the files of each shard and checkpoint that its rows name, as JSON
SEALED_KEY = b"levelproof.sealed"  # present if several units' fragments were merged into this one

# Packed arrays of a shard, with the bits of a component. What changes along time: (level, component, 256).
PACKED = {"dyn32": 32, "dyn8": 8, "act": 8, "lvl32": 32, "lvl8": 8, "witness": 8}
ALONG_TIME = ("dyn32", "dyn8", "act")
FLAT = "witness"  # all fields as bytes, one after another: one small chunk per level for densities that keep little
WIDE = "record/timestep"  # integers that do not fit 8 bits; others count, index or enumerate entities of one level


class ContentsError(ValueError):
    """A shard's contents are invalid; the message is the end of a sentence."""


@dataclass(frozen=True)
class Encoding:
    """How a shard stores records."""

    density: Density = "full"
    key_every: int = KEY_EVERY  # env steps of an episode between key frames; `witness` only
    rules: TaskParams = DEFAULT_RULES  # the task's rules, to recompute fields that are not stored
    sampler_version: int = SAMPLER_VERSION  # of the sampler that made the levels
    engine_version: int = ENGINE_VERSION  # of the engine that made the records

    def as_json(self) -> dict[str, Any]:
        keys = {"key_every": self.key_every} if self.density == "witness" else {}
        made_with = {"sampler_version": self.sampler_version, "engine_version": self.engine_version}
        return {"density": self.density, **keys, "task": plain(self.rules), **made_with}

    @staticmethod
    def of(attributes: Mapping[str, Any]) -> "Encoding":
        """Parse a shard's attributes.

        Raises:
            ContentsError: this program never writes such attributes.
        """
        try:
            density, key_every = attributes["density"], attributes.get("key_every", KEY_EVERY)
            made_with = [attributes[name] for name in ("sampler_version", "engine_version")]
            encoding = Encoding(density, key_every, typed(TaskParams, attributes["task"]), *made_with)
        except (KeyError, TypeError, ConfigError) as error:
            raise ContentsError("its attributes do not say how records are stored") from error
        if any(type(version) is not int for version in made_with):
            raise ContentsError("its attributes do not say which versions made it")
        if density not in get_args(Density) or type(key_every) is not int or key_every not in KEYS_EVERY:
            raise ContentsError("its attributes do not say how records are stored")
        if density != "full" and encoding.rules.frame_skip > MAX_FRAME_SKIP:
            raise ContentsError(f"its env steps have more than {MAX_FRAME_SKIP} physics steps")
        return encoding


@dataclass(frozen=True)
class FieldSpec:
    """Where one field lies in the packed arrays."""

    name: str  # record/... and key/... change along time, level/... does not
    dtype: str  # of the original
    shape: tuple[int, ...]  # per level and step
    steps: int  # rows along time; 1 for what is constant
    array: str  # one of PACKED
    first: int  # component at which it starts; of FLAT, byte

    @property
    def count(self) -> int:
        return math.prod(self.shape)

    @property
    def bits(self) -> int:
        return bits_for(self.name, np.dtype(self.dtype))

    @property
    def constant(self) -> bool:
        return self.name.startswith("level/")

    @property
    def extent(self) -> int:
        """Components of its array; of FLAT, bytes."""
        return self.count * self.steps * self.bits // 8 if self.array == FLAT else self.count

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"shape": list(self.shape)}


def bits_for(name: str, dtype: np.dtype) -> int:
    """Return the bits with which each number of a field is stored."""
    bits = 8 if dtype.kind in "bi" and name != WIDE else 32
    if bits == 32 and dtype.itemsize != 4:
        raise TypeError(f"{name} is {dtype}: fields must be 32-bit or bool")
    return bits


def array_for(name: str, bits: int, density: Density) -> str:
    """Return the packed array that holds a field."""
    if density == "witness":
        return FLAT
    if name == "record/action":
        return "act"
    return f"{'lvl' if name.startswith('level/') else 'dyn'}{bits}"


def field_table(arrays: Mapping[str, np.ndarray], density: Density = "full") -> list[FieldSpec]:
    """Lay out all fields, in the order of `arrays` (level axis last; time first except in `level/` fields).

    In FLAT, wide numbers come first, which aligns them.
    """
    used, table = dict.fromkeys(PACKED, 0), []
    bits = {name: bits_for(name, values.dtype) for name, values in arrays.items()}
    for name in sorted(arrays, key=lambda name: -bits[name]) if density == "witness" else arrays:
        steps, *shape = (1, *arrays[name].shape) if name.startswith("level/") else arrays[name].shape
        target = array_for(name, bits[name], density)
        field = FieldSpec(name, str(arrays[name].dtype), tuple(shape[:-1]), steps, target, used[target])
        used[target] += field.extent
        table.append(field)
    return table

"""What is written: the manifest's columns, and how a shard stores records and where its fields lie, with versions.

A fragment or shard of another version is refused with a sentence, never guessed at.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, get_args

import numpy as np
import pyarrow as pa

from configs.convert import plain, typed
from configs.errors import ConfigError
from configs.schema import KEY_EVERY, KEYS_EVERY, MOST_FRAME_SKIP, Density
from experts.steps import Seconds
from levelgen.task.rules import DEFAULT_RULES, TaskParams

MANIFEST_VERSION = 7
SHARD_VERSION = 2

# Keys of a fragment's metadata
VERSION_KEY = b"levelproof.manifest_version"
HASH_KEY = b"levelproof.config_hash"
CONFIG_KEY = b"levelproof.config"  # the settings that decide results, as JSON
DENSITIES_KEY = b"levelproof.densities"  # how its shards were to be stored, as JSON; see `configs.schema.stored_as`
DIGESTS_KEY = b"levelproof.sha256"  # of the files of each shard and checkpoint that its rows name, as JSON
SEALED_KEY = b"levelproof.sealed"  # there: fragments of several units were merged into this one

COLUMNS = pa.schema(
    [
        pa.field("level_id", pa.int64(), nullable=False),
        pa.field("content_hash", pa.string(), nullable=False),  # levelgen.identity.content
        pa.field("signature", pa.list_(pa.string()), nullable=False),  # levelgen.identity.signature
        pa.field("file", pa.string()),  # absolute path of the level file; null: its id makes the level
        pa.field("size", pa.string(), nullable=False),
        pa.field("budget", pa.string(), nullable=False),  # as typed
        pa.field("label", pa.string(), nullable=False),  # solved, unsolved, unsolvable, trivial
        pa.field("label_reason", pa.string(), nullable=False),
        pa.field("failed_by_noop", pa.bool_(), nullable=False),  # doing nothing lets green touch red
        pa.field("witness", pa.string()),  # experts.labels.Source; null: there is none
        # of the last evaluation, first episodes; null: there were no such attempts (SQL has NaN above every number)
        pa.field("success_rate", pa.float32()),  # of sampled attempts
        pa.field("most_probable_succeeds", pa.bool_(), nullable=False),
        pa.field("sticky_success_rate", pa.float32()),
        pa.field("moved_success_rate", pa.float32()),
        pa.field("steps_to_goal", pa.int32()),  # env steps of the witness's first episode; null: none
        pa.field("portability", pa.float32()),  # share of the witness's replays that reach the goal; null: none
        pa.field("steps_to_first_success", pa.int64()),  # env steps of training; null: never
        pa.field("env_steps", pa.int64(), nullable=False),  # of training: used of the budget
        pa.field("evaluation_steps", pa.int64(), nullable=False),  # env steps, as the next two
        pa.field("scout_steps", pa.int64(), nullable=False),
        pa.field("search_steps", pa.int64(), nullable=False),
        pa.field("cells", pa.int32()),  # that the search reached; null: there was none
        pa.field("still_grew", pa.bool_()),  # its archive, at its end
        pa.field(
            "learning_curve", pa.list_(pa.float32()), nullable=False
        ),  # success rate per update, null: no episode ended
        pa.field("best_return", pa.float32()),  # null: no episode of training ended
        pa.field("episodes", pa.int64(), nullable=False),
        pa.field("shard", pa.string()),  # path below the split; null: no witness
        pa.field("row", pa.int32()),  # of the shard
        pa.field("experts", pa.string()),  # path below the split of the checkpoint with its expert; null: none is kept
        pa.field("config_hash", pa.string(), nullable=False),
        pa.field(
            "versions",
            pa.struct(
                [
                    pa.field("levelproof", pa.string(), nullable=False),
                    pa.field("python", pa.string(), nullable=False),
                    pa.field("jax", pa.string(), nullable=False),
                    pa.field("jaxlib", pa.string(), nullable=False),
                    pa.field("sampler", pa.int32(), nullable=False),
                ]
            ),
            nullable=False,
        ),
        pa.field("device", pa.string(), nullable=False),
        pa.field("command", pa.string(), nullable=False),  # makes this row again
        pa.field("seconds", pa.struct([pa.field(stage, pa.float32()) for stage in Seconds._fields])),
        # what the level cost the run that made it (`experts.ledger`); null: nobody has counted
    ]
)

VERSIONS = {str(MANIFEST_VERSION): COLUMNS.names, "6": COLUMNS.names[:-1]}  # that are read: there were no seconds in 6

# Columns that tell of the run that made a row, and not of its level: in all others two runs of a job agree, bit for bit
OF_THE_RUN = ("shard", "row", "experts", "seconds")

# Columns of strings that are the same in many rows
REPETITIVE = ("size", "budget", "label", "label_reason", "witness", "shard", "experts", "config_hash", "device")


def schema_of(names: Sequence[str], compact: bool = False) -> pa.Schema:
    """Of some columns; `compact`: what is repetitive as dictionaries."""
    fields = [COLUMNS.field(name) for name in names]
    as_dictionary = pa.dictionary(pa.int32(), pa.string())
    return pa.schema([of.with_type(as_dictionary) if compact and of.name in REPETITIVE else of for of in fields])


def completed(table: pa.Table, asked: Sequence[str] | None) -> pa.Table:
    """A fragment's rows with all columns that were asked for (None: all), also if it is of the version before."""
    field = COLUMNS.field("seconds")
    if field.name in table.column_names or field.name not in (COLUMNS.names if asked is None else asked):
        return table
    return table.append_column(field, pa.nulls(table.num_rows, field.type))


# Packed arrays of a shard; the number is the bits of a component. What changes along time: (level, component, 256).
PACKED = {"dyn32": 32, "dyn8": 8, "act": 8, "lvl32": 32, "lvl8": 8, "witness": 8}
ALONG_TIME = ("dyn32", "dyn8", "act")
FLAT = "witness"  # the bytes of everything, field after field: one small chunk a level where little is kept
WIDE = "record/timestep"  # the integers that do not fit 8 bits; others count, index or enumerate things of one level


class ContentsError(ValueError):
    """A shard does not hold what it should; the message is the end of a sentence."""


@dataclass(frozen=True)
class Encoding:
    """How a shard stores records."""

    density: Density = "full"
    key_every: int = KEY_EVERY  # env steps of an episode between key frames; of `witness` alone
    rules: TaskParams = DEFAULT_RULES  # by which what is not stored is computed again

    def as_json(self) -> dict[str, Any]:
        keys = {"key_every": self.key_every} if self.density == "witness" else {}
        return {"density": self.density, **keys, "task": plain(self.rules)}

    @staticmethod
    def of(attributes: Mapping[str, Any]) -> "Encoding":
        """What a shard's attributes say.

        Raises:
            ContentsError: nothing that this program writes.
        """
        try:
            density, key_every = attributes["density"], attributes.get("key_every", KEY_EVERY)
            encoding = Encoding(density, key_every, typed(TaskParams, attributes["task"]))
        except (KeyError, TypeError, ConfigError) as error:
            raise ContentsError("it does not say how records are stored") from error
        if density not in get_args(Density) or type(key_every) is not int or key_every not in KEYS_EVERY:
            raise ContentsError("it does not say how records are stored")
        if density != "full" and encoding.rules.frame_skip > MOST_FRAME_SKIP:
            raise ContentsError(f"its env steps have more than {MOST_FRAME_SKIP} physics steps")
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
    """Bits that each number of a field is stored with."""
    bits = 8 if dtype.kind in "bi" and name != WIDE else 32
    if bits == 32 and dtype.itemsize != 4:
        raise TypeError(f"{name} is {dtype}: fields are of 32 bits, or bool")
    return bits


def array_for(name: str, bits: int, density: Density) -> str:
    """Which packed array holds a field."""
    if density == "witness":
        return FLAT
    if name == "record/action":
        return "act"
    return f"{'lvl' if name.startswith('level/') else 'dyn'}{bits}"


def field_table(arrays: Mapping[str, np.ndarray], density: Density = "full") -> list[FieldSpec]:
    """Where all fields lie, in the order of `arrays` (level axis last; time first but for `level/` fields).

    In FLAT, wide numbers come first.
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

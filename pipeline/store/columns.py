"""The manifest's columns, their meanings and versions; docs/columns.md is generated from here.

Readers refuse a fragment of another version instead of guessing.
"""

from collections.abc import Sequence
from typing import NamedTuple

import pyarrow as pa

from levelproof.experts.steps import Seconds

MANIFEST_VERSION = 10

# Columns that depend on the run and not on the level: in all others two runs of a job agree, bit for bit
OF_THE_RUN = ("shard", "row", "experts", "seconds")

# String columns whose values repeat in many rows
REPETITIVE = ("size", "budget", "label", "label_reason", "witness", "shard", "experts", "config_hash", "device")

# String columns that are nearly unique per row; they precede all other string columns. A dictionary of them would save
# nothing, and reading it would take more time than everything else.
OWN = ("content_hash", "signature")


class ManifestColumn(NamedTuple):
    """A column's name, type and description."""

    name: str
    type: pa.DataType
    meaning: str
    unit: str = ""
    null: str = ""  # meaning of null; empty: the column has no nulls

    @property
    def text(self) -> str:
        """Meaning of the column and of null."""
        return f"{self.meaning}; null: {self.null}" if self.null else self.meaning

    @property
    def type_name(self) -> str:
        name = lambda dtype: {"float": "float32"}.get(str(dtype), str(dtype))
        if pa.types.is_list(self.type):
            return f"list of {name(self.type.value_type)}"
        if pa.types.is_struct(self.type):
            return f"struct of {' and '.join(dict.fromkeys(name(part.type) for part in self.type))}"
        return name(self.type)


STACK = ("levelproof", "python", "jax", "jaxlib")
NO_WITNESS, NO_ATTEMPTS = "no witness", "no such attempts"

DESCRIBED = (
    ManifestColumn(
        "level_id",
        pa.int64(),
        "Rebuilds the level, given size, distribution and sampler version. Level files: derived from the content hash; "
        "imported trajectories: position in the folder",
    ),
    ManifestColumn("content_hash", pa.string(), "Equal for levels with equal content"),
    ManifestColumn(
        "signature",
        pa.list_(pa.string()),
        "Two hashes; levels that look nearly the same share one of them",
    ),
    ManifestColumn(
        "file",
        pa.string(),
        "Absolute path of the level file, or `FOLDER/ARRAY#ROW` of an imported trajectory",
        null="sampled from its id",
    ),
    ManifestColumn("size", pa.string(), "s, m, l, or numbers such as 8-8-8-4"),
    ManifestColumn("budget", pa.string(), "The training budget, as typed by the user"),
    ManifestColumn("label", pa.string(), "solved, unsolved, trivial or unsolvable"),
    ManifestColumn("label_reason", pa.string(), "A sentence that says why the level has this label"),
    ManifestColumn("failed_by_noop", pa.bool_(), "Without any action, green touches red"),
    ManifestColumn(
        "witness",
        pa.string(),
        "Source of the witness: `most probable` or `sampled` actions of the expert, `exploration` (an episode of "
        "training), `search` (before training, or around another witness), `nothing` (a trivial level), `import` "
        "(another program's data)",
        null=NO_WITNESS,
    ),
    # Null instead of NaN for what was not measured: in SQL, NaN is greater than every number
    ManifestColumn(
        "success_rate",
        pa.float32(),
        "First episodes of the expert with sampled actions that reach the goal, in attempts after its training that do "
        "not affect the label; trivial levels have 1, unsolvable ones 0, without an expert",
        "share",
        NO_ATTEMPTS,
    ),
    ManifestColumn(
        "most_probable_succeeds",
        pa.bool_(),
        "In the last evaluation, all finished episodes with the most probable actions reach the goal; trivial levels "
        "have true, unsolvable ones false, without an expert",
    ),
    ManifestColumn(
        "sticky_success_rate",
        pa.float32(),
        "First episodes of the last evaluation that reach the goal with sticky actions, which sometimes repeat the "
        "last action instead of the expert's",
        "share",
        NO_ATTEMPTS,
    ),
    ManifestColumn(
        "perturbed_success_rate",
        pa.float32(),
        "First episodes of the last evaluation that reach the goal from perturbed starts (slightly different "
        "velocities)",
        "share",
        NO_ATTEMPTS,
    ),
    ManifestColumn("steps_to_goal", pa.int32(), "Length of the witness's first episode", "env steps", NO_WITNESS),
    ManifestColumn(
        "portability",
        pa.float32(),
        "Witness replays from starts differing by rounding that reach the goal; no column counts their env steps",
        "share",
        f"{NO_WITNESS}, an imported one, or `expert.replays=0`",
    ),
    ManifestColumn(
        "steps_to_first_success",
        pa.int64(),
        "Training steps until the expert's first success, in environments where it alone acts (no persistence or "
        "rehearsal)",
        "env steps",
        "never",
    ),
    ManifestColumn("env_steps", pa.int64(), "Training steps used, at most the budget", "env steps"),
    ManifestColumn(
        "evaluation_steps",
        pa.int64(),
        "Steps of the expert's evaluations and of the attempts of success_rate",
        "env steps",
    ),
    ManifestColumn(
        "search_steps", pa.int64(), "Steps of the search before training and around the witness", "env steps"
    ),
    ManifestColumn("cells", pa.int32(), "Cells that the search reached", "cells", "no search"),
    ManifestColumn(
        "still_grew", pa.bool_(), "The last quarter of the search still reached new cells", null="no search"
    ),
    ManifestColumn(
        "learning_curve",
        pa.list_(pa.float32()),
        "Training success rate per update, in environments where the expert alone acts; an entry is null if no episode "
        "ended",
        "share",
    ),
    ManifestColumn(
        "best_return",
        pa.float32(),
        "The highest return of a training episode, shaping included",
        "reward",
        "no episode of training ended",
    ),
    ManifestColumn("episodes", pa.int64(), "Training episodes that ended", "episodes"),
    ManifestColumn("shard", pa.string(), "Path of the level's shard below the split", null=NO_WITNESS),
    ManifestColumn("row", pa.int32(), "Index of the level in the shard", null=NO_WITNESS),
    ManifestColumn("experts", pa.string(), "Path of the expert's file below the split", null="not kept"),
    ManifestColumn("config_hash", pa.string(), "Hash of the settings that decide results"),
    ManifestColumn(
        "versions",
        pa.struct(
            [
                *(pa.field(name, pa.string(), nullable=False) for name in STACK),
                pa.field("sampler", pa.int32(), nullable=False),
            ]
        ),
        f"Versions that made the row: {', '.join(STACK)}, and the sampler",
    ),
    ManifestColumn("engine", pa.int32(), "Version of the arithmetic of a physics step"),
    ManifestColumn("device", pa.string(), "Device that computed the row, such as `cpu: AMD EPYC`"),
    ManifestColumn("command", pa.string(), "Command that regenerates this row"),
    ManifestColumn(
        "seconds",
        pa.struct([pa.field(stage, pa.float32()) for stage in Seconds._fields]),
        "Seconds of a core (of a GPU if `device` is one) for the level: sampling (and labels without an expert), "
        "search, training, evaluation, idle slots, replay of witnesses, writing, compiling; wall-clock time, so other "
        "work on the core makes it longer",
        "s",
        "not measured",
    ),
)
COLUMNS = pa.schema([pa.field(column.name, column.type, nullable=bool(column.null)) for column in DESCRIBED])


def schema_of(
    names: Sequence[str],
    compact: bool = False,
    columns: pa.Schema = COLUMNS,
    repetitive: Sequence[str] = REPETITIVE,
) -> pa.Schema:
    """Return the schema of columns; `compact`: with repetitive ones as dictionaries."""
    fields = [columns.field(name) for name in names]
    if compact:
        as_dictionary = pa.dictionary(pa.int32(), pa.string())
        fields = [field.with_type(as_dictionary) if field.name in repetitive else field for field in fields]
    return pa.schema(fields)

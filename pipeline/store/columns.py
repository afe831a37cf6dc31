"""The manifest's columns: what each means, and in which versions it is. docs/columns.md is written from here.

A fragment of another version is refused with a sentence, never guessed at.
"""

from collections.abc import Sequence
from typing import NamedTuple

import pyarrow as pa

from levelproof.experts.steps import Seconds

MANIFEST_VERSION, OLDEST_VERSION = 7, 6  # that is written; that is still read

# Columns that tell of the run that made a row, and not of its level: in all others two runs of a job agree, bit for bit
OF_THE_RUN = ("shard", "row", "experts", "seconds")

# Columns of strings that are the same in many rows
REPETITIVE = ("size", "budget", "label", "label_reason", "witness", "shard", "experts", "config_hash", "device")

# Columns of strings that hardly two rows share, before all others of strings: a dictionary of them saves nothing, and
# reading it takes more time than all else
OWN = ("content_hash", "signature")


class ManifestColumn(NamedTuple):
    """A column, as programs and as people know it."""

    name: str
    type: pa.DataType
    meaning: str
    unit: str = ""
    null: str = ""  # what it says; empty: there is none
    since: int = OLDEST_VERSION  # the manifest version

    @property
    def text(self) -> str:
        """Meaning, and what null says."""
        return f"{self.meaning}; null: {self.null}" if self.null else self.meaning

    @property
    def type_name(self) -> str:
        name = lambda of: {"float": "float32"}.get(str(of), str(of))
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
        "With size, distribution and sampler version it rebuilds the level. Of a level file, made of its content hash; "
        "of an imported trajectory, its place in the folder",
    ),
    ManifestColumn("content_hash", pa.string(), "The same for levels of the same content"),
    ManifestColumn(
        "signature",
        pa.list_(pa.string()),
        "Two hashes, one of which is the same for levels that nearly look the same",
    ),
    ManifestColumn(
        "file",
        pa.string(),
        "Absolute path of the level file, or `FOLDER/ARRAY#ROW` of an imported trajectory",
        null="the id makes the level",
    ),
    ManifestColumn("size", pa.string(), "s, m, l, or numbers such as 8-8-8-4"),
    ManifestColumn("budget", pa.string(), "The training budget, as it was typed"),
    ManifestColumn("label", pa.string(), "solved, unsolved, trivial or unsolvable"),
    ManifestColumn("label_reason", pa.string(), "A sentence: what the label rests on"),
    ManifestColumn("failed_by_noop", pa.bool_(), "Doing nothing lets green touch red"),
    ManifestColumn(
        "witness",
        pa.string(),
        "Where it comes from: `most probable` or `sampled` actions of the expert, `exploration` (an episode of "
        "training), `scout` (random play before training), `search` (before training, or around another witness), "
        "`nothing` (a trivial level), `import` (another program's data)",
        null=NO_WITNESS,
    ),
    # NaN would be above every number in SQL, so what nobody counted is null
    ManifestColumn(
        "success_rate",
        pa.float32(),
        "How many first episodes of the expert reach the goal with sampled actions, in attempts after its training "
        "that decide nothing",
        "share",
        NO_ATTEMPTS,
    ),
    ManifestColumn(
        "most_probable_succeeds",
        pa.bool_(),
        "All finished episodes of the last evaluation with the most probable actions reach the goal",
    ),
    ManifestColumn(
        "sticky_success_rate",
        pa.float32(),
        "How many of the last evaluation's first episodes reach the goal, where an action is sometimes repeated "
        "against the expert's will",
        "share",
        NO_ATTEMPTS,
    ),
    ManifestColumn(
        "moved_success_rate",
        pa.float32(),
        "How many of the last evaluation's first episodes reach the goal from starts with slightly other velocities",
        "share",
        NO_ATTEMPTS,
    ),
    ManifestColumn("steps_to_goal", pa.int32(), "Length of the witness's first episode", "env steps", NO_WITNESS),
    ManifestColumn(
        "portability",
        pa.float32(),
        "How many of the witness's replays from moved starts reach the goal",
        "share",
        f"{NO_WITNESS}, or `expert.replays=0`",
    ),
    ManifestColumn(
        "steps_to_first_success",
        pa.int64(),
        "Training steps until the expert's first success of its own, so in no environment that repeats actions",
        "env steps",
        "never",
    ),
    ManifestColumn("env_steps", pa.int64(), "Training steps that were used, at most the budget", "env steps"),
    ManifestColumn(
        "evaluation_steps",
        pa.int64(),
        "Spent on the expert's evaluations, and on the attempts of success_rate",
        "env steps",
    ),
    ManifestColumn("scout_steps", pa.int64(), "Spent on random play before training", "env steps"),
    ManifestColumn(
        "search_steps", pa.int64(), "Spent on the search before training and around the witness", "env steps"
    ),
    ManifestColumn("cells", pa.int32(), "How many the search reached", "cells", "no search"),
    ManifestColumn(
        "still_grew", pa.bool_(), "The last quarter of the search still reached new cells", null="no search"
    ),
    ManifestColumn(
        "learning_curve",
        pa.list_(pa.float32()),
        "Success rate of training for each update, of environments in which the expert alone chooses actions; an entry "
        "is null where no episode ended",
        "share",
    ),
    ManifestColumn(
        "best_return",
        pa.float32(),
        "The best of a training episode, shaping included",
        "reward",
        "no episode of training ended",
    ),
    ManifestColumn("episodes", pa.int64(), "Episodes of training that ended", "episodes"),
    ManifestColumn("shard", pa.string(), "Where its data is: a path below the split", null=NO_WITNESS),
    ManifestColumn("row", pa.int32(), "Its place in the shard", null=NO_WITNESS),
    ManifestColumn("experts", pa.string(), "File with its expert: a path below the split", null="none is kept"),
    ManifestColumn("config_hash", pa.string(), "Hash of the settings that decide results"),
    ManifestColumn(
        "versions",
        pa.struct(
            [
                *(pa.field(name, pa.string(), nullable=False) for name in STACK),
                pa.field("sampler", pa.int32(), nullable=False),
            ]
        ),
        f"What made the row: {', '.join(STACK)}, and the sampler",
    ),
    ManifestColumn("device", pa.string(), "Such as `cpu: AMD EPYC`"),
    ManifestColumn("command", pa.string(), "Makes this row again"),
    ManifestColumn(
        "seconds",
        pa.struct([pa.field(stage, pa.float32()) for stage in Seconds._fields]),
        "What the level cost the run that made it, of a core, or of a GPU where `device` is one: sampling (and what "
        "needs no expert), search (and scouts), training, evaluation, idle slots and rows, replay of witnesses, "
        "writing, compiling",
        "s",
        "nobody has counted",
        since=7,
    ),
)
COLUMNS = pa.schema([pa.field(of.name, of.type, nullable=bool(of.null)) for of in DESCRIBED])
VERSIONS = {
    str(version): [of.name for of in DESCRIBED if of.since <= version]
    for version in range(OLDEST_VERSION, MANIFEST_VERSION + 1)
}


def schema_of(names: Sequence[str], compact: bool = False) -> pa.Schema:
    """Of some columns; `compact`: what is repetitive as dictionaries."""
    fields = [COLUMNS.field(name) for name in names]
    as_dictionary = pa.dictionary(pa.int32(), pa.string())
    return pa.schema([of.with_type(as_dictionary) if compact and of.name in REPETITIVE else of for of in fields])


def completed(table: pa.Table, asked: Sequence[str]) -> pa.Table:
    """A fragment's rows with all columns that were asked for, also if it is of a version before."""
    for of in DESCRIBED:
        if of.name in asked and of.name not in table.column_names:
            table = table.append_column(COLUMNS.field(of.name), pa.nulls(table.num_rows, of.type))
    return table

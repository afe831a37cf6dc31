"""Text of a dataset's card: Markdown under a YAML header, from facts about its splits. Reads and writes no files."""

import datetime
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from rich.filesize import decimal

from levelproof.experts.config import RECORD_STEPS
from levelproof.experts.labels import Label
from levelproof.pipeline.look.figures import Share
from levelproof.pipeline.words import number

MARK = "<!-- written by levelproof card: run it again rather than edit this -->"
PREVIEW, FIGURES = "preview", "figures"  # folders beside the README
SHEET, RATES, STEPS = (f"{FIGURES}/{name}.png" for name in ("solved", "solve-rate", "steps-to-goal"))
SUBSET_SPLIT = "levels"  # every subset on the hub needs a split, in the hub's sense; its name
CATEGORIES = (  # the hub's size categories, by exclusive upper bound
    (10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"), (10**9, "100M<n<1B"), (10**10, "1B<n<10B"), (10**11, "10B<n<100B"), (10**12, "100B<n<1T"),
)  # fmt: skip
RANDOM, IMPORTED = "random", "imported"  # how descriptions of distributions begin
TAGS = ["reinforcement-learning", "offline-rl", "imitation-learning", "physics", "procedural-generation", "jax"]
TAGS += ["kinetix", "levelproof"]
KINETIX = """\
@inproceedings{matthews2025kinetix,
  title={Kinetix: Investigating the Training of General Agents through Open-Ended Physics-Based Control Tasks},
  author={Michael Matthews and Michael Beukman and Chris Lu and Jakob Foerster},
  booktitle={The Thirteenth International Conference on Learning Representations},
  year={2025},
  url={https://arxiv.org/abs/2410.23208}
}"""


@dataclass(frozen=True)
class CardOptions:
    """Facts of a card that no split records."""

    license: str | None = None  # as the hub names it; None: not chosen yet
    name: str | None = None  # the dataset's name; None: its folder's name
    repo: str | None = None  # USER/NAME on the hub; None: not known yet
    code: str | None = None  # URL of the levelproof that made it; None: no link


@dataclass(frozen=True)
class SplitFacts:
    """Facts about one split."""

    path: str  # below the dataset's folder, such as 64k/s
    seeds: bool  # whether it is one or more seed files
    rows: str  # path of its manifest's files, with `*`
    labels: Mapping[str, int]  # levels with each label
    distinct: int  # number of distinct contents
    witnesses: int  # number of trajectories
    transitions: int  # env steps of them, without repetitions
    steps_to_goal: np.ndarray  # of solved levels
    split_bytes: int  # size of all its files
    shard_bytes: int
    budget: str
    distribution: str  # description
    searched: bool  # whether a search is known to have come before any training
    experts: bool  # whether experts are known to have trained
    config_hash: str
    stored_as: str  # densities, as settings name them
    made_with: Sequence[str]  # each stack of versions and device
    whole: bool  # whether every level that was tried is known to have a row

    @property
    def subset(self) -> str:
        """Name of the hub's subset."""
        return re.sub(r"[^\w-]", "-", self.path.removesuffix(".parquet"))

    @property
    def preview(self) -> str:
        """Name of its preview in the hub's viewer, which allows no hyphen."""
        return re.sub(r"\W", "_", self.path)

    @property
    def levels(self) -> int:
        return sum(self.labels.values())

    @property
    def solved(self) -> Share | None:
        """Share solved of the levels that needed an expert or a search; None if none did."""
        hits = self.labels.get(Label.SOLVED, 0)
        tried = hits + self.labels.get(Label.UNSOLVED, 0)
        return Share(hits, tried) if tried else None


def readme(name: str, splits: Sequence[SplitFacts], options: CardOptions, figures: Sequence[str], version: str) -> str:
    """Compose the file; `figures` are the paths of SHEET, RATES and STEPS that were drawn."""
    header = yaml.safe_dump(_header(name, splits, options), sort_keys=False, allow_unicode=True, width=120)
    total = sum(split.transitions for split in splits)
    witnesses = sum(split.witnesses for split in splits)
    origin = "random " if all(split.distribution.startswith(RANDOM) for split in splits) else ""
    rows = WHOLE if all(split.whole for split in splits) else PARTIAL
    sections = [
        f"---\n{header}---\n\n{MARK}",
        f"# {name}",
        f"**{_short(total)} transitions that solve {_short(witnesses)} {origin}physics levels, each proved by "
        f"replay.** Made by {_link('levelproof', options.code)} {version}.",
        _picture(SHEET, figures, "Levels of this dataset at the moment their witness reaches the goal"),
        OVERVIEW.format(
            rows=rows.format(levels=f"{sum(split.levels for split in splits):,}"),
            costs="" if any(split.seeds for split in splits) else ", with its search, learning curve and costs",
        ),
        f"## Splits\n\nOne folder for each training budget and size, `{{budget}}/{{size}}`.\n\n{_sizes(splits)}",
        _picture(RATES, figures, "Share of tried levels that were solved, with 95% intervals"),
        _picture(STEPS, figures, "Number of steps that solved levels take"),
        _loading(splits, options),
        _format(splits, options),
        _making(splits),
        _licence(options),
        _citation(options, version),
    ]
    return "\n\n".join(filter(None, sections)) + "\n"


def _header(name: str, splits: Sequence[SplitFacts], options: CardOptions) -> dict[str, Any]:
    total = sum(split.transitions for split in splits)
    shown = [{"split": split.preview, "path": f"{PREVIEW}/{split.subset}.parquet"} for split in splits]
    configs: list[dict[str, Any]] = [{"config_name": PREVIEW, "default": True, "data_files": shown}]
    for split in splits:
        files = [{"split": SUBSET_SPLIT, "path": split.rows}]
        configs.append({"config_name": split.subset, "data_files": files})
    return {
        **({"license": options.license} if options.license else {}),
        "pretty_name": name,
        "task_categories": ["reinforcement-learning"],
        "tags": TAGS,
        "size_categories": [next((words for most, words in CATEGORIES if total < most), "n>1T")],
        "configs": configs,
    }


WHOLE = "**No level that was tried is left out.** The manifests have a row for each of {levels} levels, solved or not"
PARTIAL = "**Every level has a label.** The manifests have a row for each of the {levels} levels in these files"
OVERVIEW = """## What it is

Tasks are those of [Kinetix](https://github.com/FLAIROx/Kinetix): in a 2D world of rigid bodies, make the **green** \
body touch the **blue** one, but never the **red** one, by switching motors and thrusters. Every level is a task of \
its own.

- **Solved means replayed.** A level is `solved` only if replaying its actions from its initial state, through the \
engine, reached the goal. `levelproof verify` repeats the replay on your machine.
- {rows}{costs}; `trivial` and `unsolvable` levels have labels of their own, each with its reason.
- **The whole world at every step**, stored or recomputed by the engine, bit for bit: draw it, observe it in any way, \
or start an environment from it."""


def _sizes(splits: Sequence[SplitFacts]) -> str:
    head = ("split", "levels", "distinct levels", "with a witness", "transitions", "size on disk")
    rows = [f"| {' | '.join(head)} | bytes per transition |", "|---" * (len(head) + 1) + "|"]
    for split in splits:
        each = f"{split.shard_bytes / split.transitions:.1f}" if split.transitions else "-"
        counts = (split.levels, split.distinct, split.witnesses, split.transitions)
        cells = " | ".join(f"{count:,}" for count in counts)
        rows.append(f"| `{split.path}` | {cells} | {decimal(split.split_bytes)} | {each} |")
    if len(splits) > 1:
        levels, witnesses, steps, size = (
            sum(getattr(split, name) for split in splits)
            for name in ("levels", "witnesses", "transitions", "split_bytes")
        )
        rows.append(f"| **all** | {levels:,} | | {witnesses:,} | {steps:,} | {decimal(size)} | |")
    labels = ["| split | " + " | ".join(Label) + " | solved, of those trained or searched |"]
    labels.append("|---" * (len(Label) + 2) + "|")
    for split in splits:
        counts = " | ".join(f"{split.labels.get(label, 0):,}" for label in Label)
        labels.append(f"| `{split.path}` | {counts} | {split.solved or '-'} |")
    return "\n".join(rows) + "\n\n" + "\n".join(labels)


def _loading(splits: Sequence[SplitFacts], options: CardOptions) -> str:
    repo, split = options.repo or "USER/NAME", splits[0]
    included = split.rows if split.seeds else f"{split.path}/*"
    return f"""## Load it

    hf download {repo} --repo-type dataset --local-dir data --include "{included}"

Trajectories, with {_link("levelproof", options.code)}:

```python
import levelproof

data = levelproof.open("data/{split.path}", where="steps_to_goal < 64")
for batch in data.batches(64, seed=0, subset="train"):  # (B, T, ...)
    batch.observation, batch.action, batch.action_mask, batch.reward, batch.done, batch.mask
```

The manifest is parquet. Without levelproof, with DuckDB:

```sql
SELECT label, count(*), median(steps_to_goal) FROM 'hf://datasets/{repo}/{split.rows}' GROUP BY label
```

or with the library `datasets`: `load_dataset("{repo}", "{split.subset}", split="{SUBSET_SPLIT}")`."""


SHARDED = f"""
- `manifest/*.parquet`: a row for every level: `label` and `label_reason`, `steps_to_goal`, success \
rates, costs, `shard` and `row` of its data, and the command that remakes the row.
- `shards/*.zarr`: zarr v3. A record of {RECORD_STEPS} steps for each level with a witness; the level restarts \
whenever an episode ends. The split's density says how much of a record is stored; reading returns world, contacts, \
action, reward, end and goal at any density. One trajectory is one compressed chunk with a checksum."""
SEEDED = """
- Seed files (`*.parquet`): a row for every level: its id, `label`, `steps_to_goal`, success rates, \
and the actions of its first episode that reached the goal, packed into some ten bytes. levelproof makes the level \
from its id and plays the actions when the row is read; a checksum tells whether the states are the original ones. \
Costs and learning curves are not in them."""


def _format(splits: Sequence[SplitFacts], options: CardOptions) -> str:
    kinds = [SHARDED] * (not all(split.seeds for split in splits)) + [SEEDED] * any(split.seeds for split in splits)
    return f"""## Format
{"".join(kinds)}
- `{PREVIEW}/*.parquet`: a sample of the levels with pictures, for the viewer.

Columns and fields: {_link("docs/columns.md", options.code, "/blob/main/docs/columns.md")} and \
{_link("docs/shards.md", options.code, "/blob/main/docs/shards.md")}."""


def _making(splits: Sequence[SplitFacts]) -> str:
    rows = ["| split | budget | origin | configuration | stored as | made with |", "|---" * 6 + "|"]
    for split in splits:
        cells = f"{split.budget} | {split.distribution} | `{split.config_hash}` | `{split.stored_as}`"
        rows.append(f"| `{split.path}` | {cells} | {'; '.join(split.made_with)} |")
    first = next((split for split in splits if split.distribution != IMPORTED), splits[0])
    aim, commands = "check every byte and every witness", [["verify", f"data/{first.path}"]]
    if first.distribution != IMPORTED:  # whose labels are of another program's actions
        aim = f"remake the levels and their labels, or to {aim}"
        commands.insert(0, ["regenerate", f"manifest=data/{first.path}", f"budget={first.budget}", "out=again"])
    return (
        f"## How it was made\n\n{_procedure(splits)} The manifest's column `witness` (`source` in seed files) says "
        "where each solution came from. The manifests contain the whole configuration.\n\n" + "\n".join(rows) + "\n\n"
        f"To {aim}:\n\n" + "\n".join(f"    levelproof {shlex.join(words)}" for words in commands)
    )


def _procedure(splits: Sequence[SplitFacts]) -> str:
    """Say what was searched and what was trained; nothing of splits that do not record it, as imported ones."""

    def among(some: Sequence[SplitFacts]) -> str:
        return "" if len(some) == len(splits) else f" of {', '.join(f'`{split.path}`' for split in some)}"

    searched, trained = ([split for split in splits if getattr(split, name)] for name in ("searched", "experts"))
    sentences = [f"Levels{among(searched)} were searched for a way to the goal, as configured."] * bool(searched)
    own = "had PPO experts of their own, trained for at most the budget's env steps, as configured."
    sentences += [f"Levels{among(trained)} {own}"] * bool(trained)
    return " ".join([*sentences, *["No experts were trained."] * (bool(searched) and not trained)])


def _licence(options: CardOptions) -> str:
    if options.license:
        return f"## Licence\n\n{options.license}, chosen by the publisher of this dataset."
    return "## Licence\n\nNone has been chosen yet: ask the publisher of this dataset before you use it."


def _citation(options: CardOptions, version: str) -> str:
    entries = {
        "title": "levelproof: physics levels with experts that provably solve them",
        "author": "{levelproof authors}",
        "version": version,
        "year": str(datetime.date.today().year),
        **({"url": options.code} if options.code else {}),
    }
    ours = "@software{levelproof,\n" + ",\n".join(f"  {name}={{{text}}}" for name, text in entries.items()) + "\n}"
    return f"## Citation\n\nThe program that made the data, and the tasks:\n\n```bibtex\n{ours}\n\n{KINETIX}\n```"


def _picture(path: str, figures: Sequence[str], words: str) -> str:
    return f"![{words}]({path})" if path in figures else ""


def _link(words: str, code: str | None, path: str = "") -> str:
    return f"[{words}]({code.rstrip('/')}{path})" if code else words


def _short(count: int) -> str:
    """Format a count as 1.5 billion, 320 million or 12,345."""
    for unit, word in ((10**9, "billion"), (10**6, "million")):
        if count >= unit:
            return f"{number(count / unit)} {word}"
    return f"{count:,}"

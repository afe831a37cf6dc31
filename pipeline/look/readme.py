"""What a dataset's card says: Markdown under a YAML header, from facts about its splits. Reads and writes nothing."""

import datetime
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
SUBSET_SPLIT = "levels"  # the hub's word split, of which each of its subsets needs one
CATEGORIES = (  # the hub's own
    (10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"), (10**9, "100M<n<1B"), (10**10, "1B<n<10B"), (10**11, "10B<n<100B"), (10**12, "100B<n<1T"),
)  # fmt: skip
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
class Wishes:
    """What no split tells."""

    license: str | None = None  # as the hub names it; None: nobody has chosen one
    name: str | None = None  # of the dataset; None: that of its folder
    repo: str | None = None  # USER/NAME on the hub; None: not known yet
    code: str | None = None  # address of the levelproof that made it; None: not told


@dataclass(frozen=True)
class SplitFacts:
    """What a card says of one split."""

    path: str  # below the dataset's folder, such as 64k/s
    labels: Mapping[str, int]  # levels with each label
    distinct: int  # levels of different content
    witnesses: int  # trajectories
    steps_to_goal: np.ndarray  # of solved levels
    split_bytes: int  # of all its files
    shard_bytes: int
    budget: str
    distribution: str  # in words
    config_hash: str
    stored_as: str  # densities, in the words of settings
    made_with: Sequence[str]  # each stack of versions and device

    @property
    def subset(self) -> str:
        """The hub's name for it."""
        return self.path.replace("/", "-")

    @property
    def levels(self) -> int:
        return sum(self.labels.values())

    @property
    def transitions(self) -> int:
        return self.witnesses * RECORD_STEPS

    @property
    def solved(self) -> Share | None:
        """Of the levels that needed an expert or a search."""
        hits = self.labels.get(Label.SOLVED, 0)
        tried = hits + self.labels.get(Label.UNSOLVED, 0)
        return Share(hits, tried) if tried else None


def readme(name: str, splits: Sequence[SplitFacts], wishes: Wishes, figures: Sequence[str], version: str) -> str:
    """The whole file; `figures` are those of SHEET, RATES and STEPS that there are."""
    header = yaml.safe_dump(_header(name, splits, wishes), sort_keys=False, allow_unicode=True, width=120)
    total = sum(split.transitions for split in splits)
    witnesses = sum(split.witnesses for split in splits)
    sections = [
        f"---\n{header}---\n\n{MARK}",
        f"# {name}",
        f"**{_short(total)} transitions that solve {_short(witnesses)} random physics levels, each of them proved by "
        f"replay.** Made by {_link('levelproof', wishes.code)} {version}.",
        _picture(SHEET, figures, "Levels of this dataset at the moment their witness reaches the goal"),
        OVERVIEW.format(tried=f"{sum(split.levels for split in splits):,}"),
        f"## Splits\n\nOne folder for each training budget and size, `{{budget}}/{{size}}`.\n\n{_sizes(splits)}",
        _picture(RATES, figures, "Share of the levels that were tried and got solved, with 95% intervals"),
        _picture(STEPS, figures, "How many steps solved levels take"),
        _loading(splits, wishes),
        _format(wishes),
        _making(splits),
        _licence(wishes),
        _citation(wishes, version),
    ]
    return "\n\n".join(filter(None, sections)) + "\n"


def _header(name: str, splits: Sequence[SplitFacts], wishes: Wishes) -> dict[str, Any]:
    total = sum(split.transitions for split in splits)
    shown = [{"split": split.path.replace("/", "_"), "path": f"{PREVIEW}/{split.subset}.parquet"} for split in splits]
    configs: list[dict[str, Any]] = [{"config_name": PREVIEW, "default": True, "data_files": shown}]
    for split in splits:
        files = [{"split": SUBSET_SPLIT, "path": f"{split.path}/manifest/*.parquet"}]
        configs.append({"config_name": split.subset, "data_files": files})
    return {
        **({"license": wishes.license} if wishes.license else {}),
        "pretty_name": name,
        "task_categories": ["reinforcement-learning"],
        "tags": TAGS,
        "size_categories": [next((words for most, words in CATEGORIES if total < most), "n>1T")],
        "configs": configs,
    }


OVERVIEW = """## What it is

Tasks are those of [Kinetix](https://github.com/FLAIROx/Kinetix): in a 2D world of rigid bodies, make the **green** \
and the **blue** body touch, and never the green and the **red** one, by switching motors and thrusters. Every level \
is another task.

- **Solved means replayed.** A level is `solved` only if its actions were played again from its initial state, through \
the engine, and reached the goal. `levelproof verify` does it again on your machine.
- **All that was tried is here.** The manifests have a row for each of {tried} levels, unsolved ones too, with what \
was tried, learning curves and costs; `trivial` and `unsolvable` ones are told apart, each with its reason.
- **The whole world at every step**, stored or computed again by the engine, the same bits: draw it, observe it in any \
way, and start an environment from it."""


def _sizes(splits: Sequence[SplitFacts]) -> str:
    head = ("split", "levels tried", "of different content", "with a witness", "transitions", "size on disk")
    rows = [f"| {' | '.join(head)} | bytes a transition |", "|---" * (len(head) + 1) + "|"]
    for split in splits:
        each = f"{split.shard_bytes / split.transitions:.1f}" if split.transitions else "-"
        counts = (split.levels, split.distinct, split.witnesses, split.transitions)
        told = " | ".join(f"{count:,}" for count in counts)
        rows.append(f"| `{split.path}` | {told} | {decimal(split.split_bytes)} | {each} |")
    if len(splits) > 1:
        levels, witnesses, steps, size = (
            sum(getattr(split, name) for split in splits)
            for name in ("levels", "witnesses", "transitions", "split_bytes")
        )
        rows.append(f"| **all** | {levels:,} | | {witnesses:,} | {steps:,} | {decimal(size)} | |")
    labels = ["| split | " + " | ".join(Label) + " | solved of those that were trained or searched for |"]
    labels.append("|---" * (len(Label) + 2) + "|")
    for split in splits:
        counts = " | ".join(f"{split.labels.get(label, 0):,}" for label in Label)
        labels.append(f"| `{split.path}` | {counts} | {split.solved or '-'} |")
    return "\n".join(rows) + "\n\n" + "\n".join(labels)


def _loading(splits: Sequence[SplitFacts], wishes: Wishes) -> str:
    repo, split = wishes.repo or "USER/NAME", splits[0]
    return f"""## Load it

    hf download {repo} --repo-type dataset --local-dir data --include "{split.path}/*"

Trajectories, with {_link("levelproof", wishes.code)}:

```python
import levelproof

data = levelproof.open("data/{split.path}", where="steps_to_goal < 64")
for batch in data.batches(64, seed=0, subset="train"):  # (B, T, ...)
    batch.observation, batch.action, batch.action_mask, batch.reward, batch.done, batch.mask
```

The manifest is parquet. Without levelproof, with DuckDB:

```sql
SELECT label, count(*), median(steps_to_goal) FROM 'hf://datasets/{repo}/{split.path}/manifest/*.parquet' GROUP BY label
```

or with the library `datasets`: `load_dataset("{repo}", "{split.subset}", split="{SUBSET_SPLIT}")`."""


def _format(wishes: Wishes) -> str:
    return f"""## Format

- `manifest/*.parquet`: a row for every level that was tried. `label` and `label_reason`, `steps_to_goal`, success \
rates, what it cost, `shard` and `row` of its data, and the command that makes the row again.
- `shards/*.zarr`: zarr v3. A record of {RECORD_STEPS} steps for each level with a witness, with a restart of the \
level after every end; how much of it is stored is the split's density, and reading gives world, contacts, action, \
reward, end and goal whatever that is. One trajectory is one compressed chunk with a checksum.
- `{PREVIEW}/*.parquet`: a sample of the levels with pictures, which the viewer shows.

Columns and fields: {_link("docs/columns.md", wishes.code, "/blob/main/docs/columns.md")} and \
{_link("docs/shards.md", wishes.code, "/blob/main/docs/shards.md")}."""


def _making(splits: Sequence[SplitFacts]) -> str:
    rows = ["| split | budget | levels are | configuration | stored as | made with |", "|---" * 6 + "|"]
    for of in splits:
        stored, stacks = f"`{of.stored_as}`", "; ".join(of.made_with)
        rows.append(f"| `{of.path}` | {of.budget} | {of.distribution} | `{of.config_hash}` | {stored} | {stacks} |")
    first = splits[0]
    return (
        "## How it was made\n\nAs its configuration says, each level was searched for a way to the goal, and got a PPO "
        "expert of its own for at most the budget's env steps; `witness` in the manifest says who found the way. The "
        "manifests carry the whole configuration.\n\n" + "\n".join(rows) + "\n\n"
        "To make the levels and their experts again, or to check every byte and every witness:\n\n"
        f"    levelproof regenerate manifest=data/{first.path} budget={first.budget} out=again\n"
        f"    levelproof verify data/{first.path}"
    )


def _licence(wishes: Wishes) -> str:
    if wishes.license:
        return f"## Licence\n\n{wishes.license}, chosen by those who publish this dataset."
    return "## Licence\n\nNone has been chosen yet: ask those who publish this dataset before you use it."


def _citation(wishes: Wishes, version: str) -> str:
    entries = {
        "title": "levelproof: physics levels with experts that provably solve them",
        "author": "{levelproof authors}",
        "version": version,
        "year": str(datetime.date.today().year),
        **({"url": wishes.code} if wishes.code else {}),
    }
    ours = "@software{levelproof,\n" + ",\n".join(f"  {name}={{{text}}}" for name, text in entries.items()) + "\n}"
    return f"## Citation\n\nThe program that made the data, and the tasks:\n\n```bibtex\n{ours}\n\n{KINETIX}\n```"


def _picture(path: str, figures: Sequence[str], words: str) -> str:
    return f"![{words}]({path})" if path in figures else ""


def _link(words: str, code: str | None, path: str = "") -> str:
    return f"[{words}]({code.rstrip('/')}{path})" if code else words


def _short(count: int) -> str:
    """1.5 billion, 320 million, 12,345."""
    for unit, word in ((10**9, "billion"), (10**6, "million")):
        if count >= unit:
            return f"{number(count / unit)} {word}"
    return f"{count:,}"

"""Offline reinforcement learning by TorchRL on the witnesses of a split, beside clones of the same levels.

A stopped run resumes: the folder keeps trained networks and finished evaluations.
"""

import argparse
import json
import os
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.cloning import SAMPLED, command, interval_text, kept, lines_of, slug, timed_process
from benchmarks.report import Report, Table
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.learn.evaluate import AGENT, SOLVED
from levelproof.pipeline.store.files import write
from levelproof.pipeline.store.job_note import sound_note

SCRIPT = Path(__file__).parents[1] / "docs" / "learners" / "offline_torchrl.py"
METHODS = {  # name: the script's word for it
    "TorchRL, cloning": "cloning",
    "TorchRL, conservative Q-learning": "cql",
    "TorchRL, implicit Q-learning": "iql",
}
CLONES = {  # name: settings of `levelproof clone`
    "levelproof clone, flat network": ("network.kind=flat", "network.width=256", "network.depth=2"),
    "levelproof clone": (),
}
BASELINES = "random", "sticky random"
ATTEMPTS = 8
MINARI, SECONDS = "minari", "seconds"  # in the folder: the dataset; in that of a network: CPU time of its training


def register(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("split", type=Path, help="split to learn from")
    names = [*METHODS, *CLONES]
    parser.add_argument("--ways", nargs="+", choices=names, default=names, help="default: all")
    parser.add_argument("--where", default="label = 'solved'", help="levels to learn from (default: all solved ones)")
    parser.add_argument("--seeds", type=int, default=2, help="policies of each way (default: 2)")
    parser.add_argument("--updates", type=int, default=3000, help="updates of each, of 1,024 steps (default: 3000)")
    parser.add_argument("--measured", type=int, default=2048, help="sealed levels to measure on (default: 2048)")
    parser.add_argument("--folder", type=Path, default=Path("offline"), help="where networks are kept")


def run(args: argparse.Namespace) -> Report:
    require_same_data(args)
    data = exported(args)
    results = [learned(args, data, way, seed) for way in args.ways for seed in range(args.seeds)]
    rows = [row_of(each) for each in results]
    players = results[0]["sealed"][SOLVED]
    rows += [[name, "", "", *(interval_text(players[name][key]) for key in ("once", "best"))] for name in BASELINES]
    head = ("policy", "seed", "core-seconds", "one attempt", "best of 8")
    return Report(
        "Offline reinforcement learning",
        results,
        [Table(head, rows, "Share of sealed levels labelled solved that a policy solves; 95% intervals over levels")],
        [
            f"All policies learn from the first episodes of `{args.where}` in {args.split.name}, and take "
            f"{args.updates:,} updates of 1,024 steps. `docs/learners/offline_torchrl.py` trains those of TorchRL on "
            "the Minari dataset of these levels: two layers of 256 on the symbolic observation, one output for each of "
            "324 combined actions. Conservative Q-learning takes its best action, the others draw theirs. *Flat "
            "network*: an MLP of the same width and depth with an output for each choice of each entry; *levelproof "
            "clone*: the default, attention over entities. Clones keep a tenth of these levels for validation; "
            "TorchRL's policies learn from all, and draw steps uniformly, so long witnesses weigh more.",
            f"Core-seconds are CPU time of training, with reading and compiling.{made_by(args.split)}",
        ],
    )


def require_same_data(args: argparse.Namespace) -> None:
    """Raise UserError if the folder holds what other levels or updates gave: it would be taken for these."""
    told = json.dumps({"split": str(args.split), "where": args.where, "updates": args.updates})
    file = args.folder / "settings.json"
    if not file.exists():
        args.folder.mkdir(parents=True, exist_ok=True)
        if any(args.folder.iterdir()):
            raise UserError(f"{args.folder} does not say what it was made with: choose another --folder.")
        write(file, told.encode())
    if (made := file.read_text()) != told:
        raise UserError(f"{args.folder} was made with {made}, not with {told}: choose another --folder.")


def made_by(split: Path) -> str:
    """Return a sentence with the command that made a split, without the words that decide nothing about its data.

    Empty for a split without a job's note, such as a seed file.
    """
    if (note := sound_note(split)) is None:
        return ""
    words = [word for word in shlex.split(note.command) if word.partition("=")[0] not in ("out", "executor")]
    return f" `{shlex.join(words)}` made the split."


def exported(args: argparse.Namespace) -> str:
    """Write the Minari dataset of the split, unless it is there; return its name."""
    out = args.folder / MINARI
    if not out.exists():
        out.parent.mkdir(parents=True, exist_ok=True)
        command("export", args.split, "--format", "minari", "--actions", "combined", "--where", args.where, "-o", out)
    (metadata,) = out.glob("*/*/*/data/metadata.json")
    return str(metadata.parents[1].relative_to(out))


def learned(args: argparse.Namespace, data: str, way: str, seed: int) -> dict[str, Any]:
    """Train one policy, and measure it on sealed levels."""
    folder = args.folder / f"{slug(way)}-{seed}"
    if way in CLONES:
        chosen = f"where={args.where}", f"train.updates={args.updates}", f"seed={seed}"
        command("clone", args.split, "-o", folder, *chosen, *CLONES[way])
        policy, player = folder, SAMPLED
    else:
        policy, player = folder / "agent.py", AGENT
        if not (folder / SECONDS).exists():
            folder.mkdir(exist_ok=True)
            shutil.copy(SCRIPT, policy)
            seconds = trained(policy, args.folder / MINARI, METHODS[way], data, args.updates, seed)
            write(folder / SECONDS, str(seconds).encode())
    words = "--attempts", ATTEMPTS, "--levels", args.measured
    sealed = kept(folder / "sealed.json", policy, *words)
    seconds = lines_of(folder)[-1]["bc/core_seconds"] if way in CLONES else float((folder / SECONDS).read_text())
    return {"way": way, "seed": seed, "core_seconds": seconds, "player": player, "sealed": sealed}


def trained(script: Path, datasets: Path, *words: Any) -> float:
    """Run TorchRL's training; return its CPU seconds. Raise Failure with the last line of its errors if it fails."""
    environment = os.environ | {"MINARI_DATASETS_PATH": str(datasets.absolute())}
    return timed_process(str(script), [sys.executable, str(script), *map(str, words)], env=environment)[1]


def row_of(each: Mapping[str, Any]) -> list[str]:
    rates = each["sealed"][SOLVED][each["player"]]
    shown = [interval_text(rates[key]) for key in ("once", "best")]
    return [each["way"], str(each["seed"]), f"{each['core_seconds']:,.0f}", *shown]

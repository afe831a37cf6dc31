"""The presets of the distribution: a sheet of each, and how many of their levels need no expert.

python -m benchmarks.families [--levels 2000] [--sheets docs] [--write docs/levels.md]
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.document import between_marks
from configs.compose import compose_job, distributions
from experts.before import facts_of
from levelgen.level import SIZES
from levelgen.pictures.raster import write_png
from levelgen.proofs import Proof
from levelgen.sampling.sampler import Distribution, sample_levels
from levelgen.task.rules import DEFAULT_RULES
from pipeline.look.sample import LEVELS, sheet_of
from pipeline.runtime import prepare_jax

SHEET_SIZE = "l"
MARK = "families"


def shares(distribution: Distribution, size: str, count: int) -> tuple[float, float, float]:
    """Of levels that are trivial, that doing nothing fails, and that are proved unsolvable."""
    facts = facts_of(sample_levels(np.arange(count), SIZES[size], distribution), DEFAULT_RULES)
    return facts.reaches.mean(), facts.fails.mean(), (facts.proof != Proof.NONE).mean()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.families", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--levels", type=int, default=2_000, help="levels a size and preset (default: 2,000)")
    parser.add_argument("--sheets", type=Path, help="folder for the sheets, levels-NAME.png")
    parser.add_argument("--write", type=Path, help="document to put the table into, between its marks")
    given = parser.parse_args()
    prepare_jax()
    head = "".join(f" {size}: trivial | fails | unsolvable |" for size in SIZES)
    lines = [f"| distribution |{head}", f"|---{'|---|---|---' * len(SIZES)}|"]
    for name, distribution in distributions().items():
        if given.sheets:
            job = compose_job([f"size={SHEET_SIZE}", f"distribution={name}", f"levels={LEVELS}"])
            write_png(sheet_of(job), given.sheets / f"levels-{name}.png")
        cells = "".join(f" {share:.1%} |" for size in SIZES for share in shares(distribution, size, given.levels))
        lines.append(f"| `{name}` |{cells}")
        print(lines[-1], flush=True)
    if given.write:
        given.write.write_text(between_marks(given.write.read_text(), MARK, "\n".join(lines)))


if __name__ == "__main__":
    main()

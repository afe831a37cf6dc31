"""Make levels.json: hashes of the bits of random levels, ids from 0 on, in chunks of CHUNK.

Run from the root of the repository after the sampler's arithmetic has changed, and increment SAMPLER_VERSION:

    python -m tests.golden.make_levels
"""

import json

from levelproof.configs.compose import distributions
from levelproof.levelgen.level import SIZES
from tests.golden.load import HERE
from tests.levelgen.sampling.bits import COUNT, digests

FILE = HERE / "levels.json"


def main() -> None:
    made = {f"{size}/{preset}": digests(size, preset, COUNT) for size in SIZES for preset in distributions()}
    FILE.write_text(json.dumps(made, indent=1) + "\n")
    print(f"{FILE}: {COUNT} levels of each of {len(made)} distributions")


if __name__ == "__main__":
    main()

"""Draws docs/solved.png: solved levels of a split, each at the moment its witness reaches the goal.

levelproof generate size=l levels=24 budget=64k
python docs/make_solved.py data/64k/l 0 4 5 11 19 20
"""

import sys
from pathlib import Path

from levelgen.pictures.raster import rasterised, sheet, write_png
from pipeline.look.show import film_of

COLUMNS = 3
PIXELS = 260  # width of one level's picture


def main(split: Path, level_ids: list[int]) -> None:
    last = [rasterised(film_of(split, level_id).scenes[-1], PIXELS) for level_id in level_ids]
    write_png(sheet(last, COLUMNS), Path(__file__).parent / "solved.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), list(map(int, sys.argv[2:])))

"""Draw docs/solved-SIZE.png: the first solved levels of a split, each when its witness reaches the goal.

levelproof generate size=s levels=96 budget=64k
python docs/make_sheets.py data/64k/s
"""

import sys
from pathlib import Path

from levelproof.experts.labels import Label
from levelproof.levelgen.pictures.raster import rasterise, sheet, write_png
from levelproof.pipeline.look.show import film_of
from levelproof.pipeline.store.manifest import read_manifest

LEVELS, COLUMNS = 10, 5
PIXELS = 220  # width of a level's picture


def main(split: Path) -> None:
    manifest = read_manifest(split, ["label"])
    solved = manifest.level_ids[manifest.labels == Label.SOLVED][:LEVELS]
    pictures = [rasterise(film_of(split, int(level_id)).scenes[-1], PIXELS) for level_id in solved]
    write_png(sheet(pictures, COLUMNS), Path(__file__).with_name(f"solved-{split.name}.png"))


if __name__ == "__main__":
    for name in sys.argv[1:]:
        main(Path(name))

"""Draw docs/solved.webp: solved levels of a split playing their witnesses, until all have reached the goal.

levelproof generate size=l levels=96 budget=64k
python docs/make_solved.py data/64k/l 66 32 76 88 83 89
"""

import sys
from pathlib import Path

from levelproof.levelgen.pictures.raster import rasterise, sheet
from levelproof.pipeline.look.show import film_of

COLUMNS = 3
PIXELS = 260  # width of a level's picture
REST = 1.5  # s that the film rests on its last frame
FILM = Path(__file__).with_name("solved.webp")


def main(split: Path, level_ids: list[int]) -> None:
    films = [film_of(split, level_id) for level_id in level_ids]
    pictures = [[rasterise(scene, PIXELS) for scene in film.scenes] for film in films]
    frames = [
        sheet([film[min(frame, len(film) - 1)] for film in pictures], COLUMNS)
        for frame in range(max(map(len, pictures)))
    ]
    durations = [round(1000 * films[0].seconds[0])] * len(frames)  # ms
    durations[-1] = round(1000 * REST)
    frames[0].save(FILM, save_all=True, append_images=frames[1:], duration=durations, loop=0, quality=30, method=6)


if __name__ == "__main__":
    main(Path(sys.argv[1]), list(map(int, sys.argv[2:])))

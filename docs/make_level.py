"""Draw docs/concepts-level.svg: a level with its parts labelled.

python docs/make_level.py
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from levelproof.levelgen.edit import add_body, add_joint, add_thruster, bind, fix, resize, set_role
from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.pictures.scene import scene_of
from levelproof.levelgen.pictures.shapes import Part, Point, line, text
from levelproof.levelgen.pictures.style import INK
from levelproof.levelgen.pictures.svg import svg_of
from levelproof.levelgen.pictures.words import Caption
from levelproof.pipeline.play.session import empty_file
from levelproof.pipeline.runtime import prepare_jax

DRAWING = Path(__file__).with_name("concepts-level.svg")
ACTION = np.array([1, 0, 0, 0, 1, 0])
LETTER = 0.15  # m; height of a label's letters
BODIES = (  # shape, centre in m, scale factor, role
    ("rectangle", (1.45, 1.05), 1.7, Role.GREEN),
    ("circle", (1.2, 0.72), 1.1, Role.PLAIN),
    ("circle", (1.7, 0.72), 1.1, Role.PLAIN),
    ("circle", (4.3, 2.05), 1.3, Role.BLUE),
    ("rectangle", (4.2, 1.35), 1.6, Role.PLAIN),
    ("triangle", (3.0, 0.7), 1.2, Role.RED),
)
LABELS: tuple[tuple[str, Point, Point, Point], ...] = (  # text, its position, start and end of the line to the part
    ("thruster: pushes along its nozzle", (0.25, 2.15), (0.9, 2.05), (1.08, 1.2)),
    ("green: must touch blue", (2.05, 1.78), (2.0, 1.74), (1.7, 1.4)),
    ("motor", (2.06, 1.1), (2.02, 1.05), (1.77, 0.83)),
    ("red: ends the episode", (2.3, 1.4), (3.0, 1.3), (3.0, 1.0)),
    ("blue: the goal", (3.6, 2.85), (4.2, 2.75), (4.3, 2.25)),
    ("cannot move: hatched", (3.42, 0.7), (4.2, 0.8), (4.2, 1.05)),
)


def level() -> Level:
    one = empty_file("l").level
    for shape, (x, y), factor, role in BODIES:
        one = add_body(one, shape, x, y)
        body = int(np.flatnonzero((one.state.position[..., 0] == np.float32((x, y))).all(-1))[0])
        one = set_role(resize(one, body, factor), body, role)
        if role == Role.PLAIN and shape == "rectangle":
            one = fix(one, body, True)
    one = add_joint(add_joint(one, 1.2, 0.78), 1.7, 0.78)
    return add_thruster(bind(one, "joint", 1, 0), 1.12, 1.1, 0.0)


def main() -> None:
    prepare_jax()
    one = level()
    scene = scene_of(one, one.state, action=ACTION, caption=Caption("a level, under an action"))
    labels = "".join(
        line([start, end], INK, 0.012) + text(position, words, INK, LETTER) for words, position, start, end in LABELS
    )
    labelled = replace(scene, title="A level and what it is made of", parts=(*scene.parts, Part(labels)))
    DRAWING.write_text(svg_of([labelled], [1.0]), encoding="utf-8")


if __name__ == "__main__":
    main()

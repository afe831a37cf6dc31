"""The text of a picture: title, badge and clock above the world, the keys of an action below it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from levelproof.levelgen.level import MOTOR_BINDINGS, WORLD_SIDE, Level, Role
from levelproof.levelgen.pictures import style
from levelproof.levelgen.pictures.shapes import Part, disc, rectangle, text, text_width

ELLIPSIS = "…"


@dataclass(frozen=True)
class Caption:
    """The text above the world."""

    title: str = ""  # left; shortened to fit
    clock: str = ""  # right
    outcome: str = ""  # a badge in the middle
    good: bool = True  # whether the badge has the colour of success


def caption_parts(caption: Caption) -> list[Part]:
    """Draw title, clock and badge, one part each."""
    middle, size = WORLD_SIDE + style.BORDER + style.HEADER / 2, style.CAPTION_SIZE
    left, right = 0.04, WORLD_SIDE - 0.04
    title, clock, outcome = (printable(words) for words in (caption.title, caption.clock, caption.outcome))
    badge = text_width(outcome, size) + 0.3 if outcome else 0.0
    title = _fitted(title, right - left - badge - text_width(clock, size) - 0.1, size)
    shapes = ""
    if outcome:
        start = left + (text_width(title, size) + 0.2 if title else 0.09)
        end = start + text_width(outcome, size)
        colour = style.ROLE_COLOUR[Role.GREEN] if caption.good else style.ROLE_COLOUR[Role.RED]
        shapes = rectangle((start - 0.09, middle - 0.12), (end + 0.09, middle + 0.12), colour, corner=0.1)
        shapes += text((start, middle), outcome, style.PAPER, size)
    return [
        Part(text((left, middle), title, style.INK, size) if title else ""),
        Part(text((right, middle), clock, style.MUTED, size, ends=True) if clock else ""),
        Part(shapes),
    ]


def printable(words: str) -> str:
    """Replace unprintable characters, which file names may contain, by question marks."""
    return "".join(letter if letter.isprintable() else "?" for letter in words)


def _fitted(words: str, room: float, size: float) -> str:
    """Shorten words at the end until they fit into `room`, m."""
    if text_width(words, size) <= room:
        return words
    while words and text_width(words + ELLIPSIS, size) > room:
        words = words[:-1]
    return words.rstrip() + ELLIPSIS


def key_parts(level: Level, action: Int[np.ndarray, "6"]) -> list[Part]:
    """Draw a key for each entry that some actuator obeys, lit in its binding's colour while it is pressed."""
    middle, left, parts = -style.FOOTER / 2, 0.04, []
    for entry in obeyed_entries(level):
        is_motor = entry < MOTOR_BINDINGS
        name = f"M{entry + 1}" if is_motor else f"T{entry - MOTOR_BINDINGS + 1}"
        state = ("off", "forward" if is_motor else "on", "back")[int(action[entry])]
        lit, colour = int(action[entry]) != 0, style.BINDING_COLOUR[entry]
        key = disc((left + 0.07, middle), 0.07, colour if lit else style.PAPER, colour)
        parts.append(
            Part(key + text((left + 0.2, middle), f"{name} {state}", style.INK if lit else style.MUTED, style.KEY_SIZE))
        )
        left += 0.2 + text_width(f"{name} forward", style.KEY_SIZE) + 0.06
    return parts


def obeyed_entries(level: Level) -> list[int]:
    """Return the action entries of ONE level (no lane axis) that some motor or thruster obeys."""
    model = level.model
    motor = model.joint_active & ~model.joint_fixed & model.motor_on & ~level.motor_auto
    motors = {int(binding) for binding in level.motor_binding[motor]}
    thrusters = {MOTOR_BINDINGS + int(binding) for binding in level.thruster_binding[model.thruster_active]}
    return sorted(motors | thrusters)

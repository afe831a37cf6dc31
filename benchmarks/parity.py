"""How far one physics step of ours is from the reference's, and whether rounding explains what is off.

    python -m benchmarks.parity [--padding] [FILE.npz ...]

FILES are golden states (tests/golden/make_golden.py makes more of them with another --seed); without any, the
committed ones. For each state that is off by OFF or more, the step is taken again from COPIES neighbours of the
state, every float of it moved by at most one unit in its last place: where our own results spread as far as the
reference's is away, no engine in single precision can be asked for more. The table of docs/physics.md.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np

from physics.step import step
from physics.types import Params
from tests.golden.load import HERE, Golden, load

MOTION = ("position", "rotation", "velocity", "angular_velocity")
REMEMBERED = ("contact_normal_impulse", "contact_tangent_impulse", "joint_impulse", "joint_angular_impulse")
OFF = 1e-4
COPIES = 256
BROKEN = 1e6  # rad or m; a world with such numbers has broken down
LIMITS = (1e-6, 1e-5, 1e-4, 1e-3)


def main() -> None:
    parser = argparse.ArgumentParser(description="Distance of one physics step from the reference's.")
    parser.add_argument("files", nargs="*", type=Path, default=[HERE / f"{size}.npz" for size in "sml"])
    parser.add_argument("--padding", action="store_true", help="compare with and without the padding defect")
    given = parser.parse_args()
    if given.padding:
        padding(given.files)
    else:
        parity(given.files)


def stepper(params: Params):
    return jax.jit(lambda model, state, motor, thrust: step(model, state, motor, thrust, params)[0])


def take(compiled, of: Golden):
    return jax.tree.map(np.asarray, compiled(of.level.model, of.state, of.motor, of.thrust))


def row(*cells) -> None:
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def parity(files: list[Path]) -> None:
    head = ["size", "states", *(f"within {limit:.0e}" for limit in LIMITS), "median", "largest", "other contacts"]
    row(*head)
    row(*["---"] * len(head))
    notes = []
    for path in files:
        of, compiled = load(path), stepper(Params())
        ours = take(compiled, of)
        worst = errors(ours, of.after)
        shares = [f"{(worst < limit).mean():.2%}" for limit in LIMITS]
        contacts = int((ours.contact_active != of.after.contact_active).any(0).sum())
        row(of.about["size"], len(worst), *shares, f"{np.median(worst):.1e}", f"{worst.max():.1e}", contacts)
        notes += [
            f"{path.name} state {lane} ({of.scene[lane]}): off by {worst[lane]:.1e}, {verdict}"
            for lane, verdict in explain(compiled, of, np.flatnonzero(worst >= OFF))
        ]
    print("", *notes, sep="\n")


def padding(files: list[Path]) -> None:
    head = ["size", "states", f"differ by {OFF:.0e}", "by 1e-2", "largest difference"]
    row(*head)
    row(*["---"] * len(head))
    for path in files:
        of = load(path)
        apart = errors(take(stepper(Params()), of), take(stepper(Params(faithful_padding=False)), of))
        row(of.about["size"], len(apart), (apart > OFF).sum(), (apart > 1e-2).sum(), f"{apart.max():.1g}")


def errors(ours, theirs) -> np.ndarray:
    """Largest difference of any place or speed, by lane."""
    gaps = [np.abs(getattr(ours, name) - getattr(theirs, name)) for name in MOTION]
    return np.nan_to_num(np.max([gap.reshape(-1, gap.shape[-1]).max(0) for gap in gaps], 0), nan=np.inf)


def explain(compiled, of: Golden, lanes: np.ndarray):
    """(lane, what neighbours of its state give)."""
    rng = np.random.default_rng(0)
    for lane in lanes:
        if max(np.abs(getattr(of.after, name)[..., lane]).max() for name in MOTION) > BROKEN:
            yield lane, "the world has broken down"
            continue
        copy = lambda x, lane=lane: np.repeat(np.asarray(x)[..., [lane]], COPIES, -1)
        model, state = jax.tree.map(copy, (of.level.model, of.state))
        state = dataclasses.replace(state, **{name: nudged(getattr(state, name), rng) for name in MOTION + REMEMBERED})
        after = jax.tree.map(np.asarray, compiled(model, state, copy(of.motor), copy(of.thrust)))
        goal = jax.tree.map(copy, of.after)
        apart = [getattr(after, name) for name in MOTION]
        spread = max(float((x.max(-1) - x.min(-1)).max()) for x in apart)
        nearest, missed = errors(after, goal).min(), errors(after, goal)[0]
        told = "rounding" if missed <= spread or nearest < OFF else "NOT EXPLAINED"
        yield lane, f"neighbours spread over {spread:.1e}, the nearest is off by {nearest:.1e}: {told}"


def nudged(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each number at one of its neighbours or where it was; zeros and the first copy stay."""
    towards = np.where(rng.random(values.shape) < 0.5, -np.inf, np.inf).astype(np.float32)
    moved = np.where(rng.random(values.shape) < 2 / 3, np.nextafter(values, towards), values)
    moved = np.where(values == 0, values, moved)
    moved[..., 0] = values[..., 0]
    return moved.astype(np.float32)


if __name__ == "__main__":
    main()

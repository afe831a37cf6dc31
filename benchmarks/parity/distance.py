"""Differences of one physics step between our engine and the reference, field by field."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from benchmarks.parity.engines import Stepped
from benchmarks.parity.worlds import contact_bodies
from levelproof.levelgen.level import Level
from levelproof.physics.types import State

OFF = 1e-3  # a state with a larger difference is investigated
MOTION = ("position", "rotation", "velocity", "angular_velocity")
CONTACT_IMPULSES = ("contact_normal_impulse", "contact_tangent_impulse")
JOINT_IMPULSES = ("joint_impulse", "joint_angular_impulse")
GEOMETRY = ("normal", "penetration", "point")
UNITS = {
    "position": "m",
    "rotation": "rad",
    "velocity": "m/s",
    "angular_velocity": "rad/s",
    **dict.fromkeys((*CONTACT_IMPULSES, *JOINT_IMPULSES), "relative"),
    "normal": "1",
    "penetration": "m",
    "point": "m",
    "control": "1",
}


class Distances(NamedTuple):
    """Largest difference of each field in each lane, and the number of contacts active in one engine only."""

    by_field: dict[str, Float[np.ndarray, " lane"]]
    contacts: Float[np.ndarray, " lane"]

    @property
    def motion(self) -> Float[np.ndarray, " lane"]:
        """Largest difference of any position or speed."""
        return np.max([self.by_field[name] for name in MOTION], 0)

    @property
    def off(self) -> Bool[np.ndarray, " lane"]:
        """States to investigate: numbers or contacts that the next step starts from differ."""
        evolving = [self.by_field[name] for name in (*MOTION, *CONTACT_IMPULSES, *JOINT_IMPULSES)]
        return (np.max(evolving, 0) > OFF) | (self.contacts > 0)


def distances(level: Level, ours: Stepped, theirs: Stepped) -> Distances:
    """Compare both engines after a step of these levels.

    Geometry counts for contacts that act in both engines; control counts for active actuators.
    """
    fields = {name: largest(gap) for name, gap in evolving_gaps(ours.state, theirs.state).items()}
    both = ours.state.contact_active & theirs.state.contact_active & level.model.collides[contact_bodies(level.size)]
    for name in GEOMETRY:
        apart = gap(getattr(ours, name), getattr(theirs, name))
        fields[name] = largest(np.where(both if apart.ndim == both.ndim else both[:, None], apart, 0))
    acting = np.concatenate([level.model.joint_active, level.model.thruster_active])
    fields["control"] = largest(np.where(acting, gap(ours.control, theirs.control), 0))
    return Distances(fields, np.asarray(ours.state.contact_active != theirs.state.contact_active).sum(0))


def evolving_gaps(ours: State, theirs: State) -> dict[str, Float[np.ndarray, "... lane"]]:
    """Compare every number that evolves, in UNITS; the lanes of either may broadcast.

    Impulses of contacts that do not touch are ignored: the reference leaves old numbers there.
    """
    gaps = {name: gap(getattr(ours, name), getattr(theirs, name)) for name in MOTION}
    touching = ours.contact_active | theirs.contact_active
    for name in (*CONTACT_IMPULSES, *JOINT_IMPULSES):
        reference = getattr(theirs, name)
        apart = gap(getattr(ours, name), reference) / (1 + np.abs(np.nan_to_num(reference)))
        gaps[name] = np.where(touching, apart, 0) if name in CONTACT_IMPULSES else apart
    return gaps


def gap(a: ArrayLike, b: ArrayLike) -> Float[np.ndarray, "..."]:
    """Return |a - b|: 0 where both are NaN, infinite where only one is."""
    a, b = np.asarray(a), np.asarray(b)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(same, 0, np.nan_to_num(np.abs(a - b), nan=np.inf, posinf=np.inf))


def largest(values: np.ndarray) -> Float[np.ndarray, " lane"]:
    """Return the maximum of each lane; 0 for empty arrays."""
    return values.reshape(-1, values.shape[-1]).max(0, initial=0)

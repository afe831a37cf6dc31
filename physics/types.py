"""Types of the engine: what is constant within a level (Model) and what evolves (State).

The engine knows bodies, joints and thrusters. It knows nothing of goals, roles or rewards.

Layout: a batch of simulated environments, the *lanes*, is the LAST axis of every array, so that each
operation is one dense loop over lanes. Bodies are numbered polygons first, then circles; polygons
`0 .. FIXED_POLYGONS - 1` are the scenery (floor, left wall, right wall, ceiling) and never move.

Units: metres, radians, seconds, kilograms. Facts about the reference are those of Jax2D 1.0.1
(`jax2d.sim_state`).
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Float, Int

from levelproof.physics.bounds import require

FIXED_POLYGONS = 4  # floor, left wall, right wall, ceiling; pairs among them are never tested
MAX_VERTICES = 4  # of a polygon; a triangle leaves its fourth vertex unused
SOLVER_BATCH = 16  # pairs that read the same velocities; the reference's result depends on it
SOLVER_ITERATIONS = 10  # fewer: stacks sag and chains stretch; more: slower, and no longer the reference's result
MIN_DT, MAX_DT = 1e-6, 1  # s
MAX_CONSTANT = 1e6  # upper bound of every constant in Params: above useful values, and products stay finite in float32


class Size(NamedTuple):
    """Capacity of a world: the number of bodies, joints and thrusters it has room for. Static: decides array shapes."""

    polygons: int  # the fixed ones included
    circles: int
    joints: int
    thrusters: int

    @property
    def bodies(self) -> int:
        return self.polygons + self.circles


@dataclass(frozen=True)
class Params:
    """Constants of the engine (hashable: pass as a static argument). Defaults: `SimParams` of Jax2D 1.0.1."""

    dt: float = 1 / 60  # s; larger: faster and less stable
    slop: float = 0.01  # m of penetration that contacts tolerate; larger: visible overlap, smaller: jitter
    contact_bias: float = 0.2  # share of the penetration beyond the slop undone per step; near 1: bodies jump apart
    joint_bias_velocity: float = 2.0  # 1/s; pull of a joint's ends towards each other; larger: stiffer, then unstable
    joint_bias_position: float = 0.7  # share of the gap closed per solver iteration; above 1: overshoots
    fixed_joint_bias: float = 2.0  # 1/s; pull of a fixed joint to its angle
    joint_limit_bias: float = 5.0  # 1/s; pull of a joint back within its limits
    joint_stiffness: float = 0.6  # share of the joint impulse applied per solver iteration; near 1: chains oscillate
    max_position: float = 15.0  # m from 0 on each axis, within which bodies are kept; below 10.2, the ceiling sinks
    max_velocity: float = 100.0  # m/s, limit on each axis in either direction
    max_angular_velocity: float = 50.0  # rad/s, limit in either direction
    motor_speed: float = 6.0  # rad/s; target speed of a motor whose speed is 1
    motor_power: float = 900.0  # N m per kg m^2; largest torque of a motor whose power is 1
    motor_decay: float = 0.1  # s/rad; steepness of a motor's speed control
    motor_limit_zone: float = 0.1  # rad; distance from a joint limit within which a motor weakens
    thruster_power: float = 10.0  # N; force of a thruster whose power is 1
    base_friction: float = 0.4  # factor on the friction of every body
    faithful_padding: bool = True  # reproduce the reference's padding defect, see docs/physics.md

    def __post_init__(self) -> None:
        require(self, [field.name for field in fields(self) if field.type is float], 0, MAX_CONSTANT)
        require(self, ("dt",), MIN_DT, MAX_DT)


DEFAULT_PARAMS = Params()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Model:
    """Everything that is constant within a level. Lanes are the last axis of every field (size 1 broadcasts)."""

    gravity: Float[Array, "2 lane"]  # m/s^2
    # bodies: polygons, then circles
    active: Bool[Array, "body lane"]
    inverse_mass: Float[Array, "body lane"]  # 1/kg; 0: immovable
    inverse_inertia: Float[Array, "body lane"]  # 1/(kg m^2)
    friction: Float[Array, "body lane"]
    restitution: Float[Array, "body lane"]
    collision_mode: Int[Array, "body lane"]  # 2 meets everything, else the product must be > 0
    collides: Bool[Array, "body body lane"]  # False for bodies that joints hold together
    vertices: Float[Array, "polygon vertex 2 lane"]  # clockwise, around the centroid
    n_vertices: Int[Array, "polygon lane"]  # 3 or 4
    radius: Float[Array, "circle lane"]
    # joints
    joint_active: Bool[Array, "joint lane"]
    joint_a: Int[Array, "joint lane"]  # index of its first body
    joint_b: Int[Array, "joint lane"]  # index of its second body
    joint_anchor_a: Float[Array, "joint 2 lane"]  # in the frame of body a
    joint_anchor_b: Float[Array, "joint 2 lane"]
    joint_fixed: Bool[Array, "joint lane"]  # else revolute
    joint_rotation: Float[Array, "joint lane"]  # rad; resting angle of b relative to a
    joint_limited: Bool[Array, "joint lane"]
    joint_min: Float[Array, "joint lane"]  # rad
    joint_max: Float[Array, "joint lane"]
    motor_on: Bool[Array, "joint lane"]
    motor_speed: Float[Array, "joint lane"]  # as a multiple of Params.motor_speed
    motor_power: Float[Array, "joint lane"]  # as a multiple of Params.motor_power
    # thrusters
    thruster_active: Bool[Array, "thruster lane"]
    thruster_body: Int[Array, "thruster lane"]
    thruster_position: Float[Array, "thruster 2 lane"]  # in the frame of the body
    thruster_rotation: Float[Array, "thruster lane"]  # rad, relative to the body
    thruster_power: Float[Array, "thruster lane"]  # as a multiple of Params.thruster_power

    @property
    def size(self) -> Size:
        return Size(
            self.vertices.shape[0], self.radius.shape[0], self.joint_active.shape[0], self.thruster_active.shape[0]
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """Everything that evolves: enough to resume the simulation bit for bit. `pairs` defines the order of contacts."""

    position: Float[Array, "body 2 lane"]  # m, of the centroid
    rotation: Float[Array, "body lane"]  # rad
    velocity: Float[Array, "body 2 lane"]  # m/s
    angular_velocity: Float[Array, "body lane"]  # rad/s
    contact_active: Bool[Array, "contact lane"]  # in the last step's manifolds
    contact_normal_impulse: Float[Array, "contact lane"]  # N s, accumulated over the last step
    contact_tangent_impulse: Float[Array, "contact lane"]
    joint_impulse: Float[Array, "joint 2 lane"]  # N s, accumulated (never reset by the reference)
    joint_angular_impulse: Float[Array, "joint lane"]  # N m s; fixed joints only


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Manifold:
    """The contacts of one step, all zero where not active."""

    active: Bool[Array, "contact lane"]
    normal: Float[Array, "contact 2 lane"]  # from the pair's first body to its second
    penetration: Float[Array, "contact lane"]  # m
    point: Float[Array, "contact 2 lane"]  # m, in the world
    restitution_velocity: Float[Array, "contact lane"]  # m/s along the normal: approach (negative) times restitution

"""The distribution of random levels: every number that the sampler uses.

The defaults are the random-level distribution of the reference, Kinetix 3.0.2. The comment on each field names its
source: [name] is a field of the reference's `UEDParams`; (module.function) is the function of `kinetix.environment.ued`
whose code contains the number.
"""

import math
from dataclasses import dataclass, fields

from levelproof.levelgen.level import HALF_WORLD
from levelproof.physics.bounds import require

# m, from a free body's centre to its farthest point: green and blue may each have to fit into one half of the world
MAX_REACH = HALF_WORLD / 2
MAX_NUMBER = 1_000_000  # of any float: far from where single precision overflows
MAX_COUNT = 10**9  # of any integer
MAX_PROPOSALS = 1000
CONTROL_WEIGHTS = ("motor_only_weight", "thruster_only_weight", "motor_and_thruster_weight")


@dataclass(frozen=True)
class Distribution:
    """A distribution over levels (hashable: pass as a static argument).

    `*_chance` are probabilities; `*_weight` are relative to one another.

    Raises:
        ValueError: a value is out of range; the message starts with the field's name.
    """

    # The floor's role (plain otherwise)
    floor_green_chance: float = 0.0  # chance that the floor is green [floor_prob_green]
    floor_blue_chance: float = 0.02  # chance that the floor is blue [floor_prob_blue]
    floor_red_chance: float = 0.08  # chance that the floor is red [floor_prob_red]

    # Shapes
    max_size: float = 1.0  # m, across a shape before lengthening [max_shape_size]
    goal_size_factor: float = 1.0  # multiplies max_size for free green and blue bodies [goal_body_size_factor]
    min_half_side: float = 0.05  # m, smallest half side of a rectangle (util.sample_dimensions)
    min_radius: float = 0.1  # m, smallest radius of a circle (util.sample_dimensions)
    circle_size_factor: float = 0.8  # multiplies max_size for circles [circle_max_size_coeff]
    long_side_chance: float = 0.3  # chance that one side of a rectangle is lengthened [large_rect_dim_chance]
    long_side_factor: float = 2.0  # factor by which a rectangle's long side is lengthened [large_rect_dim_scale]

    # Free bodies
    opposite_sides_chance: float = 0.5  # chance that green starts left and blue right [goal_body_opposide_side_chance]
    fixed_chance: float = 0.02  # chance that a body is fixed at mass 0; grows with mass [fixate_chance_min]
    fixed_chance_per_mass: float = 4.0  # 1/kg; this times the mass is added to fixed_chance [fixate_chance_scale]
    max_fixed_chance: float = 1.0  # upper bound on the chance that a body is fixed [fixate_chance_max]
    lowered_chance: float = 0.0  # chance that a fixed body in the upper half is lowered [fixate_shape_bottom_bias]
    goal_lowered_chance: float = 0.6  # added to lowered_chance if not plain [fixate_shape_bottom_bias_special_role]
    red_weight: float = 1 / 3  # weight of red as a new body's role while none is red; that of plain: 1 (util.get_role)

    # Required actuators; kinds that a size has no room for are left out (distributions.sample_kinetix_level)
    motor_only_weight: float = 1.0  # weight of levels that require a motor
    thruster_only_weight: float = 1.0  # weight of levels that require a thruster
    motor_and_thruster_weight: float = 1.0  # weight of levels that require both

    # Connected bodies
    connected_circle_chance: float = 0.5  # chance of a circle if both kinds fit (mutators.mutate_add_connected_shape)
    fixed_target_weight: float = 0.05  # weight of a fixed body as partner; others: 1 [connect_to_fixated_prob_coeff]
    polygon_connections: int = 2  # maximum joints per polygon until all are full (mutators.mutate_add_connected_shape)
    min_revolute_joints: int = 2  # no joint is fixed before this many are revolute [min_rjoints_bias]
    fixed_joint_chance: float = 0.5  # chance that a later joint is fixed (mutators.mutate_add_connected_shape)
    visible_margin: float = 0.05  # m that a body must reach beyond its partner at some angle [connect_visibility_min]
    hidden_penalty: float = 10.0  # contacts added if a proposal misses visible_margin [connect_no_visibility_bias]

    # Motors
    motor_chance: float = 0.8  # chance that a revolute joint's motor is on [motor_on_chance]
    min_motor_speed: float = 0.4  # slowest, as a multiple of task.physics.motor_speed [motor_min_speed]
    max_motor_speed: float = 3.0  # fastest, as a multiple of task.physics.motor_speed [motor_max_speed]
    min_motor_power: float = 1.0  # weakest, as a multiple of task.physics.motor_power [motor_min_power]
    max_motor_power: float = 3.0  # strongest, as a multiple of task.physics.motor_power [motor_max_power]
    max_wheel_power: float = 1.0  # strongest if it drives a circle: stronger wheels are unstable [wheel_max_power]
    limit_chance: float = 0.4  # chance that a revolute joint of two polygons has limits [joint_limit_chance]
    max_limit: float = math.pi  # rad, widest limit of a joint, to either side [joint_limit_max]

    # Thrusters
    extra_thruster_chance: float = 0.3  # chance of each thruster after the first [add_thruster_chance]
    aligned_chance: float = 0.8  # chance that a thruster aims through its body's centre [thruster_align_com_prob]
    min_thruster_power: float = 0.5  # weakest, per unit of mass (mutators.mutate_add_thruster)
    max_thruster_power: float = 2.0  # strongest, per unit of mass (mutators.mutate_add_thruster)
    thruster_power_factor: float = 2.0  # multiplies the drawn power [thruster_power_multiplier]

    # Each body after the first three (green, blue and another)
    connected_weight: float = 0.35  # weight of adding a body joined to another [add_connected_shape_chance]
    free_weight: float = 0.35  # weight of adding a body without a joint [add_shape_chance]
    empty_weight: float = 0.3  # weight of adding none [add_no_shape_chance]
    proposals: int = 8  # proposals per body; the one with the fewest contacts is kept [add_shape_n_proposals]
    small_world: int = 7  # bodies; sizes up to this: one proposal, no fixed bodies (distributions.sample_kinetix_level)

    # Last
    swap_chance: float = 0.5  # chance of swapping green and blue on a plain floor (distributions.sample_kinetix_level)

    def __post_init__(self) -> None:
        names = [field.name for field in fields(self)]
        require(self, [name for name in names if name.endswith("_chance")], 0, 1)
        require(self, names, 0)  # the error of a negative number need not name a maximum
        for kind, most in (float, MAX_NUMBER), (int, MAX_COUNT):
            require(self, [field.name for field in fields(self) if field.type is kind], 0, most)
        require(self, ("proposals", "polygon_connections", "min_half_side", "min_radius"), 0, above=True)
        require(self, ("proposals",), 1, MAX_PROPOSALS)
        self._check_sums()
        for low, high in (
            ("min_motor_speed", "max_motor_speed"),
            ("min_motor_power", "max_motor_power"),
            ("min_motor_power", "max_wheel_power"),
            ("min_thruster_power", "max_thruster_power"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} is {getattr(self, low)}: it must be at most {high}, {getattr(self, high)}")
        self._check_shapes()

    def _check_sums(self) -> None:
        floor = self.floor_green_chance + self.floor_blue_chance + self.floor_red_chance
        if floor > 1 + 1e-6:
            raise ValueError(
                f"floor_red_chance is {self.floor_red_chance}: the floor's chances add up to {floor}, over 1"
            )
        for names in (("connected_weight", "free_weight", "empty_weight"), CONTROL_WEIGHTS):
            if not any(getattr(self, name) for name in names):
                raise ValueError(f"{names[-1]} is 0: set at least one of {names[0]}, {names[1]} and {names[2]} above 0")

    def _check_shapes(self) -> None:
        for name, factor in (("max_size", 1.0), ("goal_size_factor", self.goal_size_factor)):
            size = self.max_size * factor
            if size / 2 / math.sqrt(2) < self.min_half_side or size / 2 * self.circle_size_factor < self.min_radius:
                raise ValueError(
                    f"{name} is {getattr(self, name)}: shapes would be smaller than min_half_side or min_radius"
                )
            reach = size / 2 * max(1.0, self.long_side_factor, self.circle_size_factor)
            if reach > MAX_REACH:
                raise ValueError(
                    f"{name} is {getattr(self, name)}: shapes would reach {reach:.2f} m, over {MAX_REACH} m"
                )

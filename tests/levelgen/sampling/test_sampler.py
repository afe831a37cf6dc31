"""Random levels have the reference's statistics, and properties that hold for every level."""

import dataclasses
import hashlib
from functools import cache

import jax
import numpy as np
import pytest
from scipy import stats

from benchmarks.reference.level_statistics import statistics
from levelproof.configs.compose import distributions
from levelproof.levelgen.files.kinetix import state_to_kinetix
from levelproof.levelgen.level import SIZES, WORLD_SIDE, Level, Role
from levelproof.levelgen.sampling.distribution import Distribution
from levelproof.levelgen.sampling.overlap import WorldCircle, WorldPolygon, discs_touch, polygon_contacts, touch
from levelproof.levelgen.sampling.sampler import CHUNK, sample_levels, sampler
from levelproof.levelgen.sampling.scenery import FLOOR_TOP, empty_level
from levelproof.levelgen.sampling.shuffle import collision_matrix
from levelproof.levelgen.task.actions import action_mask
from levelproof.physics.pairs import pairs_of
from levelproof.physics.step import step
from levelproof.physics.trigonometry import cos_sin
from levelproof.physics.types import FIXED_POLYGONS, Size
from levelproof.physics.vector import Vec
from tests.golden.load import HERE, golden

COUNTS = {"s": 1024, "m": 1024, "l": 512}  # levels
MANY = {"s": 4096, "m": 4096, "l": 2048}  # in a campaign
MORE = pytest.mark.campaign
ROUND = Size(4, 3, 2, 2)  # no polygon but the scenery
CROWD = Size(7, 3, 1, 1)
SIGNIFICANT = 1e-3  # for all statistics of a size together
RARE = 10  # values that occur less often, in both samples together, are merged into one


@cache
def sampled(size: Size, count: int = COUNTS["s"], distribution: Distribution | None = None) -> Level:
    return jax.tree.map(np.asarray, sample_levels(np.arange(count), size, distribution or Distribution()))


@pytest.fixture(params=COUNTS)
def level(request: pytest.FixtureRequest) -> Level:
    return sampled(SIZES[request.param], COUNTS[request.param])


def summaries(level: Level) -> dict[str, np.ndarray]:
    lanes = level.role.shape[-1]
    return statistics(state_to_kinetix(level, level.state, np.zeros(lanes, np.int32), np.zeros(lanes, np.float32)))


def reference_statistics(size: str) -> dict[str, dict[str, np.ndarray]]:
    """Return {statistic: values and counts, or quantiles and count}."""
    read: dict[str, dict[str, np.ndarray]] = {}
    with np.load(HERE / "level_statistics.npz") as file:
        for path in file.files:
            if path.startswith(f"{size}/"):
                _, name, part = path.split("/")
                read.setdefault(name, {})[part] = file[path]
    return read


def p_value(ours: np.ndarray, theirs: dict[str, np.ndarray]) -> float:
    """Return the p-value of both samples having one distribution: chi-square of counts, or Kolmogorov-Smirnov."""
    ours = np.asarray(ours, np.float32)
    if "quantiles" in theirs:
        expected = np.linspace(0, 1, len(theirs["quantiles"]))
        counted = np.searchsorted(np.sort(ours), theirs["quantiles"], "right") / len(ours)
        count = 1 / (1 / len(ours) + 1 / theirs["counts"].item())
        return float(stats.kstwobign.sf(np.abs(counted - expected).max() * np.sqrt(count)))
    values = np.union1d(ours, theirs["values"])
    table = np.zeros((2, len(values)))
    table[0] = [(ours == value).sum() for value in values]
    table[1, np.searchsorted(values, theirs["values"])] = theirs["counts"]
    rare = table.sum(0) < RARE
    table = np.concatenate([table[:, ~rare], table[:, rare].sum(1, keepdims=True)], 1)
    table = table[:, table.sum(0) > 0]
    return float(stats.chi2_contingency(table)[1]) if table.shape[1] > 1 else 1.0


@pytest.mark.parametrize(
    ("size", "count"), [*COUNTS.items(), *(pytest.param(*item, marks=MORE) for item in MANY.items())]
)
def test_sampler_has_the_references_statistics(size: str, count: int) -> None:
    ours, theirs = summaries(sampled(SIZES[size], count)), reference_statistics(size)
    assert {name for name, values in ours.items() if len(values)} == set(theirs)
    p = {name: p_value(ours[name], theirs[name]) for name in theirs}
    assert len(p) >= 90
    worst = dict(sorted(p.items(), key=lambda item: item[1])[:5])
    assert min(p.values()) > SIGNIFICANT / len(p), f"differs from the reference: {worst}"


@MORE
@pytest.mark.parametrize(("chance", "count"), [(0.7, COUNTS["s"]), (0.75, MANY["s"])])
def test_statistics_notice_a_changed_distribution(chance: float, count: int) -> None:
    """Fewer than four motors in five are on; no other statistic changes."""
    changed = Distribution(motor_chance=chance)
    ours, theirs = summaries(sampled(SIZES["s"], count, changed)), reference_statistics("s")
    p = {name: p_value(ours[name], theirs[name]) for name in theirs}
    assert [name for name in p if p[name] < SIGNIFICANT / len(p)] == ["joint motor on"]


def test_content_of_levels_is_that_of_all_versions_so_far() -> None:
    """Bodies, roles, joints, thrusters of the first 64 levels: version 2 changed only the last digits of numbers."""
    digests = {}
    for name, size in SIZES.items():
        level, model = sampled(size, COUNTS[name]), sampled(size, COUNTS[name]).model
        whole = (model.active, level.role, model.joint_a, model.joint_b, model.joint_fixed, model.motor_on)
        whole += (model.thruster_body, level.motor_binding, level.thruster_binding, model.inverse_mass == 0)
        text = b"".join(np.asarray(values)[..., :64].astype(np.uint8).tobytes() for values in whole)
        digests[name] = hashlib.sha256(text).hexdigest()[:16]
    assert digests == {"s": "e8988f5977c671a4", "m": "13e88ef1ba1b54dc", "l": "9e8317e219c8246d"}


def test_sampler_takes_both_kinds_of_keys() -> None:
    draw = sampler("s")
    pairs = zip(*(jax.tree.leaves(draw(key(7))) for key in (jax.random.key, jax.random.PRNGKey)), strict=True)
    assert all((a == b).all() for a, b in pairs)


def test_sampler_returns_no_levels_for_no_ids() -> None:
    none = sample_levels(np.arange(0), SIZES["s"])
    assert none.role.shape == (SIZES["s"].bodies, 0)


def test_every_level_has_one_green_and_one_blue(level: Level) -> None:
    for role, most in ((Role.GREEN, 1), (Role.BLUE, 1), (Role.RED, 1)):
        count = (level.model.active & (level.role == role)).sum(0)
        assert count.max() == most
        assert role == Role.RED or count.min() == 1
    assert (level.role[1:FIXED_POLYGONS] == Role.PLAIN).all()


def test_green_or_blue_can_move(level: Level) -> None:
    goal = level.model.active & ((level.role == Role.GREEN) | (level.role == Role.BLUE))
    assert (goal & (level.model.inverse_mass > 0)).any(0).all()


def test_sampled_level_has_a_motor_or_thruster(level: Level) -> None:
    assert np.asarray(action_mask(level)).any(0).all()


def test_small_sizes_have_no_fixed_bodies() -> None:
    model = sampled(SIZES["s"], COUNTS["s"]).model
    assert (model.inverse_mass[FIXED_POLYGONS:] > 0)[model.active[FIXED_POLYGONS:]].all()


def test_free_bodies_lie_within_the_world(level: Level) -> None:
    """Bodies that no joint holds and that were not lowered lie within the world."""
    model, polygons, numbers = level.model, level.size.polygons, np.arange(level.size.bodies)[:, None, None]
    joined = ((model.joint_a == numbers) | (model.joint_b == numbers)) & model.joint_active
    free = model.active & (model.inverse_mass > 0) & ~joined.any(1)
    reach = np.concatenate([np.hypot(*np.moveaxis(model.vertices, 2, 0)).max(1), model.radius])
    x, y = np.moveaxis(level.state.position, 1, 0)
    assert free[:polygons].any()
    assert free[polygons:].any()
    slack = 1e-5
    for low, high in ((x - reach, x + reach), (y - reach - FLOOR_TOP, y + reach)):
        assert (low > -slack)[free].all()
        assert (high < WORLD_SIDE + slack)[free].all()


def test_unused_rows_are_blank(level: Level) -> None:
    model, unused = level.model, ~level.model.active
    assert (level.state.position[np.broadcast_to(unused[:, None], level.state.position.shape)] == 0).all()
    assert (level.role[unused] == Role.PLAIN).all()
    assert (model.inverse_mass[unused] == 0).all()
    assert (model.motor_power[~model.joint_active] == 0).all()
    assert (model.thruster_power[~model.thruster_active] == 0).all()
    for name in ("velocity", "angular_velocity", "contact_normal_impulse", "joint_impulse"):
        assert (getattr(level.state, name) == 0).all()


@pytest.mark.parametrize("size", SIZES)
def test_scenery_and_collision_matrix_equal_the_references(size: str) -> None:
    theirs = golden(size).level
    ours, lanes = empty_level(SIZES[size], theirs.role.shape[-1]), np.s_[:FIXED_POLYGONS]
    np.testing.assert_array_equal(jax.jit(collision_matrix)(theirs.model), theirs.model.collides)
    for name in ("vertices", "inverse_mass", "collision_mode", "active", "n_vertices"):
        np.testing.assert_array_equal(getattr(ours.model, name)[lanes], getattr(theirs.model, name)[lanes])
    for name in ("position", "rotation"):
        np.testing.assert_array_equal(getattr(ours.state, name)[lanes], getattr(theirs.state, name)[lanes])
    assert np.abs(np.asarray(ours.model.gravity) - [[0], [-9.81]]).max() < 1e-6


def test_count_contacts_agrees_with_the_engine() -> None:
    """The new body is the last polygon or the last circle."""
    level = sampled(SIZES["m"], COUNTS["m"])
    model, state, polygons = level.model, level.state, level.size.polygons
    controls = (np.zeros((len(x), state.rotation.shape[-1]), np.float32) for x in (model.joint_a, model.thruster_body))
    still = dataclasses.replace(model, gravity=np.zeros_like(model.gravity))
    pairs, active = pairs_of(level.size), np.asarray(jax.jit(step)(still, state, *controls)[1].active)
    kinds = (pairs.polygon, pairs.polygon, pairs.circle_polygon, pairs.circle)
    a, b = (np.concatenate([getattr(kind, end) for kind in kinds]) for end in "ab")
    for last in (polygons - 1, level.size.bodies - 1):
        there = model.active[last]
        expected = active[(a == last) | (b == last)].sum(0)
        counted = sum(contacts_of(level, last, i) for i in range(level.size.bodies) if i != last)
        assert expected[there].sum() > 100
        np.testing.assert_array_equal(np.asarray(counted)[there], expected[there])


def contacts_of(level: Level, i: int, j: int) -> np.ndarray:
    """Count the contacts of two bodies as the sampler does; 0 where j is not active."""
    bodies = [outline_at(level, k) if k < level.size.polygons else disc_at(level, k) for k in (i, j)]
    match bodies:
        case WorldPolygon() as a, WorldPolygon() as b:
            count = polygon_contacts(b, a)
        case (WorldPolygon() as polygon, WorldCircle() as disc) | (WorldCircle() as disc, WorldPolygon() as polygon):
            count = touch(polygon, disc)
        case _:
            count = discs_touch(*bodies)  # type: ignore[arg-type]
    return np.where(level.model.active[j], count, 0)


def outline_at(level: Level, i: int) -> WorldPolygon:
    x, y = np.moveaxis(level.model.vertices[i], 1, 0)
    turned = Vec(x, y).rotate(*cos_sin(level.state.rotation[i]))
    return WorldPolygon.of(turned + Vec(*level.state.position[i]))


def disc_at(level: Level, i: int) -> WorldCircle:
    return WorldCircle(Vec(*level.state.position[i]), level.model.radius[i - level.size.polygons])


@MORE
@pytest.mark.parametrize("size", [ROUND, Size(8, 0, 3, 0)], ids=str)
def test_sampler_serves_any_size(size: Size) -> None:
    assert_possible(sampled(size, CHUNK), size)


def assert_possible(level: Level, size: Size) -> None:
    model = level.model
    assert level.size == size
    assert model.active[:FIXED_POLYGONS].all()
    for role in (Role.GREEN, Role.BLUE):
        assert ((model.active & (level.role == role)).sum(0) == 1).all()
    assert np.asarray(action_mask(level)).any(0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(level))


@pytest.mark.parametrize("size", [Size(4, 1, 1, 1), Size(3, 4, 1, 1), Size(5, 2, -1, 0)], ids=str)
def test_sampler_refuses_sizes_without_room(size: Size) -> None:
    with pytest.raises(ValueError, match="leave no room for"):
        sample_levels(np.arange(1), size)


@pytest.mark.parametrize("level_id", [-1, 2**31])
def test_sampler_refuses_ids_out_of_range(level_id: int) -> None:
    with pytest.raises(ValueError, match="must be within 0 to 2147483647"):
        sample_levels(np.array([level_id]), SIZES["s"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motor_chance": 1.3}, "motor_chance is 1.3: it must be between 0 and 1"),
        ({"floor_red_chance": -0.1}, "floor_red_chance is -0.1: it must be between 0 and 1"),
        ({"hidden_penalty": -1.0}, "hidden_penalty is -1.0: it must be at least 0"),
        ({"hidden_penalty": 1e7}, "hidden_penalty is 10000000.0: it must be between 0 and 1000000"),
        ({"proposals": 0}, "proposals is 0: it must be above 0"),
        ({"proposals": 1001}, "proposals is 1001: it must be between 1 and 1000"),
        ({"polygon_connections": 0}, "polygon_connections is 0: it must be above 0"),
        ({"max_limit": float("nan")}, "max_limit is nan: it must be a finite number"),
        ({"max_motor_speed": 0.1}, "min_motor_speed is 0.4: it must be at most max_motor_speed, 0.1"),
        ({"connected_circle_chance": 2.0}, "connected_circle_chance is 2.0: it must be between 0 and 1"),
        ({"motor_only_weight": -1.0}, "motor_only_weight is -1.0: it must be at least 0"),
        (
            {"motor_only_weight": 0.0, "thruster_only_weight": 0.0, "motor_and_thruster_weight": 0.0},
            "motor_and_thruster_weight is 0: set at least one of motor_only_weight, thruster_only_weight and "
            "motor_and_thruster_weight above 0",
        ),
        ({"floor_blue_chance": 0.95}, "floor_red_chance is 0.08: the floor's chances add up to 1.03, over 1"),
        ({"max_size": 0.1}, "max_size is 0.1: shapes would be smaller than min_half_side or min_radius"),
        ({"max_size": 1.5}, "max_size is 1.5: shapes would reach 1.50 m, over 1.25 m"),
        ({"goal_size_factor": 2.0}, "goal_size_factor is 2.0: shapes would reach 2.00 m, over 1.25 m"),
    ],
)
def test_distribution_refuses_wrong_values_by_name(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match="is") as refused:
        Distribution(**changes)  # type: ignore[arg-type]
    assert str(refused.value) == message


@MORE
def test_required_actuators_follow_their_weights() -> None:
    """Here a thruster is always required, and a motor in three of four levels. Size s joins bodies only for a motor."""
    changed = Distribution(motor_only_weight=0.0, motor_and_thruster_weight=3.0)
    model = sampled(SIZES["s"], COUNTS["s"], changed).model
    assert model.thruster_active.any(0).all()
    assert abs(model.joint_active.any(0).mean() - 0.75) < 0.03


def crowd(floor: Role, wheels: float) -> Level:
    """Sample levels with a green or blue floor, the other goal, a body, and one joined to either of them.

    The joined one is a rectangle, or with chance `wheels` a circle on a rectangle.
    """
    never = ("thruster_only_weight", "connected_weight", "free_weight", "floor_red_chance", "floor_blue_chance")
    chances = dict.fromkeys(never, 0.0) | {f"floor_{floor.name.lower()}_chance": 1.0, "fixed_chance": 0.5}
    how = Distribution(connected_circle_chance=wheels, small_world=0, proposals=1, **chances)  # type: ignore[arg-type]
    return sampled(CROWD, CHUNK, how)


@pytest.mark.parametrize("chance", [pytest.param(0.0, marks=MORE), 1.0])
def test_connected_circles_follow_their_chance(chance: float) -> None:
    model = crowd(Role.GREEN, chance).model
    assert model.joint_active[0].all()
    circles = model.active[CROWD.polygons :].sum(0)
    assert circles.min() == chance  # among levels whose free bodies are rectangles


PRESETS = [pytest.param(name, marks=() if name == "vehicles" else MORE) for name in distributions()]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_have_their_described_effect(name: str) -> None:
    level = sampled(SIZES["m"], CHUNK, distributions()[name])
    model = level.model
    movable = np.s_[FIXED_POLYGONS:]
    there, fixed = model.active[movable], (model.inverse_mass == 0)[movable] & model.active[movable]
    says = {
        "kinetix": fixed.any() and model.motor_on.any() and model.thruster_active.any(),
        "free": not fixed.any(),
        "thrusters": not model.motor_on.any() and model.thruster_active.any(0).all(),
        "vehicles": model.motor_on[model.joint_active].all()
        and model.joint_active.any(0).all()
        and not model.thruster_active.any(),
        "clutter": there.all() and not fixed.any(),
        "obstacles": fixed.sum() > there.sum() / 2,
    }
    assert says[name]
    assert_possible(level, SIZES["m"])


@pytest.mark.parametrize("floor", [Role.GREEN, pytest.param(Role.BLUE, marks=MORE)])
def test_level_with_a_goal_floor_gets_the_other_goal_as_a_body(floor: Role) -> None:
    other, level = Role.GREEN + Role.BLUE - floor, crowd(floor, 1.0)
    assert_possible(level, CROWD)
    assert (level.role[0] == floor).all()
    body = level.model.active & (level.role == other)
    assert (body.sum(0) == 1).all()
    assert (level.model.inverse_mass > 0)[body].all()


@pytest.mark.campaign
@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Distribution)])
def test_every_number_of_the_distribution_has_an_effect(name: str) -> None:
    """A number in place of a setting that has the same default would have the reference's statistics, too."""
    default, sizes = Distribution(), [SIZES["s"], SIZES["l"]]  # some count in one of them only
    value = getattr(default, name)
    others = {"proposals": 2, "hidden_penalty": 0.0, "max_wheel_power": 2 * value}  # bounded below, or huge
    halved = 0.25 if value == 0 else value // 2 if isinstance(value, int) else value / 2
    changed = dataclasses.replace(default, **{name: others.get(name, halved)})
    assert any(
        (x != y).any()
        for size in sizes
        for x, y in zip(*(jax.tree.leaves(sampled(size, 256, each)) for each in (default, changed)), strict=True)
    )

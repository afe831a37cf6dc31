"""The content hash: the same for every numbering and naming of a level, different for any other level."""

import itertools
from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.levelgen.identity.content import content_hashes
from levelproof.levelgen.identity.form import NO_ENTRY, Push, Side, World, canonical_form
from levelproof.levelgen.identity.signature import signatures
from levelproof.levelgen.level import MOTOR_BINDINGS, SIZES, Level
from levelproof.levelgen.task.rules import TaskParams, reset, step
from tests.levelgen.variants import (
    COUNT,
    edited,
    idle_changed,
    more_room,
    names,
    one,
    renamed,
    renumbered,
    sampled,
    turned,
    weakened,
    with_names,
)

EXAMPLES = settings(max_examples=20, deadline=None)
ANY_LEVEL = st.tuples(st.sampled_from("sml"), st.integers(0, COUNT - 1))
SEED = st.integers(0, 2**32 - 1)
SOME = [*(pytest.param(size, marks=pytest.mark.campaign) for size in "sm"), "l"]  # l has everything
SAME = (renumbered, turned, renamed, more_room, idle_changed)


@pytest.mark.parametrize("change", SAME, ids=lambda change: change.__name__)
@EXAMPLES
@given(ANY_LEVEL, SEED)
def test_irrelevant_change_keeps_the_content_hash(change, which: tuple[str, int], seed: int) -> None:
    level = one(*which)
    other = change(level, np.random.default_rng(seed))
    assert content_hashes(other) == content_hashes(level)
    assert signatures(other) == signatures(level)


@EXAMPLES
@given(ANY_LEVEL, SEED)
def test_combined_irrelevant_changes_keep_the_content_hash(which: tuple[str, int], seed: int) -> None:
    level, rng = one(*which), np.random.default_rng(seed)
    other = level
    for change in rng.permutation(np.array(SAME)):
        other = change(other, rng)
    assert content_hashes(other) == content_hashes(level)


BODIES = ("position", "rotation", "velocity", "angular_velocity", "role", "inverse_mass", "inverse_inertia")
BODIES += ("friction", "restitution", "collision_mode")
HELD = ("joint_anchor_a", "joint_anchor_b", "joint_impulse", "joint_angular_impulse", "joint_fixed")
LIMITS = ("joint_rotation", "joint_min", "joint_max")
MOTORS = ("motor_speed", "motor_power", "motor_auto", "motor_on")
THRUSTERS = ("thruster_position", "thruster_rotation", "thruster_power", "thruster_active")
WHO = ("joint_a", "joint_b", "thruster_body", "active", "joint_active", "collides", "gravity", "vertices", "radius")


def counts(level: Level, name: str) -> np.ndarray:
    """Return (row, level): where an attribute is content."""
    model = level.model
    moves = model.inverse_mass != 0
    held = np.take_along_axis(moves, model.joint_a, 0) | np.take_along_axis(moves, model.joint_b, 0)
    joints = model.joint_active & held
    limited, runs = joints & model.joint_limited, joints & model.motor_on
    which = {
        **dict.fromkeys((*BODIES, "active"), model.active),
        **dict.fromkeys((*HELD, "joint_active"), joints),
        **dict.fromkeys(("joint_a", "joint_b"), joints & (model.joint_active.sum(0) == 1)),  # without a duplicate joint
        **dict.fromkeys(LIMITS, limited & ~model.joint_fixed),
        **dict.fromkeys(MOTORS, runs & ~model.joint_fixed),
        **dict.fromkeys(THRUSTERS, model.thruster_active),
        "thruster_body": model.thruster_active & (model.thruster_active.sum(0) == 1),
        "vertices": model.active[: level.size.polygons],
        "radius": model.active[level.size.polygons :],
        "collides": model.active & moves,
        "gravity": np.ones((2, COUNT), bool),
    }
    return which[name]


@cache
def having(name: str) -> list[tuple[str, int, int]]:
    """Return (size, level, index) of all bodies, joints or thrusters whose attribute is content."""
    return [(size, i, k) for size in SIZES for k, i in np.argwhere(counts(sampled(size), name)).tolist()]


@pytest.mark.parametrize("name", BODIES + HELD + LIMITS + MOTORS + THRUSTERS + WHO)
@EXAMPLES
@given(st.data())
def test_content_hash_notices_the_smallest_change(name: str, data: st.DataObject) -> None:
    """The smallest possible change of one attribute of one body, joint or thruster."""
    size, number, row_index = data.draw(st.sampled_from(having(name)))
    level = one(size, number)
    before, values = content_hashes(level), field(level, name)
    row = values[row_index]
    if name in ("joint_a", "joint_b", "thruster_body"):
        taken = (
            {int(field(level, end)[row_index, 0]) for end in ("joint_a", "joint_b")}
            if "joint" in name
            else {int(row[0])}
        )
        row[...] = data.draw(st.sampled_from(sorted({*np.flatnonzero(level.model.active).tolist()} - taken)))
    elif name == "collides":
        other = data.draw(st.sampled_from(sorted({*np.flatnonzero(level.model.active).tolist()} - {row_index})))
        row[other] = values[other, row_index] = ~row[other]
    elif name == "vertices":
        row[0, 0] = np.nextafter(row[0, 0], np.float32(9))
    elif row.dtype == np.float32:
        row[...] = np.nextafter(row, np.float32(9))
    else:
        row[...] = ~row if row.dtype == bool else row + 1
    assert content_hashes(level) != before


def field(level: Level, name: str) -> np.ndarray:
    return next(getattr(part, name) for part in (level, level.model, level.state) if hasattr(part, name))


def test_content_hash_notices_which_motors_obey_together_or_opposed() -> None:
    model = sampled("l").model
    motors = model.joint_active & model.motor_on & ~model.joint_fixed & (model.motor_speed != 0)
    chosen = np.flatnonzero(motors.sum(0) >= 2)
    assert len(chosen) > 20
    for i in chosen[:50]:
        level = one("l", i)
        level.model.joint_limited[...], level.motor_binding[...] = False, 2
        first, second = np.flatnonzero(motors[:, i])[:2]
        level.motor_binding[[first, second]] = 0
        together = content_hashes(level)
        level.model.motor_speed[second] *= -1
        against = content_hashes(level)
        level.motor_binding[second] = 1
        apart = content_hashes(level)
        level.model.motor_speed[second] *= -1
        assert content_hashes(level) == apart  # the direction of a motor that is alone on its entry is arbitrary
        assert len({*together, *against, *apart}) == 3


def test_reversing_a_motor_weakened_by_a_limit_changes_the_content_hash() -> None:
    """The engine weakens a motor if its control, not its speed, goes towards the limit."""
    weak = weakened(sampled("l")) & sampled("l").model.joint_active & (sampled("l").model.motor_speed != 0)
    for i in np.flatnonzero(weak.any(0))[:20]:
        level = one("l", i)
        before = content_hashes(level)
        level.model.motor_speed[np.flatnonzero(weak[:, i])[0]] *= -1
        assert content_hashes(level) != before


def test_content_ignores_what_the_engine_skips() -> None:
    """A joint between bodies that cannot move, and a thruster without power."""
    level = one("s", int(np.flatnonzero(sampled("s").model.joint_active.any(0))[0]))
    level.model.inverse_mass[...], level.model.thruster_power[...] = 0, 0
    before = content_hashes(level), signatures(level)
    level.model.joint_anchor_a[...], level.model.motor_on[...] = 0.3, False
    level.model.joint_active[...], level.model.thruster_active[...] = False, False
    assert (content_hashes(level), signatures(level)) == before


def test_sampled_levels_have_different_content_hashes() -> None:
    for size in SIZES:
        assert len(set(content_hashes(sampled(size)))) == COUNT


def test_mirror_image_has_another_content_hash() -> None:
    level = one("s", 3)
    mirrored = level.state.position * np.array([[-1], [1]], np.float32) + np.array([[5], [0]], np.float32)
    assert content_hashes(edited(level, state={"position": mirrored})) != content_hashes(level)


def test_content_hashes_stay_those_of_version_1() -> None:
    """Uses a level made without the sampler, whose last bits may differ between machines."""
    level: Level = jax.tree.map(np.zeros_like, one("m", 0))
    level.model.active[[0, 4, 6]] = True
    level.model.inverse_mass[[4, 6]] = np.array([[0.5], [0.25]])
    level.model.n_vertices[...], level.model.radius[...], level.model.gravity[1] = 4, 0.5, -9.8
    level.model.vertices[4, :, :, 0] = [[-1, 1], [1, 1], [1, -1], [-1, -1]]
    level.state.position[4], level.state.position[6] = 1.5, 3.5
    level.model.joint_active[0], level.model.joint_a[0], level.model.joint_b[0] = True, 4, 6
    level.model.motor_on[0], level.model.motor_speed[0], level.model.motor_power[0] = True, 1.0, 2.0
    assert content_hashes(level) == ["c1:0d3efd675e229a4120e42a7630fc95d8"]
    assert signatures(level) == [["n1:aba1dfcb80240912", "n1:4b1994e94f32b348"]]


# Levels with the same hash play alike


def play(level: Level, actions: np.ndarray) -> np.ndarray:
    """Return positions and angles of all bodies after each env step, (step, body, 3, level)."""
    rules, now, poses = TaskParams(dense_reward_scale=0.0), reset(level), []
    go = jax.jit(lambda now, action: step(level, now, action, rules)[0])
    for action in actions:
        now = go(now, action)
        poses.append(np.concatenate([now.state.position, np.asarray(now.state.rotation)[:, None]], 1))
    return np.array(poses)


@pytest.mark.parametrize("size", SOME)
def test_idle_values_change_no_bits_of_an_episode(size: str) -> None:
    level, rng = sampled(size), np.random.default_rng(0)
    actions = rng.integers(0, 2, (8, 6, COUNT)).repeat(3, 0).astype(np.int32)
    active = level.model.active[:, None]
    ours, other = play(level, actions), play(idle_changed(level, rng), actions)
    np.testing.assert_array_equal(np.where(active, ours, 0), np.where(active, other, 0))


@pytest.mark.parametrize("size", SOME)
def test_levels_of_equal_hash_play_alike(size: str) -> None:
    """Except for the last bits, which depend on the order of the solver's sums, and differ chaotically later on."""
    level, rng = sampled(size), np.random.default_rng(0)
    weak = (weakened(level) & level.model.joint_active).any(0)
    assert weak.any() == (size != "s")  # joints of size s have no limits
    motor, thruster, backward = names(rng)
    actions = rng.integers(0, [[3]] * MOTOR_BINDINGS + [[2], [2]], (4, 6, COUNT)).repeat(3, 0).astype(np.int32)
    other_actions = np.array(actions)
    against = np.array([0, 2, 1])[actions[:, :MOTOR_BINDINGS]]
    other_actions[:, motor] = np.where(backward[:, None], against, actions[:, :MOTOR_BINDINGS])
    other_actions[:, MOTOR_BINDINGS + thruster] = actions[:, MOTOR_BINDINGS:]
    gap = np.abs(play(with_names(turned(level, rng), motor, thruster, backward), other_actions) - play(level, actions))
    worst = np.where(level.model.active[:, None], gap, 0).max((0, 1, 2))
    assert (worst < 1e-3).mean() > 0.97, np.sort(worst)[-20:]
    assert (worst[weak] < 1e-3).all() or (worst[weak] < 1e-3).mean() > 0.9


# Exact copies of bodies


def worlds(bodies: int) -> st.SearchStrategy[World]:
    """Draw worlds of copies of one body that differ only in a few joints and thrusters."""
    body = st.integers(0, bodies - 1)

    def joined(a: int, b: int, row: bytes, direction: int, entry: int) -> tuple[Side, Side]:
        back = row if row == b"both" else row + b" back"
        direction = 0 if entry == NO_ENTRY else direction
        return Side(a, b, row, direction, entry), Side(b, a, back, -direction, entry)

    parts = (body, body, st.sampled_from([b"both", b"left"]), st.sampled_from([1, -1]), st.integers(NO_ENTRY, 1))
    joints = st.lists(st.tuples(*parts).filter(lambda x: x[0] != x[1]).map(lambda x: joined(*x)), max_size=5)
    pushes = st.lists(st.builds(Push, body, st.just(b"push"), st.integers(0, 1)), max_size=2)
    apart = st.lists(st.tuples(body, body).filter(lambda x: x[0] < x[1]), max_size=2, unique=True)
    return st.builds(World, st.just(b""), st.just([b"copy"] * bodies), joints, pushes, apart)


def by_hand(world: World) -> list[str]:
    """Return the smallest encoding of a world over all numberings and namings."""
    ways = itertools.product(
        itertools.permutations(range(len(world.bodies))),
        itertools.permutations(range(2)),
        itertools.permutations(range(2)),
        itertools.product((1, -1), repeat=2),
    )

    def written(rank, entry, flame, sign) -> list[str]:
        lines = [
            str(sorted((rank[s.first], rank[s.second], s.row, s.direction, -1) if s.entry == NO_ENTRY else
                       (rank[s.first], rank[s.second], s.row, s.direction * sign[s.entry], entry[s.entry])
                       for s in sides))
            for sides in world.joints
        ]  # fmt: skip
        lines += [f"push {rank[p.body]} {p.row!r} {flame[p.entry]}" for p in world.pushes]
        return sorted(lines + [f"apart {sorted((rank[i], rank[j]))}" for i, j in world.apart])

    return min(written(*way) for way in ways)


def changed_once(world: World) -> list[World]:
    """Return worlds without one joint, thruster or pair that does not collide, or with another entry or direction."""
    reversed_ = lambda sides: tuple(side._replace(direction=-side.direction) for side in sides)
    others = []
    for name, change in (
        ("joints", reversed_),
        ("pushes", lambda push: push._replace(entry=1 - push.entry)),
        ("apart", lambda pair: pair),
    ):
        parts = getattr(world, name)
        for i, part in enumerate(parts):
            rest = parts[:i] + parts[i + 1 :]
            others += [replace(world, **{name: left}) for left in (rest, [*rest, change(part)])]
    return others


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 3).flatmap(worlds), SEED)
def test_worlds_of_equal_form_are_renumberings_of_each_other(world: World, seed: int) -> None:
    rng, form, smallest = np.random.default_rng(seed), canonical_form(world), by_hand(world)
    for other in [world, *changed_once(world)]:
        other = reordered(other, rng.permutation(len(world.bodies)))
        if canonical_form(other) == form:
            assert by_hand(other) == smallest


def test_form_ignores_the_numbering_of_copies_that_are_joined_differently() -> None:
    """The legs of a walker: two copies of a thigh and of a shin, at the two ends of one body."""
    links = [(0, 1, b"left"), (0, 2, b"right"), (1, 3, b"left knee"), (2, 4, b"right knee")]
    joints = [(Side(a, b, row, 1, k), Side(b, a, row + b" back", -1, k)) for k, (a, b, row) in enumerate(links)]
    walker = World(b"", [b"body", *[b"thigh"] * 2, *[b"shin"] * 2], joints, [], [(1, 2)])
    forms = {canonical_form(reordered(walker, np.array(order))) for order in itertools.permutations(range(5))}
    assert len(forms) == 1


def reordered(world: World, rank: np.ndarray) -> World:
    """Renumber body i as rank[i]; reverse the order of joints, of their sides and of thrusters."""
    side = lambda s: s._replace(first=int(rank[s.first]), second=int(rank[s.second]))
    bodies = [world.bodies[i] for i in np.argsort(rank)]
    joints = [(side(b), side(a)) for a, b in reversed(world.joints)]
    pushes = [push._replace(body=int(rank[push.body])) for push in reversed(world.pushes)]
    return World(world.gravity, bodies, joints, pushes, [(int(rank[j]), int(rank[i])) for i, j in world.apart])


def test_form_tells_a_ring_of_six_copies_from_two_rings_of_three() -> None:
    """Comparing neighbours alone cannot tell them apart."""
    six = ring_of(*((i, (i + 1) % 6) for i in range(6)), bodies=6)
    threes = ring_of((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), bodies=6)
    assert canonical_form(six) != canonical_form(threes)


def ring_of(*links: tuple[int, int], bodies: int) -> World:
    joints = [(Side(a, b, b"", 0, NO_ENTRY), Side(b, a, b"", 0, NO_ENTRY)) for a, b in links]
    return World(b"", [b"copy"] * bodies, joints, [], [])


# Signatures


def jittered(level: Level, by: float) -> Level:
    """Perturb everything but the scenery, by m and rad."""
    rng, state = np.random.default_rng(0), level.state
    noise = [rng.normal(0, by, x.shape).astype(np.float32) for x in (state.position, state.rotation)]
    for x in noise:
        x[:4] = 0
    return edited(level, state={"position": state.position + noise[0], "rotation": state.rotation + noise[1]})


@pytest.mark.parametrize("size", SIZES)
def test_signatures_of_a_jittered_level_share_one(size: str) -> None:
    level = sampled(size)
    near = {}
    for by in (0.001, 0.01, 0.3):
        other = jittered(level, by)
        assert not set(content_hashes(other)) & set(content_hashes(level))
        both = zip(signatures(other), signatures(level), strict=True)
        near[by] = np.mean([any(a == b for a, b in zip(*pair, strict=True)) for pair in both])
    assert near[0.001] > 0.98
    assert near[0.01] > 0.85
    assert near[0.3] < 0.1


def test_signatures_of_different_levels_differ() -> None:
    for size in SIZES:
        assert len({half for both in signatures(sampled(size)) for half in both}) == 2 * COUNT

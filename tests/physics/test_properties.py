"""Properties of every world: momentum, rest, mirror symmetry, and the error of single precision."""

import functools

import jax
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from levelproof.physics.step import step
from tests.golden.load import golden
from tests.physics import mirror
from tests.physics.test_oracle import errors
from tests.physics.test_step import host, momentum, play
from tests.physics.worlds import BALL, BOX, FLOOR_TOP, HALF, MASS, OTHER, PARAMS, RADIUS, changed, idle, room

SIZES = ("s", "m", "l")
MOVABLE = (BOX, BALL, OTHER)
few = settings(max_examples=40, deadline=None)
numbers = functools.partial(st.floats, width=32, allow_subnormal=False)  # subnormals count as zero
near, speeds, turns = numbers(-0.5, 0.5), numbers(-3, 3), numbers(-6, 6)
motions = st.lists(st.tuples(near, near, turns, speeds, speeds, turns), min_size=3, max_size=3)


def thrown_together(motions, gravity: float):
    """Place the three bodies around the middle of the room, overlapping or not, far from all walls."""
    model, state = room(gravity=gravity)
    for body, (x, y, rotation, v_x, v_y, w) in zip(MOVABLE, motions, strict=True):
        state = changed(state, position={body: (2.5 + x, 2.5 + y)}, rotation={body: rotation})
        state = changed(state, velocity={body: (v_x, v_y)}, angular_velocity={body: w})
    return model, state


def angular_momentum(model, state, position) -> float:
    """Return the angular momentum of the three movable bodies about the origin, kg m^2/s."""
    body = list(MOVABLE)
    v, (x, y) = np.asarray(state.velocity)[body, :, 0].T, np.asarray(position)[body, :, 0].T
    spin = state.angular_velocity[body, 0] / model.inverse_inertia[body, 0]
    return float((MASS * (x * v[1] - y * v[0]) + spin).sum())


class TestMomentum:
    @few
    @given(motions)
    def test_collisions_keep_momentum_and_angular_momentum(self, motions) -> None:
        """Bodies act on each other with opposite impulses at one point (taken before they move)."""
        model, state = thrown_together(motions, gravity=0.0)
        after, manifold = play(model, state, *idle())
        assume(manifold.active.any())
        assume(np.abs(after.angular_velocity).max() < PARAMS.max_angular_velocity)  # else a bound was reached
        np.testing.assert_allclose(momentum(after), momentum(state), atol=2e-4)
        before, now = (angular_momentum(model, s, state.position) for s in (state, after))
        np.testing.assert_allclose(now, before, atol=1e-3)

    @few
    @given(motions, st.booleans(), numbers(-1, 1))
    def test_centre_of_mass_falls_freely(self, motions, fixed, drive) -> None:
        """A joint, a motor and collisions among the bodies do not disturb the fall of their centre of mass."""
        model, state = thrown_together(motions, gravity=-9.81)
        model = changed(model, joint_active={0: True}, joint_fixed={0: fixed}, joint_anchor_a={0: (0.3, 0.0)})
        model = changed(model, collides={(BOX, BALL): False, (BALL, BOX): False})
        motor, thrust = idle()
        after, manifold = play(model, state, motor + np.float32(drive), thrust)
        walls = [*range(4), *range(4, 8), *range(8, 12), *range(13, 17)]  # contacts with polygons 0 to 3
        assert not manifold.active[walls].any()
        assume(np.abs(after.velocity).max() < PARAMS.max_velocity)
        fall = np.array([0, -9.81 / 60 * 3 * MASS])
        np.testing.assert_allclose(momentum(after) - momentum(state), fall, atol=1e-3)


class TestRest:
    @few
    @given(st.lists(st.tuples(near, near, turns), min_size=3, max_size=3), st.booleans())
    def test_bodies_without_forces_keep_every_bit(self, places, joined) -> None:
        """Bodies apart from each other, one perhaps hinged to another where their centres meet."""
        model, state = room(gravity=0.0)
        model = changed(model, collides={(BOX, BALL): False, (BALL, BOX): False})
        for body, middle, (x, y, rotation) in zip(MOVABLE, (1.0, 2.5, 4.0), places, strict=True):
            state = changed(state, position={body: (middle + x, 2.0 + y)}, rotation={body: rotation})
        if joined:
            model = changed(model, joint_active={0: True})
            state = changed(state, position={BALL: state.position[BOX, :, 0]})
        after, _ = play(model, state, *idle(), steps=16)
        for name in ("position", "rotation", "velocity", "angular_velocity"):
            np.testing.assert_array_equal(getattr(after, name), getattr(state, name), name)

    @few
    @given(st.floats(0.5, 4.0), st.sampled_from([0.0, np.pi / 2, np.pi, -np.pi / 2]), st.floats(0.1, 20))
    def test_pile_on_the_floor_stays(self, x, side, mass) -> None:
        """A box on any of its sides with a ball on top, at any position and of any weight."""
        model, state = room()
        share = MASS / mass
        for body in (BOX, BALL):
            model = changed(model, inverse_mass={body: share / MASS})
            model = changed(model, inverse_inertia={body: model.inverse_inertia[body, 0] * share})
        aside = 4.5 if x < 3 else 0.5
        top = FLOOR_TOP + 2 * HALF
        state = changed(state, rotation={BOX: side}, position={BOX: (x, FLOOR_TOP + HALF - 0.005)})
        state = changed(state, position={BALL: (x, top + RADIUS - 0.01), OTHER: (aside, FLOOR_TOP + RADIUS)})
        after, _ = play(model, state, *idle(), steps=60)
        for body, height in ((BOX, FLOOR_TOP + HALF), (BALL, top + RADIUS)):
            np.testing.assert_allclose(after.position[body, :, 0], [x, height], atol=0.03)
            np.testing.assert_allclose(after.velocity[body, :, 0], 0, atol=0.02)
        np.testing.assert_allclose(after.rotation[BOX, 0], side, atol=0.02)


def world_of(size: str):
    """Return the golden worlds of a size with their controls."""
    sample = golden(size)
    return sample.level.model, sample.state, sample.motor, sample.thrust


class TestMirror:
    """A mirrored world evolves in mirror image, up to rounding: vertices, and so sums, come in another order.

    One part of the engine is asymmetric, as in the reference: a motor whose joint's limits are less than twice
    `Params.motor_limit_zone` apart is weakened as if it were at the upper limit.
    """

    @staticmethod
    def asymmetric(model, motor) -> np.ndarray:
        """Find lanes with such a motor."""
        narrow = model.joint_limited & (model.joint_max - model.joint_min < 2 * PARAMS.motor_limit_zone)
        return (model.joint_active & ~model.joint_fixed & model.motor_on & (motor != 0) & narrow).any(0)

    @staticmethod
    @functools.cache
    def both(size: str, steps: int):
        world = world_of(size)
        here, contacts = play(*world, steps)
        there, contacts_there = play(*mirror.of_world(*world), steps)
        return here, contacts, mirror.of_state(there), mirror.of_manifold(contacts_there)

    def off(self, size: str, steps: int) -> np.ndarray:
        """Return the largest difference of each symmetric lane."""
        model, _, motor, _ = world_of(size)
        here, _, there, _ = self.both(size, steps)
        return errors(here, there)[~self.asymmetric(model, motor)]

    @pytest.mark.parametrize("size", SIZES)
    def test_mirroring_twice_restores_the_world(self, size: str) -> None:
        world = world_of(size)
        for a, b in zip(
            jax.tree.leaves(world), jax.tree.leaves(mirror.of_world(*mirror.of_world(*world))), strict=True
        ):
            np.testing.assert_allclose(a, b, atol=1e-6)

    @pytest.mark.parametrize("size", SIZES)
    def test_one_step_keeps_mirror_symmetry(self, size: str) -> None:
        off = self.off(size, 1)
        assert np.median(off) < 1e-6
        assert (off < 1e-4).mean() >= 0.99
        assert (off < 1e-3).mean() >= 0.995
        assert off.max() < 1e-2

    @pytest.mark.parametrize("size", SIZES)
    def test_contacts_keep_mirror_symmetry(self, size: str) -> None:
        _, here, _, there = self.both(size, 1)
        np.testing.assert_array_equal(here.active, there.active)
        for name in ("penetration", "point"):
            np.testing.assert_allclose(getattr(here, name), getattr(there, name), atol=2e-5, err_msg=name)
        turned = np.abs(here.normal - there.normal).max(1)[here.active]
        assert (turned < 2e-5).mean() >= 0.99  # the others have a circle's centre almost on an edge
        assert turned.max() < 0.1

    def test_mirrored_step_without_contacts_and_thrusters_is_exact(self) -> None:
        model, _, motor, thrust = world_of("s")
        here, _, there, _ = self.both("s", 1)
        fires = (model.thruster_active & (thrust != 0)).any(0)
        plain = ~here.contact_active.any(0) & ~fires & ~self.asymmetric(model, motor)
        assert plain.sum() >= 10
        assert (errors(here, there)[plain] == 0).all()

    @pytest.mark.parametrize("size", SIZES)
    @pytest.mark.parametrize(("steps", "share"), [(8, 0.99), (30, 0.975), (60, 0.92)])
    def test_many_steps_keep_mirror_symmetry_in_most_lanes(self, size: str, steps: int, share: float) -> None:
        """The other lanes are chaotic: rounding has grown to 1e-3."""
        assert (self.off(size, steps) < 1e-3).mean() >= share


class TestPrecision:
    """One step in single precision against the same source in double precision."""

    @pytest.mark.slow
    @pytest.mark.parametrize("size", ["s", *(pytest.param(size, marks=pytest.mark.campaign) for size in "ml")])
    def test_single_precision_step_is_close_to_double(self, size: str) -> None:
        world = world_of(size)
        single, _ = play(*world)
        with jax.enable_x64(True):
            wide = jax.tree.map(
                lambda x: np.asarray(x, np.float64 if np.asarray(x).dtype == np.float32 else None), world
            )
            options = {"xla_backend_optimization_level": 0}  # compiles sooner
            double, _ = host(jax.jit(step, compiler_options=options)(*wide))
        assert double.position.dtype == np.float64
        off = errors(single, double)
        assert np.median(off) < 5e-6
        assert (off < 1e-4).mean() >= 0.95
        assert (off < 1e-3).mean() >= 0.985
        assert (single.contact_active == double.contact_active).all(0).mean() >= 0.995

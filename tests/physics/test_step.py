"""The engine from first principles: conservation laws, and what it guarantees about lanes."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.physics.pairs import table_of
from levelproof.physics.step import step
from levelproof.physics.types import Params, Size
from tests.golden.load import golden
from tests.physics.worlds import (
    BALL,
    BOX,
    FLOOR_TOP,
    HALF,
    MASS,
    OTHER,
    PARAMS,
    RADIUS,
    changed,
    idle,
    room,
)

speeds = st.floats(-5, 5, width=32)
turns = st.floats(-20, 20, width=32)
few = settings(max_examples=40, deadline=None)


@functools.cache
def _compiled(params: Params):
    """Compile `count` steps; the count is traced, so that one compilation serves all tests."""

    def run(model, state, motor, thrust, count):
        def body(_, now):
            return step(model, now[0], motor, thrust, params)

        shapes = jax.eval_shape(body, 0, (state, None))
        return jax.lax.fori_loop(0, count, body, (state, jax.tree.map(jnp.zeros_like, shapes[1])))

    return jax.jit(run)


def play(model, state, motor, thrust, steps: int = 1, params: Params = PARAMS):
    """Return state and manifold after some physics steps, on the host."""
    return host(_compiled(params)(model, state, motor, thrust, steps))


def host(tree):
    return jax.tree.map(np.asarray, tree)


def momentum(state) -> np.ndarray:
    """Return the linear momentum of the three movable bodies, kg m/s."""
    return MASS * np.asarray(state.velocity)[[BOX, BALL, OTHER]].sum(0)[..., 0]


class TestFreeFlight:
    @few
    @given(st.lists(st.tuples(speeds, speeds, turns), min_size=3, max_size=3))
    def test_bodies_without_contacts_fall_freely(self, motions) -> None:
        model, state = room()
        for body, (x, y, w) in zip((BOX, BALL, OTHER), motions, strict=True):
            state = changed(state, velocity={body: (x, y)}, angular_velocity={body: w})
        after, manifold = play(model, state, *idle())
        assert not manifold.active.any()
        fall = np.array([0, -9.81 / 60], np.float32)
        for body, (x, y, w) in zip((BOX, BALL, OTHER), motions, strict=True):
            np.testing.assert_allclose(after.velocity[body, :, 0], np.array([x, y]) + fall, atol=1e-5)
            np.testing.assert_allclose(after.angular_velocity[body, 0], w, atol=1e-5)
            moved = state.position[body, :, 0] + after.velocity[body, :, 0] / 60
            np.testing.assert_allclose(after.position[body, :, 0], moved, atol=1e-5)
            np.testing.assert_allclose(after.rotation[body, 0], w / 60, atol=1e-5)

    @few
    @given(speeds, speeds, turns, st.booleans())
    def test_joint_keeps_the_momentum_of_its_bodies(self, x, y, w, fixed) -> None:
        model, state = room(gravity=0.0)
        model = changed(model, joint_active={0: True}, joint_fixed={0: fixed}, joint_anchor_a={0: (0.7, 0.0)})
        model = changed(model, joint_anchor_b={0: (-0.8, 0.0)}, collides={(BOX, BALL): False, (BALL, BOX): False})
        state = changed(state, velocity={BOX: (x, y)}, angular_velocity={BALL: w})
        after, _ = play(model, state, *idle(), steps=8)
        np.testing.assert_allclose(momentum(after), momentum(state), atol=2e-4)

    @few
    @given(speeds, speeds)
    def test_collision_keeps_momentum(self, x, y) -> None:
        model, state = room(gravity=0.0)
        state = changed(state, position={OTHER: (2.5 + 2 * RADIUS - 0.005, 2.05)}, velocity={BALL: (abs(x) + 0.1, y)})
        after, manifold = play(model, state, *idle())
        assert manifold.active.any()
        np.testing.assert_allclose(momentum(after), momentum(state), atol=1e-4)

    def test_motor_turns_both_bodies_and_moves_neither(self) -> None:
        model, state = room(gravity=0.0)
        model = changed(model, joint_active={0: True}, collides={(BOX, BALL): False, (BALL, BOX): False})
        state = changed(state, position={BALL: (1.0, 2.0)})
        motor, thrust = idle()
        after, _ = play(model, state, motor + 1, thrust)
        spins = after.angular_velocity[:, 0]
        assert spins[BALL] > 0 > spins[BOX]  # forward: b turns counterclockwise relative to a
        angular = spins[[BOX, BALL]] / model.inverse_inertia[[BOX, BALL], 0]
        np.testing.assert_allclose(angular.sum(), 0, atol=1e-5)
        np.testing.assert_allclose(after.velocity[[BOX, BALL], :, 0], 0, atol=1e-5)

    def test_thruster_pushes_along_its_rotation(self) -> None:
        model, state = room(gravity=0.0)
        model = changed(model, thruster_active={0: True}, thruster_rotation={0: np.pi / 2})
        motor, thrust = idle()
        after, _ = play(model, state, motor, thrust + 1)
        np.testing.assert_allclose(after.velocity[BOX, :, 0], [0, 10.0 / 60 / MASS], atol=1e-6)
        assert (after.velocity[BALL] == 0).all()


class TestRest:
    @pytest.mark.parametrize(("body", "height"), [(BOX, HALF), (BALL, RADIUS)])
    def test_body_on_the_floor_stays(self, body, height) -> None:
        model, state = room()
        state = changed(state, position={body: (2.0, FLOOR_TOP + height - 0.005)})
        if body == BOX:
            state = changed(state, position={BALL: (3.0, 2.0)})
        after, _ = play(model, state, *idle(), steps=240)  # four seconds
        np.testing.assert_allclose(after.position[body, :, 0], [2.0, FLOOR_TOP + height], atol=0.02)
        np.testing.assert_allclose(after.velocity[body, :, 0], 0, atol=0.02)
        np.testing.assert_allclose(after.rotation[body, 0], 0, atol=0.02)

    @pytest.mark.parametrize(("wall", "height", "side"), [(0, FLOOR_TOP + HALF - 0.005, -1), (3, 4.805, 1)])
    def test_contacts_of_a_flat_box_begin_at_the_start_of_the_face(self, wall, height, side) -> None:
        """The reference begins there, too. Faces run clockwise: the floor's to the right, the ceiling's to the left."""
        model, state = room()
        state = changed(state, position={BOX: (1.5, height)})
        _, manifold = play(model, state, *idle())
        first, second = wall, 4 + wall
        assert manifold.active[[first, second]].all()
        np.testing.assert_allclose(manifold.point[[first, second], 0, 0] - 1.5, [side * HALF, -side * HALF], atol=1e-5)

    def test_bodies_fall_to_the_floor_of_the_room(self) -> None:
        model, state = room()
        after, _ = play(model, state, *idle(), steps=240)
        lowest = np.array([HALF, RADIUS, RADIUS])
        np.testing.assert_allclose(after.position[[BOX, BALL, OTHER], 1, 0], FLOOR_TOP + lowest, atol=0.02)

    def test_immovable_bodies_never_move(self) -> None:
        model, state = room()
        state = changed(state, position={BALL: (2.0, FLOOR_TOP), BOX: (0.1, 2.0)})
        after, _ = play(model, state, *idle(), steps=8)
        for name in ("position", "rotation", "velocity", "angular_velocity"):
            np.testing.assert_array_equal(getattr(after, name)[:4], getattr(state, name)[:4])


class TestInactive:
    @few
    @given(st.sampled_from([BOX, BALL, OTHER]), speeds, turns)
    def test_inactive_body_moves_nothing(self, ghost, speed, turn) -> None:
        """Inside another body or thrown at it, an inactive body has no effect: others move as if it were far away."""
        victim = BALL if ghost != BALL else OTHER
        model, state = room()
        model = changed(model, active={ghost: False})
        there = changed(
            state,
            position={ghost: state.position[victim, :, 0] + 0.05},
            velocity={ghost: (speed, speed)},
            angular_velocity={ghost: turn},
        )
        near, _ = play(model, there, *idle())
        far, _ = play(model, state, *idle())
        others = [body for body in range(7) if body != ghost]
        for name in ("position", "rotation", "velocity", "angular_velocity"):
            np.testing.assert_array_equal(getattr(near, name)[others], getattr(far, name)[others])

    def test_inactive_joint_or_thruster_does_nothing(self) -> None:
        model, state = room()
        motor, thrust = idle()
        plain, _ = play(model, state, motor, thrust)
        driven, _ = play(model, state, motor + 1, thrust + 1)
        for name in ("position", "rotation", "velocity", "angular_velocity"):
            np.testing.assert_array_equal(getattr(plain, name), getattr(driven, name))

    def test_collision_modes_and_groups_let_bodies_pass(self) -> None:
        """Collision modes leave no contact; `collides` leaves the contact without its impulse."""
        model, state = room(gravity=0.0)
        state = changed(state, position={OTHER: (2.6, 2.0)})
        thin = changed(model, collision_mode={BALL: 0})
        after, manifold = play(thin, state, *idle())
        assert not manifold.active.any()
        assert (after.velocity == 0).all()
        grouped = changed(model, collides={(BALL, OTHER): False, (OTHER, BALL): False})
        after, manifold = play(grouped, state, *idle())
        assert manifold.active.any()
        assert (after.velocity == 0).all()
        thick = changed(model, collision_mode={BALL: 0, OTHER: 2})
        after, manifold = play(thick, state, *idle())
        assert manifold.active.any()
        assert after.velocity[OTHER, 0, 0] > 0 > after.velocity[BALL, 0, 0]


class TestBounds:
    @few
    @given(st.floats(-1e4, 1e4, width=32), st.floats(-1e4, 1e4, width=32), st.floats(-1e4, 1e4, width=32))
    def test_positions_and_speeds_are_bounded(self, x, y, w) -> None:
        model, state = room()
        state = changed(state, velocity={BALL: (x, y)}, angular_velocity={BALL: w})
        after, _ = play(model, state, *idle())
        assert np.abs(after.position).max() <= PARAMS.max_position
        assert np.abs(after.velocity).max() <= PARAMS.max_velocity
        assert np.abs(after.angular_velocity).max() <= PARAMS.max_angular_velocity
        assert np.isfinite(after.position).all()


class TestLanes:
    """A lane's bits depend only on its own world, not on its neighbours or their number."""

    SOME = 64
    STEPS = 16

    @classmethod
    def after(cls, lanes, steps: int = STEPS, size: str = "s"):
        """Step the golden states of `lanes`, as a batch of their own."""
        sample = golden(size)
        take = lambda tree: jax.tree.map(lambda x: np.ascontiguousarray(x[..., lanes]), tree)
        return play(
            take(sample.level.model), take(sample.state), sample.motor[:, lanes], sample.thrust[:, lanes], steps
        )[0]

    @staticmethod
    def same_bits(ours, theirs) -> None:
        for field in dataclasses.fields(ours):
            np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name), field.name)

    def test_order_of_lanes_changes_no_bits(self) -> None:
        order = np.random.default_rng(1).permutation(self.SOME)
        straight = self.after(np.arange(self.SOME))
        self.same_bits(self.after(order), jax.tree.map(lambda x: x[..., order], straight))

    @pytest.mark.parametrize(
        ("size", "count"), [("s", 40), *(pytest.param(size, 3, marks=pytest.mark.campaign) for size in "sml")]
    )
    def test_neighbours_change_no_bits(self, size: str, count: int) -> None:
        """The batch is padded with copies of the last lane, as at the end of a job."""
        padded = self.after(np.minimum(np.arange(self.SOME), count - 1), size=size)
        whole = self.after(np.arange(self.SOME), size=size)
        mine = lambda tree: jax.tree.map(lambda x: x[..., :count], tree)
        self.same_bits(mine(padded), mine(whole))

    @pytest.mark.parametrize(
        ("size", "count"),
        [
            *(("s", 1), ("s", 16), ("l", 129)),  # less than a block, one block, blocks and a remainder
            *(pytest.param(*case, marks=pytest.mark.campaign) for case in itertools.product("sml", (3, 17, 100))),
        ],
    )
    def test_number_of_lanes_changes_no_bits(self, size: str, count: int) -> None:
        alone, together = self.after(np.arange(count), size=size), self.after(np.arange(256), size=size)
        self.same_bits(alone, jax.tree.map(lambda x: x[..., :count], together))

    @pytest.mark.parametrize("size", ["s", *(pytest.param(size, marks=pytest.mark.campaign) for size in "ml")])
    def test_returning_contacts_changes_no_bits(self, size: str) -> None:
        """A step that returns no contacts leads to the same state."""
        sample = golden(size)
        given = sample.level.model, sample.state, sample.motor, sample.thrust
        self.same_bits(host(jax.jit(lambda *given: step(*given, with_contacts=False)[0])(*given)), play(*given)[0])

    def test_step_broadcasts_one_model(self) -> None:
        """A model with one lane broadcasts over the lanes of its states."""
        model, state = room()
        single, _ = room(lanes=1)
        state = changed(state, velocity={BALL: (1.0, 2.0)})
        whole, _ = play(model, state, *idle())
        shared, _ = play(single, state, *idle())
        for field in dataclasses.fields(whole):
            np.testing.assert_array_equal(getattr(whole, field.name), getattr(shared, field.name), field.name)


class TestPadding:
    """The reference loses the accumulated impulses of the last pair of each kind; see docs/physics.md."""

    @staticmethod
    def resting_on_the_other(params: Params):
        """Let one circle rest on another, the last circle-circle pair, for some steps."""
        model, state = room()
        state = changed(state, position={BALL: (2.5, FLOOR_TOP + RADIUS), OTHER: (2.5, FLOOR_TOP + 3 * RADIUS - 0.005)})
        return play(model, state, *idle(), steps=4, params=params)[0]

    def test_padding_defect_clears_the_last_pairs_impulse(self) -> None:
        after = self.resting_on_the_other(Params(faithful_padding=True))
        assert after.contact_active[-1].all()
        assert (after.contact_normal_impulse[-1] == 0).all()

    def test_without_the_padding_defect_the_last_pair_keeps_its_impulse(self) -> None:
        after = self.resting_on_the_other(Params(faithful_padding=False))
        assert (after.contact_normal_impulse[-1] > 0).all()
        weight = MASS * 9.81 / 60
        np.testing.assert_allclose(after.contact_normal_impulse[-1], weight, rtol=0.2)

    @pytest.mark.parametrize(
        ("contact", "positions", "gravity"),
        [
            (3, {BOX: (2.5, 5 - HALF + 0.005)}, 9.81),  # ceiling and box: first points
            (7, {BOX: (2.5, 5 - HALF + 0.005)}, 9.81),  # second points
            (17, {BOX: (2.5, FLOOR_TOP + HALF), OTHER: (2.5, FLOOR_TOP + 2 * HALF + RADIUS - 0.005)}, -9.81),
        ],
    )
    def test_padding_defect_clears_impulses_of_each_kinds_last_pair(
        self, contact: int, positions: dict, gravity: float
    ) -> None:
        """Ceiling and box, second circle and box; the test above has the two circles."""
        model, state = room(gravity=gravity)
        state = changed(state, position={BALL: (4.0, 2.0), OTHER: (1.0, 2.0)} | positions)
        for faithful in (True, False):
            after, _ = play(model, state, *idle(), steps=4, params=Params(faithful_padding=faithful))
            assert after.contact_active[contact].all()
            assert ((after.contact_normal_impulse[contact] == 0) == faithful).all()

    def test_padding_defect_spares_kinds_whose_last_batch_is_full(self) -> None:
        """8 polygons and 8 circles: 22 polygon pairs, 64 circle-polygon pairs, 28 pairs of circles."""
        forgotten = np.flatnonzero(table_of(Size(8, 8, 0, 0), faithful_padding=True).kept == 0)
        assert forgotten.tolist() == [21, 43, 44 + 64 + 27]
        assert (table_of(Size(8, 8, 0, 0), faithful_padding=False).kept == 1).all()

    def test_padding_defect_spares_other_pairs(self) -> None:
        """A box on the floor is not the last pair of its kind in a room with a ceiling."""
        model, state = room()
        state = changed(state, position={BOX: (2.0, FLOOR_TOP + HALF - 0.005), BALL: (3.4, 2.0)})
        faithful, _ = play(model, state, *idle(), steps=4)
        fixed, _ = play(model, state, *idle(), steps=4, params=Params(faithful_padding=False))
        assert faithful.contact_normal_impulse.max() > 0
        for field in dataclasses.fields(faithful):
            np.testing.assert_allclose(
                getattr(faithful, field.name), getattr(fixed, field.name), atol=1e-5, err_msg=field.name
            )

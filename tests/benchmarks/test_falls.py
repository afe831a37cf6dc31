"""Levels in which green can only fall: what is said of them holds under random play, and any doubt says nothing."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.falls import fall
from levelproof.experts.search.play import act, arena, fresh_walk, persistent
from levelproof.levelgen.level import Level, Role
from levelproof.levelgen.task.rules import DEFAULT_RULES
from levelproof.physics.types import FIXED_POLYGONS
from tests.experts.search.worlds import BALL, GOAL, world

LANES = 256


def falling(thrust: float = 0.45) -> Level:
    """A ball above a red floor, whose thrusters lift half of its weight and push it to the right; a goal far away."""
    level = world(
        bars=[((1.0, 4.0), (0.3, 0.2), 0.4), ((4.0, 3.0), (0.2, 0.2), 0.0)],
        bar_role=Role.RED,
        ball=(1.5, 2.0),
        goal=(4.5, 4.2),
        angles=(np.pi / 2, 0.0),
        thrust=thrust,
    )
    level.role[0] = Role.RED
    return level


def test_red_comes_first_whatever_is_done() -> None:
    """In as many env steps as it says, within what it says, and never the goal."""
    level = falling()
    what = fall(level, DEFAULT_RULES)
    assert what
    ring = arena(level, LANES, (0.05, 0.3))

    @jax.jit
    def played() -> tuple[jax.Array, ...]:
        def one(walk, bits):
            after = act(ring, walk, persistent(walk.action, bits, ring), DEFAULT_RULES)
            return after, (walk.ended, after.state.position[BALL])

        bits = jax.random.bits(jax.random.key(0), (what.env_steps, 6, LANES))
        end, (over, place) = jax.lax.scan(one, fresh_walk(ring.lanes), bits)
        return end.ended, end.reached, over, place

    ended, reached, over, place = map(np.asarray, played())
    assert ended.all()
    assert not reached.any()
    x, radius = place[:, 0][~over], 0.2
    assert what.reach[0] <= x.min() - radius
    assert x.max() + radius <= what.reach[1]
    assert what.reach[1] - (x.max() + radius) < 0.5, "some lanes go nearly as far"
    assert what.lift < what.weight


def shelf(level: Level) -> None:
    """Something that is not red, on its way."""
    level.role[FIXED_POLYGONS], level.state.position[FIXED_POLYGONS, :, 0] = Role.PLAIN, (2.0, 1.0)


def moving(level: Level) -> None:
    level.model.inverse_mass[GOAL] = 1.0


def thrown(level: Level) -> None:
    level.state.velocity[BALL, 1] = 1.0


def plain(level: Level) -> None:
    level.role[0] = Role.PLAIN


def held(level: Level) -> None:
    level.model.joint_active[0], level.model.joint_a[0], level.model.joint_b[0] = True, FIXED_POLYGONS, BALL


def aside(level: Level) -> None:
    """A thruster that turns it, and so may lift with both."""
    level.model.inverse_inertia[BALL] = 100.0
    level.model.thruster_position[:, 1] = 0.2
    level.model.thruster_power[:] *= 1.9


def box(level: Level) -> None:
    level.role[BALL], level.role[FIXED_POLYGONS] = Role.PLAIN, Role.GREEN


@pytest.mark.parametrize("change", [shelf, moving, thrown, plain, held, aside, box])
def test_every_doubt_says_nothing(change: Callable[[Level], None]) -> None:
    level = falling()
    change(level)
    assert fall(level, DEFAULT_RULES) is None


def test_what_may_rise_is_no_fall() -> None:
    assert fall(falling(thrust=1.01), DEFAULT_RULES) is None
    strong = replace(DEFAULT_RULES.physics, thruster_power=DEFAULT_RULES.physics.thruster_power * 3)
    assert fall(falling(), replace(DEFAULT_RULES, physics=strong)) is None


def test_a_red_shelf_only_ends_it_sooner() -> None:
    level = falling()
    shelf(level)
    level.role[FIXED_POLYGONS] = Role.RED
    assert fall(level, DEFAULT_RULES)
    assert jnp.isfinite(jnp.array(fall(level, DEFAULT_RULES).reach)).all()  # pyright: ignore

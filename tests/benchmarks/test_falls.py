"""Levels in which green can only fall: bounds hold under random play, and a failed premise proves nothing."""

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
    """A ball above a red floor; thrusters lift half of its weight and push it right; the goal is far away."""
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


@pytest.mark.campaign
def test_fall_bounds_what_random_play_does() -> None:
    """Episodes end within the bound on env steps and the reach, and never in the goal."""
    level = falling()
    proof = fall(level, DEFAULT_RULES)
    assert proof
    ring = arena(level, LANES, (0.05, 0.3))

    @jax.jit
    def played() -> tuple[jax.Array, ...]:
        def one(walk, bits):
            after = act(ring, walk, persistent(walk.action, bits, ring), DEFAULT_RULES)
            return after, (walk.ended, after.state.position[BALL])

        bits = jax.random.bits(jax.random.key(0), (proof.env_steps, 6, LANES))
        end, (ended_at, place) = jax.lax.scan(one, fresh_walk(ring.lanes), bits)
        return end.ended, end.reached, ended_at, place

    ended, reached, ended_at, place = map(np.asarray, played())
    assert ended.all()
    assert not reached.any()
    x, radius = place[:, 0][~ended_at], 0.2
    assert proof.reach[0] <= x.min() - radius
    assert x.max() + radius <= proof.reach[1]
    assert proof.reach[1] - (x.max() + radius) < 0.5, "some lanes go nearly as far"
    assert proof.lift < proof.weight


def shelf(level: Level) -> None:
    """Put a body that is not red in its way."""
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
    """Move a thruster off the ball's centre, so that it turns the ball and both thrusters may lift it."""
    level.model.inverse_inertia[BALL] = 100.0
    level.model.thruster_position[:, 1] = 0.2
    level.model.thruster_power[:] *= 1.9


def box(level: Level) -> None:
    level.role[BALL], level.role[FIXED_POLYGONS] = Role.PLAIN, Role.GREEN


@pytest.mark.parametrize("change", [shelf, moving, thrown, plain, held, aside, box])
def test_fall_returns_none_if_a_premise_fails(change: Callable[[Level], None]) -> None:
    level = falling()
    change(level)
    assert fall(level, DEFAULT_RULES) is None


def test_fall_returns_none_if_thrusters_can_lift_green() -> None:
    assert fall(falling(thrust=1.01), DEFAULT_RULES) is None
    strong = replace(DEFAULT_RULES.physics, thruster_power=DEFAULT_RULES.physics.thruster_power * 3)
    assert fall(falling(), replace(DEFAULT_RULES, physics=strong)) is None


def test_fall_ignores_red_bodies_in_the_way() -> None:
    level = falling()
    shelf(level)
    level.role[FIXED_POLYGONS] = Role.RED
    assert fall(level, DEFAULT_RULES)
    assert jnp.isfinite(jnp.array(fall(level, DEFAULT_RULES).reach)).all()  # pyright: ignore

"""The engine against the reference: one physics step from each golden state; docs/physics.md has the differences."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from levelproof.physics.pairs import pairs_of
from levelproof.physics.step import step
from levelproof.physics.types import Params
from tests.golden.load import HERE, Golden, golden

MOTION = ("position", "rotation", "velocity", "angular_velocity")
SIZES = ("s", "m", "l")
# minimum number of the 768 states of each size that show a feature
SHOWN = {
    "polygon contact": 300,
    "circle-polygon contact": 500,
    "circle-circle contact": 50,
    "two-point polygon contact": 150,
    "circle centre inside a polygon": 40,
    "joint beyond its limit": 25,
    "fixed joint": 40,
    "driven motor": 200,
    "firing thruster": 200,
    "triangle": 50,
}


@functools.cache
def stepped(size: str):
    """Return our state after one physics step, on the host."""
    sample = golden(size)
    compiled = jax.jit(lambda model, state, motor, thrust: step(model, state, motor, thrust, Params())[0])
    return jax.tree.map(np.asarray, compiled(sample.level.model, sample.state, sample.motor, sample.thrust))


def errors(ours, theirs) -> np.ndarray:
    """Return each lane's largest absolute difference of any position or velocity (NaN counts as infinite)."""
    gaps = [np.abs(getattr(ours, name) - getattr(theirs, name)) for name in MOTION]
    worst = np.max([gap.reshape(-1, gap.shape[-1]).max(0) for gap in gaps], 0)
    return np.where(np.isnan(worst), np.inf, worst)


def circles_inside(sample: Golden) -> np.ndarray:
    """Find lanes in which a circle's centre lies in a polygon that it may collide with."""
    model, polygons = sample.level.model, sample.level.size.polygons
    position, angle = sample.state.position, sample.state.rotation[:polygons]
    inside_any = np.zeros(angle.shape[-1], bool)
    for circle in range(polygons, sample.level.size.bodies):
        x, y = (position[circle, axis] - position[:polygons, axis] for axis in (0, 1))
        x, y = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        inside = model.active[circle] & model.active[:polygons] & model.collides[circle, :polygons]
        for k in range(4):
            exists = k < model.n_vertices
            a = model.vertices[:, k]
            b = np.where((k + 1 < model.n_vertices)[:, None], model.vertices[:, (k + 1) % 4], model.vertices[:, 0])
            right = (b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0]) < 0
            inside = inside & (right | ~exists)
        inside_any |= inside.any(0)
    return inside_any


def shows(sample: Golden) -> dict[str, np.ndarray]:
    """Return, for each feature of SHOWN, the lanes that show it."""
    model, pairs = sample.level.model, pairs_of(sample.level.size)
    n, m = len(pairs.polygon), len(pairs.circle_polygon)
    active = sample.after.contact_active
    turn = [np.take_along_axis(sample.state.rotation, body, 0) for body in (model.joint_a, model.joint_b)]
    angle = turn[1] - turn[0] - model.joint_rotation
    revolute = model.joint_active & ~model.joint_fixed
    return {
        "polygon contact": active[:n].any(0),
        "two-point polygon contact": (active[:n] & active[n : 2 * n]).any(0),
        "circle-polygon contact": active[2 * n : 2 * n + m].any(0),
        "circle-circle contact": active[2 * n + m :].any(0),
        "circle centre inside a polygon": circles_inside(sample),
        "joint beyond its limit": (
            revolute & model.joint_limited & ((angle < model.joint_min) | (angle > model.joint_max))
        ).any(0),
        "fixed joint": (model.joint_active & model.joint_fixed).any(0),
        "driven motor": (revolute & model.motor_on & (sample.motor != 0)).any(0),
        "firing thruster": (model.thruster_active & (sample.thrust != 0)).any(0),
        "triangle": (model.active[: sample.level.size.polygons] & (model.n_vertices == 3)).any(0),
    }


@pytest.mark.parametrize("size", SIZES)
def test_golden_states_show_everything(size: str) -> None:
    sample = golden(size)
    assert sample.reward.size >= 500
    assert sample.about["versions"]["jax2d"] == "1.0.1"
    counts = {name: int(lanes.sum()) for name, lanes in shows(sample).items()}
    missing = {name: counts[name] for name, least in SHOWN.items() if counts[name] < least}
    assert not missing, f"size {size} shows too little: {missing}"


@pytest.mark.parametrize("size", SIZES)
def test_one_step_agrees_with_the_reference(size: str) -> None:
    worst = errors(stepped(size), golden(size).after)
    assert (worst < 1e-3).mean() >= 0.995, np.sort(worst)[-10:]
    assert (worst < 1e-4).mean() >= 0.98, np.sort(worst)[-20:]
    assert np.median(worst) < 5e-6


@pytest.mark.parametrize("size", SIZES)
def test_step_agrees_with_the_reference_in_every_kind_of_state(size: str) -> None:
    """No kind of state hides its errors behind the others."""
    worst = errors(stepped(size), golden(size).after)
    for name, lanes in shows(golden(size)).items():
        assert (worst[lanes] < 1e-3).mean() >= 0.98, name
        assert (worst[lanes] < 1e-4).mean() >= 0.9, name  # circles deep in a polygon amplify rounding most


@pytest.mark.parametrize("size", SIZES)
def test_warm_start_state_agrees_with_the_reference(size: str) -> None:
    """Which contacts are active, and the impulses that warm starting reads."""
    ours, sample = stepped(size), golden(size)
    assert (ours.contact_active == sample.after.contact_active).all(0).mean() >= 0.995
    names = ("contact_normal_impulse", "contact_tangent_impulse", "joint_impulse", "joint_angular_impulse")
    for name in names:
        a, b = getattr(ours, name), getattr(sample.after, name)
        if name.startswith("contact"):  # the reference leaves stale impulses in inactive contacts and never reads them
            a, b = np.where(sample.after.contact_active, a, 0), np.where(sample.after.contact_active, b, 0)
        off = np.abs(a - b) / (1 + np.abs(b))
        assert (off.reshape(-1, off.shape[-1]).max(0) < 1e-3).mean() >= 0.985, name


def test_golden_states_show_the_padding_defect() -> None:
    """Without the padding defect some states of size s differ, and only those with a padded pair."""
    sample = golden("s")
    fixed = jax.jit(
        lambda model, state, motor, thrust: step(model, state, motor, thrust, Params(faithful_padding=False))[0]
    )
    after = jax.tree.map(np.asarray, fixed(sample.level.model, sample.state, sample.motor, sample.thrust))
    pairs = pairs_of(sample.level.size)
    n, m = len(pairs.polygon), len(pairs.circle_polygon)
    last = np.zeros(sample.reward.size, bool)
    for contact in (n - 1, 2 * n - 1, 2 * n + m - 1, 2 * n + m + len(pairs.circle) - 1):
        last |= sample.after.contact_active[contact]
    differs = errors(after, stepped("s")) > 1e-4
    assert differs.sum() > 20
    assert not (differs & ~last).any()


def test_golden_files_are_small() -> None:
    assert sum(path.stat().st_size for path in HERE.glob("*.npz")) < 6e6


def test_golden_states_are_complete() -> None:
    for size in SIZES:
        sample = golden(size)
        lanes = sample.reward.size
        for tree in (sample.state, sample.after, sample.env_after):
            for field in dataclasses.fields(tree):
                value = getattr(tree, field.name)
                assert value.shape[-1] == lanes
                assert np.isfinite(value).all(), field.name


@pytest.mark.campaign
@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Params) if field.type is float])
def test_every_constant_has_an_effect(name: str) -> None:
    """A number in place of a setting that has the same default would agree with the reference, too."""
    sample, default, factor = golden("m"), Params(), 0.01 if name.startswith("max_") else 0.5
    changed = dataclasses.replace(default, **{name: factor * getattr(default, name)})
    compiled = jax.jit(lambda model, state, motor, thrust: step(model, state, motor, thrust, changed)[0])
    after, before = compiled(sample.level.model, sample.state, sample.motor, sample.thrust), stepped("m")
    assert any((np.asarray(getattr(after, field)) != getattr(before, field)).any() for field in MOTION)

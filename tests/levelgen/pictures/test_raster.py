"""Pictures show what they must, in the colours of their style; films play."""

import dataclasses

import jax
import numpy as np
import pytest
from PIL import Image

from levelproof.levelgen.level import WORLD_SIDE, Role
from levelproof.levelgen.pictures.raster import draw, sheet, write_gif, write_png
from levelproof.levelgen.pictures.style import BINDING_COLOUR, BORDER, HEADER, ROLE_COLOUR
from levelproof.levelgen.pictures.words import Caption, obeyed_entries
from tests.golden.load import golden

OFF = np.zeros(6, np.int32)


@pytest.fixture(scope="module")
def sample():
    return golden("m")


def shows(picture: Image.Image, colour: tuple[int, int, int]) -> bool:
    return bool((np.asarray(picture) == colour).all(-1).any())


def changed(left: Image.Image, right: Image.Image) -> int:
    return int((np.asarray(left) != np.asarray(right)).any(-1).sum())


def lane_with(flag: np.ndarray) -> int:
    """Return a lane in which some entry of flag (row, lane) holds."""
    return int(np.flatnonzero(flag.any(0))[0])


def test_picture_shows_bodies_in_their_role_colours(sample) -> None:
    model = sample.level.model
    movable = model.active & (model.inverse_mass != 0)
    for role in Role:
        lanes = np.flatnonzero((movable & (sample.level.role == role) & (sample.state.position[:, 1] > 0.3)).any(0))[:5]
        shown = [shows(draw(sample.level, sample.state, lane), ROLE_COLOUR[role]) for lane in lanes]
        assert sum(shown) >= 4, role  # a body may hide behind another


def test_pictures_of_a_level_have_one_size(sample) -> None:
    plain = draw(sample.level, sample.state, 0)
    assert plain.size[0] == 480
    assert draw(sample.level, sample.state, 1).size == plain.size
    assert draw(sample.level, sample.state, 1, action=OFF).size[1] > plain.size[1]
    assert draw(sample.level, sample.state, 0, pixels=240).size[0] == 240


def test_picture_hatches_immovable_bodies(sample) -> None:
    """The same circle, fixed and free: the fixed one has more edge colour than fill."""
    model = sample.level.model
    lane = lane_with(model.active & (model.inverse_mass != 0) & (sample.level.role == Role.PLAIN))
    inverse_mass = model.inverse_mass.copy()
    inverse_mass[:, lane] = 0
    held = dataclasses.replace(sample.level, model=dataclasses.replace(model, inverse_mass=inverse_mass))
    assert changed(draw(sample.level, sample.state, lane), draw(held, sample.state, lane)) > 100
    assert not shows(draw(held, sample.state, lane), ROLE_COLOUR[Role.PLAIN])


@pytest.mark.parametrize("actuator", ["motor", "thruster"])
def test_picture_shows_actuators_in_use(sample, actuator: str) -> None:
    level, model = sample.level, sample.level.model
    if actuator == "motor":
        acts = model.joint_active & model.motor_on & ~model.joint_fixed & ~level.motor_auto
    else:
        acts = model.thruster_active
    lane = lane_with(acts[:1])
    used = OFF.copy()
    entry = int(level.motor_binding[0, lane]) if actuator == "motor" else 4 + int(level.thruster_binding[0, lane])
    used[entry] = 1
    off, on = draw(level, sample.state, lane, action=OFF), draw(level, sample.state, lane, action=used)
    world = (0, 40, 480, off.size[1] - 30)  # without caption and keys
    assert changed(off.crop(world), on.crop(world)) > 20
    assert shows(on, BINDING_COLOUR[entry])


def test_arrow_follows_the_sign_of_a_motors_speed(sample) -> None:
    """As in a level file, or a mirrored motor that runs by itself."""
    level, model = sample.level, sample.level.model
    lane = lane_with((model.joint_active & model.motor_on & ~model.joint_fixed & ~level.motor_auto)[:1])
    backwards = dataclasses.replace(level, model=dataclasses.replace(model, motor_speed=-model.motor_speed))
    entry, choices = int(level.motor_binding[0, lane]), []
    for choice in (1, 2):
        choices.append(OFF.copy())
        choices[-1][entry] = choice
    forward, back = (draw(level, sample.state, lane, action=action) for action in choices)
    assert changed(forward, back) > 20
    world = (0, 40, 480, forward.size[1] - 30)  # without caption and keys
    for action, expected in zip(choices, (back, forward), strict=True):
        drawn = draw(backwards, sample.state, lane, action=action)
        assert changed(drawn.crop(world), expected.crop(world)) == 0


def test_flame_points_opposite_to_the_force(sample) -> None:
    """The engine pushes a body along its thruster; the flame is on the other side."""
    model, state = sample.level.model, sample.state
    lane = lane_with(model.thruster_active[:1])
    body = int(model.thruster_body[0, lane])
    turn = state.rotation[body, lane] + np.array([0, model.thruster_rotation[0, lane]])
    arm = model.thruster_position[0, :, lane]
    place = state.position[body, :, lane] + np.array(
        [
            arm[0] * np.cos(turn[0]) - arm[1] * np.sin(turn[0]),
            arm[0] * np.sin(turn[0]) + arm[1] * np.cos(turn[0]),
        ]
    )
    push = np.array([np.cos(turn.sum()), np.sin(turn.sum())])
    used = OFF.copy()
    used[4 + int(sample.level.thruster_binding[0, lane])] = 1
    off, on = (np.asarray(draw(sample.level, state, lane, action=x)).astype(int) for x in (OFF, used))
    rows, columns = np.nonzero((off != on).any(-1)[40:-30])
    scale = 480 / (WORLD_SIDE + 2 * BORDER)
    middle = np.array([columns.mean() / scale - BORDER, WORLD_SIDE + BORDER + HEADER - (rows.mean() + 40) / scale])
    assert np.dot(middle - place, push) < -0.1


def test_obeyed_entries_are_those_of_the_action_mask_but_for_motors_without_a_player(sample) -> None:
    seen = set[int]()
    for lane in range(64):
        one = jax.tree.map(lambda x, lane=lane: x[..., lane], sample.level)
        obeyed, mask = obeyed_entries(one), np.flatnonzero(sample.action_mask[:, lane])
        turns = one.model.joint_active & ~one.model.joint_fixed
        if (one.model.motor_on & ~one.motor_auto)[turns].all():
            assert obeyed == [*mask]
            seen |= {*obeyed}
        else:
            assert {*obeyed} <= {*mask}
    assert seen == {*range(len(OFF))}


def test_picture_shows_its_caption(sample) -> None:
    bare = draw(sample.level, sample.state, 0)
    captioned = draw(sample.level, sample.state, 0, caption=Caption("level 7 · size m", "1.2 s", "goal reached"))
    bad = draw(sample.level, sample.state, 0, caption=Caption("level 7 · size m", "1.2 s", "touched red", good=False))
    assert changed(bare, captioned) > 500
    assert shows(captioned.crop((0, 0, 480, 34)), ROLE_COLOUR[Role.GREEN])
    assert shows(bad.crop((0, 0, 480, 34)), ROLE_COLOUR[Role.RED])


def test_gif_shows_each_picture_for_its_time(sample, tmp_path) -> None:
    pictures = [draw(sample.level, sample.state, lane, pixels=160) for lane in range(5)]
    write_gif(pictures, tmp_path / "film.gif", [0.07] * 4 + [1.0])
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 5
        assert film.info["loop"] == 0
        assert film.info["duration"] == 70
        film.seek(4)
        assert film.info["duration"] == 1000
        last = np.asarray(film.convert("RGB")).astype(int)
    assert np.abs(last - np.asarray(pictures[4]).astype(int)).mean() < 4  # 128 colours are enough
    write_png(sheet(pictures, 3), tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as page:
        assert page.size == (3 * pictures[0].size[0], 2 * pictures[0].size[1])

"""Level files without the reference: round trips, and untrusted files."""

import copy
import dataclasses
import functools
import json
import os
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levelproof.levelgen.files.entries import LevelFileError
from levelproof.levelgen.files.kinetix import MANIFOLDS
from levelproof.levelgen.files.level_file import (
    MAX_BYTES,
    LevelFile,
    from_document,
    parse,
    read_level_file,
    to_document,
    write_level_file,
)
from levelproof.levelgen.level import SIZES, Level
from levelproof.levelgen.sampling.sampler import Distribution, sample_levels
from levelproof.levelgen.sampling.scenery import empty_level
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import Params, Size
from tests.trees import assert_same

RULES = TaskParams(frame_skip=3, max_timesteps=100, dense_reward_scale=0.5, physics=Params(dt=0.01, motor_power=500.0))
MAX_MEMORY = 250e6  # bytes, for the worst file of MAX_BYTES


@functools.cache
def levels(size: Size, count: int = 8) -> Level:
    return jax.tree.map(np.asarray, sample_levels(np.arange(count), size, Distribution()))


def one(level: Level, lane: int) -> Level:
    return jax.tree.map(lambda x: x[..., lane : lane + 1], level)


@functools.cache
def document() -> Any:
    """Return the JSON of a level of size s. Do not modify it."""
    return json.loads(json.dumps(to_document(LevelFile(one(levels(SIZES["s"]), 2), TaskParams()))))


def changed(path: str, value: object) -> Any:
    """Return `document()` with another value at a path such as `env_state.polygon.4.radius`."""
    altered = copy.deepcopy(document())
    *parents, last = path.split(".")
    parent = functools.reduce(lambda x, key: x[int(key) if isinstance(x, list) else key], parents, altered)
    parent[int(last) if isinstance(parent, list) else last] = value
    return altered


def assert_same_file(ours: LevelFile, theirs: LevelFile) -> None:
    assert ours.rules == theirs.rules
    assert_same(ours.level, theirs.level)


# A size that other tests sample, so that their compiled program is reused; others in a campaign
OTHERS = (SIZES["m"], SIZES["l"], Size(4, 3, 2, 2), Size(7, 1, 3, 4))
ROUND_TRIPS = [SIZES["s"], *(pytest.param(size, marks=pytest.mark.campaign) for size in OTHERS)]


@pytest.mark.slow
@pytest.mark.parametrize("size", ROUND_TRIPS, ids=str)
def test_sampled_level_survives_a_round_trip(size: Size, tmp_path: Path) -> None:
    for lane in range(8):
        file = LevelFile(one(levels(size), lane), RULES)
        write_level_file(file, tmp_path / "level.json")
        assert_same_file(read_level_file(tmp_path / "level.json"), file)
    assert os.listdir(tmp_path) == ["level.json"]


@pytest.mark.parametrize("size", [Size(5, 0, 0, 0), Size(4, 1, 0, 0), Size(64, 64, 64, 64)], ids=str)
def test_smallest_and_largest_sizes_fit_into_a_file(size: Size, tmp_path: Path) -> None:
    write_level_file(LevelFile(empty_level(size, 1), TaskParams()), tmp_path / "level.json")
    assert (tmp_path / "level.json").stat().st_size < MAX_BYTES
    assert read_level_file(tmp_path / "level.json").level.size == size


def test_write_level_file_accepts_a_string_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_level_file(LevelFile(empty_level(SIZES["s"], 1), TaskParams()), "level.json")
    assert read_level_file("level.json").level.size == SIZES["s"]


def test_file_has_all_entries_that_the_reference_requires() -> None:
    world = document()["env_state"]
    assert list(document()) == ["env_state", "env_params", "static_env_params"]
    assert [len(world[kind]) for kind in ("polygon", "circle", "joint", "thruster", *MANIFOLDS)] == [
        *(5, 2, 1, 1),
        *(8, 10, 1),  # two points of each of four polygon pairs, circle-polygon pairs, circle pairs
    ]
    assert world["gravity"] == {"0": 0.0, "1": float(np.float32(-9.81))}
    assert world["polygon"][0]["vertices"]["3"] == {"0": -2.5, "1": float(np.float32(5.2))}
    assert document()["env_params"]["baumgarte_coefficient_collision"] == 0.2


def test_file_positions_of_joints_agree_with_both_bodies() -> None:
    """A joint's position is computed from body a; at the start of a level, body b gives the same."""
    checked = 0
    for lane in range(8):
        world = to_document(LevelFile(one(levels(SIZES["s"]), lane), TaskParams()))["env_state"]
        bodies = world["polygon"] + world["circle"]
        for joint in world["joint"]:
            if joint["active"]:
                body, anchor = bodies[joint["b_index"]], joint["b_relative_pos"]
                turned = complex(anchor["0"], anchor["1"]) * np.exp(1j * body["rotation"])
                place = complex(body["position"]["0"], body["position"]["1"]) + turned
                assert abs(place - complex(joint["global_position"]["0"], joint["global_position"]["1"])) < 1e-5
                checked += 1
    assert checked > 3


def test_writer_refuses_levels_that_a_file_cannot_hold() -> None:
    level = one(levels(SIZES["s"]), 2)
    assert level.model.joint_active.all()
    own_will = dataclasses.replace(level, motor_auto=np.ones_like(level.motor_auto))
    touching = dataclasses.replace(
        level, state=dataclasses.replace(level.state, contact_active=np.ones_like(level.state.contact_active))
    )
    broken = dataclasses.replace(
        level, state=dataclasses.replace(level.state, position=np.full_like(level.state.position, np.nan))
    )
    apart = dataclasses.replace(
        level, model=dataclasses.replace(level.model, collides=np.zeros_like(level.model.collides))
    )
    for altered, words in (
        (levels(SIZES["s"]), "8 levels"),
        (apart, "bodies collide otherwise than its joints imply"),
        (own_will, "runs by itself"),
        (touching, "starts with contacts"),
        (broken, r"polygon\[0\]\.position\.0 is NaN"),
    ):
        with pytest.raises(LevelFileError, match=words):
            to_document(LevelFile(altered, TaskParams()))


NUMBER = r"but must be a number from -1,000 to 1,000"
WRONG = [
    ("env_state.polygon.4.position.1", float("nan"), rf"^env_state\.polygon\[4\]\.position\.1 is NaN, {NUMBER}$"),
    ("env_state.polygon.4.position.1", float("inf"), f"is Infinity, {NUMBER}"),
    ("env_state.polygon.4.position.1", 1e30, f"is 1e.30, {NUMBER}"),
    ("env_state.polygon.4.position.1", "0.5", f'is "0.5", {NUMBER}'),
    ("env_state.polygon.4.position.1", True, f"is true, {NUMBER}"),
    ("env_state.polygon.4.position", 3, r"position is 3, but must be an object$"),
    ("env_state.polygon.4.position", [1, 2], "position is a list, but must be an object"),
    ("env_state.polygon.4.position", {"0": 1}, r"polygon\[4\]\.position\.1 is missing$"),
    ("env_state.polygon.4", None, r"polygon\[4\] is null, but must be an object"),
    ("env_state.circle.1.radius", -1, r"circle\[1\]\.radius is -1, but must be a number from 0 to 1,000"),
    ("env_state.circle.1.active", 1, "active is 1, but must be true or false"),
    ("env_state.circle.1.role", 4, "role is 4, but must be a whole number from 0 to 3"),
    ("env_state.circle.1.role", 1.0, "role is 1.0, but must be a whole number"),
    ("env_state.joint.0.a_index", 7, r"joint\[0\]\.a_index is 7, but must be a whole number from 0 to 6"),
    ("env_state.joint.0.b_index", -1, "b_index is -1"),
    ("env_state.joint.0.motor_binding", 4, r"joint\[0\] has a motor_binding beyond 3"),
    ("env_state.thruster.0.object_index", 10**30, r"object_index is 10{30}, but must be"),
    ("env_state.thruster.0.object_index", 10**4000, r"object_index is 10+ \.\.\., but must be"),
    ("env_state.thruster", {}, r"thruster is an object, but static_env_params.num_thrusters is 1"),
    ("env_state.polygon", [], "polygon is a list of 0, but static_env_params.num_polygons is 5"),
    ("env_state.polygon", [0] * 1_000_000, "polygon is a list of 1000000, but static_env_params.num_polygons is 5"),
    ("env_state.polygon.4.n_vertices", 2, r"polygon\[4\] is active and has fewer than 3 vertices"),
    ("env_state.polygon.2.inverse_mass", 1, r"polygon\[2\] is scenery and may move"),
    ("env_state.polygon.0.velocity", {"0": 0, "1": 1}, r"polygon\[0\] is scenery and may move"),
    ("static_env_params.num_polygons", 1_000_000, r"num_polygons is 1000000, but must be a whole number from 4 to 64"),
    ("static_env_params.num_polygons", 3, "num_polygons is 3"),
    ("static_env_params.solver_batch_size", 8, "solver_batch_size is 8, but this engine supports only 16"),
    ("static_env_params.do_warm_starting", False, "do_warm_starting is false, but this engine supports only true"),
    ("static_env_params.frame_skip", 0, "frame_skip is 0, but must be a whole number from 1 to 1e.06"),
    ("env_params.dt", 0, "env_params.dt is 0, but must be a number from 1e-06 to 1"),
    ("env_params", "x" * 1000, r'^env_params is "x{39} \.\.\., but must be an object'),
]


@pytest.mark.parametrize(("path", "value", "words"), WRONG, ids=lambda x: str(x)[:30])
def test_reader_names_the_path_of_a_wrong_value(path: str, value: object, words: str) -> None:
    assert document()["env_state"]["thruster"][0]["active"] in (True, False)
    with pytest.raises(LevelFileError, match=words):
        parse(json.dumps(changed(path, value)).encode())


def test_reader_refuses_a_joint_from_a_body_to_itself() -> None:
    altered = changed("env_state.joint.0.a_index", 4)
    altered["env_state"]["joint"][0]["b_index"] = 4
    with pytest.raises(LevelFileError, match="joins a body to itself"):
        from_document(altered)


@pytest.mark.parametrize(
    ("kind", "binding", "most", "names"),
    [
        ("joint", 4, 3, "motor"),
        ("joint", 255, 3, "motor"),
        ("thruster", 2, 1, "thruster"),
        ("thruster", 3, 1, "thruster"),
    ],
)
def test_reader_refuses_unknown_bindings_of_active_actuators(kind: str, binding: int, most: int, names: str) -> None:
    """A policy reads the bindings of a motor that is off and of a fixed joint, so these are checked, too."""
    for switches in ({}, {"motor_on": False}, {"is_fixed_joint": True}):
        altered = changed(f"env_state.{kind}.0.{names}_binding", binding)
        altered["env_state"][kind][0] |= {"active": True, **(switches if kind == "joint" else {})}
        with pytest.raises(LevelFileError, match=rf"^env_state\.{kind}\[0\] has a {names}_binding beyond {most}$"):
            from_document(altered)


@pytest.mark.parametrize("kind", ["motor", "thruster"])
@pytest.mark.parametrize("binding", [-1, 256, 1.0, None])
def test_reader_refuses_malformed_bindings_of_any_actuator(kind: str, binding: object) -> None:
    row_kind = "joint" if kind == "motor" else kind
    altered = changed(f"env_state.{row_kind}.0.{kind}_binding", binding)
    altered["env_state"][row_kind][0]["active"] = False
    with pytest.raises(LevelFileError, match=rf"{kind}_binding is .*, but must be a whole number from 0 to 255$"):
        from_document(altered)


def test_reader_zeroes_unknown_bindings_of_inactive_actuators() -> None:
    """Two thrusters of the reference's own levels have such bindings, which no shard may have."""
    for kind, name, most in ("thruster", "thruster", 1), ("joint", "motor", 3):
        for binding, read in (most, most), (most + 1, 0), (255, 0):
            altered = changed(f"env_state.{kind}.0.{name}_binding", binding)
            altered["env_state"][kind][0]["active"] = False
            assert getattr(from_document(altered).level, f"{name}_binding")[0, 0] == read


def test_reader_refuses_a_size_without_room_for_bodies() -> None:
    altered = changed("static_env_params.num_polygons", 4)
    altered["static_env_params"]["num_circles"] = 0
    with pytest.raises(LevelFileError, match="no room for a body"):
        from_document(altered)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "it is not JSON"),
        (b"\xff\xfe", "it is not UTF-8 text"),
        (b"{", "it is not JSON"),
        (b"[" * MAX_BYTES, "nested too deeply"),
        (b'{"a":' * (MAX_BYTES // 5), "nested too deeply"),
        (b"1" * 5000, "it is not JSON"),
        (b"[]", "the whole file is a list, but must be an object"),
        (b"{}", "^env_state is missing$"),
        (b"null", "the whole file is null"),
    ],
    ids=lambda x: str(x)[:12],
)
def test_parse_refuses_text_that_is_not_a_level(text: bytes, words: str) -> None:
    with pytest.raises(LevelFileError, match=words):
        parse(text)


JUNK = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([0, 1, -1, 3, 64, 65, 255, 2**31, 2**63, 10**400])
    | st.floats()
    | st.sampled_from([1e-45, 1e38, 1e39, -0.0])
    | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.sampled_from(["0", "1", "a"]), inner, max_size=3),
    max_leaves=6,
)


@functools.cache
def paths() -> list[tuple[str, ...]]:
    """Return the path of every value in the level that the reader reads."""

    def below(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        yield path
        entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, entry in entries:
            if key not in (*MANIFOLDS, "collision_matrix"):
                yield from below(entry, (*path, str(key)))

    return [path for path in below(document(), ()) if path]


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(0, 10_000), st.just("set") | st.just("drop"), JUNK), min_size=1, max_size=3))
@settings(max_examples=150, deadline=None)
def test_reader_reads_or_refuses_arbitrary_values_anywhere(changes) -> None:
    altered = copy.deepcopy(document())
    for number, what, junk in changes:
        *parents, last = paths()[number % len(paths())]
        try:
            parent = functools.reduce(lambda x, key: x[int(key) if isinstance(x, list) else key], parents, altered)
            key = int(last) if isinstance(parent, list) else last
            if what == "set":
                parent[key] = copy.deepcopy(junk)
            else:
                del parent[key]
        except (KeyError, IndexError, TypeError, ValueError, AttributeError):
            continue  # an earlier change removed the path
    assert_sentence_or_level(json.dumps(altered).encode())


@given(st.binary(max_size=60), st.integers(0, 3_000), st.integers(0, 40))
@settings(max_examples=150, deadline=None)
def test_reader_reads_or_refuses_arbitrary_bytes(junk: bytes, start: int, length: int) -> None:
    assert_sentence_or_level(junk)
    text = json.dumps(document()).encode()
    assert_sentence_or_level(text[:start] + junk + text[start + length :])


def assert_sentence_or_level(text: bytes) -> None:
    refused, file = "", None
    try:
        file = parse(text)
    except LevelFileError as error:
        refused = str(error)
    if file is None:
        assert 0 < len(refused) < 400
        assert "\n" not in refused
        return
    for leaf in jax.tree.leaves(file.level):
        assert np.isfinite(leaf).all()
    assert_same_file(from_document(to_document(file)), file)


BITS = {"objects": b"{},", "fuller objects": b'{"":0},', "lists in lists": b"[" * 900 + b"]" * 900 + b","}


@pytest.mark.slow
@pytest.mark.parametrize("bit", BITS.values(), ids=BITS)
def test_reader_bounds_memory_for_any_file(bit: bytes, tmp_path: Path) -> None:
    path = tmp_path / "level.json"
    path.write_bytes(b"[" + bit * ((MAX_BYTES - 3) // len(bit)) + b"0]")
    assert peak_memory(path) < MAX_MEMORY


def test_reader_does_not_read_a_gigabyte(tmp_path: Path) -> None:
    path = tmp_path / "level.json"
    with path.open("wb") as file:
        file.truncate(1 << 30)  # sparse: uses no disk space
    assert peak_memory(path) < 1e6


def peak_memory(path: Path) -> int:
    """Return the peak memory of refusing a file, bytes."""
    tracemalloc.start()
    try:
        with pytest.raises(LevelFileError, match=r"^Cannot use the level file "):
            read_level_file(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_reader_refuses_a_missing_or_irregular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    for name, words in (
        ("pipe.json", "not a regular file"),
        (".", "not a regular file"),
        ("nothing.json", r"^Cannot read the level file .*nothing\.json \(No such file or directory\)\.$"),
        ("x" * 300, "File name too long"),
    ):
        with pytest.raises(LevelFileError, match=words):
            read_level_file(tmp_path / name)

"""Folders of trajectories from any source: read exactly, or rejected in one sentence."""

import json
import os
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numcodecs import Blosc

from levelproof.levelgen.level import SIZES
from levelproof.levelgen.task.actions import CHOICES
from levelproof.pipeline.read.kinetix.folder import Trajectories, open_folder, read_trajectories
from levelproof.pipeline.read.kinetix.zarr2 import FormatError, StoredArray
from levelproof.pipeline.store.contents import highest
from levelproof.pipeline.store.fields import arrays_of
from tests.pipeline.read.kinetix.folder import GOLDEN, OTHERS, SOLVED, to_ours, trajectories_in

ONE_WAY = "its collision matrix lets a body collide with another, but not that one with it"
MAX_MEMORY = 20e6  # bytes; a chunk of four trajectories takes 1.5 MB


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    return Path(shutil.copytree(GOLDEN / "s", tmp_path / "theirs"))


def read(folder: Path) -> list[Trajectories]:
    """Read everything in a folder."""
    return [read_trajectories(array, 0, array.rows) for array in open_folder(folder).arrays]


@pytest.mark.parametrize("size", ["s", "m"])
def test_read_trajectories_accepts_any_chunk_shape(size: str) -> None:
    folder, (level, record) = open_folder(GOLDEN / size), to_ours(trajectories_in(GOLDEN / size))
    assert (folder.size, folder.rows) == (SIZES[size], SOLVED + OTHERS)
    first, second = folder.arrays
    assert (first.chunks, second.chunks) == ((4, 256), (2, 100))
    for array, start, stop, offset in ((first, 0, 3, 0), (second, 1, 4, first.rows), (second, 3, 4, first.rows)):
        trajectories = read_trajectories(array, start, stop)
        at = slice(offset + start, offset + stop)
        assert trajectories.wrong == [""] * (stop - start)
        np.testing.assert_array_equal(trajectories.action, record.action[..., at])
        np.testing.assert_array_equal(trajectories.level.state.position, level.state.position[..., at])
        np.testing.assert_array_equal(trajectories.level.model.vertices, level.model.vertices[..., at])


def test_one_way_collisions_and_contacts_at_the_start_are_named(theirs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The engine would see them, but neither content hashes nor level files would."""
    chunk = StoredArray._chunk

    def altered(array: StoredArray, i: int, j: int) -> np.ndarray:
        values = chunk(array, i, j).copy()
        values["env_state/collision_matrix"][1, 0, 6, 4] ^= True  # of a circle and a polygon
        values["env_state/acc_cr_manifolds/active"][2, 0, 3] = True
        return values

    monkeypatch.setattr(StoredArray, "_chunk", altered)
    wrong = read_trajectories(open_folder(theirs).arrays[0], 0, 3).wrong
    assert wrong == ["", ONE_WAY, "it begins with contacts, which levels do not"]


def changed(**entries: Any) -> Callable[[Path], None]:
    """Return a change of entries in the metadata of the first array."""

    def change(folder: Path) -> None:
        path = folder / "first/.zarray"
        path.write_text(json.dumps(json.loads(path.read_text()) | entries))

    return change


def fields(change: Callable[[list[Any]], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        about = json.loads((folder / "first/.zarray").read_text())
        change(about["dtype"])
        (folder / "first/.zarray").write_text(json.dumps(about))

    return apply


def put(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(data)


def pipe(folder: Path) -> None:
    (folder / "first/0.0").unlink()
    os.mkfifo(folder / "first/0.0")


def bomb(folder: Path) -> None:
    """Make a chunk claim that it decodes to four gigabytes."""
    path = folder / "first/0.0"
    raw = bytearray(path.read_bytes())
    raw[4:8] = (2**32 - 1).to_bytes(4, "little")
    path.write_bytes(raw)


LISTS = json.dumps([[] for _ in range(3)]).encode()
SIZE = [["env_state/polygon/n_vertices", "<i4", [1, 900]], ["env_state/circle/radius", "<f4", [1, 2]],
        ["env_state/joint/active", "|b1", [1, 1]], ["env_state/thruster/active", "|b1", [1, 1]]]  # fmt: skip
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no group": (lambda folder: (folder / ".zgroup").unlink(), "there is no .zgroup in"),
    "zarr 3": (put(".zgroup", b'{"zarr_format": 3}'), "is not of zarr format 2"),
    "no JSON": (put(".zgroup", b"{"), "cannot be read"),
    "deep": (put("first/.zarray", b"[" * 2**21), "cannot be read"),
    "a list": (put("first/.zarray", LISTS), "its array first has invalid metadata"),
    "no arrays": (lambda folder: [shutil.rmtree(folder / name) for name in ("first", "second")], "no trajectories"),
    "two steps": (changed(shape=[3, 2]), "has the shape [3, 2], but must have (trajectories, 256)"),
    "many": (changed(shape=[2**62, 256]), "has the shape"),
    "negative": (changed(shape=[-3, 256]), "has the shape"),
    "a word": (changed(shape="many"), "has the shape many"),
    "too many": (
        changed(shape=[10**11, 256]),
        "claims 100,000,000,004 trajectories, more than the maximum of 100,000,000",
    ),
    "more rows": (changed(shape=[300, 256]), "its chunk"),
    "no chunks": (changed(chunks=[0, 256]), "has the shape"),
    "large chunks": (changed(chunks=[2**30, 256]), "of more than 1,073,741,824 bytes"),
    "other chunks": (changed(chunks=[3, 256]), "is not the 1,142,016 bytes"),
    "zlib": (changed(compressor={"id": "zlib", "level": 1}), "compressed by 'zlib', but must use blosc"),
    "a pickle": (changed(compressor={"id": "pickle"}), "compressed by 'pickle'"),
    "no compressor": (changed(compressor=None), "is damaged"),
    "filters": (changed(filters=[{"id": "pickle"}]), "has filters"),
    "Fortran": (changed(order="F"), "has filters, an order other than C"),
    "objects": (
        fields(lambda dtype: dtype.append(["extra", "|O", [1]])),
        "its field extra has the type |O, which is not a number",
    ),
    "strings": (fields(lambda dtype: dtype.append(["extra", "<U9999999", [1]])), "which is not a number or flag"),
    "a huge field": (fields(lambda dtype: dtype.append(["extra", "<f4", [1, 2**40]])), "its array first"),
    "a repeated name": (fields(lambda dtype: dtype.append(dtype[0])), "has invalid metadata"),
    "no action": (
        fields(lambda dtype: dtype.remove(next(x for x in dtype if x[0] == "action"))),
        "has no field action",
    ),
    "float actions": (
        fields(lambda dtype: next(x for x in dtype if x[0] == "action").__setitem__(1, "<f4")),
        "the field action of its array first is float32 of shape (6,), but must be int32",
    ),
    "floats as flags": (
        fields(lambda dtype: next(x for x in dtype if x[0] == "env_state/joint/active").__setitem__(1, "<f4")),
        "the field env_state/joint/active of its array first is float32 of shape (1,), but must be bool",
    ),
    "flags as floats": (
        fields(lambda dtype: next(x for x in dtype if x[0] == "env_state/polygon/position").__setitem__(1, "|b1")),
        "the field env_state/polygon/position of its array first is bool",
    ),
    "no size": (fields(lambda dtype: dtype.__setitem__(slice(None), SIZE)), "do not match any level size"),
    "missing": (lambda folder: (folder / "first/0.0").unlink(), "0.0 is missing"),
    "a pipe": (pipe, "0.0 is missing"),
    "empty": (put("first/0.0", b""), "is not the 1,522,688 bytes"),
    "long": (put("first/0.0", bytes(2**21)), "is larger than its contents"),
    "a bomb": (bomb, "is not the 1,522,688 bytes"),
    "another": (put("first/0.0", Blosc().encode(bytes(100))), "is not the 1,522,688 bytes"),
}


@pytest.mark.parametrize(("change", "message"), HOSTILE.values(), ids=HOSTILE)
def test_open_folder_rejects_hostile_folders_in_one_sentence_and_little_memory(
    theirs: Path, change: Callable[[Path], object], message: str
) -> None:
    change(theirs)
    tracemalloc.start()
    try:
        with pytest.raises(FormatError) as error:
            read(theirs)
        assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY
    finally:
        tracemalloc.stop()
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_read_trajectories_reports_a_flipped_byte_or_returns_checked_values(theirs: Path) -> None:
    """Blosc chunks have no checksum, so values read after a flip are checked like any untrusted ones."""
    path, rng = theirs / "first/0.0", np.random.default_rng(0)
    raw, refused, wrong = path.read_bytes(), 0, list[str]()
    flips = [*range(16), *rng.integers(16, len(raw), 24).tolist()]
    for at in flips:
        broken = bytearray(raw)
        broken[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            trajectories = read(theirs)
        except FormatError as error:
            assert "its chunk" in str(error)  # noqa: PT017
            refused += 1
            continue
        for each in trajectories:
            require_usable(each)
            wrong += each.wrong
    assert 0 < refused < len(flips)
    assert any(wrong)


def require_usable(trajectories: Trajectories) -> None:
    """Check that all values of trajectories that are not reported are finite and within bounds."""
    good = np.array([not reason for reason in trajectories.wrong])
    action, maxima = trajectories.action[..., good], highest(SIZES["s"])
    assert ((action >= 0) & (action < np.array(CHOICES)[:, None])).all()
    for name, values in arrays_of(trajectories.level, "level/").items():
        some = np.asarray(values)[..., good]
        assert np.isfinite(some).all(), name
        assert name not in maxima or ((some >= 0) & (some <= maxima[name])).all(), name

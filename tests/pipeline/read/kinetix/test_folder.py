"""Folders of trajectories from anywhere: read as they are, or refused in one sentence."""

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
from levelproof.pipeline.read.kinetix.folder import open_folder, read_trajectories
from levelproof.pipeline.read.kinetix.zarr2 import FormatError
from tests.pipeline.read.kinetix.folder import GOLDEN, OTHERS, SOLVED, ours_of, trajectories_in

MAX_MEMORY = 20e6  # bytes; a chunk of four trajectories has 1.5 MB


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    return Path(shutil.copytree(GOLDEN / "s", tmp_path / "theirs"))


def read(folder: Path) -> None:
    """All that is read of a folder."""
    found = open_folder(folder)
    for array in found.arrays:
        read_trajectories(array, 0, array.rows)


@pytest.mark.parametrize("size", ["s", "m"])
def test_chunks_of_any_cut_are_read(size: str) -> None:
    folder, (level, record) = open_folder(GOLDEN / size), ours_of(trajectories_in(GOLDEN / size))
    assert (folder.size, folder.rows) == (SIZES[size], SOLVED + OTHERS)
    first, second = folder.arrays
    assert (first.chunks, second.chunks) == ((4, 256), (2, 100))
    for array, start, stop, offset in ((first, 0, 3, 0), (second, 1, 4, first.rows), (second, 3, 4, first.rows)):
        found = read_trajectories(array, start, stop)
        at = slice(offset + start, offset + stop)
        assert found.wrong == [""] * (stop - start)
        np.testing.assert_array_equal(found.action, record.action[..., at])
        np.testing.assert_array_equal(found.level.state.position, level.state.position[..., at])
        np.testing.assert_array_equal(found.level.model.vertices, level.model.vertices[..., at])


def changed(**entries: Any) -> Callable[[Path], None]:
    """A change of the description of the first array."""

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
    """A chunk that says that it becomes four gigabytes."""
    path = folder / "first/0.0"
    raw = bytearray(path.read_bytes())
    raw[4:8] = (2**32 - 1).to_bytes(4, "little")
    path.write_bytes(raw)


LISTS = json.dumps([[] for _ in range(3)]).encode()
SIZE = [["env_state/polygon/n_vertices", "<i4", [1, 900]], ["env_state/circle/radius", "<f4", [1, 2]],
        ["env_state/joint/active", "|b1", [1, 1]], ["env_state/thruster/active", "|b1", [1, 1]]]  # fmt: skip
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no group": (lambda folder: (folder / ".zgroup").unlink(), "there is no .zgroup in"),
    "zarr 3": (put(".zgroup", b'{"zarr_format": 3}'), "is not of zarr's format 2"),
    "no JSON": (put(".zgroup", b"{"), "cannot be read"),
    "deep": (put("first/.zarray", b"[" * 2**21), "cannot be read"),
    "a list": (put("first/.zarray", LISTS), "its array first has a description that says nothing"),
    "no arrays": (lambda folder: [shutil.rmtree(folder / name) for name in ("first", "second")], "no trajectories"),
    "two steps": (changed(shape=[3, 2]), "has the shape [3, 2], and it should be (trajectories, 256)"),
    "many": (changed(shape=[2**62, 256]), "has the shape"),
    "negative": (changed(shape=[-3, 256]), "has the shape"),
    "a word": (changed(shape="many"), "has the shape many"),
    "too many": (changed(shape=[10**11, 256]), "has 100,000,000,004 trajectories, and at most 100,000,000 are read"),
    "more rows": (changed(shape=[300, 256]), "its chunk"),
    "no chunks": (changed(chunks=[0, 256]), "has the shape"),
    "large chunks": (changed(chunks=[2**30, 256]), "of more than 1,073,741,824 bytes"),
    "other chunks": (changed(chunks=[3, 256]), "is not the 1,142,016 bytes"),
    "zlib": (changed(compressor={"id": "zlib", "level": 1}), "compressed by 'zlib', and only blosc is read"),
    "a pickle": (changed(compressor={"id": "pickle"}), "compressed by 'pickle'"),
    "no compressor": (changed(compressor=None), "is damaged"),
    "filters": (changed(filters=[{"id": "pickle"}]), "has filters"),
    "Fortran": (changed(order="F"), "has filters, another order than C"),
    "objects": (fields(lambda of: of.append(["extra", "|O", [1]])), "its field extra is of type |O, and no number"),
    "strings": (fields(lambda of: of.append(["extra", "<U9999999", [1]])), "and no number or flag"),
    "a huge field": (fields(lambda of: of.append(["extra", "<f4", [1, 2**40]])), "its array first"),
    "two of a name": (fields(lambda of: of.append(of[0])), "says nothing"),
    "no action": (fields(lambda of: of.remove(next(x for x in of if x[0] == "action"))), "has no field action"),
    "of floats": (
        fields(lambda of: next(x for x in of if x[0] == "action").__setitem__(1, "<f4")),
        "the field action of its array first is float32 of shape (6,), and a level of size s has int32",
    ),
    "no size": (fields(lambda of: of.__setitem__(slice(None), SIZE)), "those of no size of levels"),
    "missing": (lambda folder: (folder / "first/0.0").unlink(), "0.0 is missing"),
    "a pipe": (pipe, "0.0 is missing"),
    "empty": (put("first/0.0", b""), "is not the 1,522,688 bytes"),
    "long": (put("first/0.0", bytes(2**21)), "is larger than what is in it"),
    "a bomb": (bomb, "is not the 1,522,688 bytes"),
    "another": (put("first/0.0", Blosc().encode(bytes(100))), "is not the 1,522,688 bytes"),
}


@pytest.mark.parametrize(("change", "words"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_folders_get_one_sentence_and_little_memory(
    theirs: Path, change: Callable[[Path], object], words: str
) -> None:
    change(theirs)
    tracemalloc.start()
    try:
        with pytest.raises(FormatError) as error:
            read(theirs)
        assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY
    finally:
        tracemalloc.stop()
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_any_flipped_byte_is_a_sentence_or_another_trajectory(theirs: Path) -> None:
    """A blosc chunk has no checksum: what is read after a flip is looked at as what anybody wrote."""
    path, rng = theirs / "first/0.0", np.random.default_rng(0)
    raw = path.read_bytes()
    for at in [*range(16), *rng.integers(16, len(raw), 24).tolist()]:
        broken = bytearray(raw)
        broken[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            read(theirs)
        except FormatError as error:
            assert "its chunk" in str(error)  # noqa: PT017

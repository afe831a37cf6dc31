"""`levelproof export --format kinetix`: contents of the folder, atomic creation, and rejected arguments."""

from pathlib import Path

import numpy as np
import pytest

from levelproof.experts.labels import Label
from levelproof.levelgen.level import SIZES
from levelproof.physics.pairs import pairs_of
from levelproof.pipeline.exchange import kinetix as module
from levelproof.pipeline.read.kinetix import zarr2
from levelproof.pipeline.read.kinetix.records import dtype_of
from levelproof.pipeline.read.kinetix.zarr2 import write_group
from levelproof.pipeline.read.rows import read_rows
from levelproof.pipeline.store.manifest import require_manifest
from levelproof.pipeline.words import many
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import made_split
from tests.pipeline.read.kinetix.folder import trajectories_in

BYTES = {"s": 1487, "m": 2473, "l": 8053}  # per step, in zarr 2.18 and the reference
UNITS = [[Label.SOLVED, Label.UNSOLVED, Label.TRIVIAL], [Label.SOLVED]]


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A split whose arrays hold arbitrary bits."""
    return made_split(tmp_path_factory.mktemp("data"), UNITS)


@pytest.mark.parametrize("size", SIZES)
def test_dtype_of_matches_the_step_size_of_the_reference(size: str) -> None:
    assert dtype_of(SIZES[size]).itemsize == BYTES[size]
    assert len(dtype_of(SIZES[size]).names or ()) == 85


def test_export_kinetix_keeps_every_bit_of_a_record(split: Path, tmp_path: Path) -> None:
    done = here(["export", str(split), "--format", "kinetix", "-o", "new/k"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("new/k: 2 trajectories of")
    exported = trajectories_in(tmp_path / "new/k")
    rows = require_manifest(split).table.to_pylist()
    assert [row["label"] for row in rows] == [label for unit in UNITS for label in unit]
    table = require_manifest(split).table.take([0, 3])
    ours = {name: np.moveaxis(x, -1, 0) for name, x in read_rows(split, table).items()}
    polygons, pairs = SIZES["s"].polygons, len(pairs_of(SIZES["s"]).polygon)

    def assert_same(theirs: str, values: np.ndarray) -> None:
        stored = exported[theirs][:, :, 0]
        want = np.broadcast_to(values, stored.shape).astype(values.dtype)
        assert stored.dtype == want.dtype, theirs
        assert stored.tobytes() == want.tobytes(), theirs

    still = lambda name: ours[f"level/{name}"][:, None]
    assert_same("action", ours["record/action"])
    assert_same("done", ours["record/done"])
    assert_same("env_state/timestep", ours["record/timestep"])
    assert_same("env_state/polygon/position", ours["record/state/position"][:, :, :polygons])
    assert_same("env_state/circle/position", ours["record/state/position"][:, :, polygons:])
    assert_same("env_state/circle_shape_roles", still("role")[:, :, polygons:])
    at_rest = np.where(ours["record/timestep"] == 0, np.float32(256), np.float32(0))[..., None, None]
    active = still("model/joint_active")[..., None]
    assert_same("env_state/joint/global_position", np.where(active, ours["record/joint_point"], at_rest))
    points = ours["record/manifold/point"]
    assert_same(
        "env_state/acc_rr_manifolds/collision_point",
        np.stack([points[:, :, :pairs], points[:, :, pairs : 2 * pairs]], 3),
    )
    assert_same("env_state/collision_matrix", still("model/collides"))


def test_export_kinetix_selects_levels_by_where(split: Path, tmp_path: Path) -> None:
    for where, count in (("true", 3), ("label = 'trivial'", 1), ("level_id > 0 AND label = 'solved'", 1)):
        done = here(["export", str(split), "--format", "kinetix", "-o", f"k{where}", "--where", where], tmp_path)
        assert many(count, "trajectory") in done.stdout, done.stderr
    none = ["export", str(split), "--format", "kinetix", "-o", "none", "--where"]
    assert_refused(here([*none, "label = 'unsolved'"], tmp_path), 2, "has a witness", "--where")
    assert_refused(here([*none, "labell = 1"], tmp_path), 2, "Cannot use the condition")
    assert not (tmp_path / "none").exists()


def test_export_kinetix_names_rules_that_the_layout_does_not_hold(tmp_path: Path) -> None:
    split = made_split(tmp_path / "data", UNITS, "task.frame_skip=4")
    done = here(["export", str(split), "--format", "kinetix", "-o", "k"], tmp_path)
    assert "the layout does not hold them: task.frame_skip=4." in done.stdout


def test_export_kinetix_splits_trajectories_into_arrays_and_blocks(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["export", str(split), "--format", "kinetix", "--where", "true", "-o"]
    assert here([*command, "one"], tmp_path).returncode == 0
    for target, name, value in ((zarr2, "ROWS", 1), (module, "ROWS", 1), (module, "BLOCK", 2), (module, "ARRAY", 2)):
        monkeypatch.setattr(target, name, value)
    assert here([*command, "cut"], tmp_path).returncode == 0
    assert sorted(path.name for path in (tmp_path / "cut").iterdir()) == [".zgroup", "000000", "000001"]
    one, cut = (trajectories_in(tmp_path / name) for name in ("one", "cut"))
    assert len(one) == 3
    assert one.tobytes() == cut.tobytes()


def test_export_kinetix_creates_the_folder_atomically(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["export", str(split), "--format", "kinetix", "-o", "k"]
    names_before: list[list[str]] = []

    def last(folder: Path) -> None:
        names_before.append([path.name[:3] for path in tmp_path.iterdir()])
        write_group(folder)

    with monkeypatch.context() as patch:
        patch.setattr(module, "write_group", lambda _: 1 / 0)
        assert here(command, tmp_path).returncode == 1
    assert not (tmp_path / "k").exists()
    monkeypatch.setattr(module, "write_group", last)
    assert here(command, tmp_path).returncode == 0
    assert names_before == [[".k."]], "killed before its last step, it leaves no k"
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "k").rglob("*")}
    assert_refused(here(command, tmp_path), 2, "k already exists", "-o")
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "k").rglob("*")}
    (tmp_path / "file").write_text("")
    assert_refused(here([*command[:-1], "file/k"], tmp_path), 2, "Cannot write file/k")


def test_export_rejects_arguments_of_other_formats(split: Path, tmp_path: Path) -> None:
    assert_refused(here(["export", str(split)], tmp_path), 2, "give its id", "--format")
    assert_refused(here(["export", str(split), "0", "--where", "true"], tmp_path), 2, "without --where")
    assert_refused(here(["export", str(split), "0", "--actions", "combined"], tmp_path), 2, "leave it out for json")
    assert_refused(here(["export", str(split), "0", "--format", "kinetix"], tmp_path), 2, "--where", "level_id = 0")
    assert_refused(here(["export", str(split), "--format", "kinetix"], tmp_path), 2, "with -o")
    assert_refused(here(["export", "nothing", "--format", "kinetix", "-o", "k"], tmp_path), 2, "There is no split")

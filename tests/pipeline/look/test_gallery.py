"""Gallery files agree with the split: rows, worlds and states."""

import json
import shlex
import shutil
from base64 import b64decode
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from levelproof.experts.evaluation import play, play_sampled
from levelproof.experts.networks.over_levels import PolicyKind
from levelproof.experts.networks.saved import load_policy, save_policy
from levelproof.experts.witness.witness import steps_to_goal
from levelproof.levelgen.level import SIZES
from levelproof.pipeline.cli.gallery import MAX_LEVELS
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.look.entities import count_entities
from levelproof.pipeline.look.gallery import gallery as module
from levelproof.pipeline.look.gallery.gallery import gallery
from levelproof.pipeline.look.gallery.pages import FLAGS, NOTHING, NUMBERS
from levelproof.pipeline.look.gallery.worlds import ANGLE, LENGTH, angles
from levelproof.pipeline.look.reasons import kind_of_reason
from levelproof.pipeline.read.levels import levels_of, rules_of
from levelproof.pipeline.read.rows import read_row
from levelproof.pipeline.store.manifest import Manifest, require_manifest
from tests.pipeline.made import PLAYED, small_policy


@pytest.fixture(scope="module")
def manifest(split: Path) -> Manifest:
    return require_manifest(split)


@pytest.fixture(scope="module")
def site(split: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site") / "gallery"
    gallery(split, out, None, MAX_LEVELS)
    return out


def data(site: Path, name: str) -> Any:
    """Read the value of a data file."""
    before, after = f'levelproof.arrived("{name}",', ");\n"
    text = (site / "data" / f"{name}.js").read_text()
    assert text.startswith(before)
    assert text.endswith(after)
    return json.loads(text.removeprefix(before).removesuffix(after))


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(b64decode(text), kind)


def test_gallery_columns_equal_the_manifests(site: Path, manifest: Manifest) -> None:
    about, page, table = data(site, "about"), data(site, "columns/0"), manifest.table
    assert about["levels"] == about["found"] == PLAYED
    columns = {column["name"]: column for column in about["columns"]}
    for name in NUMBERS:
        found = numbers(page[name], f"<f{columns[name]['bits'] // 8}")
        np.testing.assert_array_equal(found, table[name].to_numpy().astype(float))
    for name in ("label", "label_reason", "witness", *FLAGS):
        words = {NOTHING: None} | dict(enumerate(columns[name]["words"]))
        found = [words[index] for index in numbers(page[name], "<u2")]
        if name in FLAGS:
            found = [None if word is None else word == "yes" for word in found]
        assert found == [kind_of_reason(x) if name == "label_reason" else x for x in table[name].to_pylist()]
    for name, counts in count_entities(levels_of(manifest, table)).items():
        np.testing.assert_array_equal(numbers(page[name], "<f4"), counts)


def test_commands_of_the_pages_quote_the_split_for_a_shell(split: Path, tmp_path: Path) -> None:
    spaced = Path(shutil.copytree(split, tmp_path / "my $levels"))
    gallery(spaced, tmp_path / "site", None, 1)
    about = data(tmp_path / "site", "about")
    assert shlex.split(about["quoted"]) == [str(spaced)] == [about["split"]]


def test_level_file_has_its_row_and_witness_states(site: Path, manifest: Manifest) -> None:
    worlds = data(site, "worlds/0")
    for number, row in enumerate(manifest.table.to_pylist()):
        page = data(site, f"levels/0/{row['level_id']}")
        assert page["row"]["command"] == row["command"]
        assert page["row"]["learning_curve"] == [None, 0.5]
        assert ("states" in page) == bool(row["shard"])
        if not row["shard"]:
            continue
        arrays = read_row(manifest.split, row)
        steps, moving = int(steps_to_goal(arrays["record/done"])[0]), moving_bodies(arrays)
        count, still = numbers(worlds[number], "<i2")[:2]
        assert count - still == len(moving)
        states = numbers(page["states"], "<i2").reshape(steps + 1, len(moving), 3)
        position, rotation = (arrays[f"record/state/{name}"][:steps, ..., 0] for name in ("position", "rotation"))
        assert np.abs(states[:-1, :, :2] * LENGTH - position[:, moving]).max() <= 0.501 * LENGTH
        turned = states[:-1, :, 2] * ANGLE - rotation[:, moving]
        assert np.abs(np.angle(np.exp(1j * turned))).max() <= 0.51 * ANGLE
        actions = numbers(page["actions"], "u1").reshape(steps, 6)
        np.testing.assert_array_equal(actions, arrays["record/action"][:steps, :, 0])


def moving_bodies(arrays: dict[str, np.ndarray]) -> np.ndarray:
    return np.flatnonzero(arrays["level/model/active"][:, 0] & (arrays["level/model/inverse_mass"][:, 0] != 0))


def test_last_state_is_where_green_touches_blue(split: Path, manifest: Manifest, site: Path) -> None:
    """A record ends before the step that reaches the goal; the film extrapolates it."""
    row = next(row for row in manifest.table.to_pylist() if row["shard"])
    states = numbers(data(site, f"levels/0/{row['level_id']}")["states"], "<i2")
    arrays = read_row(split, row)
    last, moving = int(steps_to_goal(arrays["record/done"])[0]) - 1, moving_bodies(arrays)
    position, velocity = (arrays[f"record/state/{name}"][last, moving, :, 0] for name in ("position", "velocity"))
    found = states.reshape(-1, len(moving), 3)[-1, :, :2] * LENGTH
    np.testing.assert_allclose(found, position + velocity / 60, atol=LENGTH)


def test_world_has_every_body_joint_and_thruster(site: Path, manifest: Manifest) -> None:
    levels = jax.tree.map(np.asarray, levels_of(manifest, manifest.table))
    for lane, text in enumerate(data(site, "worlds/0")):
        world = numbers(text, "<i2").tolist()
        count, _, joints, thrusters = (world.pop(0) for _ in range(4))
        model = jax.tree.map(lambda x, lane=lane: x[..., lane], levels.model)
        assert (count, joints, thrusters) == (model.active.sum(), model.joint_active.sum(), model.thruster_active.sum())
        found = []
        for _ in range(count):
            role, corners, x, y, _ = (world.pop(0) for _ in range(5))
            shape = [world.pop(0) for _ in range(2 * corners or 1)]
            found.append((role, corners, round(x * LENGTH, 2), round(y * LENGTH, 2), len(shape)))
        polygons = levels.size.polygons
        corners = [model.n_vertices[body] if body < polygons else 0 for body in range(levels.size.bodies)]
        active = np.flatnonzero(model.active)
        positions = levels.state.position[..., lane]
        assert sorted(body[:2] for body in found) == sorted((levels.role[body, lane], corners[body]) for body in active)
        assert sorted(body[2] for body in found) == pytest.approx(sorted(positions[active, 0]), abs=0.01)
        assert len(world) == 5 * joints + 5 * thrusters


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy")
    save_policy(folder, small_policy())
    return folder


@pytest.mark.slow
def test_policy_plays_every_level_as_evaluations_do(
    split: Path, manifest: Manifest, policy: Path, tmp_path: Path
) -> None:
    gallery(split, tmp_path / "site", None, MAX_LEVELS, policy)
    levels, ids = levels_of(manifest, manifest.table), manifest.table["level_id"].to_numpy()
    loaded = load_policy(policy)
    played = play(play_sampled(loaded.network), loaded.params, levels, ids, 1, 0, rules_of(manifest))
    about, page = data(tmp_path / "site", "about"), data(tmp_path / "site", "columns/0")
    (words,) = [column["words"] for column in about["columns"] if column["name"] == "policy"]
    found = [words[index] for index in numbers(page["policy"], "<u2")]
    assert found == ["solves" if solved else "fails" for solved in played.solved[:, 0]]
    assert set(found) == {"solves", "fails"}
    for number, level_id in enumerate(ids.tolist()):
        attempt = data(tmp_path / "site", f"levels/0/{level_id}")["policy"]
        assert attempt["solved"] == played.solved[number, 0]
        assert len(numbers(attempt["actions"], "u1")) == 6 * played.env_steps[number, 0]


def test_policy_of_another_size_is_refused(split: Path, tmp_path: Path) -> None:
    save_policy(tmp_path, small_policy(SIZES["m"], PolicyKind.FLAT))
    with pytest.raises(UserError, match="plays levels of size m only"):
        gallery(split, tmp_path / "site", None, 1, tmp_path)
    with pytest.raises(UserError, match="There is no policy in"):
        gallery(split, tmp_path / "site", None, 1, tmp_path / "none")


def test_angles_wrap_to_one_turn() -> None:
    turned = np.array([0.0, 3.0, -3.0, 50.0, -50.0, np.pi, 1e6])
    np.testing.assert_allclose(np.exp(1j * angles(turned) * ANGLE), np.exp(1j * turned), atol=ANGLE)


def test_pages_load_nothing_from_other_hosts(site: Path) -> None:
    """Nor define colours that are not in palette.css."""
    for path in [*site.glob("*.js"), *site.glob("*.html"), *site.glob("*.css")]:
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "http" not in text
        assert "fetch(" not in text
    assert "rgb(" not in (site / "style.css").read_text()
    assert "--green: rgb(62, 176, 92);" in (site / "palette.css").read_text()


def test_gallery_shows_a_sample_of_matching_levels(
    split: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gallery(split, tmp_path / "some", "level_id >= 10 AND level_id < 60", 3)
    about = data(tmp_path / "some", "about")
    assert (about["levels"], about["found"], about["where"]) == (3, 50, "level_id >= 10 AND level_id < 60")
    assert numbers(data(tmp_path / "some", "columns/0")["level_id"], "<f4").tolist() == [10, 34, 59]
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{tmp_path / 'some' / 'index.html'}: 3 of 50 levels, spread evenly over their ids, of ")
    assert second.endswith(f"-m webbrowser {tmp_path / 'some' / 'index.html'}")
    with pytest.raises(UserError, match=r"No level of .* matches"):
        gallery(split, tmp_path / "none", "level_id < 0", MAX_LEVELS)


def test_gallery_replaces_only_galleries(split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "gallery"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"/.* already exists"):
        gallery(split, out, None, 1)
    assert (out / "notes.txt").read_text() == "mine"
    (out / "notes.txt").unlink()
    out.rmdir()
    gallery(split, out, None, 1)
    (out / "CNAME").write_text("mine")  # the root of a website
    with pytest.raises(UserError, match=r"/.* has CNAME, which is not part of a gallery"):
        gallery(split, out, None, 2)
    assert (out / "CNAME").read_text() == "mine"
    (out / "CNAME").rename(out / "data/old")
    gallery(split, out, None, 2)
    assert data(out, "about")["levels"] == 2
    assert not (out / "data/old").exists()

    def fail(_: object) -> str:
        raise Failure("the shard is damaged")

    monkeypatch.setattr(module, "world_of", fail)
    with pytest.raises(Failure):
        gallery(split, out, None, MAX_LEVELS)
    assert data(out, "about")["levels"] == 2  # unchanged
    assert [path.name for path in tmp_path.iterdir()] == ["gallery"]


def test_gallery_reads_levels_block_by_block(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, manifest: Manifest
) -> None:
    read: list[int] = []
    rows = module.read_rows
    monkeypatch.setattr(module, "BLOCK", 7)
    monkeypatch.setattr(
        module, "read_rows", lambda at, table, fields: read.append(table.num_rows) or rows(at, table, fields)
    )
    gallery(split, tmp_path / "gallery", None, MAX_LEVELS)
    assert max(read) <= 7
    assert sum(read) == manifest.table["shard"].is_valid().to_numpy().sum()
    assert len(list((tmp_path / "gallery/data/worlds").iterdir())) == -(-PLAYED // 7)

"""Parity: scenes, distances, causes and tables on golden states; a small real campaign."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks import oracle
from benchmarks.__main__ import main
from benchmarks.parity import causes, episodes, scenes
from benchmarks.parity.campaign import SizeReport
from benchmarks.parity.distance import distances, gap
from benchmarks.parity.engines import Played, Stepped, play_ours, step_ours
from benchmarks.parity.onestep import Pool, distinct, one_step, picked
from benchmarks.parity.report import report_of
from benchmarks.parity.worlds import BLOCK, contact_bodies, lanes_of, nudged
from benchmarks.report import Report
from levelproof.levelgen.batching import blocks
from levelproof.physics.types import FIXED_POLYGONS, Params
from levelproof.pipeline.errors import Exit
from tests.golden.load import golden
from tests.pace import patience

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def pool() -> Pool:
    """A block of golden states of size s."""
    sample = golden("s")
    level, action = lanes_of((sample.level, sample.action), np.arange(BLOCK))
    return Pool(level, action, sample.scene[:BLOCK], [f"golden {lane}" for lane in range(BLOCK)])


@pytest.fixture(scope="module")
def stepped(pool) -> Stepped:
    return step_ours(pool.level, pool.action)


@pytest.fixture(scope="module")
def reference_after(pool, stepped) -> Stepped:
    """The reference's results; its geometry is not stored, so ours is used."""
    return stepped._replace(state=lanes_of(golden("s").after, np.arange(BLOCK)))


@pytest.fixture(scope="module")
def large():
    """Levels of size l, at rest at their starts."""
    return golden("l").level


def altered(after: Stepped, **state) -> Stepped:
    return after._replace(state=dataclasses.replace(after.state, **state))


class TestWorlds:
    def test_blocks_are_padded(self) -> None:
        parts = [*blocks(5, 3)]
        np.testing.assert_array_equal(parts, [[0, 1, 2], [3, 4, 4]])

    def test_nudged_changes_at_most_units_in_the_last_place(self) -> None:
        values = np.array([1.0, -3.0, 1e-8, 1e8, 0.0], np.float32)[:, None].repeat(1000, 1)
        for most in (1, 4):
            units = np.abs(nudged(values, np.random.default_rng(0), most).view(np.int32) - values.view(np.int32))
            assert units[:4].max() == most
            assert (units[4] == 0).all()


class TestScenes:
    @pytest.mark.parametrize("name", scenes.SCENES)
    def test_scene_keeps_shapes_types_and_scenery(self, large, name) -> None:
        made = scenes.SCENES[name](large, np.random.default_rng(0))
        for new, old in zip(jax.tree.leaves(made), jax.tree.leaves(large), strict=True):
            assert np.shape(new) == np.shape(old)
            assert np.asarray(new).dtype == np.asarray(old).dtype
            assert np.isfinite(new).all()
        still = ~scenes.movable(large)
        np.testing.assert_array_equal(
            made.state.velocity[still[:, None].repeat(2, 1)], large.state.velocity[still[:, None].repeat(2, 1)]
        )

    @staticmethod
    def made(name: str, level):
        return scenes.SCENES[name](level, np.random.default_rng(0))

    def test_coincident_bodies_share_centres(self, large) -> None:
        level = self.made("coincident", large)
        free, place = scenes.movable(level), level.state.position
        same = (place[:, None] == place[None]).all(2) & free[:, None] & free[None]
        assert (same.sum((0, 1)) > free.sum(0)).mean() > 0.5

    def test_fast_bodies_reach_100_m_s(self, large) -> None:
        level = self.made("fast", large)
        speed = np.linalg.norm(level.state.velocity, axis=1)[scenes.movable(level)]
        assert np.isclose(speed, 100).mean() > 0.3

    def test_triangles_get_new_masses(self, large) -> None:
        level = self.made("triangles", large)
        cut = (level.model.n_vertices == 3) & (large.model.n_vertices == 4)
        assert cut.sum() > 100
        n = level.size.polygons
        assert (level.model.inverse_mass[:n][cut] > large.model.inverse_mass[:n][cut]).all()

    def test_stacks_stand_on_the_floor(self, large) -> None:
        level = self.made("stacks", large)
        low = scenes._upright_reach(level)[0] + level.state.position[:, 1]
        assert np.isclose(np.where(scenes.movable(level), low, np.inf).min(0), scenes.FLOOR_TOP, atol=1e-5).mean() > 0.9
        assert not level.model.joint_active.any()

    def test_chains_join_at_their_anchors(self, large) -> None:
        level = self.made("chains", large)
        model, state = level.model, level.state
        first = [scenes._at(state.position, body[0]) for body in (model.joint_a, model.joint_b)]
        turn = [scenes._at(state.rotation, body[0]) for body in (model.joint_a, model.joint_b)]
        anchors = (model.joint_anchor_a[0], model.joint_anchor_b[0])
        ends = [x + scenes._turned(angle, anchor) for x, angle, anchor in zip(first, turn, anchors, strict=True)]
        # a loop may move its bodies again, but the chain holds
        assert (np.abs(ends[0] - ends[1]).max(0) < 1e-4)[model.joint_active[0]].mean() > 0.9
        ceiling = (model.joint_a[0] == FIXED_POLYGONS - 1) & model.joint_active[0]
        assert 0.3 < ceiling.mean() < 0.7
        assert (model.joint_active.sum(0) >= 2).mean() > 0.5

    def test_limits_limit_every_joint(self, large) -> None:
        model = self.made("limits", large).model
        assert model.joint_limited.all()
        assert not model.joint_fixed.any()
        assert (model.joint_min <= model.joint_max).all()
        assert (model.joint_active.sum(0) >= 2).mean() > 0.4

    def test_inactive_bodies_keep_joints(self, large) -> None:
        model = self.made("inactive", large).model
        asleep = ~np.take_along_axis(model.active, model.joint_b, 0) & model.joint_active
        assert asleep.any()


class TestDistances:
    def test_distances_to_itself_are_zero(self, pool, stepped) -> None:
        apart = distances(pool.level, stepped, stepped)
        assert all((x == 0).all() for x in apart.by_field.values())
        assert not apart.off.any()

    def test_gap_treats_nan_as_a_value(self) -> None:
        nan = np.nan
        np.testing.assert_array_equal(gap([nan, nan, np.inf, 1], [nan, 1, np.inf, 3]), [0, np.inf, 0, 2])

    def test_distances_ignore_impulses_of_inactive_contacts(self, pool, stepped) -> None:
        active, impulse = stepped.state.contact_active, stepped.state.contact_normal_impulse
        old = altered(stepped, contact_normal_impulse=np.where(active, impulse, 7))
        assert not distances(pool.level, stepped, old).off.any()
        other = altered(stepped, contact_normal_impulse=np.where(active, impulse + 7, 7))
        np.testing.assert_array_equal(distances(pool.level, stepped, other).off, active.any(0))

    def test_distances_are_off_if_contacts_differ(self, pool, stepped) -> None:
        other = altered(stepped, contact_active=~stepped.state.contact_active)
        assert distances(pool.level, stepped, other).off.all()


class TestCauses:
    @staticmethod
    def find(pool: Pool, lane: int, theirs: Stepped) -> causes.Cause:
        one = pool.lanes(np.array([lane]))
        return causes.find_cause(step_ours, one.level, one.action, lanes_of(theirs, [lane]))

    def test_find_cause_does_not_explain_a_wrong_engine(self, pool, stepped) -> None:
        """Velocities include half of gravity again, in lanes of every scene."""
        free = scenes.movable(pool.level)[:, None] * np.array([0, 0.08])[:, None]
        wrong = altered(stepped, velocity=(stepped.state.velocity + free).astype(np.float32))
        off = np.flatnonzero(distances(pool.level, stepped, wrong).off)
        result = [self.find(pool, lane, wrong).explained for lane in off[:24]]
        assert np.mean(result) < 0.1

    def test_reached_accepts_a_neighbours_result(self, pool, stepped) -> None:
        """A neighbour's result lies among the neighbours' results."""
        near = causes.neighbours(step_ours, pool.lanes(np.array([3])).level, pool.action[:, [3]], 1)
        theirs = lanes_of(near.after, [BLOCK - 1])
        assert causes.reached(near.after.state, theirs.state)

    def test_find_cause_names_the_tie_of_a_flat_box(self, pool) -> None:
        """Two corners are equally deep: the last bit decides which is the first contact point."""
        alone = np.arange(pool.level.size.bodies)[:, None] < pool.level.size.polygons
        model = dataclasses.replace(pool.level.model, active=pool.level.model.active & alone)
        level = scenes.stacks(dataclasses.replace(pool.level, model=model), np.random.default_rng(0))
        lower = np.array([0, 0.005], np.float32)[:, None] * scenes.movable(level)[:, None]
        position = level.state.position - lower
        level = dataclasses.replace(level, state=dataclasses.replace(level.state, position=position.astype(np.float32)))
        after = step_ours(level, pool.action)
        lane = int(np.flatnonzero(after.state.contact_active[0] & after.state.contact_active[4])[0])
        swap = np.arange(len(after.state.contact_active))
        swap[[0, 4]] = [4, 0]  # both points of floor and box
        impulse = after.state.contact_tangent_impulse[swap] + np.float32(0.01)
        theirs = altered(after, contact_tangent_impulse=impulse)._replace(point=after.point[swap])
        result = self.find(Pool(level, pool.action, pool.scene, pool.origin), lane, theirs)
        assert result.name == causes.DEEPEST_VERTEX

    def test_find_cause_does_not_explain_a_lost_deep_contact(self, pool, stepped) -> None:
        active = stepped.state.contact_active
        lane = int(np.argmax(active.any(0)))
        one = int(np.argmax(active[:, lane]))
        other = active.copy()
        other[one, lane] = False
        result = self.find(pool, lane, altered(stepped, contact_active=other))
        assert result.name == causes.TOUCHING
        assert not result.explained  # no neighbour loses a contact that is deep

    def test_find_cause_explains_a_broken_world(self, pool, stepped) -> None:
        broken = altered(stepped, rotation=stepped.state.rotation + np.float32(1e8))
        result = self.find(pool, 0, broken)
        assert (result.name, result.explained) == (causes.BROKEN_WORLD, True)

    def test_bodies_off_finds_the_body_by_impulses_alone(self, pool, stepped) -> None:
        active = stepped.state.contact_active
        a, b = contact_bodies(pool.level.size)
        lane = int(np.argmax(active[9:].any(0)))
        contact = 9 + int(np.argmax(active[9:, lane]))
        impulse = stepped.state.contact_normal_impulse.copy()
        impulse[contact, lane] += 5
        one = lanes_of((pool.level, stepped, altered(stepped, contact_normal_impulse=impulse)), [lane])
        assert causes.Bodies.off(*one).worst in (a[contact], b[contact])


class TestPool:
    def test_distinct_drops_duplicate_worlds(self, pool) -> None:
        twice = pool.lanes(np.array([1, 2, 1, 3, 2]))
        assert distinct(twice).origin == ["golden 1", "golden 2", "golden 3"]


@pytest.fixture(scope="module")
def touching(pool) -> tuple[int, np.ndarray, Played]:
    """A lane that ends by touching within 20 env steps, one action more, and how our engine plays."""
    action = np.repeat(pool.action[None], 21, 0)
    played = play_ours(pool.level, pool.level.state, action[:20], record=True)
    result = episodes.outcome(played)
    lane = int(np.argmax((result.reward != 0) & (result.step > 0)))
    assert result.reward[lane] != 0
    return lane, action, played


class TestEpisodes:
    def test_outcome_has_the_first_episodes_end(self) -> None:
        done = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 1, 1]], bool)
        reward = np.array([[0, 0, 0], [1.0, 0, 0], [0, 0, -1], [-1, 0, 1]])
        result = episodes.outcome(Played(reward, done, None))
        assert [result.text(lane) for lane in range(3)] == ["goal at 2", "time at 4", "red at 3"]
        other = episodes.Outcome(np.array([1, 3, 3]), np.array([1, 0, -1]))
        np.testing.assert_array_equal(result.same(other), [True, True, False])

    def test_near_keeps_the_scenery(self, pool) -> None:
        level = pool.level
        near = episodes.near(level, np.random.default_rng(0))
        free = scenes.movable(level)
        np.testing.assert_array_equal(near.rotation[~free], level.state.rotation[~free])
        assert (near.rotation[free] != level.state.rotation[free]).mean() > 0.3
        np.testing.assert_allclose(near.position, level.state.position, rtol=3e-7)

    def test_first_off_finds_the_step_and_the_contact(self, pool) -> None:
        states = jax.tree.map(lambda x: np.repeat(np.asarray(x)[..., :1], 6, -1), pool.level.state)
        moved = states.position.copy()
        moved[5, 0, 3:] += 1e-3
        first, at_contact = episodes._first_off(states, dataclasses.replace(states, position=moved))
        assert (first, at_contact) == ([3, None], False)
        active = states.contact_active.copy()
        active[0, 3:] ^= True
        _, at_contact = episodes._first_off(states, dataclasses.replace(states, position=moved, contact_active=active))
        assert at_contact

    @pytest.mark.parametrize("shift", [-1, 0, 1])
    def test_episodes_that_end_early_or_late_are_not_explained(self, pool, touching, shift) -> None:
        """Ours stands in for the reference: the same states, but an end that is noticed an env step off."""
        lane, action, played = touching
        result = episodes.outcome(played)
        last, end = int(result.step[lane]), int(result.reward[lane])
        until = episodes._until(played.states, lane, last + 1 + min(shift, 0))
        if shift > 0:  # the state after the end is not in the record, so this one stays
            until = jax.tree.map(lambda x: np.concatenate([x, x[..., -1:]], -1), until)
        off, reason = episodes._steps(pool.lanes(np.array([lane])).level, until, action[..., [lane]], end)
        if shift:
            assert reason == episodes.NOT_EXPLAINED
        else:
            assert (off, reason) == (0, episodes.STEPS_AGREE)

    def test_play_ours_records_states_before_actions(self, pool) -> None:
        action = np.repeat(pool.action[None], 3, 0)
        played = play_ours(pool.level, pool.level.state, action, record=True)
        np.testing.assert_array_equal(played.states.rotation[:, 0], pool.level.state.rotation)
        assert played.reward.shape == (3, BLOCK)
        times = np.array([[0, 2], [1, 1]])
        lanes = pool.lanes(np.array([4, 5]))
        lanes = dataclasses.replace(lanes, action=action[..., 4:6])
        states = picked(lanes, lanes_of(played.states, [4, 5]), times)
        np.testing.assert_array_equal(states.level.state.position[..., 1], played.states.position[..., 2, 5])
        assert states.origin == [
            "golden 4, env step 0",
            "golden 5, env step 2",
            "golden 4, env step 1",
            "golden 5, env step 1",
        ]


@pytest.fixture(scope="module")
def sizes(pool, reference_after) -> list[SizeReport]:
    """Report of golden states with the reference's results, and an episode."""
    ticks: list[str] = []
    result = one_step(pool, lambda *_: reference_after, ticks.append)
    assert ticks == ["states"]
    pairs = episodes.Episodes(
        pairs=4,
        touched=2,
        same=0.75,
        same_touched=0.5,
        reference_itself=1.0,
        ours_itself=1.0,
        target=0.97,
        parted=[episodes.Parted("sampled", "level 3", "goal at 3", "goal at 4", [2, None], True, 5, 1e-5, "chance")],
        reasons={"chance": 1},
    )
    return [SizeReport("s", result, pairs, ["one"])]


@pytest.fixture(scope="module")
def report(sizes) -> Report:
    return report_of(sizes, {"states": 40}, {"jax2d": "1.0.1"})


class TestReport:
    def test_report_explains_golden_states(self, sizes, report) -> None:
        result = sizes[0].one_step
        assert result.states == BLOCK
        motion = result.scenes[-1]
        assert (motion.scene, motion.states) == ("all", BLOCK)
        assert motion.within[-1] > 0.99
        assert sum(row.states for row in result.scenes[:-1]) == BLOCK
        assert [row.field for row in result.fields][:2] == ["position", "rotation"]
        assert result.defect.differ[0] >= result.defect.differ[1] > 0
        assert not report.fault

    def test_report_faults_too_few_equal_episodes(self, sizes) -> None:
        (one,) = sizes
        fewer = dataclasses.replace(one, episodes=dataclasses.replace(one.episodes, pairs=400))
        assert "(size s, 75.0% of episodes alike instead of 97%)" in report_of([fewer], {}, {}).fault

    @pytest.mark.slow
    def test_report_faults_another_engine(self, pool) -> None:
        """Our engine with another constant: contacts are pushed apart a quarter faster."""
        params = Params(contact_bias=0.25)
        result = one_step(pool.lanes(np.arange(40)), lambda *given: step_ours(*given, params), lambda _: None)
        wrong = [state for state in result.off if not state.explained]
        assert len(wrong) > 5
        result = report_of([SizeReport("s", result, None, [])], {}, {})
        assert re.search(rf"does not explain {len(wrong)} differences.*size s, golden.*--json", result.fault)
        assert len(result.notes) == len(wrong)

    def test_report_has_tables_and_json(self, report) -> None:
        for table in report.tables:
            assert all(len(row) == len(table.head) for row in table.rows)
        played = next(table for table in report.tables if table.title.startswith("Whole episodes"))
        assert "75.0%" in played.rows[0]
        (result,) = report.results
        assert result["sizes"][0]["episodes"]["same"] == 0.75
        assert result["sizes"][0]["one_step"]["fields"][0]["largest"] < 1e-4


@pytest.mark.campaign
def test_small_campaign_runs_for_real(reference, level_file, tmp_path) -> None:
    """Run as a user would, with handmade levels, scenes and episodes: only rounding differs."""
    options = ["--size", "s", "--states", "120", "--episodes", "12", "--level-file", str(level_file), "--json"]
    code = "import sys; from benchmarks.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "parity", *options]
    environment = dict(os.environ) | {oracle.PYTHON_VARIABLE: str(reference)}
    words = [*command, "--keep", str(tmp_path / "kept")]
    how: Any = {"capture_output": True, "text": True, "cwd": ROOT, "env": environment, "timeout": patience(1800)}
    done = subprocess.run(words, **how)
    assert done.returncode == Exit.DONE, done.stderr
    result = json.loads(done.stdout)
    (one,) = result["sizes"]
    scene = {row["scene"]: row for row in one["one_step"]["scenes"]}
    assert {"sampled", "handmade", *scenes.SCENES} <= set(scene)
    assert scene["all"]["states"] >= 100
    assert scene["all"]["within"][-1] > 0.9
    assert len(one["handmade"]) == 10
    assert one["episodes"]["pairs"] == 12
    assert one["episodes"]["same"] >= 0.75
    assert result["versions"]["reference"]["jax2d"] == "1.0.1"
    assert "blocks" in done.stderr
    again = subprocess.run(words, **how)
    assert json.loads(again.stdout)["sizes"] == result["sizes"]  # from the kept answers


class TestInput:
    def test_parity_rejects_levels_of_another_size(self, level_file, monkeypatch, capsys) -> None:
        monkeypatch.setenv(oracle.PYTHON_VARIABLE, sys.executable)
        assert main(["parity", "--size", "m", "--level-file", str(level_file)]) == Exit.INPUT
        assert "are of size s: --size is m." in capsys.readouterr().err
        assert main(["parity", "--level-file", str(level_file)]) == Exit.INPUT
        assert "levels of one size" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("size", "sentence"),
        [
            ("xl", "'xl': choose one of s, m, l"),
            ("8,8,8,4", "'8,8,8,4': choose one of s, m, l"),
            ("4-1-1-1", "4-1-1-1: scenes need at least one polygon beside"),
        ],
    )
    def test_parity_rejects_invalid_sizes(self, size, sentence, capsys) -> None:
        with pytest.raises(SystemExit) as error:
            main(["parity", "--size", size])
        assert error.value.code == 2
        assert f"size is {sentence}" in " ".join(capsys.readouterr().err.split())

"""The search solves levels that random play does not, and its results depend on the level alone."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.alone import label
from levelproof.experts.config import ExpertConfig, Rule, StopConfig
from levelproof.experts.labels import Label, Source
from levelproof.experts.pool.strengthen import cycled, strengthen
from levelproof.experts.procedure import Procedure
from levelproof.experts.search.config import LEAST_ROUND, SearchConfig
from levelproof.experts.search.edit import Draws
from levelproof.experts.search.explore import NEARER, Search, begin, draw, explore, explore_rounds, under_way
from levelproof.experts.search.near import FAR
from levelproof.experts.search.play import arena, fresh_walk, play
from levelproof.experts.search.search import AHEAD, Searching, SearchResult, side_by_side
from levelproof.experts.search.shorten import shorten
from levelproof.experts.steps import EnvSteps
from levelproof.experts.verdict.judge import repeated
from levelproof.experts.witness.success import Success
from levelproof.experts.witness.witness import replay
from levelproof.levelgen.batching import take
from levelproof.levelgen.level import Level, concatenate_levels
from levelproof.levelgen.task.rules import DEFAULT_RULES, TaskParams
from tests.experts.search.worlds import broken, switchback, tower, valley

CONFIG = SearchConfig(env_steps=262_144, variations=65_536, patience_gap=0, lanes=32, entries=128)
ROUND = CONFIG.lanes * CONFIG.segments * CONFIG.segment  # env steps
SWITCHBACK, VALLEY, BROKEN = range(3)
KINDS = np.array([SWITCHBACK, VALLEY, BROKEN, SWITCHBACK, VALLEY, SWITCHBACK, VALLEY, SWITCHBACK, VALLEY])
IDS = np.arange(700, 700 + len(KINDS), dtype=np.int32)
SOLVABLE = np.flatnonzero(KINDS != BROKEN)


def search(levels: Level, level_ids: np.ndarray, config: SearchConfig, rules: TaskParams) -> SearchResult:
    """Search every level to its end."""
    searching = Searching(config, rules)
    job = searching.submit(levels, level_ids)
    while searching.step():
        pass
    return searching.result(job)


@cache
def levels() -> Level:
    return take(concatenate_levels([switchback(), valley(), broken()]), KINDS)


@cache
def found() -> SearchResult:
    return search(levels(), IDS, CONFIG, DEFAULT_RULES)


def same(one: SearchResult, other: SearchResult) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def begun() -> Search:
    first = np.arange(side_by_side(CONFIG))
    return begin(take(levels(), first), IDS[first], CONFIG, DEFAULT_RULES)


def test_rounds_are_longer_than_the_numbers_of_other_random_streams() -> None:
    """Go-Explore's streams are numbered by its env steps, those of `Draws` from 1 on."""
    assert max(Draws) < LEAST_ROUND
    with pytest.raises(ValueError, match="has fewer than 5"):
        SearchConfig(lanes=4, segments=1, segment=1)


@jax.jit
def random_play(levels: Level, key: jax.Array) -> jax.Array:
    """Return whether each of 256 random episodes per level reaches the goal."""
    ring = arena(levels, 256, CONFIG.resample)
    bits = jax.random.bits(key, (256, 6, 256 * levels.role.shape[-1]))
    return play(ring, fresh_walk(ring.lanes), bits, DEFAULT_RULES)[0].reached.reshape(-1, 256) > 0


@pytest.mark.slow
def test_search_finds_what_random_play_does_not() -> None:
    """In every level the search needs a fraction of its env steps; random play finds almost nothing in as many."""
    assert (found().success.length[SOLVABLE] > 0).all()
    assert (found().env_steps[SOLVABLE] < CONFIG.env_steps).all()
    twice = take(
        concatenate_levels([switchback(), valley()]), np.array([0, 1, 0, 1])
    )  # four levels, as where a tower is toppled
    episodes = CONFIG.env_steps // 256 // 256
    wins = sum(random_play(twice, jax.random.key(i)).sum(-1) for i in range(episodes // 2))
    np.testing.assert_array_equal(wins, 0)


@pytest.mark.slow
def test_search_topples_a_tower() -> None:
    """The search topples it on some levels; random play does in fewer than one episode in a thousand."""
    four = take(tower(), np.zeros(4, int))
    searched = search(four, IDS[:4], CONFIG, DEFAULT_RULES)
    assert (searched.success.length > 0).any()
    won = np.concatenate([random_play(four, jax.random.key(i)) for i in range(4)])
    assert won.mean() < 1e-3


def test_successes_of_the_search_replay() -> None:
    """The engine's program with rewards and contacts reaches the goal at the last step, and ends no episode before."""
    length = found().success.length[SOLVABLE]
    record = replay(take(levels(), SOLVABLE), np.moveaxis(np.asarray(found().success.action)[SOLVABLE], 0, -1))
    lane = np.arange(len(SOLVABLE))
    np.testing.assert_array_equal(np.argmax(record.done, axis=0) + 1, length)
    assert record.goal[length - 1, lane].all()
    ended = np.arange(256)[None] >= found().success.length[:, None]
    assert (found().success.action[ended] == 0).all()


def test_result_depends_on_the_level_alone() -> None:
    """Neighbours, search slots and batch differ."""
    for some in ([4], [8, 3, 2], list(range(len(KINDS)))[::-1]):
        alone = search(take(levels(), np.array(some)), IDS[some], CONFIG, DEFAULT_RULES)
        same(alone, jax.tree.map(lambda x, some=some: x[some], found()))


def test_flag_of_the_caller_leaves_a_search_unchanged() -> None:
    one = np.array([VALLEY])
    with jax.threefry_partitionable(False):
        under_flag = search(take(levels(), one), IDS[one], CONFIG, DEFAULT_RULES)
    same(under_flag, search(take(levels(), one), IDS[one], CONFIG, DEFAULT_RULES))


def test_units_share_search_slots() -> None:
    """Later levels enter the search slots that others leave; each unit gets the results of its own levels."""
    searching, units = Searching(CONFIG, DEFAULT_RULES), [np.arange(3), np.arange(3, 4), np.arange(4, len(KINDS))]
    assert not searching.step()
    assert searching.wants == AHEAD * side_by_side(CONFIG)
    totals, jobs = [], []
    for some in units:
        jobs.append(searching.submit(take(levels(), some), IDS[some]))
        assert searching.step()
        totals.append(sum(job.env_steps for job in jobs))
    waiting = searching.waiting(jobs[-1])
    assert searching.wants == AHEAD * side_by_side(CONFIG) - len(waiting)
    left_out, left = searching.submit(levels(), IDS), set(jobs[-1].under_way)
    searching.withdraw(left_out, range(len(KINDS)))
    assert (left_out.under_way, jobs[-1].under_way, searching.waiting(jobs[-1])) == (set(), left, waiting)
    assert totals == sorted(set(totals))
    while searching.step():
        pass
    for some, job in zip(units, jobs, strict=True):
        assert not job.under_way
        assert job.ledger.total().search > 0
        same(searching.result(job), jax.tree.map(lambda x, some=some: x[some], found()))


def test_search_depends_on_the_level_id() -> None:
    one = search(take(levels(), np.array([0])), np.array([9], np.int32), CONFIG, DEFAULT_RULES)
    assert (one.success.action[0] != found().success.action[0]).any()


def test_random_draws_are_never_reused() -> None:
    """Every round and level has its own draws."""
    deal = jax.jit(draw, static_argnums=2)
    drawn = [deal(level_id, jnp.int32(env_steps), CONFIG) for level_id in IDS[:2] for env_steps in (0, ROUND)]
    for numbers in zip(*drawn, strict=True):
        assert len({np.asarray(x).tobytes() for x in numbers}) == len(drawn)


def test_interruption_changes_no_result() -> None:
    """The state moves to the host and back, as in a checkpoint."""
    twice = explore(explore(begun(), CONFIG, DEFAULT_RULES), CONFIG, DEFAULT_RULES)
    once = jax.tree.map(np.array, explore(begun(), CONFIG, DEFAULT_RULES))
    resumed = explore(jax.tree.map(jnp.array, once), CONFIG, DEFAULT_RULES)
    jax.tree.map(np.testing.assert_array_equal, resumed, twice)


def test_env_steps_add_up() -> None:
    now = begun()
    for calls in (1, 2):
        now = explore(now, CONFIG, DEFAULT_RULES)
        steps = np.asarray(now.env_steps)
        assert (steps % ROUND == 0).all()
        going = np.asarray(now.length) == 0
        np.testing.assert_array_equal(steps[going], calls * CONFIG.rounds * ROUND)
    assert (found().grew <= found().env_steps).all()


def test_level_with_few_cells_leaves_at_a_rung() -> None:
    """With one cell it leaves at the first rung; with as many as required it reaches the next."""
    assert (found().env_steps[KINDS == BROKEN] == CONFIG.first_rung).all()
    broken = take(levels(), np.flatnonzero(KINDS == BROKEN)[:1])
    config = replace(CONFIG, env_steps=40_960, patience=0, first_rung=4096, per_cell=4096)
    assert search(broken, IDS[:1], config, DEFAULT_RULES).env_steps == 16_384


def test_stopping_limits_need_no_recompilation() -> None:
    """Other env steps, rungs or patience need no compiling."""
    programs = explore_rounds.count
    explore(begun(), CONFIG, DEFAULT_RULES)
    before = programs()
    given = {"env_steps": 5000, "variations": 7000, "patience": 300, "per_cell": 9, "first_rung": 2048, "bodies": 30}
    given |= {"patience_gap": 0.3}
    for name, number in given.items():
        assert number != getattr(CONFIG, name)
        explore(begun(), replace(CONFIG, **{name: number}), DEFAULT_RULES)
    assert programs() == before


@pytest.mark.campaign
def test_rounds_between_syncs_change_no_result() -> None:
    same(search(levels(), IDS, replace(CONFIG, rounds=3), DEFAULT_RULES), found())


def test_level_without_progress_leaves() -> None:
    config = replace(CONFIG, patience=65_536, patience_gap=0, per_cell=0)
    now = begun()
    at = lambda waited: replace(
        now, closed=jnp.full_like(now.closed, 8192), env_steps=jnp.full_like(now.env_steps, 8192 + waited)
    )
    assert under_way(at(65_536 - ROUND), config.ends).all()
    assert not under_way(at(65_536), config.ends).any()
    assert under_way(at(65_536), replace(config, patience=0).ends).all()


def test_patience_falls_with_the_gap() -> None:
    """Up to `patience_gap` it is whole; at twice that gap it is half, and never less than a quarter."""
    config = replace(CONFIG, patience=65_536, patience_gap=0.5, per_cell=0)
    now = begun()
    gaps = jnp.array(np.resize(np.array([0.0, 0.5, 1.0, 9.0], np.float32), len(now.gap)))
    at = lambda waited: replace(now, gap=gaps, env_steps=jnp.full_like(now.env_steps, waited))
    goes_on = lambda waited, config=config: np.asarray(under_way(at(waited), config.ends))
    assert goes_on(16_384 - 1).all()
    np.testing.assert_array_equal(goes_on(16_384), gaps <= 1.0)
    np.testing.assert_array_equal(goes_on(32_768 - 1), gaps <= 1.0)
    np.testing.assert_array_equal(goes_on(32_768), gaps <= 0.5)
    np.testing.assert_array_equal(goes_on(65_536 - 1), gaps <= 0.5)
    assert not goes_on(65_536).any()
    assert goes_on(65_536 - 1, replace(config, patience_gap=0)).all()
    assert goes_on(65_536, replace(config, patience=0)).all()


def test_the_gap_shrinks_on_the_way_to_the_goal() -> None:
    """The state has the smallest gap so far, and when it last shrank; a broken world has none."""
    now, read = begun(), lambda now: jax.device_get((now.gap, now.closed, now.env_steps))
    first = last = read(now)
    broken = KINDS[: len(first[0])] == BROKEN
    np.testing.assert_array_equal(first[0] == FAR, broken)
    for _ in range(4):
        now = explore(now, CONFIG, DEFAULT_RULES)
        gap, closed, env_steps = read(now)
        shrank = gap < last[0]
        assert (closed[shrank] > last[2][shrank]).all()
        np.testing.assert_array_equal(closed[~shrank], last[1][~shrank])
        archive = jax.device_get(now.archive)
        nearest = np.where(archive.used, archive.entry.distance, np.inf).min(-1)
        assert (NEARER * gap <= nearest)[~broken].all()  # what shrinks it less does not count
        last = gap, closed, env_steps
    assert (last[0] < first[0])[~broken].all()
    assert (last[1] == 0)[broken].all()


def test_rung_with_a_loose_limit_stops_no_level() -> None:
    """Cells times env steps per cell would overflow 32 bits."""
    now = begun()
    steps, cells = jnp.full_like(now.env_steps, CONFIG.first_rung), jnp.full_like(now.archive.cells, 3000)
    reached = replace(now, env_steps=steps, archive=now.archive._replace(cells=cells))
    assert under_way(reached, replace(CONFIG, patience=0, per_cell=1_000_000).ends).all()
    assert not under_way(reached, replace(CONFIG, patience=0, per_cell=1).ends).any()


def test_scaled_gives_larger_worlds_fewer_env_steps() -> None:
    """The level has one cell; without rungs it is searched to the end."""
    given = SearchConfig(env_steps=100_000, variations=20_000, patience=4000, bodies=8)
    limits = lambda config: (config.env_steps, config.variations, config.patience)
    assert (
        limits(given.scaled(7))
        == limits(given.scaled(8))
        == limits(given)
        == limits(replace(given, bodies=0).scaled(16))
    )
    assert limits(given.scaled(16)) == (25_000, 5000, 1000)
    assert limits(replace(given, patience=3, variations=0).scaled(64)) == (1562, 0, 1), "0 would mean no limit"
    four = replace(CONFIG, bodies=4, env_steps=207_360, patience=0, per_cell=0)
    at = np.flatnonzero(KINDS == BROKEN)[:1]
    assert search(take(levels(), at), IDS[:1], four, DEFAULT_RULES).env_steps == 40_960  # of 9 bodies


def test_explore_leaves_solved_levels_unchanged() -> None:
    now, calls = begun(), -(-int(found().env_steps[SOLVABLE].min()) // (CONFIG.rounds * ROUND))
    for _ in range(calls):
        now = explore(now, CONFIG, DEFAULT_RULES)
    solved = np.flatnonzero(now.length)
    assert len(solved)
    results = lambda now: jax.tree.map(
        lambda x: np.array(x)[solved], (now.archive, now.env_steps, now.code, now.length)
    )
    before = results(now)
    jax.tree.map(np.testing.assert_array_equal, before, results(explore(now, CONFIG, DEFAULT_RULES)))


def test_full_archive_widens_its_cells() -> None:
    """Entries stay distinct."""
    now = begun()
    for _ in range(4):
        now = explore(now, CONFIG, DEFAULT_RULES)
    archive = jax.device_get(now.archive)
    full = archive.cells > CONFIG.entries
    assert full.any()
    np.testing.assert_array_equal(archive.width > CONFIG.width * CONFIG.growth / 1.01, full)
    assert not full[KINDS[: len(full)] == BROKEN].any()
    for level in range(len(full)):
        keys = archive.key[level][archive.used[level]]
        assert len(set(keys.tolist())) == len(keys)
        assert archive.used[level].any()


def test_search_notes_when_its_last_cell_entered() -> None:
    """The end of that round; 0 if only the first state was reached."""
    now = jax.device_get(begun())
    for _ in range(4):
        before, now = now, jax.device_get(explore(jax.tree.map(jnp.array, now), CONFIG, DEFAULT_RULES))
        grown = now.archive.cells > before.archive.cells
        np.testing.assert_array_equal(now.grew[~grown], before.grew[~grown])
        assert (now.grew[grown] > before.env_steps[grown]).all()
        assert (now.grew[grown] <= now.env_steps[grown]).all()
    kinds = KINDS[: len(now.grew)]
    np.testing.assert_array_equal(now.grew > 0, kinds != BROKEN)
    assert (now.grew == now.env_steps).any(), "some grew in their last round"


def test_broken_world_archives_only_its_start() -> None:
    at = np.flatnonzero(KINDS == BROKEN)
    assert (found().success.length[at] == 0).all()
    np.testing.assert_array_equal(found().cells[at], 1)


def test_insert_omits_states_that_break_later() -> None:
    """A thruster too strong for the engine's floats: archived states are finite."""
    level = take(levels(), np.array([SWITCHBACK]))
    level.model.thruster_power[...] = 3e38
    now = explore(begin(take(level, np.zeros(side_by_side(CONFIG), int)), IDS[: side_by_side(CONFIG)], CONFIG,
                        DEFAULT_RULES), CONFIG, DEFAULT_RULES)  # fmt: skip
    archive = jax.device_get(now.archive)
    assert np.isfinite(archive.entry.state[archive.used]).all()
    assert np.isfinite(archive.entry.feature[archive.used]).all()


def delayed(at: np.ndarray) -> Success:
    """Return the successes of these levels; the first begins with 20 env steps in which the ball lies on the floor."""
    known = jax.tree.map(lambda x: x[at], found().success)
    given = Success(known.action.copy(), known.length.copy())
    given.action[0, :20] = 0
    given.action[0, 20:] = known.action[0, :-20]
    given.length[0] += 20
    return given


def test_strengthening_plays_what_a_witness_repeats() -> None:
    """Replays go on for some env steps after the witness's last, which is several repeats of a short one."""
    steps = np.array([1, 2, 7, 16, 100, 255, 256, 257])  # the last: no success
    code = np.arange(len(steps) * 256, dtype=np.uint16).reshape(len(steps), 256)
    for row, one, length in zip(np.asarray(cycled(code, steps)), code, steps.tolist(), strict=True):
        np.testing.assert_array_equal(row, repeated(one, length))


@pytest.mark.slow
def test_strengthening_keeps_a_witness_that_survives_all_replays() -> None:
    """It is compared with its variations even if many of these are shorter."""
    at = SOLVABLE[:1]
    given = delayed(at)
    stronger = strengthen(take(levels(), at), IDS[at], given, 2, DEFAULT_RULES)
    assert stronger.success.length[0] == given.length[0]
    np.testing.assert_array_equal(np.asarray(stronger.success.action)[0], given.action[0])


def test_shorten_removes_detours() -> None:
    """A success after idle steps becomes shorter, a failing one is dropped, none becomes longer."""
    width = side_by_side(CONFIG)
    at = np.resize(SOLVABLE, width)
    given = delayed(at)
    given.action[1] = 0
    shorter = shorten(take(levels(), at), IDS[at], given, CONFIG, DEFAULT_RULES)
    length = np.asarray(shorter.success.length)
    assert 0 < length[0] < given.length[0]
    assert length[1] == 0
    assert (length <= given.length).all()
    assert (np.asarray(shorter.env_steps)[2:] > 0).all()
    left = np.flatnonzero(length)
    record = replay(take(levels(), at[left]), np.moveaxis(np.asarray(shorter.success.action)[left], 0, -1))
    np.testing.assert_array_equal(np.argmax(record.done, axis=0) + 1, length[left])
    assert record.goal[length[left] - 1, np.arange(len(left))].all()


@pytest.mark.parametrize(
    "wrong",
    [{"lanes": 30}, {"entries": 0}, {"entries": 7}, {"growth": 1.0}, {"width": 0.0}, {"nearer": 1.5},
     {"new_action": -0.5}, {"resample": (0.5, 2.0)}, {"resample": ()}, {"entries": 16_385}, {"env_steps": 2**31},
     {"driven_weight": -1.0}, {"first_rung": 0}, {"per_cell": -1}, {"bodies": -1}, {"trials": 2000},
     {"trials": 1024, "lanes": 16_384}, {"robustness": 2000}, {"width": 1e-46}, {"growth": 1.00000001},
     {"lanes": 2**28}, {"patience": -1}, {"variations": 2**31}, {"polish": -1}, {"polish": 2**31},
     {"robustness": -1}, {"patience_gap": -0.1}],
)  # fmt: skip
def test_search_config_rejects_invalid_settings(wrong: dict) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))} is"):
        SearchConfig(**wrong)


def test_label_without_expert_rests_on_the_search() -> None:
    """All env steps are counted."""
    some = np.array([0, 1, 2])
    procedure = Procedure(CONFIG, ExpertConfig(), StopConfig(rule=Rule.NONE))
    result = label(take(levels(), some), IDS[some], 2048, procedure)
    searched = found().env_steps + found().varied + found().shortened
    for i, verdict in zip(some, result.verdicts, strict=True):
        length = int(found().success.length[i])
        assert verdict.label is (Label.SOLVED if length else Label.UNSOLVED)
        assert verdict.witness is (Source.SEARCH if length else None)
        assert verdict.steps_to_goal == (length or None)
        assert verdict.search_steps == searched[i]
        assert verdict.cells == found().cells[i]
    assert result.spent == EnvSteps(searched=int(searched[some].sum()))

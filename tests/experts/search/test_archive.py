"""Archives choose and keep states as plain formulas say."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from levelproof.experts.search.archive import ONE, Archive, ReachedStates, choose, insert, new_archive
from levelproof.experts.search.config import SearchConfig
from tests.quick import jit_once

choose_some = jit_once(choose, static_argnames="config")
insert_some = jit_once(insert, static_argnames="config")
CONFIG = SearchConfig(entries=16, width=1.0, growth=1.5, nearer=0.5)
LANES, DRAWS = 12, 7 * 9
STEPS = 4  # length of the trajectories' codes

State = tuple[float, int]  # position and env steps, which are unique


def states(positions: Any, steps: Any, distances: Any = 0.0) -> ReachedStates:
    """Return states of one level at positions on a line; the whole state and the codes repeat the env steps."""
    steps = np.asarray(steps, np.int32)[None]
    code = np.repeat(steps[..., None], STEPS, axis=-1).astype(np.uint16)
    feature = np.asarray(positions, np.float32)[None, :, None]
    distance = np.broadcast_to(np.float32(distances), steps.shape)
    columns = feature, steps[..., None].astype(np.float32), code, steps, distance
    return ReachedStates(*map(jnp.array, columns))


def archive_of(visits: list[int], distances: list[float]) -> Archive:
    """Return a level's archive whose first entries have been chosen so often and are so far from the goal."""
    archive = new_archive(states([0.0], [0]), CONFIG)
    rest = [0] * (CONFIG.entries - len(visits))
    entry = archive.entry._replace(distance=jnp.array([distances + rest], jnp.float32))
    used = jnp.array([[True] * len(visits) + [False] * len(rest)])
    return archive._replace(entry=entry, used=used, visits=jnp.array([visits + rest], jnp.int32))


def chosen(archive: Archive, *uniform: Any) -> np.ndarray:
    draws = jnp.stack(jnp.broadcast_arrays(*map(jnp.float32, uniform)))[None]
    return np.asarray(choose_some(archive, draws, CONFIG)[0])


def test_choose_draws_entries_by_how_rarely_they_were_chosen() -> None:
    """The weight of an entry is 1/(1 + visits), at least 1/ONE; unused entries are never drawn."""
    evenly = (np.arange(DRAWS) + 0.5) / DRAWS
    some = chosen(archive_of([0, 1, 3], [0.0] * 3), evenly, 0.0, CONFIG.nearer)
    np.testing.assert_allclose(np.bincount(some), [4 * 9, 2 * 9, 9], atol=1)
    often = chosen(archive_of([2 * ONE, 2 * ONE], [0.0] * 2), evenly, 0.0, CONFIG.nearer)
    np.testing.assert_allclose(np.bincount(often), [DRAWS / 2, DRAWS / 2], atol=1)


def test_choose_picks_the_nearer_of_two_draws_at_times() -> None:
    """When the third random number is below `nearer`; otherwise the first draw counts."""
    distances = [3.0, 1.0, 2.0]
    one, other = np.divmod(np.arange(DRAWS) % 9, 3)
    draws = (one + 0.5) / 3, (other + 0.5) / 3
    archive = archive_of([0, 0, 0], distances)
    nearer = [a if distances[a] <= distances[b] else b for a, b in zip(one, other, strict=True)]
    np.testing.assert_array_equal(chosen(archive, *draws, CONFIG.nearer - 0.01), nearer)
    np.testing.assert_array_equal(chosen(archive, *draws, CONFIG.nearer), one)


def inserted(kept: dict[int, State], width: float, new: list[State]) -> tuple[dict[int, State], float]:
    """Insert states into the archive of a level, by cell; if it overflows, widen the cells and sort its states anew."""
    cell = lambda state, width: int(np.round(np.float32(state[0]) / np.float32(width)))
    soonest: dict[int, State] = {}
    for state in sorted(new, key=lambda state: state[1]):
        soonest.setdefault(cell(state, width), state)
    kept, full = dict(kept), False
    for state in (state for state in new if soonest[cell(state, width)] == state):
        at = cell(state, width)
        if at in kept or len(kept) < CONFIG.entries:
            kept[at] = min(kept.get(at, state), state, key=lambda state: state[1])
        else:
            full = True
    if full:
        return inserted({}, width * CONFIG.growth, list(kept.values()))
    return kept, width


def test_insert_keeps_the_state_that_reaches_a_cell_soonest() -> None:
    """Also when cells widen, and whatever the order in which lanes reach them. Invalid states are left out."""
    rng = np.random.default_rng(0)
    archive, kept, width, widened = new_archive(states([0.0], [0]), CONFIG), {0: (0.0, 0)}, CONFIG.width, 0
    order = 1 + rng.permutation(20 * LANES).reshape(20, LANES)
    for number, steps in enumerate(order):
        positions, valid = rng.normal(scale=1 + number, size=LANES).astype(np.float32), rng.random(LANES) < 0.8
        new = [(float(x), int(n)) for x, n in zip(positions[valid], steps[valid], strict=True)]
        archive = insert_some(archive, states(positions, steps), jnp.array(valid)[None], CONFIG)
        before = width
        kept, width = inserted(kept, width, new)
        widened += width > before

        used = np.asarray(archive.used[0])
        entry = jax.tree.map(lambda x, used=used: np.asarray(x[0])[used], archive.entry)
        assert sorted(kept.values()) == sorted(zip(entry.feature[:, 0].tolist(), entry.steps.tolist(), strict=True))
        for whole in (entry.state[:, 0], *entry.code.T):
            np.testing.assert_array_equal(whole, entry.steps)
        np.testing.assert_allclose(archive.width[0], width, rtol=1e-6)
    assert widened > 1


def test_insert_forgets_how_often_a_replaced_entry_was_chosen() -> None:
    archive = archive_of([5], [0.0])
    archive = archive._replace(entry=archive.entry._replace(steps=archive.entry.steps + 3))
    first = jnp.arange(LANES)[None] == 0
    later, sooner = (insert_some(archive, states([0.1] * LANES, [n] * LANES), first, CONFIG) for n in (3, 2))
    assert (int(later.visits[0, 0]), int(later.entry.steps[0, 0])) == (5, 3)
    assert (int(sooner.visits[0, 0]), int(sooner.entry.steps[0, 0])) == (0, 2)
    assert int(sooner.cells[0]) == 1

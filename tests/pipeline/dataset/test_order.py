"""Shuffling without a list: every item once an epoch, in an order that looks random, parted evenly among hosts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from levelproof.pipeline.dataset.order import EpochOrder, permuted
from levelproof.pipeline.errors import UserError


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 5000), st.integers(0, 2**63), st.integers(0, 10))
def test_a_permutation_has_everything_once(count: int, seed: int, epoch: int) -> None:
    found = permuted(np.arange(count), count, seed, epoch)
    assert np.array_equal(np.sort(found), np.arange(count))


def test_a_place_is_looked_up_without_the_others() -> None:
    count = 10**12 + 39
    places = np.array([0, 1, count // 2, count - 1])
    found = permuted(places, count, seed=3)
    assert len(set(found.tolist())) == 4
    assert ((found >= 0) & (found < count)).all()
    assert np.array_equal(permuted(places[::-1], count, seed=3), found[::-1])


def test_orders_look_random() -> None:
    """Where an item lands, over many keys; and what comes after it."""
    count, keys = 40, 1000
    orders = np.array([permuted(np.arange(count), count, 7, epoch) for epoch in range(keys)])
    for item in (0, 1, 17, 39):
        landed = np.bincount(orders[:, item], minlength=count)
        assert chisquare(landed).pvalue > 1e-6
    steps = np.bincount((orders[:, 1:] - orders[:, :-1]).ravel() % count, minlength=count)[1:]
    assert chisquare(steps).pvalue > 1e-6


def test_seeds_and_epochs_have_orders_of_their_own() -> None:
    orders = {tuple(permuted(np.arange(100), 100, seed, epoch)) for seed in range(5) for epoch in range(5)}
    assert len(orders) == 25


@pytest.mark.parametrize("seed", [None, 5])
@pytest.mark.parametrize(("count", "batch", "hosts"), [(103, 8, 3), (5, 8, 2), (48, 8, 3), (1, 1, 1)])
def test_hosts_share_an_epoch(count: int, batch: int, hosts: int, seed: int | None) -> None:
    orders = [EpochOrder(count, batch, seed, host, hosts) for host in range(hosts)]
    assert len({order.batches for order in orders}) == 1
    for epoch in range(2):
        seen = []
        for order in orders:
            for step in range(order.batches):
                items, new = order.items(epoch * order.batches + step)
                assert items.shape == new.shape == (batch,)
                seen += items[new].tolist()
        assert sorted(seen) == list(range(count))


def test_without_a_seed_items_come_in_their_order() -> None:
    assert EpochOrder(10, 4, None).items(1)[0].tolist() == [4, 5, 6, 7]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"batch_size": 0}, "A batch cannot have 0 items"),
        ({"batch_size": 2.5}, r"A batch cannot have 2\.5 items"),
        ({"process_index": 2, "process_count": 2}, "There is no process 2 of 2"),
        ({"seed": -1}, "The seed is -1"),
    ],
)
def test_what_makes_no_order_is_refused(words: dict, sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        EpochOrder(**({"count": 10, "batch_size": 2, "seed": 0} | words))

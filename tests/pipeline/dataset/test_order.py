"""`EpochOrder` and `permute`: every item once per epoch, in random order, apportioned evenly to hosts."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from levelproof.pipeline.dataset.order import EpochOrder, permute
from levelproof.pipeline.errors import UserError


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 5000), st.integers(0, 2**63), st.integers(0, 10))
def test_permute_is_a_permutation(count: int, seed: int, epoch: int) -> None:
    permuted = permute(np.arange(count), count, seed, epoch)
    assert np.array_equal(np.sort(permuted), np.arange(count))


def test_permute_computes_single_positions() -> None:
    count = 10**12 + 39
    positions = np.array([0, 1, count // 2, count - 1])
    permuted = permute(positions, count, seed=3)
    assert len(set(permuted.tolist())) == 4
    assert ((permuted >= 0) & (permuted < count)).all()
    assert np.array_equal(permute(positions[::-1], count, seed=3), permuted[::-1])


def test_permute_is_the_same_in_every_version() -> None:
    """Else a state that one version saved resumes elsewhere in another."""
    assert permute(np.arange(8), 1000, seed=3).tolist() == [144, 958, 748, 106, 546, 24, 592, 671]
    assert permute(np.arange(8), 1000, seed=3, epoch=1).tolist() == [926, 232, 353, 170, 29, 887, 895, 230]


def test_permute_looks_random() -> None:
    """Chi-squared tests, over many keys, of where an item lands and of which item follows it."""
    count, keys = 40, 1000
    orders = np.array([permute(np.arange(count), count, 7, epoch) for epoch in range(keys)])
    for item in (0, 1, 17, 39):
        landed = np.bincount(orders[:, item], minlength=count)
        assert chisquare(landed).pvalue > 1e-6
    steps = np.bincount((orders[:, 1:] - orders[:, :-1]).ravel() % count, minlength=count)[1:]
    assert chisquare(steps).pvalue > 1e-6


def test_permute_differs_between_seeds_and_epochs() -> None:
    orders = {tuple(permute(np.arange(100), 100, seed, epoch)) for seed in range(5) for epoch in range(5)}
    assert len(orders) == 25


@pytest.mark.parametrize("seed", [None, 5])
@pytest.mark.parametrize(("count", "batch", "hosts"), [(103, 8, 3), (5, 8, 2), (48, 8, 3), (1, 1, 1)])
def test_epoch_order_distributes_each_epoch_over_hosts(count: int, batch: int, hosts: int, seed: int | None) -> None:
    orders = [EpochOrder(count, batch, seed, host, hosts) for host in range(hosts)]
    assert len({order.batches for order in orders}) == 1
    for epoch in range(2):
        items_of_hosts = []
        for order in orders:
            for step in range(order.batches):
                items, new = order.items(epoch * order.batches + step)
                assert items.shape == new.shape == (batch,)
                items_of_hosts += items[new].tolist()
        assert sorted(items_of_hosts) == list(range(count))


def test_epoch_order_without_a_seed_keeps_item_order() -> None:
    assert EpochOrder(10, 4, None).items(1)[0].tolist() == [4, 5, 6, 7]


def test_items_of_several_batches_are_those_of_each() -> None:
    order, positions = EpochOrder(10, 4, 0), range(1, 8)  # the first epoch has three batches
    items, new = order.items(positions)
    each = [order.items(position) for position in positions]
    assert items.tolist() == np.concatenate([one for one, _ in each]).tolist()
    assert new.tolist() == np.concatenate([one for _, one in each]).tolist()


def test_integers_of_numpy_are_those_of_python() -> None:
    """Positions are saved as JSON."""
    names = ("batch_size", "seed", "process_index", "process_count")
    given = dict(zip(names, (np.int64(2), jnp.int32(7), np.array(0), np.uint8(2)), strict=True))
    assert EpochOrder(10, **given) == EpochOrder(10, 2, 7, 0, 2)
    assert all(type(getattr(EpochOrder(10, **given), name)) is int for name in names)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"batch_size": 0}, "A batch cannot have 0 items"),
        ({"batch_size": 2.5}, r"A batch cannot have 2\.5 items"),
        ({"process_index": 2, "process_count": 2}, "There is no process 2 of 2"),
        ({"seed": -1}, "The seed is -1"),
        ({"seed": 1.5}, r"The seed is 1\.5"),
        ({"process_count": 2.0}, r"There is no process 0 of 2\.0"),
    ],
)
def test_epoch_order_rejects_invalid_arguments(arguments: dict, sentence: str) -> None:
    with pytest.raises(UserError, match=sentence):
        EpochOrder(**({"count": 10, "batch_size": 2, "seed": 0} | arguments))

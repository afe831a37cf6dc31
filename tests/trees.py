"""Trees of arrays: comparison and axes."""

from typing import Any

import jax
import numpy as np


def assert_same(left: Any, right: Any) -> None:
    """Check that two trees have one structure, and that their arrays have the same shapes, types and values."""
    compare = lambda path, a, b: np.testing.assert_array_equal(a, b, jax.tree_util.keystr(path), strict=True)
    jax.tree_util.tree_map_with_path(compare, left, right)


def lanes_last(tree: Any) -> Any:
    """Move the first axis of every array to the end."""
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), 0, -1), tree)

"""Random actions of a benchmark: the same for both sides. NumPy only: both sides import it."""

import numpy as np

CHOICES = (3, 3, 3, 3, 2, 2)  # of a multi-discrete action: four motor bindings, two thruster bindings
STICKINESS = 0.9  # chance that an action entry stays as it was


def sticky_actions(steps: int, lanes: int, seed: int = 0) -> np.ndarray:
    """Multi-discrete actions that change now and then, (step, 6, lane) int32."""
    rng = np.random.default_rng(seed)
    fresh = rng.integers(0, np.array(CHOICES)[None, :, None], (steps, len(CHOICES), lanes), np.int32)
    changes = rng.random(fresh.shape) >= STICKINESS
    changes[:1] = True
    last = np.maximum.accumulate(np.where(changes, np.arange(steps)[:, None, None], 0), 0)
    return np.take_along_axis(fresh, last, 0)

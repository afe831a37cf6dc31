"""Random actions of a benchmark, equal for both sides. Imports NumPy only, because both sides import it."""

import numpy as np

CHOICES = (3, 3, 3, 3, 2, 2)  # entries of a multi-discrete action: four motor bindings, two thruster bindings
STICKINESS = 0.9  # probability that an action entry repeats


def sticky_actions(steps: int, lanes: int, seed: int = 0) -> np.ndarray:
    """Draw multi-discrete actions that mostly repeat, (step, 6, lane) int32."""
    rng = np.random.default_rng(seed)
    fresh = rng.integers(0, np.array(CHOICES)[None, :, None], (steps, len(CHOICES), lanes), np.int32)
    changes = rng.random(fresh.shape) >= STICKINESS
    changes[:1] = True
    last = np.maximum.accumulate(np.where(changes, np.arange(steps)[:, None, None], 0), 0)
    return np.take_along_axis(fresh, last, 0)

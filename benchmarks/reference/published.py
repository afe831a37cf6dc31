# pyright: reportMissingImports=false
"""The random levels of the reference's published solve rates, as its `get_randomly_sampled_eval_levels` draws them.

Doing nothing solves almost none of them within 64 steps: the reference samples twice as many levels as it needs, and
chooses those that it solves a thousand times more rarely. The settings are those of its `configs/`, which its package
lacks.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from kinetix.environment import EnvParams
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.spaces import ActionType, ObservationType
from kinetix.util.train_utils import get_randomly_sampled_eval_levels
from world import flatten, static_of


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", required=True)
    parser.add_argument("--count", type=int, required=True)
    args = parser.parse_args()
    static, params = static_of(args.size), EnvParams(dense_reward_scale=0.2)
    env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_ENTITY, None, params, static)
    config = {
        "env_size_name": args.size,
        "filter_levels": True,
        "level_filter_n_steps": 64,
        "level_filter_sample_ratio": 2,
    }
    levels = get_randomly_sampled_eval_levels(config, params, static, env, args.count)
    np.savez_compressed(args.out, **flatten(jax.device_get(levels)))  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main()

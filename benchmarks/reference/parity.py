# pyright: reportMissingImports=false
"""The reference's side of `python -m benchmarks parity`, inside its own environment: it steps and plays worlds.

Answers requests (see serve.py), each of which names the file `out` to write:
    handmade  the reference's handmade levels of this size
    play      env steps from the worlds of a file under its `actions` (step, 6, lane), with automatic reset
    step      one physics step from each world of a file under its `actions` (6, lane)
"""

import argparse
from pathlib import Path

import numpy as np
from serve import answer
from world import flatten, load_levels, static_of, stay_on

BODIES, MANIFOLDS = ("polygon", "circle"), ("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds")
EVOLVING = [f"{kind}/{x}" for kind in BODIES for x in ("position", "rotation", "velocity", "angular_velocity")]
EVOLVING += [f"{kind}/{x}" for kind in MANIFOLDS for x in ("active", "acc_impulse_normal", "acc_impulse_tangent")]
EVOLVING += ["joint/acc_impulse", "joint/acc_r_impulse"]
GEOMETRY = [f"{kind}/{x}" for kind in MANIFOLDS for x in ("normal", "penetration", "collision_point")]
GEOMETRY += [f"{kind}/restitution_velocity_target" for kind in MANIFOLDS]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", required=True)
    parser.add_argument("--cache", required=True, help="folder for compiled code")
    parser.add_argument("--core", type=int)
    args = parser.parse_args()
    stay_on(args.core)

    import jax
    from kinetix.environment import EnvParams
    from kinetix.environment.env import make_kinetix_env
    from kinetix.environment.spaces import ActionType, ObservationType

    jax.config.update("jax_compilation_cache_dir", args.cache)
    params, static = EnvParams(dense_reward_scale=0.0), static_of(args.size)
    env = make_kinetix_env(ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, static)

    def act_one(state, level, action):
        return env.step(jax.random.PRNGKey(0), state, action, params, level)[1:4]

    def step_one(state, action):
        control = env.action_type.process_action(action, state, static)
        return env.physics_engine.step(state, params, control)[0], control

    act, step = jax.jit(jax.vmap(act_one)), jax.jit(jax.vmap(step_one))

    def worlds(request):
        with np.load(request["worlds"]) as file:
            actions, lanes = file["actions"], len(file["gravity"])
        return load_levels(request["worlds"], args.size, 0, lanes), np.moveaxis(actions, -2, -1)

    def play(request):
        """Write `reward`, `done` (step, lane) and, with `record`, what evolves before each action."""
        level, actions = worlds(request)
        state, record, outcomes = level, [], []
        for action in actions:
            if request["record"]:
                record.append(part(state, EVOLVING))
            state, reward, done = act(state, level, action)
            outcomes.append((np.asarray(reward), np.asarray(done)))
        reward, done = map(np.stack, zip(*outcomes, strict=True))
        fields = {name: np.stack([fields[name] for fields in record]) for name in EVOLVING} if record else {}
        np.savez(request["out"], reward=reward, done=done, **fields)  # pyright: ignore[reportArgumentType]
        return {}

    def one_step(request):
        state, actions = worlds(request)
        after, control = step(state, actions)
        np.savez(request["out"], control=np.asarray(control), **part(after, EVOLVING + GEOMETRY))  # pyright: ignore[reportArgumentType]
        return {}

    handlers = {"handmade": lambda request: handmade(args.size, request["out"]), "play": play, "step": one_step}
    answer({}, lambda request: handlers[request["do"]](request))


def part(state, names: list[str]) -> dict[str, np.ndarray]:
    fields = flatten(state)
    return {name: fields[name] for name in names}


def handmade(size: str, out: str) -> dict:
    """Write every handmade level of the size as plain arrays."""
    from kinetix.util.saving import BASE_DIR, load_from_json_file

    files = sorted((Path(BASE_DIR) / size).glob("*.json"))
    levels = [flatten(load_from_json_file(str(file))[0]) for file in files]
    np.savez(out, **{name: np.stack([level[name] for level in levels]) for name in levels[0]})  # pyright: ignore[reportArgumentType]
    return {"names": [file.stem for file in files]}


if __name__ == "__main__":
    main()

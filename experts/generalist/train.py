"""Proximal policy optimisation of one policy over many levels, on one or more cores; reads no files.

Lanes are distributed over the cores of a mesh. Each core acts and computes gradients in its own lanes; averaged, they
change one set of weights, of which every core has a copy.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.typing import VariableDict
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, Key

from levelproof.experts.generalist.actor_critic import ActorCriticParams, initial_actor_critic, logits_and_value
from levelproof.experts.generalist.config import CHUNK, PPOConfig
from levelproof.experts.generalist.curricula import Curriculum, EndedEpisodes
from levelproof.experts.generalist.rollout import Ended, Experience, Playing, begin, rollout
from levelproof.experts.generalist.subsample import LEAST, choose
from levelproof.experts.networks.chunks import lanes_at_once, mean_gradient
from levelproof.experts.networks.layers import LOGITS
from levelproof.experts.networks.over_levels import NetworkConfig, logits_and_summary
from levelproof.experts.objective import advantages, normalised_over, terms
from levelproof.experts.optimise import clipped_adam, running_average
from levelproof.experts.policy import divergence
from levelproof.levelgen.batching import split_lanes
from levelproof.levelgen.identity.keys import key_of_seed
from levelproof.levelgen.task.lanes import Table
from levelproof.levelgen.task.rules import TaskParams
from levelproof.physics.types import Size

CORES = "core"  # axis of the mesh
BEGINNING, PLAYING, MEASURING, BREEDING = range(1, 5)  # folded into the seed's key; cloning uses that key itself


class Learner(NamedTuple):
    """Training under way, with all that decides how it continues."""

    params: ActorCriticParams
    optimiser: optax.OptState
    average: Any  # running average of the policy's parameters
    playing: Playing  # lanes of all cores
    curriculum: Any
    updates: Int[Array, ""]


class UpdateFacts(NamedTuple):
    """What happened in an update."""

    episodes: Int[Array, ""]  # that ended
    solved: Int[Array, ""]  # of them
    env_steps: Int[Array, ""]  # of them, each episode's rounded up to whole actions
    reward: Float[Array, ""]  # sum over them, shaping included
    entropy: Float[Array, ""]  # of the policy's live entries, nats; this and what follows are means over samples
    value_error: Float[Array, ""]
    kl_to_before: Float[Array, ""]  # estimate of KL(policy before || now), nats, mean over the update's minibatches
    kl_to_start: Float[Array, ""]  # KL(policy || policy that training started from), nats; 0: none


class TrainingRecipe(NamedTuple):
    """What decides the programs of a training."""

    network: NetworkConfig
    size: Size
    ppo: PPOConfig
    curriculum: Curriculum
    rules: TaskParams  # of training: `PPOConfig.training_rules`
    seed: int


class Programs(NamedTuple):
    """Functions of a training; `advance` and a measuring `between_updates` donate the learner."""

    begin: Callable[[Table, VariableDict | None], Learner]
    advance: Callable[[Learner, Table, VariableDict | None], tuple[Learner, UpdateFacts]]
    between_updates: Callable[[Learner, Table], Learner]  # every `curriculum.every` updates: measure or breed levels


class Chunk(NamedTuple):
    """Samples that go through the network together; in arrays of many, the chunk axis is first."""

    seen: Any
    live: Bool[Array, "6 sample"]
    action: Int[Array, "6 sample"]
    log_probability: Float[Array, " sample"]
    value: Float[Array, " sample"]
    advantage: Float[Array, " sample"]
    gain: Float[Array, " sample"]  # the advantage, normalised over all samples of the update
    weight: Float[Array, " sample"]  # in means; 0: not learned from
    logits_of_start: Float[Array, "logit sample"]


def programs_of(recipe: TrainingRecipe, table: Table, start: VariableDict | None, cores: int) -> Programs:
    """Return the programs of a training on the first `cores` devices.

    Args:
        recipe: what is trained, and how.
        table: the levels; gives shapes only.
        start: parameters of the policy that training starts from; None: from scratch. Gives shapes only.
        cores: number of devices that share the lanes.
    """
    leaves, tree = jax.tree.flatten((table, start))
    shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves)
    # The end of training is not part of any program
    return _programs(recipe._replace(ppo=replace(recipe.ppo, env_steps=1)), shapes, tree, cores)


@lru_cache(maxsize=8)
def _programs(recipe: TrainingRecipe, shapes: tuple[jax.ShapeDtypeStruct, ...], tree: Any, cores: int) -> Programs:
    """Make the programs once for equal arguments: jitting a function again would trace and compile it again."""
    mesh = Mesh(np.array(jax.devices()[:cores]), (CORES,))
    whole = PartitionSpec()
    shape = jax.eval_shape(partial(_begin, recipe), *jax.tree.unflatten(tree, shapes))
    by_lane = lambda x: PartitionSpec(*[None] * (x.ndim - 1), CORES)
    kept = Learner(whole, whole, whole, jax.tree.map(by_lane, shape.playing), whole, whole)  # pyright: ignore

    def on_cores(function: Callable, outputs: Any, *inputs: Any) -> Callable:
        mapped = jax.shard_map(
            partial(function, recipe), mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False
        )
        return jax.jit(mapped, donate_argnums=0)

    to_mesh = jax.tree.map(lambda spec: NamedSharding(mesh, spec), kept, is_leaf=lambda x: x is whole)
    breeds = recipe.curriculum.breed is not None
    return Programs(
        jax.jit(partial(_begin, recipe), out_shardings=to_mesh),
        on_cores(_advance, (kept, whole), kept, whole, whole),
        partial(_breed, recipe, NamedSharding(mesh, whole)) if breeds else on_cores(_measure, kept, kept, whole),
    )


def _begin(recipe: TrainingRecipe, table: Table, start: VariableDict | None) -> Learner:
    """Initialise the policy, its critic and all lanes."""
    of_weights, of_levels = jax.random.split(jax.random.fold_in(key_of_seed(recipe.seed), BEGINNING))
    params = initial_actor_critic(of_weights, recipe.network, recipe.size, start)
    state = recipe.curriculum.begin()
    table = recipe.curriculum.table(table, state)
    levels = recipe.curriculum.draw(table, state, of_levels, recipe.ppo.environments)
    playing = begin(table, levels, recipe.rules)
    # A copy, because the learner is donated, and no buffer can be donated twice
    average = jax.tree.map(jnp.copy, params.policy)
    return Learner(params, clipped_adam(recipe.ppo).init(params), average, playing, state, jnp.int32(0))


def _advance(
    recipe: TrainingRecipe, learner: Learner, table: Table, start: VariableDict | None
) -> tuple[Learner, UpdateFacts]:
    """Act in a core's lanes, and take one update together with the other cores."""
    ppo, update = recipe.ppo, learner.updates
    key = jax.random.fold_in(_key(recipe, PLAYING, update), jax.lax.axis_index(CORES))
    of_rollout, of_choice, of_epochs = jax.random.split(key, 3)
    table = recipe.curriculum.table(table, learner.curriculum)
    draw = partial(recipe.curriculum.draw, table, learner.curriculum)
    playing, experience, ended = rollout(
        learner.params, recipe.network, table, learner.playing, draw, of_rollout, ppo.horizon,
        recipe.rules,
    )  # fmt: skip
    chunks = _chunks(recipe, experience, start if ppo.kl_weight else None, update, of_choice)
    params, optimiser, means = _epochs(recipe, learner, chunks, of_epochs, start is not None)
    after = Learner(
        params,
        optimiser,
        running_average(learner.average, params.policy, update, ppo.average),
        playing,
        recipe.curriculum.learn(learner.curriculum, _of_all_cores(ended)),
        update + 1,
    )
    count = lambda x: jnp.where(ended.done, x, 0).sum()
    steps = count(ended.steps) * ppo.repeat
    sums = jax.lax.psum((ended.done.sum(), count(ended.goal), steps, count(ended.gained)), CORES)
    return after, UpdateFacts(*sums, *means)


def _of_all_cores(ended: Ended) -> EndedEpisodes:
    mine = EndedEpisodes(ended.done, ended.level_index, ended.gained, ended.expected / ended.steps)
    return jax.tree.map(lambda x: jax.lax.all_gather(x.reshape(-1), CORES, tiled=True), mine)


def _open_ended(experience: Experience) -> Bool[Array, "time lane"]:
    """Mark the last steps before the time limit, or the rollout's end, cuts an episode off."""
    return (experience.done & ~experience.terminated).at[-1].set(~experience.terminated[-1])


def _advantages(experience: Experience, config: PPOConfig) -> Float[Array, "time lane"]:
    """Estimate advantages; where an episode is cut off, later rewards are the value of the last state seen.

    That state's own action then counts for nothing. So no state has to go through the network a second time.
    """
    open_ended = _open_ended(experience)
    reward = jnp.where(open_ended, experience.value, experience.reward)
    over = experience.done | open_ended
    per_action = config.discount**config.repeat
    return advantages(experience.value, reward, over, jnp.zeros_like(reward[0]), per_action, config.gae_lambda)


def _samples(ppo: PPOConfig, experience: Experience, key: Key[Array, ""]) -> Chunk:
    """Return a core's samples, time first; with `subsample` 1 all of them, those not learned from with weight 0."""
    counts = ~_open_ended(experience)
    advantage = _advantages(experience, ppo)
    gain = normalised_over(CORES, advantage, counts)
    share = jnp.maximum(jax.lax.pmean(counts.mean(), CORES), LEAST)  # divides weights, so that their mean is 1
    samples = Chunk(
        experience.seen, experience.live, experience.action, experience.log_probability, experience.value, advantage,
        gain, counts / share, jnp.zeros((len(gain), 0, gain.shape[-1])),
    )  # fmt: skip
    if ppo.subsample == 1:
        return samples
    lane, weight = choose(gain, counts, ppo.samples(jax.lax.axis_size(CORES)), key)
    take = jax.vmap(partial(jnp.take, axis=-1, mode="clip"))
    return jax.tree.map(lambda x: take(x, lane), samples)._replace(weight=weight / share)


def _chunks(
    recipe: TrainingRecipe, experience: Experience, start: VariableDict | None, update: Array, key: Key[Array, ""]
) -> Chunk:
    """Return a core's samples as chunks, chunk axis first."""
    samples = _samples(recipe.ppo, experience, key)
    width = lanes_at_once(recipe.size, min(samples.value.shape[-1], CHUNK))

    parted = jax.vmap(partial(split_lanes, lanes=width))(samples)  # time first, then the chunks of each time step
    chunks = jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), parted)
    if start is None:
        return chunks
    logits = lambda observation: logits_and_summary(start, recipe.network, recipe.size, observation)[0]
    nothing = lambda seen: jnp.zeros((len(chunks.value), LOGITS, width))
    weighs = _kl_weight(recipe.ppo, update) > 0
    return chunks._replace(logits_of_start=jax.lax.cond(weighs, partial(jax.lax.map, logits), nothing, chunks.seen))


def _epochs(
    recipe: TrainingRecipe, learner: Learner, chunks: Chunk, key: Key[Array, ""], starts: bool
) -> tuple[ActorCriticParams, optax.OptState, Any]:
    """Pass over a core's chunks several times in minibatches; return weights, optimiser and means of the terms."""
    ppo, update, count = recipe.ppo, learner.updates, len(chunks.value)
    fitting = (update < ppo.critic_updates) if starts else jnp.array(False)
    loss = partial(_loss, recipe=recipe, kl_weight=_kl_weight(ppo, update))

    def learn(now: tuple[Any, Any], index: Int[Array, " chunk"]) -> tuple[tuple[Any, Any], Any]:
        params, state = now
        batch = jax.tree.map(lambda x: x[index], chunks)
        gradient, means = jax.lax.pmean(mean_gradient(loss, params, batch), CORES)
        if starts:
            gradient = gradient._replace(policy=jax.tree.map(lambda x: jnp.where(fitting, 0, x), gradient.policy))
        change, state = clipped_adam(ppo).update(gradient, state, params)
        changed: Any = optax.apply_updates(params, change)
        return (changed, state), means

    def epoch(now: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], Any]:
        return jax.lax.scan(learn, now, jax.random.permutation(key, count).reshape(ppo.minibatches, -1))

    state = learner.optimiser
    if starts:  # reset Adam when the policy starts to learn: moments of zero gradients make its first steps too long
        fresh = clipped_adam(ppo).init(learner.params)
        state = jax.tree.map(lambda new, old: jnp.where(update == ppo.critic_updates, new, old), fresh, state)
    (params, state), means = jax.lax.scan(epoch, (learner.params, state), jax.random.split(key, ppo.epochs))
    return params, state, jax.tree.map(jnp.mean, means)


def _loss(
    params: ActorCriticParams, chunk: Chunk, recipe: TrainingRecipe, kl_weight: Array
) -> tuple[Float[Array, ""], tuple[Array, ...]]:
    ppo = recipe.ppo
    logits, value = logits_and_value(params, recipe.network, recipe.size, chunk.seen)
    now = terms(
        logits, value, chunk.action, chunk.live, chunk.log_probability, chunk.value, chunk.advantage, chunk.gain,
        ppo.clip, chunk.weight,
    )  # fmt: skip
    mean = lambda x: (chunk.weight * x).mean()
    change = now.log_probability - chunk.log_probability
    moved = mean(jnp.exp(change) - 1 - change)  # Schulman's estimate, which is never negative
    total = ppo.value_weight * now.value_error - now.surrogate - ppo.entropy_weight * now.entropy
    from_start = jnp.zeros(())
    if len(chunk.logits_of_start):
        from_start = mean(divergence(logits, chunk.logits_of_start, chunk.live))
        total += kl_weight * from_start
    return total, (now.entropy, now.value_error, moved, jnp.where(kl_weight > 0, from_start, 0.0))


def _kl_weight(config: PPOConfig, update: Array) -> Float[Array, ""]:
    """Return the weight of the divergence from the start, at an update."""
    if not config.kl_updates:
        return jnp.zeros(())
    since = jnp.maximum(update - config.critic_updates, 0)
    return config.kl_weight * jnp.maximum(1 - since / config.kl_updates, 0.0)


def _key(recipe: TrainingRecipe, purpose: int, update: Array) -> Key[Array, ""]:
    """Derive the key of what happens in, or before, an update."""
    return jax.random.fold_in(jax.random.fold_in(key_of_seed(recipe.seed), purpose), update)


def _measure(recipe: TrainingRecipe, learner: Learner, table: Table) -> Learner:
    """Let the curriculum measure levels by the policy as it acts now, distributed over the cores."""
    curriculum = recipe.curriculum
    assert curriculum.measure

    def attempt(level_index: Int[Array, " level"], steps: int, key: Key[Array, ""]) -> tuple[Array, Array]:
        cores, core = jax.lax.axis_size(CORES), jax.lax.axis_index(CORES)
        own = jnp.resize(level_index, (-(-len(level_index) // cores) * cores,)).reshape(cores, -1)[core]
        actions = -(-steps // recipe.ppo.repeat)
        parts = jnp.resize(own, (-(-len(own) // CHUNK), min(CHUNK, len(own))))

        def play(given: tuple[Array, Array]) -> tuple[Array, Array]:
            number, part = given
            again = lambda key, lanes: part
            now = begin(table, part, recipe.rules)
            each = jax.random.fold_in(key, core * len(parts) + number)
            _, _, ended = rollout(learner.params, recipe.network, table, now, again, each, actions, recipe.rules)
            return ended.done.sum(0), (ended.done & ended.goal).sum(0)

        counts = jax.tree.map(lambda x: x.reshape(-1)[: len(own)], jax.lax.map(play, (jnp.arange(len(parts)), parts)))
        gather = lambda x: jax.lax.all_gather(x, CORES, axis=0, tiled=True)[: len(level_index)]
        return jax.tree.map(gather, counts)

    key = _key(recipe, MEASURING, learner.updates)
    return learner._replace(curriculum=curriculum.measure(table, attempt, key))


def _breed(recipe: TrainingRecipe, everywhere: NamedSharding, learner: Learner, table: Table) -> Learner:
    """Let the curriculum breed levels on the host."""
    assert recipe.curriculum.breed
    rng = np.random.default_rng((recipe.seed, BREEDING, int(learner.updates)))
    return learner._replace(curriculum=jax.device_put(recipe.curriculum.breed(learner.curriculum, rng), everywhere))

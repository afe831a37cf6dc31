"""Settings of an expert: its network, its training, when it stops, and what counts as a witness."""

from dataclasses import dataclass
from enum import StrEnum

from levelproof.physics.bounds import require

RECORD_STEPS = 256  # env steps of a record, with automatic reset inside
MAX_DOUBLINGS = 6  # of the interval between failed evaluations
MAX_COUNTED = 2**31 - 1  # env steps and updates are counted in 32 bits on the device


class Network(StrEnum):
    """Observation and network of an expert."""

    FLAT = "flat"  # all features in one vector
    ENTITY = "entity"  # a set of entities; their order does not matter


class Rule(StrEnum):
    """When a level leaves its slot."""

    NONE = "none"  # no expert is trained: labels rest on the search
    BUDGET = "budget"  # every expert gets its whole budget
    SOLVED = "solved"  # until its evaluation succeeds
    HALVING = "halving"  # until its evaluation succeeds, or its return stops growing between rungs


class Choice(StrEnum):
    """Successes of an evaluation that can become a level's witness."""

    RECORD = "record"  # attempts whose finished episodes, including those after a reset, all reached the goal
    SHORTEST = "shortest"  # the shortest successful episodes of any attempt, repeated to fill the record


@dataclass(frozen=True)
class ExpertConfig:
    """Hyperparameters of one expert (hashable: pass as a static argument)."""

    # network
    network: Network = Network.FLAT  # observation and network of an expert
    width: int = 32  # units of a hidden layer
    depth: int = 2  # hidden layers of the policy, and as many of the value function
    encoding: int = 16  # units of the first hidden layer of an entity network, for each kind of entity
    # experience
    environments: int = 32  # lanes of an expert
    horizon: int = 64  # env steps in each lane between updates
    dense_reward_scale: float = 0.2  # 1/m; shaping reward in training, in place of task.dense_reward_scale
    rehearsals: int = 8  # lanes that repeat the first success, once there is one
    persistence: float = 0.9  # probability that rehearsal lanes repeat their last action until the first success
    # PPO (Schulman et al. 2017, arXiv:1707.06347)
    epochs: int = 4  # passes over the samples of an update
    minibatches: int = 4  # updates of the weights in an epoch
    learning_rate: float = 2e-3  # Adam's step size
    adam_epsilon: float = 1e-5  # Adam's epsilon
    max_gradient_norm: float = 1.0  # maximum global norm of an expert's gradient
    discount: float = 0.995  # discount factor of rewards, per env step
    gae_lambda: float = 0.9  # lambda of advantage estimates (Schulman et al. 2016, arXiv:1506.02438)
    clip: float = 0.2  # maximum change of the probability ratio, and of the value, in either direction
    value_weight: float = 0.5  # weight of the value function's loss
    entropy_weight: float = 0.01  # weight of the policy's entropy, a bonus in the loss
    imitation_weight: float = 2.0  # weight of the log-probability of rehearsed actions, a bonus in the loss
    # evaluation: one record per lane
    attempts: int = 16  # unperturbed lanes: the first takes the most probable actions, the others sample
    sticky_attempts: int = 8  # lanes in which the last action sometimes replaces the expert's
    perturbed_attempts: int = 8  # lanes that start with perturbed velocities
    # witness
    witness: Choice = Choice.RECORD  # successes of an evaluation that can become a level's witness
    exploration: bool = True  # trained levels: if no evaluation succeeds, accept a success from search or training
    replays: int = (
        32  # replays per candidate witness, from starts that differ by rounding; 0: the first candidate is the witness
    )
    # machine
    slots: int = 0  # experts that train side by side in one program; 0: chosen by device

    def __post_init__(self) -> None:
        at_least_one = ("width", "depth", "encoding", "environments", "horizon", "epochs", "minibatches", "attempts")
        not_negative = ("dense_reward_scale", "value_weight", "entropy_weight", "imitation_weight", "slots")
        require(self, at_least_one, 1)
        require(self, ("learning_rate", "adam_epsilon", "max_gradient_norm"), 0, above=True)
        require(self, ("discount", "gae_lambda", "clip", "persistence"), 0, 1)
        require(self, (*not_negative, "rehearsals", "sticky_attempts", "perturbed_attempts", "replays"), 0)
        if self.steps_per_update % self.minibatches:
            raise ValueError(
                f"minibatches is {self.minibatches}: it must divide environments x horizon = {self.steps_per_update}"
            )
        if self.rehearsals >= self.environments:
            raise ValueError(
                f"rehearsals is {self.rehearsals}: it must be below environments = {self.environments}, so that the "
                "expert chooses the actions in some of them"
            )
        lanes = self.attempts + self.sticky_attempts + self.perturbed_attempts
        if lanes > self.environments:
            raise ValueError(
                f"attempts, sticky_attempts and perturbed_attempts add up to {lanes}: "
                f"their sum must not exceed environments = {self.environments}"
            )

    @property
    def steps_per_update(self) -> int:
        """Env steps of one expert per update."""
        return self.environments * self.horizon

    def updates_in(self, env_steps: int) -> int:
        """Return the number of updates in these env steps, at least 1."""
        return max(1, env_steps // self.steps_per_update)

    @property
    def record_rollouts(self) -> int:
        """Number of rollouts in a record."""
        return -(-RECORD_STEPS // self.horizon)


@dataclass(frozen=True)
class StopConfig:
    """When a level leaves its slot."""

    rule: Rule = Rule.HALVING  # when a level leaves its slot
    successes: int = 1  # attempts of an evaluation that must succeed for a level to leave early; a witness needs one
    share: float = 0.25  # share of an update's finished episodes that must reach the goal to trigger an evaluation
    wait: int = 2048  # env steps of training between a failed evaluation and the next; doubles up to six times
    polish: int = 0  # env steps of training after a level is solved, to shorten its witness; 0: none
    robustness: int = 65_536  # env steps of training after a level is solved, if its witness is fragile; 0: none
    first_rung: int = 2048  # env steps of training at the first rung; each rung doubles them
    gain: float = 0.05  # minimum growth of the best return between rungs
    fruitless: int = (
        163_840  # env steps of training after which an expert that never reached the goal leaves; 0: no limit
    )

    def __post_init__(self) -> None:
        require(self, ("successes", "first_rung"), 1)
        require(self, ("wait", "polish", "robustness", "gain", "fruitless"), 0)
        require(self, ("share",), 0, 1)


def check_budget(budget: int, config: ExpertConfig, stopping: StopConfig) -> None:
    """Raise ValueError if experts cannot use the budget.

    Args:
        budget: env steps of one expert.
        config: settings of an expert.
        stopping: settings that say when a level leaves.

    Raises:
        ValueError: it is too small for one update, its counters overflow, or more attempts must succeed than an
            evaluation makes.
    """
    if budget < config.steps_per_update:
        raise ValueError(
            f"budget is {budget}: one update of an expert takes {config.steps_per_update} env steps "
            f"({config.environments} environments x {config.horizon}): set at least that many"
        )
    if budget > MAX_COUNTED:
        raise ValueError(f"budget is {budget}: the maximum is {MAX_COUNTED} env steps")
    if stopping.rule in (Rule.SOLVED, Rule.HALVING) and stopping.successes > config.attempts:
        raise ValueError(
            f"stop.successes is {stopping.successes}, more than expert.attempts={config.attempts}: lower it, or raise "
            "expert.attempts"
        )
    updates = config.updates_in(budget)
    waits = {
        "wait": config.updates_in(stopping.wait) << MAX_DOUBLINGS,
        "polish": config.updates_in(stopping.polish),
        "robustness": config.updates_in(stopping.robustness),
        "first_rung": config.updates_in(stopping.first_rung),
    }
    for name, longest in waits.items():
        if updates + longest > MAX_COUNTED:
            raise ValueError(
                f"stop.{name} is {getattr(stopping, name)}: with a budget of {budget}, the update count would exceed "
                f"{MAX_COUNTED}: lower it"
            )

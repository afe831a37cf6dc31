"""What an expert is, how it learns, when it stops and what counts as a witness."""

from dataclasses import dataclass
from enum import StrEnum

from levelproof.physics.bounds import require

RECORD_STEPS = 256  # env steps of a record, with automatic reset inside
MAX_DOUBLINGS = 6  # of the wait between evaluations
MAX_COUNTED = 2**31 - 1  # env steps and updates are counted in 32 bits on the device


class Network(StrEnum):
    """What an expert sees, and through which network."""

    FLAT = "flat"  # all features side by side
    ENTITY = "entity"  # a set of things; their order does not matter


class Rule(StrEnum):
    """When a level leaves its slot."""

    NONE = "none"  # no expert is trained: labels rest on the search
    BUDGET = "budget"  # every expert gets its whole budget
    SOLVED = "solved"  # until its evaluation succeeds
    HALVING = "halving"  # until its evaluation succeeds or, at a rung, its learning does not move


class Choice(StrEnum):
    """Which successes of its evaluations can be a level's witness."""

    RECORD = "record"  # attempts whose every finished episode reached the goal, automatic reset and all
    SHORTEST = "shortest"  # the shortest successful episodes of any attempt, repeated to fill the record


@dataclass(frozen=True)
class ExpertConfig:
    """Hyperparameters of one expert (hashable: pass as a static argument)."""

    # network
    network: Network = Network.FLAT  # what an expert sees, and through which network
    width: int = 32  # units of a hidden layer
    depth: int = 2  # hidden layers of the policy and of the value function, which share none
    encoding: int = 16  # units of the first hidden layer of an entity network, of each kind of thing
    # experience
    environments: int = 32  # lanes an expert acts in
    horizon: int = 64  # env steps in each lane between updates
    dense_reward_scale: float = 0.2  # 1/m; shaping while training, in place of task.dense_reward_scale
    rehearsals: int = 8  # lanes that repeat the first success of training, once there is one
    persistence: float = 0.9  # probability that these lanes repeat their last action, before
    # PPO (Schulman et al. 2017, arXiv:1707.06347)
    epochs: int = 4  # passes over the experience of an update
    minibatches: int = 4  # updates of the weights in an epoch
    learning_rate: float = 2e-3  # Adam's step size
    adam_epsilon: float = 1e-5  # Adam's epsilon
    max_gradient_norm: float = 1.0  # global norm that one expert's gradient is cut to
    discount: float = 0.995  # of rewards, per env step
    gae_lambda: float = 0.9  # of advantages (Schulman et al. 2016, arXiv:1506.02438)
    clip: float = 0.2  # of the probability ratio, and of the value's change, to either side
    value_weight: float = 0.5  # of the value function's loss
    entropy_weight: float = 0.01  # of the policy's entropy, which the loss rewards
    imitation_weight: float = 2.0  # of the log-probability of rehearsed actions, which the loss rewards
    # evaluation: each lane rolls out one record
    attempts: int = 16  # lanes as they are: the first by the most probable actions, the others sampled
    sticky_attempts: int = 8  # lanes where an action is sometimes repeated against the expert's will
    moved_attempts: int = 8  # lanes that start with other velocities
    # witness
    witness: Choice = Choice.RECORD  # which successes of its evaluations can be a level's witness
    exploration: bool = True  # of trained levels, a success found otherwise is a witness where evaluation has none
    replays: int = 32  # of each candidate, from starts moved by a rounding error; 0: the first candidate is the witness
    # machine
    slots: int = 0  # experts that train side by side in one program; 0: as many as suit the device

    def __post_init__(self) -> None:
        at_least_one = ("width", "depth", "encoding", "environments", "horizon", "epochs", "minibatches", "attempts")
        not_negative = ("dense_reward_scale", "value_weight", "entropy_weight", "imitation_weight", "slots")
        require(self, at_least_one, 1)
        require(self, ("learning_rate", "adam_epsilon", "max_gradient_norm"), 0, above=True)
        require(self, ("discount", "gae_lambda", "clip", "persistence"), 0, 1)
        require(self, (*not_negative, "rehearsals", "sticky_attempts", "moved_attempts", "replays"), 0)
        if self.steps_per_update % self.minibatches:
            raise ValueError(
                f"minibatches is {self.minibatches}: it must divide environments x horizon = {self.steps_per_update}"
            )
        if self.rehearsals >= self.environments:
            raise ValueError(
                f"rehearsals is {self.rehearsals}: it must be below environments = {self.environments}, so that in "
                "some the expert chooses its own actions"
            )
        lanes = self.attempts + self.sticky_attempts + self.moved_attempts
        if lanes > self.environments:
            raise ValueError(
                f"attempts, sticky_attempts and moved_attempts are {lanes} together: "
                f"they must not be above environments = {self.environments}"
            )

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one expert between updates."""
        return self.environments * self.horizon

    def updates_in(self, env_steps: int) -> int:
        """How many updates so many env steps are, at least one."""
        return max(1, env_steps // self.steps_per_update)

    @property
    def record_rollouts(self) -> int:
        """Rollouts that a record takes."""
        return -(-RECORD_STEPS // self.horizon)


@dataclass(frozen=True)
class StopConfig:
    """When a level leaves its slot."""

    rule: Rule = Rule.HALVING  # when a level leaves its slot
    successes: int = 1  # attempts of an evaluation that must succeed for a level to be solved
    share: float = 0.25  # of an update's finished episodes that must reach the goal before an evaluation is worth it
    wait: int = 2048  # env steps of training between an evaluation that failed and the next; doubles each time
    polish: int = 0  # env steps of training after a level is solved, for a shorter way to the goal
    steady: int = 65_536  # env steps of training after a level is solved, for a steadier witness; 0: none
    first_rung: int = 2048  # env steps of training at the first rung; each is twice the one before
    gain: float = 0.05  # by which the best return must have grown since the rung before
    fruitless: int = 163_840  # env steps of training after which an expert leaves that never reached the goal; 0: none

    def __post_init__(self) -> None:
        require(self, ("successes", "first_rung"), 1)
        require(self, ("wait", "polish", "steady", "gain", "fruitless"), 0)
        require(self, ("share",), 0, 1)


def check_budget(budget: int, config: ExpertConfig, stopping: StopConfig) -> None:
    """Refuse a budget that experts cannot use.

    Args:
        budget: env steps of one expert.
        config: what an expert is.
        stopping: when a level leaves.

    Raises:
        ValueError: it does not suffice for one update, or counts of it do not fit.
    """
    if budget < config.steps_per_update:
        raise ValueError(
            f"budget is {budget}: one update of an expert takes {config.steps_per_update} env steps "
            f"({config.environments} environments x {config.horizon}), so give at least that many"
        )
    if budget > MAX_COUNTED:
        raise ValueError(f"budget is {budget}: an expert can count no more than {MAX_COUNTED} env steps")
    if stopping.rule in (Rule.SOLVED, Rule.HALVING) and stopping.successes > config.attempts:
        raise ValueError(
            f"stop.successes is {stopping.successes}: with expert.attempts={config.attempts} give at most "
            f"{config.attempts}, or more attempts"
        )
    updates = config.updates_in(budget)
    waits = {
        "wait": config.updates_in(stopping.wait) << MAX_DOUBLINGS,
        "polish": config.updates_in(stopping.polish),
        "steady": config.updates_in(stopping.steady),
        "first_rung": config.updates_in(stopping.first_rung),
    }
    for name, longest in waits.items():
        if updates + longest > MAX_COUNTED:
            raise ValueError(
                f"stop.{name} is {getattr(stopping, name)}: with a budget of {budget}, updates would have to be "
                f"counted beyond {MAX_COUNTED}, so give less"
            )

"""Hydra's edge: override strings in, typed settings out."""

import os
import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from importlib.resources import files
from itertools import product
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from levelproof.configs.convert import flat, nested, plain, typed
from levelproof.configs.errors import ConfigError, suggestion
from levelproof.configs.schema import REPEATED, JobConfig, from_files, hash_of
from levelproof.levelgen.sampling.distribution import Distribution

if TYPE_CHECKING:
    from levelproof.configs.clone import CloneConfig
    from levelproof.configs.distill import DistillConfig
    from levelproof.configs.train import TrainConfig

T = TypeVar("T")
JOB = "generate"
PACKAGE = "levelproof.configs"  # package of the yaml files
ConfigStore.instance().store(name="code", node=plain(JobConfig()))  # the defaults that configs/generate.yaml names
# Entries of JobConfig.results that are not settings, or that are handled separately
NOT_COPIED = frozenset({"size", "distribution", "budget", "sampler_version", "engine_version", *REPEATED})
# Values are taken as strings: 007 stays 007
VERBATIM = frozenset({"size", "levels", "level_files", "budget", "out", "continue_from", "where", "start"})
FOLDERS = ("procedure", "distribution")  # folders of presets
COMPOSING = Lock()  # Hydra's state is global: threads compose one after another
FOR_RANDOM_LEVELS = ("size", "levels", "first_level", "distribution")


def compose_job(overrides: Sequence[str]) -> JobConfig:
    """Return the job that `overrides` (Hydra's `key=value` strings) describe.

    Raises:
        ConfigError: a setting is unknown or has a wrong value.
    """
    job = typed(JobConfig, settings(overrides))
    names = {_parse(text).key_or_group.partition(".")[0] for text in overrides} if job.level_files else ()
    for name in FOR_RANDOM_LEVELS:
        if name in names:
            raise ConfigError(f"{name} is for random levels, but level_files is set: leave out one of them.")
    return job


def settings(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the composed settings as nested plain mappings; values are not yet checked."""
    parsed = [_parse(text) for text in overrides]
    _check_keys(parsed, _known())
    return _compose([override.input_line or "" for override in parsed])


@cache
def _known() -> Mapping[str, Any]:
    """Return every setting with its default."""
    return flat(_compose([]))


@cache
def default_presets() -> dict[str, str]:
    """Return the default preset of each folder of configs/."""
    with COMPOSING, initialize_config_module(PACKAGE, version_base="1.3"):
        choices = compose(JOB, return_hydra_config=True).hydra.runtime.choices
    return {name: str(choices[name]) for name in presets()}


def presets() -> dict[str, list[str]]:
    """Return the names of the presets in each folder of configs/."""
    folders = [entry for entry in files(PACKAGE).iterdir() if entry.is_dir() and not entry.name.startswith("_")]
    return {
        f.name: sorted(e.name.removesuffix(".yaml") for e in f.iterdir() if e.name.endswith(".yaml")) for f in folders
    }


@cache
def shortest_command(job: JobConfig) -> str:
    """Return the shortest command with the same results as `job`, without `out` and the choice of levels.

    It has the fewest settings; of commands with equally many, the one that names more presets.
    """
    fixed, wanted, default = [f"budget={job.budget}"], flat(job.results), flat(_default().results)
    if not job.level_files:
        fixed.insert(0, f"size={job.size}")
    commands = []
    for names in product(*(presets()[folder] for folder in FOLDERS)):
        named = dict(zip(FOLDERS, names, strict=True))
        chosen = [f"{folder}={name}" for folder, name in named.items() if name != default_presets()[folder]]
        start = default | {key: value for preset in named.items() for key, value in _changes(*preset).items()}
        changed = [key for key, value in wanted.items() if key not in NOT_COPIED and start[key] != value]
        overrides = [override_of(key, wanted[key]) for key in changed]
        command = shlex.join(["levelproof", "generate", *fixed, *chosen, *overrides])
        commands.append((len(chosen) + len(overrides), len(overrides), command))
    return min(commands)[-1]


def changed_settings(results: Mapping[str, Any]) -> list[str]:
    """Return the overrides, without the budget, that turn the default job into one with these `JobConfig.results`."""
    default, known = flat(_default().results), flat(results)
    changed = [name for name in known if name not in NOT_COPIED and known[name] != default.get(name, ...)]
    size = [] if from_files(results) else [f"size={results['size']}"]
    return [*size, *(override_of(name, known[name]) for name in changed)]


def override_of(name: str, value: Any) -> str:
    """Return a setting as users type it, so that `compose_job` reads the same value."""
    return f"{name}={value if name in VERBATIM else _in_grammar(value)}"


@cache
def _default() -> JobConfig:
    return compose_job([])


@cache
def _load(folder: str, name: str) -> dict[str, Any]:
    """Load a preset's YAML without Hydra, which takes 100 times as long, because it composes all settings."""
    content = OmegaConf.to_container(OmegaConf.load(str(files(PACKAGE) / folder / f"{name}.yaml")))
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def _changes(folder: str, name: str) -> dict[str, Any]:
    """Return the settings that a preset changes: in its folder's group, or in any group if the folder names none."""
    content = _load(folder, name)
    return flat({folder: content} if folder in JobConfig.__annotations__ else content)


@cache
def distributions() -> dict[str, Distribution]:
    """Return the presets in configs/distribution/ by name."""
    return {name: typed(Distribution, _load("distribution", name)) for name in presets()["distribution"]}


def name_and_hash(distribution: Distribution) -> tuple[str | None, str]:
    """Return the name of a distribution, None if it is not a preset, and its short hash.

    With one sampler version and size, equal hashes mean equal levels for equal ids. All settings are hashed, including
    defaults, so manifests written before a setting was added stay comparable.
    """
    name = next((name for name, preset in distributions().items() if preset == distribution), None)
    return name, hash_of(plain(distribution))


def _compose(overrides: list[str]) -> dict[str, Any]:
    try:
        with COMPOSING, initialize_config_module(PACKAGE, version_base="1.3"):
            composed = OmegaConf.to_container(compose(JOB, overrides), resolve=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(f"cannot use these settings: {str(error).splitlines()[0].rstrip('.')}.") from None
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


def _parse(text: str) -> Override:
    """Parse one `key=value`; take a value that Hydra's grammar cannot read (`out=my data/é`) as a plain string."""
    key, equals, value = text.partition("=")
    quoted = f"{key}={QuotedString(value, Quote.single).with_quotes()}"
    verbatim = key in VERBATIM and value[:1] not in "'\""
    for attempt in (quoted if verbatim else text, quoted) if key and equals else ():
        with suppress(HydraException):
            override = OverridesParser.create().parse_override(attempt)
            break
    else:
        raise ConfigError(f"cannot read {text!r}: write settings as NAME=VALUE.")
    if override.is_add() or override.is_force_add() or override.is_delete():
        raise ConfigError(f"cannot use {text!r}: settings can be changed, not added or removed.")
    if override.is_sweep_override():
        raise ConfigError(f"{key} has several values in {text!r}: one command makes one split, so set one value.")
    return override


def _check_keys(overrides: Sequence[Override], known: Mapping[str, Any]) -> None:
    parents = {key.rpartition(".")[0] for key in known}
    choices = presets()
    for override in overrides:
        key, value = override.key_or_group, override.value()
        if key in choices and not isinstance(value, Mapping):
            if str(value) not in choices[key]:
                hint = suggestion(str(value), choices[key])
                raise ConfigError(f"there is no {key} {value!s}{hint}: choose one of {', '.join(choices[key])}.")
        elif key not in known and not any(parent == key or parent.startswith(f"{key}.") for parent in parents):
            raise ConfigError(f"there is no setting {key}{suggestion(key, known)}: `levelproof settings` lists them.")


def _in_grammar(value: Any) -> str:
    """Write a value in the grammar of Hydra's overrides; quote strings only if necessary."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{','.join(map(_in_grammar, value))}]"
    if not isinstance(value, str):
        return repr(value)
    unquoted = value.isidentifier() and OverridesParser.create().parse_override(f"name={value}").value() == value
    return value if unquoted else QuotedString(value, Quote.single).with_quotes()


def compose_clone(overrides: Sequence[str]) -> "CloneConfig":
    """Return the settings of `levelproof clone` that `overrides` (`key=value` strings) change.

    Raises:
        ConfigError: a setting is unknown, has a wrong value, or has no effect beside the others.
    """
    from levelproof.configs.clone import CloneConfig  # imports flax and optax, which jobs do not need

    parsed = [_parse(text) for text in overrides]
    config = _changed(CloneConfig, parsed)
    _require_heads(config.network.kind, parsed)
    return config


def compose_train(overrides: Sequence[str]) -> "TrainConfig":
    """Return the settings of `levelproof train` that `overrides` (`key=value` strings) change.

    Raises:
        ConfigError: a setting is unknown, has a wrong value, or has no effect beside the others.
    """
    from levelproof.configs.train import CURRICULA, READ_BY, TrainConfig  # imports flax

    parsed = [_parse(text) for text in overrides]
    config = _changed(TrainConfig, parsed)
    config = replace(config, start=os.path.expanduser(config.start), levels=os.path.expanduser(config.levels))
    if random := config.levels in CURRICULA:
        _require_effect(parsed, ("where", "choice", "starts"), f"on random levels (levels={config.levels})")
    else:
        why = f"on the levels of a split or of files (levels={config.levels})"
        _require_effect(parsed, ("size", "distribution"), why)
    unread = [group for group, readers in READ_BY.items() if config.chosen_by not in readers]
    _require_effect(parsed, unread, f"with {f'levels={config.levels}' if random else f'choice={config.choice}'}")
    if not config.start:
        _require_effect(parsed, ("ppo.critic_updates", "ppo.kl_weight", "ppo.kl_updates"), "without start")
    if not config.ppo.kl_weight:
        _require_effect(parsed, ("ppo.kl_updates",), "without ppo.kl_weight")
    if config.start and config.ppo.critic_updates >= config.ppo.updates:
        raise ConfigError(
            f"ppo.env_steps gives {config.ppo.updates} updates, and the first {config.ppo.critic_updates} "
            "leave the policy as it is: raise ppo.env_steps or lower ppo.critic_updates."
        )
    _require_no_network(config.start, parsed)
    _require_heads(config.network.kind, parsed)
    if random and config.distribution not in (known := distributions()):
        hint = suggestion(config.distribution, known)
        raise ConfigError(f"there is no distribution {config.distribution}{hint}: choose one of {', '.join(known)}.")
    return config


def compose_distill(overrides: Sequence[str]) -> "DistillConfig":
    """Return the settings of `levelproof distill` that `overrides` (`key=value` strings) change.

    Raises:
        ConfigError: a setting is unknown, has a wrong value, or has no effect beside the others.
    """
    from levelproof.configs.distill import DistillConfig  # imports flax and optax

    parsed = [_parse(text) for text in overrides]
    config = _changed(DistillConfig, parsed)
    config = replace(config, start=os.path.expanduser(config.start))
    if not config.demonstrations:
        _require_effect(parsed, ("teachers.sticky", "teachers.perturbed"), "without demonstrations")
    if not config.states:
        asking = ("failed", *(f"teachers.{name}" for name in ("expert", "witness", "random", "learner")))
        _require_effect(parsed, asking, "with states=0")
    _require_no_network(config.start, parsed)
    _require_heads(config.network.kind, parsed)
    return config


def _require_effect(overrides: Iterable[Override], useless: Collection[str], why: str) -> None:
    """Raise ConfigError if a setting, or its group, is among those that have no effect; `why` ends the sentence."""
    for name in (override.key_or_group for override in overrides):
        if name in useless or name.partition(".")[0] in useless:
            raise ConfigError(f"{name} has no effect {why}: leave it out.")


def _require_no_network(start: str, overrides: Iterable[Override]) -> None:
    """Raise ConfigError if settings change the network of a policy to start from."""
    for override in overrides if start else ():
        if (name := override.key_or_group).startswith("network."):
            raise ConfigError(f"{name} cannot change the network of the policy in start: leave out {name} or start.")


def _require_heads(kind: str, overrides: Iterable[Override]) -> None:
    """Raise ConfigError if settings give heads to a network without attention."""
    if kind not in ("attention", "transformer"):
        _require_effect(overrides, ("network.heads",), f"with network.kind={kind}")


def _changed(cls: type[T], overrides: Iterable[Override]) -> T:
    """Return a dataclass of settings with changes; it has no yaml file and no presets."""
    known = flat(plain(cls()))
    changed = dict(known)
    for override in overrides:
        key = override.key_or_group
        if key == "out":
            raise ConfigError("the folder to write is not a setting of this command: write -o FOLDER, not out=FOLDER.")
        if key not in known:
            raise ConfigError(f"there is no setting {key}{suggestion(key, known)}: choose one of {', '.join(known)}.")
        changed[key] = override.value()
    return typed(cls, nested(changed))

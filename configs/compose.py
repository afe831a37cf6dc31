"""Hydra's edge: override strings in, one typed JobConfig out."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.resources import files
from itertools import product
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from levelproof.configs.convert import flat, plain, typed
from levelproof.configs.errors import ConfigError, suggestion
from levelproof.configs.schema import JobConfig, from_files, hash_of
from levelproof.levelgen.sampling.distribution import Distribution

JOB = "generate"
PACKAGE = "levelproof.configs"  # where the yaml files are
ConfigStore.instance().store(name="code", node=plain(JobConfig()))  # where configs/generate.yaml has defaults from
# Results that are not settings, or have their own word
BY_HAND = frozenset({"size", "distribution", "budget", "sampler_version"})
WORDS = frozenset({"size", "levels", "level_files", "budget", "out", "continue_from"})  # kept as typed: 007 stays 007
FOLDERS = ("procedure", "distribution")  # of presets
OF_RANDOM_LEVELS = ("size", "levels", "first_level", "distribution")


def compose_job(overrides: Sequence[str]) -> JobConfig:
    """The job that `overrides` (Hydra's `key=value` strings) describe.

    Raises:
        ConfigError: an unknown setting or a wrong value, in one sentence.
    """
    job = typed(JobConfig, settings(overrides))
    given = {_parsed(text).key_or_group.partition(".")[0] for text in overrides} if job.level_files else ()
    for name in OF_RANDOM_LEVELS:
        if name in given:
            raise ConfigError(f"{name} is for random levels, level_files for others: leave out one of the two.")
    return job


def settings(overrides: Sequence[str]) -> dict[str, Any]:
    """The composed settings as nested plain mappings, not yet checked."""
    parsed = [_parsed(text) for text in overrides]
    _check_keys(parsed, _known())
    return _composed([override.input_line or "" for override in parsed])


@cache
def _known() -> Mapping[str, Any]:
    """Every setting, with its default."""
    return flat(_composed([]))


@cache
def chosen() -> dict[str, str]:
    """The preset that each folder of configs/ stands for where no other is chosen."""
    with initialize_config_module(PACKAGE, version_base="1.3"):
        choices = compose(JOB, return_hydra_config=True).hydra.runtime.choices
    return {name: str(choices[name]) for name in presets()}


def presets() -> dict[str, list[str]]:
    """The files to choose from in each folder of configs/."""
    folders = [entry for entry in files(PACKAGE).iterdir() if entry.is_dir() and not entry.name.startswith("_")]
    return {
        f.name: sorted(e.name.removesuffix(".yaml") for e in f.iterdir() if e.name.endswith(".yaml")) for f in folders
    }


@cache
def again(job: JobConfig) -> str:
    """The shortest command, but for `out` and which levels, with the same results as `job`."""
    fixed, wanted, default = [f"budget={job.budget}"], flat(job.results), flat(_default().results)
    if not job.level_files:
        fixed.insert(0, f"size={job.size}")
    commands = []
    for names in product(*(presets()[folder] for folder in FOLDERS)):
        named = dict(zip(FOLDERS, names, strict=True))
        words = [f"{folder}={name}" for folder, name in named.items() if name != chosen()[folder]]
        start = default | {key: value for preset in named.items() for key, value in _changes(*preset).items()}
        changed = [typed_as(key, value) for key, value in wanted.items() if key not in BY_HAND and start[key] != value]
        commands.append(shlex.join(["levelproof", "generate", *fixed, *words, *changed]))
    return min(commands, key=len)


def words_for(results: Mapping[str, Any]) -> list[str]:
    """The settings, but for the budget, that a job with these `JobConfig.results` has and the default has not."""
    default, known = flat(_default().results), flat(results)
    changed = [name for name in known if name not in BY_HAND and known[name] != default.get(name, ...)]
    size = [] if from_files(results) else [f"size={results['size']}"]
    return [*size, *(typed_as(name, known[name]) for name in changed)]


def typed_as(name: str, value: Any) -> str:
    """A setting as people type it: the inverse of what `compose_job` reads."""
    return f"{name}={value if name in WORDS else _in_grammar(value)}"


@cache
def _default() -> JobConfig:
    return compose_job([])


@cache
def _written(folder: str, name: str) -> dict[str, Any]:
    """What stands in a preset's file: without Hydra, which takes a hundred times as long to compose all settings."""
    written = OmegaConf.to_container(OmegaConf.load(str(files(PACKAGE) / folder / f"{name}.yaml")))
    assert isinstance(written, dict)
    return {str(key): value for key, value in written.items()}


def _changes(folder: str, name: str) -> dict[str, Any]:
    """The settings that a preset changes: those of the group that its folder is called after, or any."""
    written = _written(folder, name)
    return flat({folder: written} if folder in JobConfig.__annotations__ else written)


@cache
def distributions() -> dict[str, Distribution]:
    """The presets in configs/distribution/ by name."""
    return {name: typed(Distribution, _written("distribution", name)) for name in presets()["distribution"]}


def identified(distribution: Distribution) -> tuple[str | None, str]:
    """Name, where it is a preset's, and short hash of a distribution: the same hash, the same levels for the same ids.

    One sampler version and size provided. Made from all its settings, so manifests written before a setting was
    added compare, too.
    """
    name = next((name for name, preset in distributions().items() if preset == distribution), None)
    return name, hash_of(plain(distribution))


def _composed(overrides: list[str]) -> dict[str, Any]:
    try:
        with initialize_config_module(PACKAGE, version_base="1.3"):
            composed = OmegaConf.to_container(compose(JOB, overrides), resolve=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(f"cannot use these settings: {str(error).splitlines()[0].rstrip('.')}.") from None
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


def _parsed(text: str) -> Override:
    """One `key=value`; what Hydra's grammar cannot read (`out=my data/é`) is taken as a plain word."""
    key, equals, value = text.partition("=")
    quoted = f"{key}={QuotedString(value, Quote.single).with_quotes()}"
    as_word = key in WORDS and value[:1] not in "'\""
    for written in (quoted if as_word else text, quoted) if key and equals else ():
        with suppress(HydraException):
            override = OverridesParser.create().parse_override(written)
            break
    else:
        raise ConfigError(f"cannot read {text!r}: write settings as NAME=VALUE, as in levels=64.")
    if override.is_add() or override.is_force_add() or override.is_delete():
        raise ConfigError(f"cannot use {text!r}: settings can be changed, not added or removed.")
    if override.is_sweep_override():
        raise ConfigError(f"{key} has several values in {text!r}: one command makes one split, so give one.")
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
    """A value in the grammar of Hydra's overrides; words that mean themselves without quotes."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{','.join(map(_in_grammar, value))}]"
    if not isinstance(value, str):
        return repr(value)
    alone = value.isidentifier() and OverridesParser.create().parse_override(f"name={value}").value() == value
    return value if alone else QuotedString(value, Quote.single).with_quotes()

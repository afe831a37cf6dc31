"""One level of a split, found without reading the others."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from levelproof.configs import schema
from levelproof.experts.labels import Label
from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.read.levels import COLUMNS, distribution_of, find_level, levels_of, rules_of
from levelproof.pipeline.store import manifest
from levelproof.pipeline.store.fragment import read_fragment
from levelproof.pipeline.store.manifest import Manifest, read_manifest
from tests.pipeline.command import assert_refused, here
from tests.pipeline.made import made_split


def test_find_level_reads_one_fragment_and_few_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    split, read = made_split(tmp_path, [[Label.SOLVED] * 2] * 4), []

    def recording(path: Path, columns: list[str], *rest: Any) -> object:
        read.append((path.stem, set(columns)))
        return read_fragment(path, columns, *rest)

    monkeypatch.setattr(manifest, "read_fragment", recording)
    split_manifest, row = find_level(split, 5)
    assert (row["level_id"], row["row"], row["label"]) == (5, 1, "solved")
    assert split_manifest.config is not None
    assert read == [("000000000004-000000000005", {"level_id", *COLUMNS})]
    read.clear()
    with pytest.raises(UserError, match=r"^There is no level 8 in .*: it has 8 levels, from 0 to 7\.$"):
        find_level(split, 8)
    assert [columns for _, columns in read] == [{"level_id"}] * 4


@pytest.mark.parametrize("settings", [None, 3, {"no_setting": 1}])
@pytest.mark.parametrize(("group", "read"), [("task", rules_of), ("distribution", distribution_of)])
def test_rules_of_and_distribution_of_report_settings_of_another_version(
    tmp_path: Path, group: str, read: Callable[[Manifest], Any], settings: Any
) -> None:
    split_manifest = read_manifest(made_split(tmp_path, [[Label.SOLVED]]), [])
    (fragment,) = split_manifest.fragments
    config = {group: settings} if settings else {}
    with pytest.raises(Failure, match="does not accept the settings of"):
        read(replace(split_manifest, fragments=(replace(fragment, config=config),)))


def test_another_samplers_levels_come_from_shards_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    split = made_split(tmp_path, [[Label.SOLVED, Label.UNSOLVED]])
    monkeypatch.setattr(schema, "SAMPLER_VERSION", schema.SAMPLER_VERSION + 1)
    split_manifest = read_manifest(split)
    assert len(levels_of(split_manifest, split_manifest.table.slice(0, 1))) == 1
    with pytest.raises(Failure, match="has levels from sampler version 2, but this levelproof has version 3: use"):
        levels_of(split_manifest, split_manifest.table)
    for code, command in (1, ["verify", str(split)]), (2, ["regenerate", f"manifest={split}", "budget=32k"]):
        assert_refused(here(command, tmp_path), code, "has levels from sampler version 2")

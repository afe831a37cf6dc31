"""What the folders of the commands that train a policy hold, and what their guides list."""

import json
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from levelproof.configs.compose import override_of
from levelproof.configs.convert import plain
from levelproof.configs.meanings import comments_in
from tests.pipeline.command import ROOT


def metrics(out: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def assert_guide_lists(settings: Mapping[str, Any], *pages: str) -> None:
    """Check that these pages list every setting with its default and meaning; `settings` by prefix."""
    guide = "".join((ROOT / f"docs/{page}.md").read_text() for page in pages)
    for path, group in settings.items():
        for name, comment in comments_in(type(group)).items():
            value = getattr(group, name)
            if not is_dataclass(value):
                assert f"| `{override_of(path + name, plain(value))}` | {comment.beside} |" in guide

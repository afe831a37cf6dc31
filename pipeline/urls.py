"""Paths that stand for URLs: `Path("s3://bucket/split")` is such a one, whatever becomes of its slashes."""

import re
from pathlib import Path

from levelproof.pipeline.errors import UserError

BUCKETS, WEB, HUB = ("s3:", "gs:", "az:"), ("https:", "http:"), ("hf:",)
SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")


def require_known(path: Path) -> None:
    """Raises UserError for a URL of a kind that nothing here reads or writes, lest it be taken for a folder."""
    first = path.parts[0] if path.parts else ""
    if SCHEME.match(first) and first not in (*BUCKETS, *WEB, *HUB):
        known = ", ".join(f"{scheme}//" for scheme in (*BUCKETS, *WEB, *HUB))
        raise UserError(f"{path} looks like a URL, and not like one that can be used: give a folder, or {known}.")


def require_here(path: Path) -> None:
    """Raises UserError for what is no file or folder on this machine."""
    require_known(path)
    if path.parts and path.parts[0] in (*BUCKETS, *WEB, *HUB):
        raise UserError(
            f"Nothing can be written to {path.parts[0]}//{'/'.join(path.parts[1:])} here: "
            "give a file or folder on this machine."
        )

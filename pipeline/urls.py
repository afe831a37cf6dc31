"""Paths that represent URLs, such as `Path("s3://bucket/split")`, although `Path` collapses their slashes."""

import re
import shlex
from pathlib import Path

from levelproof.pipeline.errors import UserError

BUCKETS, WEB, HUB = ("s3:", "gs:", "az:"), ("https:", "http:"), ("hf:",)
BUILTIN = "builtin:"  # as in experts.networks.saved, which this file must not import: it starts JAX
SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")


def is_remote(path: Path) -> bool:
    return bool(path.parts) and path.parts[0] in (*BUCKETS, *WEB, *HUB)


def as_typed(path: Path) -> str:
    """Return a path or URL as the user typed it."""
    return "//".join([path.parts[0], "/".join(path.parts[1:])]) if is_remote(path) else str(path)


def quoted(path: Path) -> str:
    """Return a path or URL as an argument of a command that users can paste into a shell."""
    return shlex.quote(as_typed(path))


def require_known(path: Path) -> None:
    """Raise UserError for a URL of an unsupported scheme, which would otherwise be taken for a folder."""
    first = path.parts[0] if path.parts else ""
    if SCHEME.match(first) and first not in (*BUCKETS, *WEB, *HUB) and not Path(first).exists():
        known = ", ".join(f"{scheme}//" for scheme in (*BUCKETS, *WEB, *HUB))
        raise UserError(
            f"{path} looks like a URL of an unknown scheme: give a folder (by its absolute path if its name has a "
            f"colon), or a URL of {known}."
        )


def require_here(path: Path) -> None:
    """Raise UserError for a URL, because the caller writes to this machine only."""
    require_known(path)
    if is_remote(path):
        raise UserError(f"This command cannot write to {as_typed(path)}: give a file or folder on this machine.")


def require_policy(path: Path) -> None:
    """Raise UserError as `require_known` does, but accept names of built-in policies, such as builtin:s."""
    if not str(path).startswith(BUILTIN):
        require_known(path)

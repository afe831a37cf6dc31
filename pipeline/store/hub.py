"""Datasets on Hugging Face's hub, `hf://datasets/USER/NAME[@REVISION]/PATH`, through its two endpoints for files."""

import json
import os
import random
import re
import time
from collections.abc import Sequence
from http.client import HTTPException
from pathlib import Path
from typing import Any, NamedTuple
from urllib.error import HTTPError
from urllib.parse import quote, unquote
from urllib.request import Request, urlopen

from levelproof.pipeline.errors import StoreFailure, UserError

ATTEMPTS = 6
PAUSE = 0.5  # s before the second attempt, at most; doubles with each further one
TIMEOUT = 30  # s of one attempt
MAX_LIST = 2**25  # bytes of a page of a list; the hub's have a thousand files
NEXT = re.compile(r'<([^<>]+)>; *rel="next"')  # in the header Link: the next page of a list


class Repository(NamedTuple):
    """A dataset at a revision: a branch, a tag, a commit, or a ref such as refs/pr/1."""

    name: str
    revision: str


def split_url(parts: Sequence[str]) -> tuple[Repository, str]:
    """Split the parts of a URL after `hf://` into a repository and a path in it.

    Raises:
        UserError: the URL does not name a dataset.
    """
    if len(parts) < 3 or parts[0] != "datasets":
        raise UserError(
            f"hf://{'/'.join(parts)} is not the URL of a dataset: give one such as hf://datasets/USER/NAME/1M/s."
        )
    name, _, revision = parts[2].partition("@")
    revision = unquote(revision) or "main"  # a / in it, as in refs/pr/1, is typed %2F
    return Repository(f"{parts[1]}/{name}", revision), "/".join(parts[3:])


def resolve_url(repository: Repository) -> str:
    """Return the URL below which a repository's files lie."""
    return f"{_endpoint()}/datasets/{repository.name}/resolve/{quote(repository.revision, safe='')}"


def sign_in() -> dict[str, Any]:
    """Return options of an HTTP client with the token of HF_TOKEN, or of `hf auth login`."""
    home = Path(os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface")
    token = os.environ.get("HF_TOKEN") or ""
    if not token and (home / "token").is_file():
        token = (home / "token").read_text()
    return {"default_headers": {"authorization": f"Bearer {token.strip()}"}} if token.strip() else {}


def files_below(repository: Repository, folder: str, deep: bool = True) -> dict[str, tuple[str, int]]:
    """Return the hash and the size in bytes of every file below a folder (empty: all); none if it does not exist.

    Without `deep`, leave out the files of its folders.

    Raises:
        UserError: the repository does not exist, or may not be read.
        StoreFailure: the hub does not answer.
    """
    place = quote(repository.revision, safe="") + (f"/{quote(folder)}" if folder else "")
    url = f"{_endpoint()}/api/datasets/{repository.name}/tree/{place}?recursive={str(deep).lower()}"
    listed: dict[str, tuple[str, int]] = {}
    while url:
        files, url = _page(url)
        listed |= files
    return listed


def _page(url: str) -> tuple[dict[str, tuple[str, int]], str]:
    """Fetch one page of a list; return its files and the URL of the next page, or an empty one."""
    request, reason = Request(url), ""
    for name, value in sign_in().get("default_headers", {}).items():
        request.add_unredirected_header(name, value)  # redirects must not get the token
    for attempt in range(ATTEMPTS):
        try:
            with urlopen(request, timeout=TIMEOUT) as answer:
                more = NEXT.search(answer.headers.get("Link", ""))
                follows = more[1] if more and more[1].startswith(f"{_endpoint()}/") else ""
                return _files(answer.read(MAX_LIST)), follows
        except HTTPError as error:
            if error.code == 404:
                return {}, ""
            if error.code in (401, 403):
                raise UserError(
                    f"There is no dataset at {url}, or you may not read it: check the URL, and set HF_TOKEN if needed."
                ) from None
            if error.code not in (408, 429) and error.code < 500:
                raise StoreFailure(f"The hub rejects {url} ({error.code} {error.reason}): check the URL.") from None
            reason = str(error.code)
        except (OSError, HTTPException, ValueError, RecursionError) as error:
            reason = str(getattr(error, "reason", error))
        if attempt < ATTEMPTS - 1:
            time.sleep(random.uniform(0.5, 1) * PAUSE * 2**attempt)
    raise StoreFailure(f"The hub does not answer at {url} ({reason}): check the network, and try again.")


def _files(text: bytes) -> dict[str, tuple[str, int]]:
    """Parse one page of a list: hash and size in bytes of each file. Raises ValueError if it is invalid."""
    entries = json.loads(text)
    try:
        files = [entry for entry in entries if entry["type"] == "file"]
        listed = {entry["path"]: (entry["oid"], entry["size"]) for entry in files}
    except (TypeError, KeyError) as error:
        raise ValueError("its list of files is invalid") from error
    if not all((type(path), type(oid), type(size)) == (str, str, int) for path, (oid, size) in listed.items()):
        raise ValueError("its list of files is invalid")
    return listed


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")

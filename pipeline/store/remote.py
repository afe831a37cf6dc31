"""Splits in object stores and on web servers, read in pieces through a cache on this machine.

A split's Path may stand for a URL: `is_remote` says whether it does, and `place` returns its store and key.
"""

import os
import random
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from functools import lru_cache
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from urllib.parse import unquote

from levelproof.pipeline.errors import LevelproofError, StoreFailure, UserError
from levelproof.pipeline.runtime import cache_folder
from levelproof.pipeline.store import hub
from levelproof.pipeline.store.pieces import PieceCache
from levelproof.pipeline.urls import BUCKETS, HUB, WEB

if TYPE_CHECKING:
    from obstore.store import ObjectStore

INDEX = "index.txt"  # in the manifest's folder: names of the fragments, for servers that do not list
MAX_INDEX = 2**25  # bytes of it; a name takes 34
PIECE = 2**20  # bytes; with 4 MB, random reads of 10 kB trajectories would fetch four times as much
MAX_PIECES = 8  # adjacent pieces that one request fetches
REQUESTS = 16  # concurrent
MAX_WHOLE = 2**29  # bytes of a file that is read as a whole, such as a fragment
CACHE_GB = "LEVELPROOF_CACHE_GB"
RETRIES: dict[str, Any] = {
    "max_retries": 8,  # of a request that is throttled, refused, cut off or not answered; with jitter
    "retry_timeout": timedelta(seconds=60),
    "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=8), "base": 2},
}
PATIENCE = {"connect_timeout": timedelta(seconds=5), "timeout": timedelta(seconds=60), "allow_http": True}
SIGN_IN = {
    "s3:": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket",
    "gs:": "set GOOGLE_APPLICATION_CREDENTIALS, or GOOGLE_SKIP_SIGNATURE=true for a public bucket",
    "az:": "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
    "hf:": "set HF_TOKEN, or run `hf auth login`",
}
# Patterns in obstore's messages about failed requests:
STATUS = re.compile(r"status code: (\d{3}[A-Za-z ]*)")
PASSING = re.compile(r"status code: (408|409|429|50[02-4])")
NO_BUCKET = "NoSuchBucket"
CUT_OFF, SILENT = "response body error", "HTTP error"  # a response ends early; no response arrives
CLOUD = re.compile(r"latest/api/token|computeMetadata")  # endpoints where a cloud's machines get credentials
COPY = {"s3:": "aws s3 sync", "gs:": "gcloud storage rsync -r", "az:": "azcopy sync", "hf:": "hf download"}

T = TypeVar("T")


class Stored(NamedTuple):
    """A store's metadata of a file."""

    tag: str  # differs if the bytes differ
    size: int  # bytes


class FileChanged(OSError):
    """A file differs from the version that was listed."""


def is_remote(path: Path) -> bool:
    return bool(path.parts) and path.parts[0] in (*BUCKETS, *WEB, *HUB)


def is_listed(split: Path) -> bool:
    """Whether all files of a split can be listed."""
    return not (split.parts and split.parts[0] in WEB)


def as_typed(path: Path) -> str:
    """Return a path or URL as the user typed it."""
    return "//".join([path.parts[0], "/".join(path.parts[1:])]) if is_remote(path) else str(path)


def absolute(path: Path) -> Path:
    """Return a path that is valid in any working directory; URLs are unchanged."""
    return path if is_remote(path) else path.expanduser().absolute()


def require_folder(split: Path, what: str) -> None:
    """Refuse a remote split; `what` names the action that needs a folder.

    Raises:
        UserError: the split is not on this machine.
    """
    if is_remote(split):
        how = COPY.get(split.parts[0], "wget -r")
        raise UserError(f"To {what}, {as_typed(split)} must be a folder on this machine: copy it with `{how}` first.")


def mended(path: Path, here: str) -> str:
    """Say what to do about a damaged file: `here` for local files."""
    return "open the split again, and if that does not help upload it again." if is_remote(path) else here


def at_once(path: Path, work: Callable[..., T], *items: Iterable[Any]) -> list[T]:
    """Map `work` over items; if the path is remote, in threads, so that requests overlap."""
    if not is_remote(path):
        return list(map(work, *items))
    with ThreadPoolExecutor(REQUESTS) as threads:
        return list(threads.map(work, *items))


def stored_in(folder: Path) -> dict[Path, Stored]:
    """List all files below a folder of a split, as the store has them now.

    Raises:
        UserError: there is no such bucket, or it may not be read.
        StoreFailure: the store does not answer.
    """
    store, key = place(folder)
    if folder.parts[0] in HUB:
        repository, key = hub.split_url(folder.parts[1:])
        files = {name: Stored(*about) for name, about in hub.files_below(repository, key).items()}
    else:
        listed = ask(folder, lambda: obstore_module().list(store, prefix=key).collect())
        files = {entry["path"]: Stored(_tag(entry), entry["size"]) for entry in listed}
    prefix = f"{key}/" if key else ""
    return {
        folder / name[len(prefix) :]: about
        for name, about in files.items()
        if name.startswith(prefix) and ".." not in name.split("/")
    }


def names_in(folder: Path) -> list[Path]:
    """List the files and folders in a folder, as the store has them now. Raises as `stored_in`."""
    store, key = place(folder)
    listing = ask(folder, lambda: obstore_module().list_with_delimiter(store, prefix=key))
    return [
        folder / name[len(key) + 1 :]
        for name in [*listing["common_prefixes"], *(file["path"] for file in listing["objects"])]
    ]


def fragments_in(folder: Path) -> dict[Path, Stored]:
    """List the manifest's folder, and drop cached metadata of the split's other files.

    Raises:
        UserError, StoreFailure: as `stored_in`; or a web server has no index.
    """
    for known in list(_known):
        if folder.parent in known.parents:
            _known.pop(known, None)
    if folder.parts[0] not in WEB:
        listing = _known[folder] = stored_in(folder)
        return listing
    store, key = place(folder / INDEX)
    try:
        text = ask(folder / INDEX, lambda: data_of(obstore_module().get(store, key), MAX_INDEX))
    except FileNotFoundError:
        raise UserError(
            f"There is no split at {as_typed(folder.parent)}, or it has no index: a split on a web "
            f"server needs {folder.name}/{INDEX}, which `levelproof seal` writes."
        ) from None
    return {folder / name: Stored("", 0) for name in text.decode(errors="replace").split() if "/" not in name}


def bytes_of(path: Path, most: int = MAX_WHOLE) -> bytes:
    """Read a whole file of at most `most` bytes.

    Raises:
        OSError: it does not exist, or is larger.
        UserError, StoreFailure: as `stored_in`.
    """
    file = RemoteFile(path)
    if file.size > most:
        raise OSError(f"{as_typed(path)} is larger than {most} bytes")
    return b"".join(file.read([(0, file.size)]))


class RemoteFile:
    """One remote file, open for reading."""

    def __init__(self, path: Path) -> None:
        """Look up the file's metadata, if it is not known yet.

        Raises:
            FileNotFoundError: there is no such file.
            UserError, StoreFailure: as `stored_in`.
        """
        self.path, self._about = path, _look_up(path)
        self.size = self._about.size
        names = f"{as_typed(path)}\n{self._about.tag}\n{self.size}\n{PIECE}"
        self._name, self._cache = sha256(names.encode()).hexdigest()[:32], _cache()

    def read(self, spans: Sequence[tuple[int, int]]) -> Iterator[bytes]:
        """Fetch missing pieces, then yield the bytes of each span (first byte, number of bytes).

        Raises:
            OSError: the file has changed.
            UserError, StoreFailure: as `stored_in`; or the cache folder cannot be written.
        """
        wanted = {n for first, length in spans for n in range(first // PIECE, -(-(first + length) // PIECE))}
        missing = [n for n in sorted(wanted) if not self._cache.has(self._piece(n))]
        if missing:
            at_once(self.path, self._keep, _runs(missing))
        for first, length in spans:
            pieces = range(first // PIECE, -(-(first + length) // PIECE))
            yield b"".join(self._part(n, max(first - n * PIECE, 0), first + length - n * PIECE) for n in pieces)

    def close(self) -> None:
        """Do nothing: a remote file holds no resource."""

    def _piece(self, n: int) -> str:
        return f"{self._name}-{n}"

    def _part(self, n: int, first: int, last: int) -> bytes:
        """Return bytes of a piece, fetched again if the cache has dropped it."""
        part = self._cache.read(self._piece(n), first, min(last, PIECE))
        return self._fetch([n])[first:last] if part is None else part

    def _keep(self, run: Sequence[int]) -> None:
        self._fetch(run)

    def _fetch(self, run: Sequence[int]) -> bytes:
        """Fetch adjacent pieces in one request, and cache them."""
        store, key = place(self.path)
        first, last = run[0] * PIECE, min((run[-1] + 1) * PIECE, self.size)
        whole = (first, last) == (0, self.size)  # also served without support for ranges
        options = {} if whole else {"range": (first, last)}

        def request() -> tuple[Any, bytes]:
            answer = obstore_module().get(store, key, options=options)
            return answer.meta, data_of(answer, last - first)

        about, data = ask(self.path, request)
        tag = self._about.tag if self.path.parts[0] in HUB else _tag(about)  # the hub's file servers use other tags
        if (tag, about["size"], len(data)) != (*self._about, last - first):
            _known.pop(_folder_of(self.path), None)
            raise FileChanged(f"{as_typed(self.path)} has changed")
        for i, n in enumerate(run):
            self._cache.put(self._piece(n), data[i * PIECE : (i + 1) * PIECE])
        return data


_known: dict[Path, dict[Path, Stored]] = {}  # by folder: metadata of looked-up or listed files


def _folder_of(path: Path) -> Path:
    """Return the folder to list for a file's metadata: its shard, or its parent."""
    return next((folder for folder in path.parents if folder.suffix == ".zarr"), path.parent)


def _look_up(path: Path) -> Stored:
    folder = _folder_of(path)
    files = _known.get(folder)
    if files is None:
        files = _known[folder] = {} if path.parts[0] in WEB else stored_in(folder)
    if path not in files and path.parts[0] in WEB:
        store, key = place(path)
        about = ask(path, lambda: obstore_module().head(store, key))
        files[path] = Stored(_tag(about), about["size"])
    if path not in files:
        raise FileNotFoundError(as_typed(path))
    return files[path]


def _tag(about: Any) -> str:
    """Return a file's entity tag without its decoration, which differs by store; if it has no tag, its time."""
    return (about["e_tag"] or about["last_modified"].isoformat()).removeprefix("W/").strip('"')


def _runs(numbers: Iterable[int]) -> list[list[int]]:
    """Group ascending piece numbers into runs of at most MAX_PIECES adjacent ones."""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and runs[-1][-1] == n - 1 and len(runs[-1]) < MAX_PIECES:
            runs[-1].append(n)
        else:
            runs.append([n])
    return runs


def place(path: Path) -> tuple["ObjectStore", str]:
    """Return the store that a path is in, and its key there."""
    _require_own_process()
    if path.parts[0] in HUB:
        repository, key = hub.split_url(path.parts[1:])
        return _store("hf:", repository), key
    if len(path.parts) < 2:
        raise UserError(f"The URL {as_typed(path)} names no split: give one such as s3://bucket/data/128k/s.")
    key = "/".join(path.parts[2:])  # obstore quotes it in requests, and would quote a URL's %20 twice
    return _store(path.parts[0], path.parts[1]), unquote(key) if path.parts[0] in WEB else key


@lru_cache(maxsize=64)
def _store(scheme: str, root: Any) -> "ObjectStore":
    url, options = f"{scheme}//{root}", PATIENCE
    if scheme in HUB:
        url, options = hub.resolve_url(root), PATIENCE | hub.sign_in()
    make = obstore_module().store.from_url if scheme in BUCKETS else obstore_module().store.HTTPStore
    return make(url, client_options=options, retry_config=RETRIES)


def obstore_module() -> Any:
    try:
        import obstore.exceptions
        import obstore.store
    except ImportError:
        raise UserError(
            'Reading splits that are not on this machine needs obstore: run `pip install -e ".[remote]"` in the clone.'
        ) from None
    return obstore


@lru_cache(maxsize=1)
def _first_process() -> int:
    """Return the PID of the first process to use stores; forked processes lack its threads."""
    return os.getpid()


def _require_own_process() -> None:
    if _first_process() != os.getpid():
        raise UserError(
            "A forked process cannot read splits that are not on this machine: start it with "
            "multiprocessing_context='forkserver'."
        )


def _cache() -> PieceCache:
    most = os.environ.get(CACHE_GB, "10")
    if not re.fullmatch(r"\d+(\.\d+)?", most):
        raise UserError(f"{CACHE_GB} is {most!r}: give the size of the cache for remote splits in gigabytes.")
    return _cache_in(cache_folder() / "remote", int(float(most) * 1e9))


@lru_cache(maxsize=8)
def _cache_in(folder: Path, most: int) -> PieceCache:
    return PieceCache(folder, most)


def data_of(answer: Any, most: float) -> bytes:
    """Read the bytes of a response; stop soon after `most`, so that the caller sees that it is too long."""
    data = bytearray()
    for part in answer.stream(min_chunk_size=PIECE):
        data += part
        if len(data) > most:
            break
    return bytes(data)


def ask(path: Path, request: Callable[[], T], what: str = "read") -> T:
    """Make a request, and retry it if the response is cut off or missing, in cases that obstore does not retry.

    obstore seldom retries cut-off responses, and never requests that it does not know to be idempotent.

    Raises:
        FileNotFoundError: the store has no such file.
        UserError: it has no such bucket, or does not allow us to `what`.
        StoreFailure: it does not answer.
    """
    exceptions, end = obstore_module().exceptions, time.monotonic() + RETRIES["retry_timeout"].total_seconds()
    for attempt in count():
        try:
            return request()
        except FileNotFoundError as error:
            if NO_BUCKET in str(error):
                raise _explained(path, str(error), what) from None
            raise FileNotFoundError(as_typed(path)) from None
        except exceptions.BaseError as error:
            text = str(error)
            passing = CUT_OFF in text or SILENT in text or PASSING.search(text)
            if not passing or CLOUD.search(text) or time.monotonic() > end:
                raise _explained(path, text, what) from None
            time.sleep(random.uniform(0, min(0.1 * 2**attempt, 5)))
    raise AssertionError("unreachable")


def _explained(path: Path, text: str, what: str) -> LevelproofError:
    """Turn obstore's message about a failed request into a sentence."""
    url, how = as_typed(path), SIGN_IN.get(path.parts[0], "copy the split to a folder first")
    if NO_BUCKET in text:
        return UserError(f"There is no bucket {path.parts[1]!r}: check {url}.")
    if CLOUD.search(text):
        return UserError(f"There are no credentials to {what} {url}: {how}.")
    if "Range request not supported" in text:
        return StoreFailure(f"The server of {url} does not support range requests: copy the split to a folder first.")
    status = STATUS.search(text)
    reason = status[1].strip() if status else "it does not answer" if SILENT in text else text.splitlines()[0]
    if reason.startswith(("401", "403")):
        return UserError(f"The store does not let you {what} {url} ({reason}): {how}.")
    then = "run the same command again; what is committed stays" if what == "write" else "try again"
    return StoreFailure(f"Cannot {what} {url} ({reason}): check the network and the URL, and {then}.")

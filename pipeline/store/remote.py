"""Splits in object stores and on web servers, read in pieces through a cache on this machine.

A split's Path may stand for a URL: `is_remote` says whether it does, and `place` returns its store and key.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from urllib.parse import unquote

from levelproof.pipeline.errors import Failure, UserError
from levelproof.pipeline.runtime import cache_folder
from levelproof.pipeline.store import hub
from levelproof.pipeline.store.pieces import PieceCache
from levelproof.pipeline.store.requests import (
    MUCH,
    PATIENCE,
    RECEIVING,
    REQUESTS,
    RESENDING,
    RETRIES,
    SENDING,
    ask,
    data_of,
    obstore_module,
)
from levelproof.pipeline.urls import BUCKETS, HUB, WEB, as_typed, is_remote

if TYPE_CHECKING:
    from obstore.store import ObjectStore

INDEX = "index.txt"  # in the manifest's folder: names of the fragments, for servers that do not list
MAX_INDEX = 2**25  # bytes of it; a name takes 34
FRAGMENT_NAME = re.compile(r"[0-9]{12}-[0-9]{12}\.parquet")
PIECE = 2**20  # bytes; with 4 MB, random reads of 10 kB trajectories would fetch four times as much
MAX_PIECES = 8  # adjacent pieces that one request fetches
CONTROL = re.compile(r"[\x00-\x1f\x7f]")  # characters that no key may have
LISTED = "manifest", "experts"  # folders of a split whose files are looked up together
MAX_WHOLE = 2**29  # bytes of a file that is read as a whole, such as a fragment
CACHE_GB = "LEVELPROOF_CACHE_GB"
COPY = {"s3:": "aws s3 sync", "gs:": "gcloud storage rsync -r", "az:": "azcopy sync", "hf:": "hf download"}

T = TypeVar("T")


class Stored(NamedTuple):
    """A store's metadata of a file."""

    tag: str  # differs if the bytes differ
    size: int  # bytes


class FileChanged(OSError):
    """A file differs from the version that was listed."""


def is_listed(split: Path) -> bool:
    """Whether all files of a split can be listed."""
    return not (split.parts and split.parts[0] in WEB)


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
    failures: list[BaseException] = []

    def unless_failed(*item: Any) -> Any:
        if not failures:  # the executor would begin further items until its reader sees the first failure
            try:
                return work(*item)
            except BaseException as error:
                failures.append(error)
        return None

    with ThreadPoolExecutor(REQUESTS) as threads:
        results = list(threads.map(unless_failed, *items))
    if failures:
        raise failures[0]
    return results


def in_order(path: Path, work: Callable[[Any], T], items: Sequence[Any]) -> Iterator[T]:
    """Map `work` over items, one after another; if the path is remote, over REQUESTS at once, and no further ahead."""
    step = REQUESTS if is_remote(path) else 1
    for first in range(0, len(items), step):
        yield from at_once(path, work, items[first : first + step])


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


def stale_index(path: Path) -> str:
    """Say that a web server's index names a fragment that is not there."""
    return (
        f"The index {as_typed(path.parent / INDEX)} names {path.name}, which is not there: run `levelproof seal` on "
        "the split's folder, and upload it again."
    )


def fragments_in(folder: Path) -> dict[Path, Stored]:
    """List the manifest's folder, and drop cached metadata of the split's other files.

    Raises:
        UserError, StoreFailure: as `stored_in`; or a web server has no index.
        Failure: its index is damaged.
    """
    for known in list(_known):
        if folder.parent in known.parents:
            _known.pop(known, None)
    if folder.parts[0] not in WEB:
        listing = _known[folder] = stored_in(folder)
        return listing
    try:
        store, key = place(folder / INDEX)
        text = ask(folder / INDEX, lambda: data_of(obstore_module().get(store, key), MAX_INDEX))
    except FileNotFoundError:
        raise UserError(
            f"There is no split at {as_typed(folder.parent)}, or it has no index: a split on a web "
            f"server needs {folder.name}/{INDEX}, which `levelproof seal` writes."
        ) from None
    names = text.decode(errors="replace").split()
    if wrong := [name for name in names if not FRAGMENT_NAME.fullmatch(name)]:
        raise Failure(
            f"The index {as_typed(folder / INDEX)} is damaged, because {wrong[0][:80]!r} names no fragment: run "
            "`levelproof seal` on the split's folder, and upload it again."
        )
    return {folder / name: Stored("", 0) for name in names}


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
        self.path, self._about = path, stored_at(path)
        self.size = self._about.size
        names = f"{as_typed(path)}\n{self._about.tag}\n{self.size}\n{PIECE}"
        self._name, self._cache = sha256(names.encode()).hexdigest()[:32], _cache()

    def read(self, spans: Sequence[tuple[int, int]]) -> Iterator[bytes]:
        """Fetch missing pieces, then yield the bytes of each span (first byte, number of bytes). Raises as `fetch`."""
        self.fetch(spans)
        for first, length in spans:
            pieces = range(first // PIECE, -(-(first + length) // PIECE))
            yield b"".join(self._part(n, max(first - n * PIECE, 0), first + length - n * PIECE) for n in pieces)

    def fetch(self, spans: Sequence[tuple[int, int]]) -> None:
        """Fetch the pieces of these spans that the cache does not have.

        Raises:
            OSError: the file has changed.
            UserError, StoreFailure: as `stored_in`; or the cache folder cannot be written.
        """
        wanted = {n for first, length in spans for n in range(first // PIECE, -(-(first + length) // PIECE))}
        missing = [n for n in sorted(wanted) if not self._cache.has(self._piece(n))]
        if missing:
            at_once(self.path, self._keep, _runs(missing))

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

        about, data = ask(self.path, request, turns=RECEIVING)
        tag = self._about.tag if self.path.parts[0] in HUB else _tag(about)  # the hub's file servers use other tags
        if (tag, about["size"], len(data)) != (*self._about, last - first):
            forget(self.path)
            raise FileChanged(f"{as_typed(self.path)} has changed")
        for i, n in enumerate(run):
            self._cache.put(self._piece(n), data[i * PIECE : (i + 1) * PIECE])
        return data


_known: dict[Path, dict[Path, Stored]] = {}  # by folder: metadata of looked-up or listed files


def _folder_of(path: Path) -> Path | None:
    """Return the folder to list for a file's metadata: its shard, or a split's folder; None: it is in neither."""
    shard = next((folder for folder in path.parents if folder.suffix == ".zarr"), None)
    return shard or (path.parent if path.parent.name in LISTED else None)


def forget(path: Path) -> None:
    """Ask for a folder's or file's metadata anew when it is next needed."""
    _known.pop(_folder_of(path) or path, None)


def stored_at(path: Path) -> Stored:
    """Return a file's metadata: as listed with its shard or fragment, or as first asked for; see `forget`.

    Raises: as `RemoteFile`.
    """
    folder = _folder_of(path)
    key, listed = folder or path, folder is not None and is_listed(path)
    files = _known.get(key)
    if files is None:
        files = _known[key] = stored_in(key) if listed else {}
    if path not in files:
        if listed:
            raise FileNotFoundError(as_typed(path))
        files[path] = _asked(path)
    return files[path]


def _asked(path: Path) -> Stored:
    """Ask for a file's metadata without a list: there may be any number of files beside it, or no right to list."""
    store, key = place(path)
    if path.parts[0] in HUB:  # it answers requests for a file with a redirect, whose target has another tag
        repository, key = hub.split_url(path.parts[1:])
        listed = hub.files_below(repository, key.rpartition("/")[0], deep=False)
        if key not in listed:
            raise FileNotFoundError(as_typed(path))
        return Stored(*listed[key])
    try:
        about = ask(path, lambda: obstore_module().head(store, key))
    except FileNotFoundError:
        if path.parts[0] in BUCKETS:  # the answer has no text, which would tell whether there is such a bucket
            ask(path, lambda: obstore_module().get_range(store, key, start=0, length=1))
        raise
    return Stored(_tag(about), about["size"])


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


def place(path: Path, sent: int = 0) -> tuple["ObjectStore", str]:
    """Return the store that a path is in, for a request that sends this many bytes, and its key there."""
    _require_own_process()
    if path.parts[0] in HUB:
        repository, key = hub.split_url(path.parts[1:])
        return _store("hf:", repository), key
    if len(path.parts) < 2:
        raise UserError(f"The URL {as_typed(path)} names no split: give one such as s3://bucket/data/128k/s.")
    key = "/".join(path.parts[2:])
    if path.parts[0] in WEB:  # obstore quotes keys in requests, and would quote a URL's %20 twice
        key = unquote(key)
        if CONTROL.search(key) or {".", ".."} & {*key.split("/")}:
            raise FileNotFoundError(as_typed(path))
    return _store(path.parts[0], path.parts[1], sent > MUCH), key


@lru_cache(maxsize=64)
def _store(scheme: str, root: Any, sends_much: bool = False) -> "ObjectStore":
    url, options, retries = f"{scheme}//{root}", PATIENCE, RETRIES
    if sends_much:
        options, retries = options | {"read_timeout": SENDING}, retries | {"retry_timeout": RESENDING}
    if scheme in HUB:
        url, options = hub.resolve_url(root), options | hub.sign_in()
    make = obstore_module().store.from_url if scheme in BUCKETS else obstore_module().store.HTTPStore
    return make(url, client_options=options, retry_config=retries)


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

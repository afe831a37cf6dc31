"""Servers on loopback that splits are read from and written to, and their failures."""

import hashlib
import hmac
import json
import os
import re
import socket
import subprocess
import sys
import time
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from email.utils import formatdate
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from typing import NamedTuple
from urllib.parse import parse_qs, unquote, urlsplit

import pytest

from levelproof.pipeline.store import leases, remote, requests
from tests.pace import patience, wait_until

HOST = "127.0.0.1"
ANSWER_SECONDS = 60  # limit of a server's start and of its answers
# The public account of Microsoft's emulator: docs of Azurite, "default storage account"
AZURE_NAME, AZURE_VERSION = "devstoreaccount1", "2021-08-06"
AZURE_KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
PAGE = 10  # keys per page of S3's lists
SLOW = 1.0  # s
DRIPS = 10  # parts of an answer that comes slowly


KEPT = ("etag", "last-modified", "content-range", "content-length", "content-type")  # headers that stores' clients read


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes


Answers = Callable[[str, str, dict[str, str], bytes], Answer]  # gets a method, a path, the request's headers and body


class Crowd:
    """Counts the blocks that run at the same time."""

    def __init__(self) -> None:
        self.now, self.most, self._lock = 0, 0, Lock()

    def __enter__(self) -> None:
        with self._lock:
            self.now += 1
            self.most = max(self.most, self.now)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self.now -= 1


class Server:
    """HTTP server that answers requests by a function, logs them, and spoils every n-th answer on request."""

    def __init__(self, answers: Answers) -> None:
        self.log: list[str] = []  # "GET /path bytes=0-99"
        self.count, self.every, self.spoiled = 0, 0, "busy"
        self.crowd = Crowd()
        self.meanwhile: Callable[[int], object] = lambda _: None  # gets the number of each request
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def answer(self) -> None:
                with server.crowd:
                    given, how = self.answered()
                if given is None:
                    self.close_connection = True
                    return
                self.give(given, how)

            def answered(self) -> tuple[Answer | None, str]:
                """Return the answer (None: drop the connection), and how it is spoiled."""
                server.count += 1
                server.log.append(f"{self.command} {self.path} {self.headers.get('Range', '')}".strip())
                server.meanwhile(server.count)
                how = server.spoiled if server.every and server.count % server.every == 0 else ""
                headers = {name.lower(): x for name, x in self.headers.items()}
                length = int(headers.get("content-length", 0))
                body = self.rfile.read(length)
                if len(body) < length:  # the client died while sending it
                    return None, how
                if how == "busy":
                    return Answer(503, {}, b"<Error><Code>SlowDown</Code></Error>"), ""
                if how == "slow":
                    time.sleep(patience(SLOW))
                given = answers(self.command, self.path, headers, body) if how != "gone" else None
                return None if how == "lost" else given, how  # before or after executing the request

            def give(self, given: Answer, how: str) -> None:
                self.send_response(given.status)
                for name, value in {"Content-Length": str(len(given.body)), **given.headers}.items():
                    self.send_header(name, value)
                self.end_headers()
                if self.command == "HEAD":
                    return
                size = len(given.body) // (2 if how == "cut" else 1)
                step = -(-size // DRIPS) if how == "dripping" else size
                for first in range(0, size, step or 1):
                    self.wfile.write(given.body[first : min(first + step, size)])
                    if how == "dripping":
                        time.sleep(patience(SLOW) / DRIPS)
                if how == "cut":
                    self.close_connection = True

            do_GET = do_HEAD = do_PUT = do_DELETE = do_POST = answer  # noqa: N815

            def handle(self) -> None:
                with suppress(ConnectionError):  # the client has ended
                    super().handle()

            def log_message(self, *_: object) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
                """Keep the terminal quiet."""

        self._server = ThreadingHTTPServer((HOST, 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_port}"
        Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def spoil(self, every: int, how: str = "busy") -> None:
        """Spoil every n-th request.

        Args:
            every: n; 0: spoil none.
            how: "busy": answer 503; "cut": send half the answer; "slow": answer late; "dripping": answer slowly;
                "lost": execute the request, then drop the connection; "gone": drop the connection at once.
        """
        self.every, self.spoiled = every, how

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@contextmanager
def serving(answers: Answers) -> Iterator[Server]:
    server = Server(answers)
    try:
        yield server
    finally:
        server.close()


@contextmanager
def serving_bucket(
    patch: pytest.MonkeyPatch, folder: Path, seconds: float, answers: Answers | None = None
) -> Iterator[Server]:
    """Serve an empty bucket to this process, which has short time-outs and no cached metadata.

    Args:
        patch: changes this process's environment and settings.
        folder: folder for the bucket and the cache.
        seconds: limit for retries, s.
        answers: function that answers requests (default: that of `bucket_of`).
    """
    patch.setenv("LEVELPROOF_CACHE_DIR", str(folder / "cache"))
    patch.setitem(requests.RETRIES, "retry_timeout", timedelta(seconds=seconds))
    patch.setitem(requests.RETRIES, "backoff", {"init_backoff": timedelta(milliseconds=5)})
    (folder / "s3/bucket").mkdir(parents=True)
    with serving(answers or bucket_of(folder / "s3")) as server:
        for name in [name for name in os.environ if name.startswith("AWS_")]:
            patch.delenv(name)
        known = {"ACCESS_KEY_ID": "any", "SECRET_ACCESS_KEY": "any", "REGION": "us-east-1", "ENDPOINT_URL": server.url}
        for name, value in known.items():
            patch.setenv(f"AWS_{name}", value)
        forget()
        yield server
    forget()


def forget() -> None:
    """Drop what this process knows of stores, as if it had just started."""
    remote._known.clear()
    remote._store.cache_clear()
    remote._cache_in.cache_clear()
    leases._served.clear()


def files_of(folder: Path) -> Answers:
    """Serve the files below a folder, or ranges of their bytes, as a web server."""

    def answers(_: str, path: str, headers: dict[str, str], body: bytes = b"") -> Answer:
        file = folder / unquote(urlsplit(path).path.lstrip("/"))
        if not file.is_file():
            return Answer(404, {}, b"")
        data = file.read_bytes()
        about = {"ETag": f'"{tag_of(file)}"', "Last-Modified": formatdate(file.stat().st_mtime, usegmt=True)}
        about["x-goog-generation"] = str(file.stat().st_mtime_ns)
        if match := re.fullmatch(r"bytes=(\d+)-(\d+)", headers.get("range", "")):
            first, last = int(match[1]), min(int(match[2]), len(data) - 1)
            about["Content-Range"] = f"bytes {first}-{last}/{len(data)}"
            return Answer(206, about, data[first : last + 1])
        return Answer(200, about, data)

    return answers


def bucket_of(folder: Path) -> Answers:
    """Serve the part of S3 that levelproof uses: the folder's entries are buckets, and keys are listed in pages."""
    files, one_at_a_time = files_of(folder), Lock()

    def answers(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        with one_at_a_time:
            return answer(method, path, headers, body)

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        asked = urlsplit(path)
        query = {name: values[0] for name, values in parse_qs(asked.query, keep_blank_values=True).items()}
        bucket = folder / asked.path.strip("/").partition("/")[0]
        if not bucket.is_dir():
            return Answer(404, {}, b"<Error><Code>NoSuchBucket</Code></Error>")
        if method in ("PUT", "POST", "DELETE"):
            return _changed(method, folder / unquote(asked.path.lstrip("/")), headers, body, folder / ".new")
        if "list-type" not in query:
            return files(method, path, headers, body)
        below = sorted(file.relative_to(bucket).as_posix() for file in bucket.rglob("*") if file.is_file())
        below = [key for key in below if key.startswith(query.get("prefix", ""))]
        if query.get("delimiter"):
            at = len(query.get("prefix", ""))
            folders = sorted({key[: key.index("/", at) + 1] for key in below if "/" in key[at:]})
            inside = [key for key in below if "/" not in key[at:]]
            given = "".join(f"<CommonPrefixes><Prefix>{name}</Prefix></CommonPrefixes>" for name in folders)
            return Answer(200, {}, f"<ListBucketResult>{given}{_contents(bucket, inside)}</ListBucketResult>".encode())
        first = int(query.get("continuation-token", 0))
        listed = _contents(bucket, below[first : first + PAGE])
        if first + PAGE < len(below):
            listed += f"<NextContinuationToken>{first + PAGE}</NextContinuationToken>"
        return Answer(200, {}, f"<ListBucketResult>{listed}</ListBucketResult>".encode())

    return answers


def _contents(bucket: Path, keys: Iterable[str]) -> str:
    return "".join(
        f"<Contents><Key>{key}</Key><LastModified>2026-01-01T00:00:00.000Z</LastModified>"
        f"<ETag>&quot;{tag_of(bucket / key)}&quot;</ETag>"
        f"<Size>{(bucket / key).stat().st_size}</Size></Contents>"
        for key in keys
    )


def _changed(method: str, file: Path, headers: dict[str, str], body: bytes, new: Path) -> Answer:
    """Execute PUT with its preconditions, DELETE of one key, or POST of keys to delete."""
    if method == "POST":
        keys = [key.decode() for key in re.findall(rb"<Key>(.*?)</Key>", body)]
        for key in keys:
            (file / key).unlink(missing_ok=True)
        deleted = "".join(f"<Deleted><Key>{key}</Key></Deleted>" for key in keys)
        return Answer(200, {}, f"<DeleteResult>{deleted}</DeleteResult>".encode())
    if method == "DELETE":
        if not file.exists() and "x-amz-content-sha256" not in headers:
            return Answer(404, {}, b"<Error><Code>NoSuchKey</Code></Error>")  # as Google's; Amazon's answers 204
        file.unlink(missing_ok=True)
        return Answer(204, {}, b"")
    wanted, generation = headers.get("if-match", "").strip('"'), headers.get("x-goog-if-generation-match")  # Google's
    if wanted and not file.exists():
        return Answer(404, {}, b"<Error><Code>NoSuchKey</Code></Error>")
    other = generation is not None and generation != str(file.stat().st_mtime_ns if file.exists() else 0)
    if other or (wanted and wanted != tag_of(file)) or ("if-none-match" in headers and file.exists()):
        return Answer(412, {}, b"<Error><Code>PreconditionFailed</Code></Error>")
    file.parent.mkdir(parents=True, exist_ok=True)
    new.write_bytes(body)
    new.replace(file)
    return Answer(200, {"ETag": f'"{tag_of(file)}"', "x-goog-generation": str(file.stat().st_mtime_ns)}, b"")


def tag_of(file: Path) -> str:
    """Return a file's entity tag: as in S3 it follows from the content, so a late copy of a request changes nothing."""
    return hashlib.md5(file.read_bytes()).hexdigest()


def hub_of(folder: Path, dataset: str, token: str, page: int, revision: str = "main") -> Answers:
    """Serve the hub's two endpoints for a dataset's files: lists in pages, and redirects to the files.

    `revision` is what requests have in their URLs, so that a / in it is %2F.
    """
    resolved, listed = f"/datasets/{dataset}/resolve/{revision}/", f"/api/datasets/{dataset}/tree/{revision}"
    files = files_of(folder)

    def answers(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if path.startswith("/elsewhere/"):
            return files(method, path.removeprefix("/elsewhere"), headers, body)
        if headers.get("authorization") != f"Bearer {token}":
            return Answer(401, {}, b"{}")
        if path.startswith(resolved):
            return Answer(302, {"Location": f"/elsewhere/{path.removeprefix(resolved)}"}, b"")
        if not path.startswith(listed):
            return Answer(404, {}, b"{}")
        asked = urlsplit(path)
        place = folder / asked.path.removeprefix(listed).lstrip("/")
        deep = "recursive=true" in asked.query
        below = [file for file in sorted(place.rglob("*") if deep else place.glob("*")) if file.is_file()]
        first = int((re.findall(r"cursor=(\d+)", asked.query) or ["0"])[0])
        entries = [
            {
                "type": "file",
                "path": file.relative_to(folder).as_posix(),
                "size": file.stat().st_size,
                "oid": tag_of(file),
            }
            for file in below[first : first + page]
        ]
        more = f'<http://{headers["host"]}{asked.path}?recursive={str(deep).lower()}&cursor={first + page}>; rel="next"'
        return Answer(200, {"Link": more} if first + page < len(below) else {}, json.dumps(entries).encode())

    return answers


def before(host: str, port: int) -> Answers:
    """Forward requests to another server."""

    def answers(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        connection = HTTPConnection(host, port, timeout=patience(ANSWER_SECONDS))
        try:
            connection.request(method, path, body, headers)
            given = connection.getresponse()
            kept = {name: x for name, x in given.getheaders() if name.lower() in KEPT}
            return Answer(given.status, kept, given.read())
        finally:
            connection.close()

    return answers


@contextmanager
def s3_process() -> Iterator[tuple[str, int]]:
    """Start moto's S3 server with a bucket named `bucket`; yield its host and port."""
    port = _free_port()
    words = [sys.executable, "-m", "moto.server", "-H", HOST, "-p", str(port)]
    with _listening(words, port, AWS_ACCESS_KEY_ID="moto", AWS_SECRET_ACCESS_KEY="moto"):
        keys = {"aws_access_key_id": "any", "aws_secret_access_key": "any", "region_name": "us-east-1"}
        pytest.importorskip("boto3").client("s3", endpoint_url=f"http://{HOST}:{port}", **keys).create_bucket(
            Bucket="bucket"
        )
        yield HOST, port


@contextmanager
def azure_process(azurite: str, folder: Path) -> Iterator[tuple[str, int]]:
    """Start Microsoft's emulator of Azure's blobs with a container named `bucket`; yield its host and port."""
    port = _free_port()
    words = [azurite, "--location", str(folder), "--blobHost", HOST, "--blobPort", str(port), "--disableTelemetry"]
    with _listening(words, port):
        date = formatdate(usegmt=True)
        path, about = f"/{AZURE_NAME}/bucket", f"x-ms-date:{date}\nx-ms-version:{AZURE_VERSION}\n"
        signed = "PUT" + "\n" * 12 + f"{about}/{AZURE_NAME}{path}\nrestype:container"
        signature = b64encode(hmac.digest(b64decode(AZURE_KEY), signed.encode(), "sha256")).decode()
        connection = HTTPConnection(HOST, port, timeout=patience(ANSWER_SECONDS))
        headers = {"x-ms-date": date, "x-ms-version": AZURE_VERSION, "Content-Length": "0"}
        headers |= {"Authorization": f"SharedKey {AZURE_NAME}:{signature}"}
        connection.request("PUT", f"{path}?restype=container", headers=headers)
        assert connection.getresponse().status == 201
        yield HOST, port


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


def _accepts(port: int) -> bool:
    try:
        socket.create_connection((HOST, port)).close()
    except OSError:
        return False
    return True


@contextmanager
def _listening(words: Sequence[str], port: int, **environment: str) -> Iterator[None]:
    """Run a process in the `with` block, which begins once the process listens on `port`."""
    process = subprocess.Popen(
        words, env=os.environ | environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: process.poll() is not None or _accepts(port), ANSWER_SECONDS, words)
        yield
    finally:
        process.terminate()
        process.wait()

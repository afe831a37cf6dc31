"""Server of the page: its files and one websocket, for this machine only.

A page sends requests and receives answers (`Session.answer`); while an expert trains, it also receives its progress
under `training`.
"""

import json
import mimetypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from threading import Event, Lock, Thread

import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from levelproof.experts.procedure import Procedure
from levelproof.levelgen.files.level_file import LevelFile
from levelproof.levelgen.pictures.palette import palette_css
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.gallery.contender import Contender
from levelproof.pipeline.look.gallery.gallery import SITE
from levelproof.pipeline.play.session import Message, Session
from levelproof.pipeline.play.training import train_level

HOST = "127.0.0.1"
PAGE = Path(__file__).parent / "page"
SHARED = ("draw.js", "curve.js", "focus.js", "style.css")  # files shared with the gallery's pages
PALETTE = "palette.css"
MAX_BYTES = 8_000_000  # of a request, which may contain a level file
SOCKET = "/socket"
HTTP_PORT = 80


@contextmanager
def serving(
    file: LevelFile,
    actions: np.ndarray | None,
    procedure: Procedure,
    budget: int,
    port: int,
    contender: Contender | None = None,
) -> Iterator[Server]:
    """Serve pages that each start with this level, in the `with` block.

    Args:
        file: the level and its rules.
        actions: the level's witness, [step, 6], or None.
        procedure: how levels are labelled.
        budget: env steps an expert may use.
        port: number; 0: any free port.
        contender: policy that plays on request, or None.

    Raises:
        UserError: the port is taken or invalid.
    """

    def handler(connection: ServerConnection) -> None:
        PageConnection(connection, Session(file, actions, contender), procedure, budget).run()

    try:
        server = serve(handler, HOST, port, process_request=_file, max_size=MAX_BYTES, compression=None)
    except (OSError, OverflowError) as error:  # OverflowError: the number is not a port
        reason = getattr(error, "strerror", None) or str(error).rstrip(".")
        raise UserError(f"Cannot listen on port {port} ({reason}): choose another with --port.") from None
    with server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield server


class PageConnection:
    """Connection to one open page."""

    def __init__(self, connection: ServerConnection, session: Session, procedure: Procedure, budget: int) -> None:
        self._connection, self._session = connection, session
        self._procedure, self._budget = procedure, budget
        self._stop, self._training = Event(), Thread()
        self._lock = Lock()  # of the session: an edit must not come between a check of its level and the witness

    def run(self) -> None:
        """Answer requests until the page closes."""
        try:
            for text in self._connection:
                try:
                    request = json.loads(text)
                except ValueError:  # not of our page
                    return
                request = request if isinstance(request, dict) else {}
                self._send(self._answer(request) | {"id": request.get("id")})
        except ConnectionClosed:
            pass
        finally:
            self._stop.set()

    def _answer(self, request: Message) -> Message:
        match request.get("ask"):
            case "train":
                return self._train()
            case "stop":
                self._stop.set()
                return {}
        with self._lock:
            return self._session.answer(request)

    def _train(self) -> Message:
        """Start training an expert for the current level; edits made during training do not affect it."""
        if self._training.is_alive():
            return {"error": "An expert is already training: stop it first."}
        self._stop = Event()
        self._training = Thread(target=self._report, args=(self._session.file, self._stop), daemon=True)
        self._training.start()
        return {}

    def _report(self, file: LevelFile, stop: Event) -> None:
        try:
            for message in train_level(file, self._procedure, self._budget, stop):
                if (witness := message.pop("witness", None)) is not None:
                    message |= self._solved(file, witness)
                self._send({"training": message})
        except ConnectionClosed:
            pass
        except Exception as error:  # only the page can show it: no caller waits for this thread
            with suppress(ConnectionClosed):
                self._send({"training": {"stage": "failed", "reason": f"{type(error).__name__}: {error}"}})

    def _solved(self, file: LevelFile, witness: np.ndarray) -> Message:
        """Keep a witness of the level as it was when training began; return its film, or nothing after an edit."""
        with self._lock:
            if file is not self._session.file:
                return {}
            self._session.solve(witness)
            return {"film": self._session.film(witness)}

    def _send(self, message: Message) -> None:
        self._connection.send(json.dumps(message))


def _file(connection: ServerConnection, request: Request) -> Response | None:
    """Answer a request for a file; None continues with the websocket. Refuses other hosts and origins."""
    port = connection.socket.getsockname()[1]
    ports = [f":{port}", *[""] * (port == HTTP_PORT)]  # browsers omit the default one
    hosts = {f"{name}{number}" for name in (HOST, "localhost") for number in ports}
    if request.headers.get("Host") not in hosts:
        return connection.respond(HTTPStatus.FORBIDDEN, "This server serves only this machine.\n")
    if request.path == SOCKET:
        if request.headers.get("Origin") not in {f"http://{host}" for host in hosts}:
            return connection.respond(HTTPStatus.FORBIDDEN, "This server serves only its own page.\n")
        return None
    name = request.path.partition("?")[0].lstrip("/") or "index.html"
    path = (SITE if name in SHARED else PAGE) / name
    if "/" in name or not (path.is_file() or name == PALETTE):
        return connection.respond(HTTPStatus.NOT_FOUND, "No such file.\n")
    body = palette_css().encode() if name == PALETTE else path.read_bytes()
    kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
    headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body)), "Cache-Control": "no-store"}
    return Response(HTTPStatus.OK, "OK", Headers(headers), body)

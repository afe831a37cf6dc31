"""The server behind the page: files and one websocket, on this machine alone.

A page asks and is answered (`Session.ask`); while an expert trains it is told as well, under `training`.
"""

import json
import mimetypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from levelproof.experts.procedure import Procedure
from levelproof.levelgen.files.level_file import LevelFile
from levelproof.levelgen.pictures.palette import palette_css
from levelproof.pipeline.errors import UserError
from levelproof.pipeline.look.gallery.gallery import SITE
from levelproof.pipeline.play.session import Session
from levelproof.pipeline.play.training import Message, trained

HOST = "127.0.0.1"
PAGE = Path(__file__).parent / "page"
SHARED = ("draw.js", "curve.js", "style.css")  # files of the gallery's pages that this one uses, too
PALETTE = "palette.css"
MAX_BYTES = 8_000_000  # of a question: a level file
SOCKET = "/socket"


@contextmanager
def serving(
    file: LevelFile, actions: np.ndarray | None, procedure: Procedure, budget: int, port: int
) -> Iterator[Server]:
    """A server for pages that each begin with this level; it listens until the context ends.

    Args:
        file: the level and its rules.
        actions: a witness that came with it, [step, 6], or None.
        procedure: how levels are labelled.
        budget: env steps of an expert.
        port: 0: any that is free.

    Raises:
        UserError: the port is taken, or there is none of this number.
    """

    def handler(connection: ServerConnection) -> None:
        Visit(connection, Session(file, actions), procedure, budget).run()

    try:
        server = serve(handler, HOST, port, process_request=_file, max_size=MAX_BYTES, compression=None)
    except (OSError, OverflowError) as error:  # the latter: no port has this number
        reason = getattr(error, "strerror", None) or str(error).rstrip(".")
        raise UserError(f"Cannot listen on port {port} ({reason}): choose another one with --port.") from None
    with server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield server


class Visit:
    """One page that is open."""

    def __init__(self, connection: ServerConnection, session: Session, procedure: Procedure, budget: int) -> None:
        self._connection, self._session = connection, session
        self._procedure, self._budget = procedure, budget
        self._stop, self._training = Event(), Thread()

    def run(self) -> None:
        """Answer until the page is closed."""
        try:
            for text in self._connection:
                asked = json.loads(text)
                asked = asked if isinstance(asked, dict) else {}
                self._send(self._answer(asked) | {"id": asked.get("id")})
        except (ConnectionClosed, ValueError):
            pass
        finally:
            self._stop.set()

    def _answer(self, asked: dict[str, Any]) -> Message:
        match asked.get("ask"):
            case "train":
                return self._train()
            case "stop":
                self._stop.set()
                return {}
        return self._session.ask(asked)

    def _train(self) -> Message:
        """Train an expert for the level as it is now; what the page edits meanwhile is another level."""
        if self._training.is_alive():
            return {"error": "An expert is in training: stop it first."}
        self._stop = Event()
        self._training = Thread(target=self._tell, args=(self._session.file, self._stop), daemon=True)
        self._training.start()
        return {}

    def _tell(self, file: LevelFile, stop: Event) -> None:
        try:
            for message in trained(file, self._procedure, self._budget, stop):
                if (witness := message.pop("witness", None)) is not None and file is self._session.file:
                    self._session.solve(witness)
                    message["film"] = self._session.film(witness)
                self._send({"training": message})
        except ConnectionClosed:
            pass
        except Exception as error:  # a page has to hear of it; there is nobody else to tell
            with suppress(ConnectionClosed):
                self._send({"training": {"stage": "failed", "reason": f"{type(error).__name__}: {error}"}})

    def _send(self, message: Message) -> None:
        self._connection.send(json.dumps(message))


def _file(connection: ServerConnection, request: Request) -> Response | None:
    """A file of the page; None: go on with the websocket. Pages of other hosts get nothing."""
    port = connection.socket.getsockname()[1]
    hosts = {f"{name}:{port}" for name in (HOST, "localhost")}
    if request.headers.get("Host") not in hosts:
        return connection.respond(HTTPStatus.FORBIDDEN, "This server is for this machine alone.\n")
    if request.path == SOCKET:
        if request.headers.get("Origin") not in {f"http://{host}" for host in hosts}:
            return connection.respond(HTTPStatus.FORBIDDEN, "This server is for its own page alone.\n")
        return None
    name = request.path.partition("?")[0].lstrip("/") or "index.html"
    path = (SITE if name in SHARED else PAGE) / name
    if "/" in name or not (path.is_file() or name == PALETTE):
        return connection.respond(HTTPStatus.NOT_FOUND, "There is no such file.\n")
    body = palette_css().encode() if name == PALETTE else path.read_bytes()
    kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
    headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body)), "Cache-Control": "no-store"}
    return Response(HTTPStatus.OK, "OK", Headers(headers), body)

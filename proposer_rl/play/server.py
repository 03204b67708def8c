"""Serves the page of the game to a browser on this machine, and to nobody else.

Other pages in the same browser get nothing: they do not know the token in the address, may not read
answers of another origin, and cannot pretend to be this host. The server writes nothing, and reads
only the files of the page, which are in memory, and those of the run.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from proposer_rl.play.session import Examine, Session, Source, Write
from proposer_rl.runs.records import checked, printable

HOSTS = ["127.0.0.1", "localhost"]
STATIC = Path(__file__).parent / "static"
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
# Only scripts, styles and connections of this server; pictures also as data, as in records.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def application(session: Session, token: str) -> Starlette:
    """Returns the application, which serves the page and its questions below ``/TOKEN/``."""
    asked: dict[str, tuple[Any, Callable[[Any], Any]]] = {
        "examine": (Examine, session.examine),
        "levels": (Source, session.levels),
        "file": (Write, session.write),
    }
    routes = [
        *(
            Route(f"/{'' if file.name == 'play.html' else file.name}", _file(file))
            for file in STATIC.iterdir()
            if file.suffix in TYPES
        ),
        Route("/api/run", partial(_told, session.about)),
        *(
            Route(f"/api/{name}", partial(_answered, *question), methods=["POST"])
            for name, question in asked.items()
        ),
    ]
    guards = [
        Middleware(TrustedHostMiddleware, allowed_hosts=HOSTS),
        Middleware(Guard, token=token),
    ]
    return Starlette(routes=[Mount("/{token}", routes=routes)], middleware=guards)


class Guard:
    """Refuses requests that are not from this server's own page, and adds headers to answers."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app, self._token = app, token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request, or refuses it."""

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        app = self._app
        if scope["type"] == "http" and (reason := self._refused(Request(scope))):
            app = PlainTextResponse(reason, status_code=403)
        await app(scope, receive, send_guarded)

    def _refused(self, request: Request) -> str | None:
        given = request.url.path.split("/")[1]
        if not secrets.compare_digest(given.encode(), self._token):
            return "The address is not complete: take the one that bin/play printed."
        origin = request.headers.get("origin")
        if origin not in (None, f"http://{request.headers['host']}"):
            return "Another page may not ask."
        return None


def listen(port: int) -> socket.socket:
    """Returns a socket on the loopback address; port 0 takes a free one.

    Raises:
        OSError: if it cannot be had.
    """
    return socket.create_server((HOSTS[0], port))


def server(app: Starlette) -> uvicorn.Server:
    """Returns a server; ``run(sockets=[listen(0)])`` answers until a signal comes."""
    return uvicorn.Server(
        uvicorn.Config(
            app,
            log_level="warning",  # no addresses with tokens in the terminal
            server_header=False,
            ws="none",
            lifespan="off",
            http="h11",
            timeout_graceful_shutdown=2,
        )
    )


def _file(file: Path) -> Callable[[Request], Awaitable[Response]]:
    content, kind = file.read_bytes(), TYPES[file.suffix]

    async def answer(_: Request) -> Response:
        return Response(content, media_type=kind)

    return answer


async def _told(function: Callable[[], Any], _: Request) -> Response:
    return await _result(function)


async def _answered(kind: Any, function: Callable[[Any], Any], request: Request) -> Response:
    if request.headers.get("content-type") != "application/json":
        return JSONResponse({"error": "must be application/json"}, status_code=415)
    body = await request.body()
    return await _result(lambda: function(checked(kind, body, "")))


async def _result(function: Callable[[], Any]) -> Response:
    """Returns a function's result as JSON, or its error in one line."""
    try:
        return JSONResponse(await run_in_threadpool(function))
    except (ValueError, LookupError, OSError) as error:
        return JSONResponse({"error": printable(str(error))}, status_code=400)

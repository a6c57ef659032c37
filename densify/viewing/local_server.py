"""A viser server that listens where it is told, and answers those alone who asked for its page there.

viser itself goes on to another port where one is taken, prints a banner, takes web sockets from pages of any origin (a
page elsewhere in the same browser could so read what is shown), and opens a tunnel to a public server for whoever
presses Share. So the socket is made here, the banner is swallowed, requests of foreign pages are refused, and there is
no tunnel.
"""

from __future__ import annotations

import errno
import io
import ipaddress
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, redirect_stdout
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

import viser
from websockets.asyncio import server as sockets
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from lightdepth.errors import InputError, MachineFailure

_OURS = "expected 127.0.0.1, or an address of this machine"
_LOCAL = ("localhost", "127.0.0.1", "[::1]")


@dataclass(frozen=True)
class Listening:
    """A server that listens, and where."""

    server: viser.ViserServer
    host: str
    """by which a browser asks for it: a local server goes by its address, or by localhost"""
    port: int
    is_local: bool
    """whether only programs of this machine can ask it"""

    @property
    def url(self) -> str:
        return f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"


@contextmanager
def local_server(host: str, port: int) -> Iterator[Listening]:
    """Within it a server without a scene listens; port 0 is any that is free. Raises InputError for a host that is none
    of this machine's, MachineFailure for a port that is taken."""
    with closing(_listening(host, port)) as place:
        address = ipaddress.ip_address(place.getsockname()[0])
        server = _started(place, address.is_loopback)
        try:
            yield Listening(server, _asked_by(host, address), place.getsockname()[1], address.is_loopback)
        finally:
            with redirect_stdout(io.StringIO()):
                server.stop()


def _listening(host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        both = address[0] == "::" and socket.has_dualstack_ipv6()
        return socket.create_server((host, port), family=family, dualstack_ipv6=both)
    except (socket.gaierror, UnicodeError) as error:
        raise InputError("--host", f"{host!r} is no host", _OURS) from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            said = f"port {port} of {host} is taken; give another one by --port, or --port 0 for any that is free"
            raise MachineFailure(said) from error
        if error.errno == errno.EACCES:
            raise InputError("--port", f"{port} is not for everyone", "give one of 1024 or more") from error
        raise InputError("--host", f"nothing can listen there ({os.strerror(error.errno or 0)})", _OURS) from error


def _asked_by(host: str, address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> str:
    if address.is_unspecified:
        return socket.gethostname()
    return str(address) if address.is_loopback and host not in _LOCAL else host


class _Unshared(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> str | None:
        """No tunnel to a public server, whatever a browser asks for."""
        return None


def _started(place: socket.socket, is_local: bool) -> viser.ViserServer:
    """A server that listens on this socket."""
    usual, asked = sockets.serve, []

    class Here(sockets.serve):
        def __init__(self, handler: Any, *_: Any, process_request: Callable[..., Any], **options: Any) -> None:
            def guarded(connection: Any, request: Request) -> Any:
                if not is_welcome(request.headers, is_local):
                    return Response(HTTPStatus.FORBIDDEN, "Forbidden", Headers())
                return process_request(connection, request)

            asked.append(place)
            super().__init__(handler, sock=place, process_request=guarded, **options)

    # viser has no argument for any of this; it looks the class up when the server starts.
    sockets.serve = Here  # type: ignore[misc,assignment]
    try:
        with redirect_stdout(io.StringIO()):
            server = _Unshared(host="127.0.0.1", port=1, verbose=False)
    finally:
        sockets.serve = usual  # type: ignore[misc]
    assert asked, "this version of viser opens its sockets in another way, and would listen where it wants"
    return server


def is_welcome(headers: Headers, is_local: bool) -> bool:
    """Whether a request comes from the server's own page, or from no page. Of a server that listens to this machine
    alone, the page must have been asked for by a local name: another one may lead here by a trick of its owner's."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) > 1 or len(origins) > 1:
        return False
    host, origin = "".join(hosts), origins[0] if origins else None
    name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
    if is_local and name not in _LOCAL and not _is_loopback(name):
        return False
    return origin is None or origin.partition("://")[2] == host


def _is_loopback(name: str) -> bool:
    try:
        return ipaddress.ip_address(name.strip("[]")).is_loopback
    except ValueError:
        return False

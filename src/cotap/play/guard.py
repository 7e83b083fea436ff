"""Who may use the page. A browser lets any website send requests to this machine: they are told by Host and Origin."""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from http import HTTPStatus

from websockets.http11 import Request

COOKIE_S = "; Path=/; HttpOnly; SameSite=Strict"
HEADERS = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
"""Of what is served: no website may show the page in a frame, and have clicks meant for itself land there."""
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:[0-9]{1,5})?", re.IGNORECASE)

PARAMETER = "set"
"""Of an URL that holds settings."""
# viser writes an URL's parameters back into it decoded; of these letters, none means anything there.
_SETTINGS = re.compile(PARAMETER + r"=[A-Za-z0-9_.,:~-]{1,4000}")


class Guard:
    """Tells requests of the page from those of strangers.

    Args:
        host: Address that the page listens at.
        port: Its port.
        token: Asked of everybody; "" for a page that only this machine reaches.

    Raises:
        ValueError: the page can be reached from elsewhere, and there is no token.
    """

    def __init__(self, host: str, port: int, token: str = "") -> None:
        self._here, self._token = is_here(host), token
        if not self._here and not token:
            raise ValueError(f"a page at {host!r} can be reached from elsewhere and needs a token")
        # Cookies are a host's, whatever the port: pages at several ports must not overwrite each other's.
        self._cookie = f"cotap-{port}={token}"
        machine = socket.gethostname().lower()
        self._names = {"localhost", host.lower()} | (set() if self._here else {machine, f"{machine}.local"})

    def refusal(self, request: Request) -> tuple[HTTPStatus, str] | None:
        """The status and the reason for which a request is refused; None if it is not."""
        host, origin = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(host) != 1 or not self._is_ours(host[0]):
            return HTTPStatus.FORBIDDEN, f"the page is not served at {host}; open the URL that cotap play printed"
        # Equal to Host, not to a fixed port: a tunnel has a port of its own.
        if origin and [o.lower() for o in origin] not in ([f"{s}://{host[0].lower()}"] for s in ("http", "https")):
            return HTTPStatus.FORBIDDEN, f"a website at {origin} may not use the page, which is at {host[0]}"
        # viser's page would take its data, and with it JavaScript to run, from wherever other parameters say.
        query = request.path.partition("?")[2]
        known = bool(self._token) and _same(query, f"token={self._token}")
        if query and not known:
            if not _SETTINGS.fullmatch(query):
                return HTTPStatus.FORBIDDEN, "wrong parameters in the URL; open the URL that cotap play printed"
            # The cookie that a page with a token asks for is not sent along from another website.
            if not self._token and request.headers.get_all("Sec-Fetch-Site") not in (["none"], ["same-origin"]):
                return HTTPStatus.FORBIDDEN, "a link with settings works from the address bar; paste it there"
        if self._token and not known and not self._has_cookie(request):
            return HTTPStatus.FORBIDDEN, "a token is missing from the URL; open the URL that cotap play printed"
        return None

    def headers(self) -> dict[str, str]:
        """Headers of every answer to a request that is not refused."""
        return HEADERS | ({"Set-Cookie": self._cookie + COOKIE_S} if self._token else {})

    def _is_ours(self, host: str) -> bool:
        """Whether the page is served under this name. A name that a stranger owns may lead here, an address cannot."""
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = match["name"].lower()
        try:
            address = ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return name in self._names
        return address.is_loopback or not self._here

    def _has_cookie(self, request: Request) -> bool:
        cookies = ";".join(request.headers.get_all("Cookie")).split(";")
        return any(_same(cookie.strip(), self._cookie) for cookie in cookies)


def is_here(host: str) -> bool:
    """Whether what listens at `host` is reached from this machine only; of an unknown host, that is not known."""
    try:
        addresses = {str(info[4][0]) for info in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)}
    except (OSError, ValueError):
        return False
    return all(ipaddress.ip_address(address).is_loopback for address in addresses)


def new_token(host: str) -> str:
    """A token for a page at `host`, or "" where only this machine reaches it."""
    return "" if is_here(host) else secrets.token_urlsafe(24)


def page_url(host: str, port: int, token: str) -> str:
    """What a browser is to open."""
    name = "localhost" if host in ("127.0.0.1", "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}" + (f"/?token={token}" if token else "")


def _same(given: str, right: str) -> bool:
    """Compared in a time that does not tell how much of it is right."""
    return secrets.compare_digest(given.encode(errors="surrogateescape"), right.encode())

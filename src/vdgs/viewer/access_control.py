"""Who may come in: nobody from elsewhere unless asked for, and then only with the token.

The page and its socket are served by one port. What asks for either must come with the name of this machine (so that no
page of another site can speak to it through the visitor's browser) and, where the server is open to others, with the
token of the printed address, which the browser keeps as a cookie.
"""

from __future__ import annotations

import hmac
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

#: Names of the loopback address.
LOOPBACK_HOSTS = ("localhost", "127.0.0.1", "::1")
#: Hosts that stand for all addresses of this machine.
ALL_INTERFACES = ("", "0.0.0.0", "::")


@dataclass(frozen=True)
class AccessControl:
    """Decides over each request by its path and its headers."""

    host: str
    #: None: only this machine can reach the server.
    token: str | None
    port: int

    @property
    def cookie_name(self) -> str:
        """The cookie's name: browsers do not tell ports apart."""
        return f"vdgs_view_{self.port}"

    def local_url(self) -> str:
        """What to open in a browser on this machine."""
        return self._url("localhost" if self.host in ALL_INTERFACES else self.host)

    def network_url(self) -> str | None:
        """What to open on another machine, by the name of this one, where `local_url` does not do there; None where it
        does, where no other machine can come in, and where this one has no name."""
        name = socket.gethostname()
        return (
            self._url(name) if self.host in ALL_INTERFACES and name.partition(".")[0] not in ("", "localhost") else None
        )

    def _url(self, name: str) -> str:
        name = f"[{name}]" if ":" in name else name
        return f"http://{name}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def deny_reason(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Why a request may not come in; None if it may."""
        hosts = _values(headers, "Host")
        host = hosts[0] if len(hosts) == 1 else ""  # nobody knows which of two names was meant
        if self.token is None and hostname_from_header(host) not in (*LOOPBACK_HOSTS, self.host):
            return (
                "This server answers only to the name of this machine. Start it with --host to open it to others, or "
                "let the proxy in front of it send Host: localhost and the same name as Origin."
            )
        origin = ", ".join(_values(headers, "Origin"))
        if "Origin" in headers and (_place_of(origin) or None) != host.lower():
            return (
                "Pages of other sites may not use this server. If a proxy stands in front of it, let it pass on the "
                "Host of the visitor (nginx: proxy_set_header Host $http_host;)."
            )
        if self.token is not None and not (self.has_token(path) or self._has_cookie(_cookie_header(headers))):
            return "The token is missing or wrong. Open the whole address that `vdgs view` printed."
        return None

    def report(self, path: str, headers: Mapping[str, str]) -> str | None:
        """What to tell who runs the server of a visitor who may not come in; None if he may. Never holds a token."""
        why = self.deny_reason(path, headers)
        if why is None:
            return None
        names = (
            f"{name} {_short(', '.join(_values(headers, name)))}" for name in ("Host", "Origin") if name in headers
        )
        return f"a visitor was refused ({', '.join(names) or 'no Host'}): {why} See docs/viewer.md."

    def has_token(self, path: str) -> bool:
        """Whether the address itself holds the token."""
        given = parse_qs(urlsplit(path).query).get("token", [""])[0]
        return self._is_token(given)

    def set_cookie_header(self) -> str:
        """The header's value that lets the browser in from now on: for this site's own requests only."""
        return f"{self.cookie_name}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    def browser_of(self, headers: Mapping[str, str]) -> str | None:
        """What tells a browser from others, by the cookie that it was given; None if it has none."""
        return next(filter(None, _cookies(_cookie_header(headers), f"{self.cookie_name}_browser")), None)

    def set_browser_header(self) -> str:
        """The header's value that gives a browser such a cookie, until it is closed."""
        return f"{self.cookie_name}_browser={secrets.token_urlsafe(18)}; HttpOnly; SameSite=Strict; Path=/"

    def _has_cookie(self, header: str) -> bool:
        return any(map(self._is_token, _cookies(header, self.cookie_name)))

    def _is_token(self, given: str) -> bool:
        # Of bytes that are no text, headers hold surrogates.
        return self.token is not None and hmac.compare_digest(given.encode(errors="surrogatepass"), self.token.encode())


def _values(headers: Mapping[str, str], name: str) -> list[str]:
    """The values of a header. A proxy may send one several times, as HTTP/2 does with cookies, and the headers of
    `websockets` give no single value then."""
    if (get_all := getattr(headers, "get_all", None)) is not None:
        return list(get_all(name))
    return [headers[name]] if name in headers else []


def _cookie_header(headers: Mapping[str, str]) -> str:
    """All cookies as one header; empty where there are none."""
    return "; ".join(_values(headers, "Cookie"))


def _cookies(header: str, name: str) -> list[str]:
    """The values of the cookies of this name in a Cookie header, without quotes around them.

    Split by hand: a browser sends the cookies of all servers of a host, and `http.cookies` drops all where one has a
    name or a value that it does not expect.
    """
    pairs = (each.partition("=") for each in header.split(";"))
    found = (value.strip() for key, _, value in pairs if key.strip() == name)
    return [value[1:-1] if len(value) > 1 and value[0] == value[-1] == '"' else value for value in found]


def _short(value: str) -> str:
    """What a visitor sent, for a terminal: printable, in a few characters."""
    return "".join(letter if letter.isprintable() else "?" for letter in value)[:80]


def _place_of(origin: str) -> str:
    """Name and port in an Origin header; nothing where it is no address."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def hostname_from_header(host: str) -> str:
    """The name in a Host header, without its port: "localhost" of "localhost:8080", "::1" of "[::1]:8080"."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def is_loopback(host: str) -> bool:
    """Only this machine reaches it."""
    return host in LOOPBACK_HOSTS or host.startswith("127.")

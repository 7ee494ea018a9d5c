"""The door of `vdgs view`: by which addresses it is found, and whom it lets in. Without a server."""

from __future__ import annotations

import socket

import pytest

pytest.importorskip("viser", reason="viser is not installed (pip install 'vdgs[viewer]')")

from websockets.datastructures import Headers

from vdgs.viewer.access_control import AccessControl
from vdgs.viewer.server import startup_message


def test_the_door_knows_its_own_name():
    alone = AccessControl("127.0.0.1", None, 8080)
    for host in ("localhost:8080", "127.0.0.1:9", "[::1]:8080", "LOCALHOST"):
        assert alone.deny_reason("/", {"Host": host}) is None
    for host in ("", "localhost.evil.example", "evil.example:8080", "[", "127.0.0.1.evil.example"):
        assert alone.deny_reason("/", {"Host": host}) is not None
    assert alone.deny_reason("/", {"Host": "localhost:8080", "Origin": "http://localhost:8080"}) is None
    assert alone.deny_reason("/", {"Host": "localhost:8080", "Origin": "http://localhost:9999"}) is not None
    for origin in ("null", "http://[", "", "http://"):
        assert alone.deny_reason("/", {"Host": "localhost:8080", "Origin": origin}) is not None
    assert AccessControl("0.0.0.0", "abc", 7).local_url() == "http://localhost:7/?token=abc"
    guarded = AccessControl("0.0.0.0", "abc", 7)
    assert guarded.deny_reason("/?token=abc", {"Host": "x"}) is None
    assert guarded.deny_reason("/?token=ab%C3%A9", {"Host": "x"}) is not None
    assert guarded.deny_reason("/", {"Host": "x", "Cookie": "vdgs_view_8=abc"}) is not None
    assert guarded.deny_reason("/", {"Host": "x", "Cookie": 'a=b; vdgs_view_7="abc"'}) is None


@pytest.mark.parametrize(
    "other", ['theme={"a":1}', "x=a b", "foo[1]=2", "é=1", "\udce9=\udce9", "flag", "a=1,2", 'n="a;b"', "expires=1", "",
              "vdgs_view_7=of another day", "vdgs_view_7=\udce9"],
)  # fmt: skip
def test_cookies_of_other_servers_of_the_host_change_nothing(other):
    guarded = AccessControl("0.0.0.0", "abc", 7)
    for cookies in (f"{other}; vdgs_view_7=abc", f"vdgs_view_7=abc;{other}"):
        assert guarded.deny_reason("/", {"Host": "x", "Cookie": cookies}) is None
    assert guarded.deny_reason("/", {"Host": "x", "Cookie": other}) is not None
    assert guarded.browser_of({"Cookie": f"{other}; vdgs_view_7_browser=me"}) == "me"
    assert guarded.browser_of({"Cookie": other}) is None


def test_a_header_may_come_several_times():
    """Proxies cut the cookies of HTTP/2 into several."""
    guarded, alone = AccessControl("0.0.0.0", "abc", 7), AccessControl("127.0.0.1", None, 7)
    cookies = Headers(
        [("Host", "x"), ("Cookie", "a=1"), ("cookie", "vdgs_view_7=abc"), ("Cookie", "vdgs_view_7_browser=me")]
    )
    assert guarded.deny_reason("/", cookies) is None
    assert guarded.browser_of(cookies) == "me"
    assert guarded.browser_of(Headers()) is None
    twice = Headers([("Host", "localhost:7"), ("Host", "localhost:7")])
    assert "Host localhost:7, localhost:7" in str(alone.report("/", twice))
    origins = Headers([("Host", "localhost:7"), ("Origin", "http://localhost:7"), ("Origin", "http://evil.example")])
    assert "Pages of other sites" in str(alone.report("/", origins))


def test_why_a_visitor_is_refused_is_told_without_what_could_let_in_or_draw():
    guarded = AccessControl("0.0.0.0", "secret", 7)
    assert guarded.report("/?token=secret", {"Host": "x"}) is None
    for path, headers in (
        ("/?token=secre", {"Host": "x", "Cookie": "vdgs_view_7=secre"}),
        ("/?token=secret", {"Host": "x", "Origin": "http://y\x1b[31m" + 200 * "z"}),
        ("/", {}),
    ):
        said = guarded.report(path, headers)
        assert said is not None
        assert "secre" not in said
        assert "\x1b" not in said
        assert len(said) < 400


def test_others_are_told_an_address_that_they_can_use(monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "Drone-7.lab")
    everyone = AccessControl("0.0.0.0", "abc", 7)
    said = "\n".join(startup_message("merged model", everyone))
    assert said.startswith("merged model: http://localhost:7/?token=abc\n")
    assert "http://Drone-7.lab:7/?token=abc" in said
    # Browsers write names small; the page's own socket comes with its origin.
    own = {"Host": "drone-7.lab:7", "Origin": "http://drone-7.lab:7"}
    assert everyone.deny_reason("/?token=abc", own) is None
    assert everyone.deny_reason("/", {**own, "Cookie": "vdgs_view_7=abc"}) is None
    assert everyone.deny_reason("/", own) is not None
    assert everyone.deny_reason("/?token=abc", {**own, "Origin": "http://evil.example"}) is not None
    # The address that was asked for is everyone's; nobody else can open that of this machine alone.
    for door in (AccessControl("192.168.1.5", "abc", 7), AccessControl("127.0.0.1", None, 7)):
        assert door.network_url() is None
        assert "Drone-7" not in "\n".join(startup_message("merged model", door))
    monkeypatch.setattr(socket, "gethostname", lambda: "localhost.localdomain")
    assert everyone.network_url() is None
    assert "IP address in place of localhost" in "\n".join(startup_message("merged model", everyone))

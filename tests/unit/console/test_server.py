# SPDX-License-Identifier: Apache-2.0
"""Who may come in at the console's port, what it serves, and what it forbids the browser."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("viser")

from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request, Response
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from armscan.console.server import Door, close_server, is_loopback, open_server
from armscan.errors import DeviceError, OptionError

VISER = Subprotocol("viser-v0")


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    folder = tmp_path_factory.mktemp("session")
    (folder / "report.html").write_text("<p>all of it</p>")
    (folder / "scanner.json").write_text("{}")
    (folder.parent / "other.html").write_text("not yours")
    server, address = open_server(lambda: folder, port=0)
    assert address == f"http://localhost:{server.get_port()}/"
    yield server.get_port()
    close_server(server)


def ask(port: int, path: str, **headers: str) -> tuple[int, str, http.client.HTTPMessage]:
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10.0)) as link:
        link.request("GET", path, headers=headers)
        with link.getresponse() as answer:
            return answer.status, answer.read().decode("utf-8", "replace"), answer.headers


def test_the_page_comes_with_a_rule_against_other_hosts(port: int) -> None:
    status, text, headers = ask(port, "/")
    assert status == 200 and "<html" in text
    rule = headers["Content-Security-Policy"]
    assert rule.startswith("default-src 'self'") and "http" not in rule and "*" not in rule


def test_pages_of_the_session_alone_are_served(port: int) -> None:
    assert ask(port, "/pages/report.html")[:2] == (200, "<p>all of it</p>")
    for path in ("scanner.json", "other.html", "../other.html", "%2e%2e/other.html", "", "a/"):
        assert ask(port, f"/pages/{path}")[0] == 404, path


def test_another_name_of_this_computer_is_refused(port: int) -> None:
    # a name that an attacker's name server leads to 127.0.0.1
    status, text, _ = ask(port, "/", Host=f"evil.example:{port}")
    assert status == 403 and "token" in text
    assert ask(port, "/pages/report.html", Host="evil.example")[0] == 403


def test_a_page_of_another_host_cannot_press_buttons(port: int) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://127.0.0.1:{port}", origin="http://evil.example", subprotocols=[VISER])
    assert refused.value.response.status_code == 403
    own = f"http://127.0.0.1:{port}"
    with connect(f"ws://127.0.0.1:{port}", origin=own, subprotocols=[VISER]) as link:
        # let in; viser then ends it, for its own page is of another version
        assert link.subprotocol == VISER


def request(path: str, **headers: str) -> Request:
    return Request(path, Headers({"Host": "192.168.1.5:80", **headers}))


def test_a_token_lets_in_whoever_is_not_here(tmp_path: Path) -> None:
    door = Door("secret", lambda: tmp_path)
    assert door.refusal("192.168.1.9", request("/"))
    assert door.refusal("192.168.1.9", request("/?token=Secret"))
    assert door.refusal("127.0.0.1", request("/")), "a forwarded name is not this computer"
    assert not door.refusal("192.168.1.9", request("/?token=secret"))
    assert not door.refusal("192.168.1.9", request("/", Cookie=f"a=b; {door.cookie}=secret"))
    # the token does not help a page of another host
    assert door.refusal("192.168.1.9", request("/?token=secret", Origin="http://evil.example"))


def test_two_consoles_at_one_computer_leave_each_other_s_cookie_alone(tmp_path: Path) -> None:
    # browsers send a host's cookies to all its ports, and keep one of each name
    first, second = (Door(token, lambda: tmp_path) for token in ("one", "two"))
    kept = {}
    for door in (first, second):
        answer = Response(200, "OK", Headers())
        door.marked(request(f"/?token={door.token}"), answer)
        name, _, value = answer.headers["Set-Cookie"].partition(";")[0].partition("=")
        kept[name] = value
    both = "; ".join(f"{name}={value}" for name, value in kept.items())
    assert not first.refusal("192.168.1.9", request("/", Cookie=both))
    assert not second.refusal("192.168.1.9", request("/", Cookie=both))


@pytest.mark.parametrize(
    "line",
    [
        b"GET /?token=\xff\xfe HTTP/1.1\r\nHost: 192.168.1.5",
        b"GET / HTTP/1.1\r\nHost: [",
        b"GET /pages/%00.html HTTP/1.1\r\nHost: localhost",
        b"GET /pages/" + 300 * b"a" + b".html HTTP/1.1\r\nHost: localhost",
        b"GET /" + 300 * b"a" + b" HTTP/1.1\r\nHost: localhost",
        b"GET //[?token=x HTTP/1.1\r\nHost: localhost",
    ],
)
def test_an_address_that_is_none_is_refused_in_words(port: int, line: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as link:
        link.sendall(line + b"\r\n\r\n")
        answer = link.makefile("rb").read()
    assert answer.startswith(b"HTTP/1.1 400") and answer.endswith(b"nothing can be read there")


@pytest.mark.parametrize("host", ["203.0.113.7", "[2001:db8::7]", "no.such.host.invalid"])
def test_another_computer_s_address_is_told_as_such(tmp_path: Path, host: str) -> None:
    with pytest.raises(DeviceError, match="no address of this computer") as told:
        open_server(lambda: tmp_path, host)
    assert told.value.where == "--host"


@pytest.mark.parametrize(
    ("name", "is_here"),
    [
        ("localhost", True),
        ("127.0.0.1", True),
        ("::1", True),
        ("127.0.0.1.evil.example", False),
        ("10.0.0.1", False),
        ("", False),
    ],
)
def test_loopback(name: str, is_here: bool) -> None:
    assert is_loopback(name) is is_here


def test_a_taken_port_is_one_sentence(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(DeviceError, match="nothing can listen"):
            open_server(lambda: tmp_path, port=taken.getsockname()[1])
    with pytest.raises(OptionError):
        open_server(lambda: tmp_path, port=70_000)


def test_all_addresses_of_this_computer_are_told_by_its_name(tmp_path: Path) -> None:
    server, address = open_server(lambda: tmp_path, "0.0.0.0", port=0)
    try:
        port, token = server.get_port(), address.partition("?token=")[2]
        assert address == f"http://{socket.gethostname()}:{port}/?token={token}"
        # from here by its loopback address as ever; by another name with the token alone
        assert ask(port, "/")[0] == 200
        name = f"{socket.gethostname()}:{port}"
        assert ask(port, "/", Host=name)[0] == 403
        assert ask(port, "/?token=wrong", Host=name)[0] == 403
        status, _, headers = ask(port, f"/?token={token}", Host=name)
        assert status == 200
        cookie = headers["Set-Cookie"].partition(";")[0]
        assert ask(port, "/", Host=name, Cookie=cookie)[0] == 200
        wrong = f"{cookie.partition('=')[0]}=wrong"
        assert ask(port, "/", Host=name, Cookie=wrong)[0] == 403
    finally:
        close_server(server)


class OtherServer:
    """A library that begins to listen in a way of its own."""

    is_stopped = False

    def __init__(self, **_: object) -> None:
        """Listen, and ask nobody."""

    def stop(self) -> None:
        OtherServer.is_stopped = True


def test_a_library_that_does_not_ask_who_comes_is_not_let_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viser.ViserServer", OtherServer)
    with pytest.raises(OptionError, match="who may come in"):
        open_server(lambda: tmp_path, port=0)
    assert OtherServer.is_stopped

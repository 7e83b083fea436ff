"""The page is closed to strangers: to other websites, to names that are not its own, to who has no token."""

from __future__ import annotations

import contextlib
import re
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest
import viser
from browser import Browser, get, looking, refused, until

from cotap.play import websocket
from cotap.play.__main__ import PlayOptions, main
from cotap.play.app import App
from cotap.play.guard import Guard, is_here, new_token, page_url
from cotap.play.replay import Replay
from cotap.play.server import open_server

TOKEN = "a-token-of-this-test"


@pytest.fixture
def open_to_all(free_port):
    """A page that listens beyond this machine, too."""
    server = open_server("0.0.0.0", free_port, TOKEN)
    yield server
    server.stop()


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "http://localhost.evil.example:{port}", "null", "http://localhost", "http://localhost:1",
     "http://127.0.0.1:{port}", "file://", "ftp://localhost:{port}", "http://localhost:{port}/", None],
)  # fmt: skip
def test_a_website_elsewhere_opens_no_websocket(server, origin):
    port = server.get_port()
    assert refused(port, origin=origin and origin.format(port=port)) == 403
    assert not server.get_clients()


@pytest.mark.parametrize("host", ["evil.example:{port}", "localhost.evil.example", "192.0.2.7:{port}", "0.0.0.0"])
def test_a_name_that_only_leads_here_is_not_the_pages(server, host):
    port = server.get_port()
    host = host.format(port=port)
    assert refused(port, host=host) == 403
    status, _, text = get(port, Host=host)
    assert status == 403
    assert host in text


@pytest.mark.parametrize("host", ["a b", "localhost:x", "localhost@evil.example", "[::1", "", "localhost:99999999"])
def test_a_host_that_is_none_is_refused(server, host):
    assert get(server.get_port(), Host=host)[0] == 403


@pytest.mark.parametrize("host", ["localhost:{port}", "127.0.0.1:{port}", "localhost:9999", "127.0.0.1:9", "[::1]:9"])
def test_the_page_itself_may_through_a_tunnel_and_another_port_too(server, host):
    host = host.format(port=server.get_port())
    assert refused(server.get_port(), host=host) == 101
    assert refused(server.get_port(), host=host, origin=f"https://{host}") == 101
    assert refused(server.get_port(), host=host, origin="https://evil.example") == 403
    status, _, text = get(server.get_port(), Host=host)
    assert status == 200
    assert "<!doctype html>" in text


def test_no_website_shows_the_page_in_a_frame_of_its_own(server):
    status, headers, _ = get(server.get_port())
    assert status == 200
    assert headers["X-Frame-Options"] == "DENY"
    assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"


@pytest.mark.parametrize(
    "query",
    ["websocket=ws://evil.example", "%77ebsocket=ws://evil.example", "playbackPath=https://evil.example/scene.viser",
     "token=", "x&websocket=ws://evil.example"],
)  # fmt: skip
def test_a_link_to_the_page_cannot_have_it_run_what_another_server_sends(server, query):
    status, _, text = get(server.get_port(), f"/?{query}")
    assert status == 403
    assert "parameters" in text


LINK = "/?set=robot:h1,stand:0"


@pytest.mark.parametrize(
    ("site", "status"),
    [({"Sec-Fetch-Site": "none"}, 200), ({"Sec-Fetch-Site": "same-origin"}, 200),
     ({"Sec-Fetch-Site": "cross-site"}, 403), ({"Sec-Fetch-Site": "same-site"}, 403), ({}, 403)],
)  # fmt: skip
def test_no_website_sets_anything_by_a_link_and_people_may_paste_one(server, site, status):
    answered, _, text = get(server.get_port(), LINK, **site)
    assert answered == status
    assert ("paste it there" in text) == (status == 403)
    assert get(server.get_port(), f"{LINK}&websocket=ws://evil.example", **site)[0] == 403


def test_a_link_with_settings_is_no_token(open_to_all):
    port = open_to_all.get_port()
    assert get(port, LINK, **{"Sec-Fetch-Site": "none"})[0] == 403
    cookie = get(port, f"/?token={TOKEN}")[1]["Set-Cookie"].partition(";")[0]
    assert get(port, LINK, Cookie=cookie)[0] == 200
    assert get(port, f"/?token={TOKEN}&set=robot:h1")[0] == 403


def test_by_default_only_this_machine_reaches_it(server):
    assert PlayOptions().host == "127.0.0.1"
    assert new_token("127.0.0.1") == new_token("localhost") == ""
    with pytest.raises(OSError):  # noqa: PT011 - which one is the system's affair
        socket.create_connection(("127.0.0.2", server.get_port()), 5.0)


def test_beyond_this_machine_there_is_no_page_without_a_token(free_port):
    for host in ("0.0.0.0", "::", "no.such.host.invalid"):
        assert not is_here(host)
        assert len(new_token(host)) >= 32
        with pytest.raises(ValueError, match="needs a token"):
            Guard(host, free_port)
    assert new_token("0.0.0.0") != new_token("0.0.0.0")
    with pytest.raises(ValueError, match="needs a token"):
        open_server("0.0.0.0", free_port)
    assert page_url("0.0.0.0", 80, "abc") == "http://localhost:80/?token=abc"
    assert page_url("::1", 80, "") == "http://[::1]:80"


def test_who_has_no_token_gets_nothing(open_to_all):
    port = open_to_all.get_port()
    for query in ("", "?token=wrong", f"?token={TOKEN}x", f"?token={TOKEN}&websocket=ws://evil.example"):
        path = f"/{query}"
        status, headers, _ = get(port, path)
        assert status == 403
        assert "Set-Cookie" not in headers
        assert refused(port, path=path) == 403
    for cookie in (f"cotap-{port}=wrong", f"cotap-1={TOKEN}", f"xcotap-{port}={TOKEN}", "\xe9"):
        assert refused(port, headers={"Cookie": cookie}) == 403
    assert "token" in get(port)[2]


def test_the_token_opens_the_page_and_its_websocket(open_to_all):
    port = open_to_all.get_port()
    status, headers, _ = get(port, f"/?token={TOKEN}")
    assert status == 200
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    sent = {"Cookie": f"other=1; {cookie.partition(';')[0]}"}
    assert get(port, **sent)[0] == 200
    assert refused(port, headers=sent) == 101
    assert refused(port, headers=sent, host=f"{socket.gethostname()}:{port}") == 101
    assert refused(port, headers=sent, host="192.0.2.7:9999") == 101


def test_the_token_excuses_no_other_website_and_no_other_name(open_to_all):
    port, sent = open_to_all.get_port(), {"Cookie": f"cotap-{open_to_all.get_port()}={TOKEN}"}
    assert refused(port, headers=sent, origin="https://evil.example") == 403
    assert refused(port, headers=sent, host="evil.example") == 403
    assert get(port, f"/?token={TOKEN}", Host="evil.example")[0] == 403


@pytest.mark.parametrize("path", ["/../_viser.py", "/%2e%2e/_viser.py", "/..%5c_viser.py", "/a/../../_viser.py", "/no"])
def test_what_is_outside_the_page_is_not_found(server, path):
    assert get(server.get_port(), path)[0] == 404


def test_more_viewers_than_it_bears_are_turned_away(server, monkeypatch):
    monkeypatch.setattr(websocket, "MAX_VIEWERS", 2)
    port = server.get_port()
    with looking(port), Browser(port):
        assert refused(port) == 503
    until(lambda: refused(port) == 101)


def test_no_flood_of_connections_takes_all_the_files_that_the_system_lets_a_program_have(server, monkeypatch):
    """From one that opens them and says nothing: those beyond the most are let go, who looks on stays, others may."""
    monkeypatch.setattr(websocket, "MAX_CONNECTIONS", 20)
    port, folder = server.get_port(), Path("/proc/self/fd")
    before = len(list(folder.iterdir())) if folder.is_dir() else 0
    with looking(port) as viewer, contextlib.ExitStack() as flood:
        for _ in range(60):
            flood.enter_context(socket.create_connection(("127.0.0.1", port), 5.0))
        until(lambda: refused_at_once(port))
        if before:  # both ends are in this process: 60 of the flood's own
            assert len(list(folder.iterdir())) - before < 60 + 40
        viewer.look()
        assert viewer.socket.recv(timeout=5.0)
    until(lambda: get(port)[0] == 200)


def refused_at_once(port: int) -> bool:
    """Whether a new connection is let go before it has said anything."""
    with socket.create_connection(("127.0.0.1", port), 5.0) as late:
        late.settimeout(0.5)
        try:
            return late.recv(1) == b""
        except ConnectionResetError:
            return True
        except TimeoutError:
            return False


def test_with_a_live_simulation_and_with_a_replay_it_is_closed(free_port, record, checkpoint, tmp_path, monkeypatch):
    path = tmp_path / "walk.npz"
    record(5, 1).save(path)
    tried = []

    def run(*_):
        tried.append((refused(free_port, origin="https://evil.example"), refused(free_port)))

    monkeypatch.setattr(App, "run", run)
    monkeypatch.setattr(Replay, "run", run)
    for arguments in (["--checkpoint", str(checkpoint)], ["--replay", str(path)]):
        assert main(["--port", str(free_port), *arguments]) == 0
    assert tried == [(403, 101)] * 2


def test_the_command_prints_the_url_that_lets_in(free_port, monkeypatch, capsys, checkpoint):
    entered = []

    def run(*_):
        url = re.search(r"open http://localhost:\d+(/\S+)", capsys.readouterr().out)
        entered.append(get(free_port, url[1])[0])

    monkeypatch.setattr(App, "run", run)
    assert main(["--port", str(free_port), "--host", "0.0.0.0", "--checkpoint", str(checkpoint)]) == 0
    assert entered == [200]


def test_a_viser_that_starts_its_server_in_another_way_is_stopped_and_refused(free_port, monkeypatch):
    stopped = []
    monkeypatch.setattr(viser, "ViserServer", lambda **_: SimpleNamespace(stop=lambda: stopped.append(True)))
    with pytest.raises(ValueError, match=r"install viser 1\.1\.1"):
        open_server("127.0.0.1", free_port)
    assert stopped == [True]


def test_no_other_server_is_started_anywhere():
    root = Path(__file__).parents[2]
    opens = re.compile(r"ViserServer\(|create_server|start_server|\.listen\(|http\.server|socketserver|\bserve\(")
    files = [
        *(root / "src").rglob("*.py"),
        *(f for p in ("benchmarks", "reports", "release") for f in (root / p).glob("*.py")),
        *(root / "examples").rglob("*.py"),
    ]
    found = [f.relative_to(root).as_posix() for f in files if opens.search(f.read_text())]
    assert found == ["src/cotap/play/websocket.py"]

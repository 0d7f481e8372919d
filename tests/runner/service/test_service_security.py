"""Access control: tokens, hosts, origins, rates, sizes; and no secrets in the log."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import stat
import time
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest
from click.testing import CliRunner
from served import Served
from starlette.testclient import TestClient

from runner.cli import cli
from runner.errors import RunnerError
from runner.runs.resolve import find_run
from runner.service import logs
from runner.service.app import create_app
from runner.service.errors import Unauthorized
from runner.service.guard import POLICY, is_allowed_host, is_same_origin
from runner.service.settings import ServiceLimits, tokens_file
from runner.service.tokens import READ, WRITE, Tokens

RUNS, RUN = "/api/v1/runs", "/api/v1/runs/first"
OWN = {"Origin": "http://localhost"}


@pytest.fixture
def tokens(settings):
    return Tokens(settings.tokens)


@pytest.fixture
def open_to_others(settings):
    return dataclasses.replace(settings, host="0.0.0.0")


def _bearer(secret):
    return {"Authorization": f"Bearer {secret}"}


def test_another_host_without_a_token_does_not_start(open_to_others, tokens):
    with pytest.raises(RunnerError, match="dualtaxi token create"):
        create_app(open_to_others)
    tokens.create("laptop", (READ,))
    create_app(open_to_others)


def test_on_another_host_reading_and_writing_need_a_token(connect, open_to_others, tokens):
    _, reads = tokens.create("reader", (READ,))
    _, writes = tokens.create("writer", (READ, WRITE))
    client = connect(open_to_others)
    assert client.get(RUNS).status_code == 401
    assert client.get("/runs").status_code == 401
    assert client.get(RUNS, headers=_bearer(reads)).status_code == 200
    assert client.patch(RUN, json={}).status_code == 401
    assert client.patch(RUN, json={}, headers=_bearer(reads)).status_code == 403
    assert client.patch(RUN, json={}, headers=_bearer(writes)).status_code == 200
    assert client.get("/healthz").status_code == 200


def test_a_second_token_of_a_name_is_refused(tokens):
    token, _ = tokens.create("laptop", (READ,))
    with pytest.raises(RunnerError, match=f"'laptop' is in use; .*revoke {token.id}"):
        tokens.create("laptop", (WRITE,))
    tokens.revoke(token.id)
    tokens.create("laptop", (READ,))


def test_a_token_is_stored_as_a_hash_for_its_owner_only(tokens):
    token, secret = tokens.create("laptop", (READ,))
    text = tokens.path.read_text()
    assert secret not in text
    assert hashlib.sha256(secret.encode()).hexdigest() in text
    assert stat.S_IMODE(tokens.path.stat().st_mode) == 0o600
    assert "sha256" not in token.as_json()


def test_a_revoked_token_is_refused_at_once(connect, open_to_others, tokens):
    _, secret = tokens.create("laptop", (READ,))
    tokens.create("other", (READ,))
    client = connect(open_to_others)
    assert client.get(RUNS, headers=_bearer(secret)).status_code == 200
    tokens.revoke("laptop")
    assert client.get(RUNS, headers=_bearer(secret)).status_code == 401


def test_wrong_tokens_lock_nobody_out(connect, open_to_others, tokens):
    _, secret = tokens.create("laptop", (READ,))
    client = connect(open_to_others)
    for _ in range(30):
        assert client.get(RUNS, headers=_bearer("guess")).status_code == 401
    assert client.get(RUNS, headers=_bearer(secret)).status_code == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "", "a b"]
)
def test_an_unknown_host_name_is_refused(client, host):
    assert client.get(RUNS, headers={"Host": host}).status_code == 421


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:8000", "127.0.0.1:1", "[::1]:8000", "10.0.0.1"])
def test_addresses_and_localhost_are_allowed(host):
    assert is_allowed_host(host, ())


def test_the_name_of_a_proxy_can_be_allowed(connect, settings):
    client = connect(dataclasses.replace(settings, hosts=("runs.example.org",)))
    assert client.get(RUNS, headers={"Host": "runs.example.org"}).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://localhost:9000"},
        {"origin": "http://localhost.evil.example"},
        {"sec-fetch-site": "cross-site", "origin": "http://localhost"},
        {"sec-fetch-site": "same-site"},
        {"sec-fetch-site": "none"},
    ],
)
def test_no_other_site_can_write(connect, settings, headers, recordings):
    client = connect(settings, **(headers or {"x-nothing": "1"}))
    answer = client.patch(RUN, json={"note": "from elsewhere"})
    assert answer.status_code == 403
    assert find_run("first", recordings).note == ""


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_other_sites_can_link_to_pages_but_not_embed_them(connect, settings, site):
    client = connect(settings, **{"Sec-Fetch-Site": site, "Sec-Fetch-Mode": "no-cors"})
    assert client.get(f"{RUN}/plot.svg").status_code == 403
    assert client.get("/runs", headers={"Sec-Fetch-Mode": "navigate"}).status_code == 200


def test_a_page_of_the_service_can_write():
    assert is_same_origin({"host": "localhost:8000", "origin": "http://localhost:8000"})
    assert is_same_origin({"host": "a.org", "origin": "https://a.org", "sec-fetch-site": "same-origin"})
    assert is_same_origin({"host": "localhost", "sec-fetch-site": "same-origin"})


def test_a_token_writes_from_anywhere_on_loopback_too(connect, settings, tokens):
    _, secret = tokens.create("writer", (READ, WRITE))
    client = connect(settings, accept="*/*")
    note = client.patch(RUN, json={"note": "by a program"}, headers=_bearer(secret))
    assert note.json()["note"] == "by a program"
    assert client.patch(RUN, json={"note": "x"}, headers=_bearer("wrong")).status_code == 401


def test_a_login_sets_a_cookie_that_cannot_write_from_other_sites(connect, open_to_others, tokens):
    _, secret = tokens.create("writer", (READ, WRITE))
    client = connect(open_to_others, accept="text/html")
    response = client.get("/runs?filter=x", follow_redirects=False)
    assert response.status_code == 303
    assert response.headers["location"] == "/login?next=%2Fruns%3Ffilter%3Dx"
    form = {"token": secret, "next": "/runs"}
    assert client.post("/login", data=form).status_code == 403
    assert client.post("/login", data=form | {"token": "wrong"}, headers=OWN).status_code == 401
    entered = client.post("/login", data=form, headers=OWN, follow_redirects=False)
    assert (entered.status_code, entered.headers["location"]) == (303, "/runs")
    cookie = entered.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=lax" in cookie
    assert secret not in cookie
    assert client.get(RUNS).status_code == 200
    assert client.patch(RUN, json={"note": "x"}, headers={"Origin": "http://evil.example"}).status_code == 403
    assert client.patch(RUN, json={"note": "x"}, headers=OWN).status_code == 200
    session = client.cookies["dualtaxi_session"]
    assert client.post("/logout", headers=OWN, follow_redirects=False).status_code == 303
    assert client.get(RUNS).status_code == 401
    assert client.get(RUNS, headers={"Cookie": f"dualtaxi_session={session}"}).status_code == 401


def test_a_session_survives_a_restart_and_ends_with_its_token_or_its_time(
    connect, open_to_others, tokens, monkeypatch
):
    _, secret = tokens.create("laptop", (READ,))
    tokens.create("other", (READ,))
    entered = connect(open_to_others).post("/login", data={"token": secret}, follow_redirects=False)
    session = entered.cookies["dualtaxi_session"]
    path = tokens.path.with_name("sessions.json")
    assert session not in path.read_text()
    assert secret not in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600

    restarted = create_app(open_to_others)
    cookie = {"Cookie": f"dualtaxi_session={session}"}

    def status():
        return TestClient(restarted, base_url="http://localhost", headers=cookie).get("/docs").status_code

    assert status() == 404, "logged in: there is no such page"
    with monkeypatch.context() as later:
        now = time.time()
        later.setattr("runner.service.tokens.time.time", lambda: now + 8 * 86_400)
        assert status() == 401
    tokens.revoke("laptop")
    assert status() == 401


def test_pages_offer_a_read_token_no_writes(connect, open_to_others, tokens):
    _, reads = tokens.create("reader", (READ,))
    _, writes = tokens.create("writer", (READ, WRITE))
    client = connect(open_to_others, **OWN, accept="text/html")
    client.post("/login", data={"token": reads})
    for address in ("/runs", "/runs/first", "/runs/first/config", "/queue", "/sweeps"):
        page = client.get(address).text
        assert "reader, may only read" in page
        assert 'action="/logout"' in page
        assert "/submit" not in page
        assert "Save labels" not in page
    for refused in (client.get("/submit"), client.post("/runs/first/labels", data={"name": "x"})):
        assert refused.status_code == 403
        assert refused.headers["content-type"].startswith("text/html")
        assert "found one for reading, expected one for writing" in refused.text
        assert 'href="/login"' not in refused.text
    client.post("/login", data={"token": writes})
    page = client.get("/runs/first").text
    assert "writer" in page
    assert "may only read" not in page
    assert "Save labels" in page


@pytest.mark.parametrize("where", ["//evil.example", "https://evil.example", "/\\evil.example", ""])
def test_a_login_redirects_to_no_other_site(connect, open_to_others, tokens, where):
    _, secret = tokens.create("writer", (READ, WRITE))
    client = connect(open_to_others)
    answer = client.post("/login", data={"token": secret, "next": where}, follow_redirects=False)
    assert answer.headers["location"] == "/"


@pytest.mark.parametrize("path", [RUNS, "/runs", "/healthz", "/nothing", "/api/v1/openapi.json"])
def test_every_response_has_the_policy(client, path):
    headers = client.get(path).headers
    assert headers["content-security-policy"] == POLICY
    assert "unsafe" not in POLICY
    assert headers["x-content-type-options"] == "nosniff"
    assert "access-control-allow-origin" not in headers


def test_a_body_that_is_too_long_is_refused(connect, settings):
    client = connect(dataclasses.replace(settings, limits=ServiceLimits(body_bytes=1000)))
    answer = client.patch(RUN, json={"note": "x" * 2000})
    assert answer.status_code == 413
    assert "1,000 bytes" in answer.json()["error"]["message"]


@pytest.mark.parametrize(
    "name", ["..", "..%2f..%2fetc", "%2fetc%2fpasswd", "a%00b", "x.mcap", ".%2ffirst", "@", "%40latest%2f.."]
)
def test_no_path_names_a_run(client, name):
    for address in (f"{RUNS}/{name}", f"{RUNS}/{name}/recording", f"{RUNS}/{name}/metrics"):
        assert client.get(address).status_code == 404


def test_a_note_and_tags_are_checked_as_by_the_commands(client):
    for wrong in ({"name": "<script>"}, {"tag": ["a b"]}, {"note": "x" * 10_001}, {"name": "../x"}):
        assert client.patch(RUN, json=wrong).status_code in (400, 422)
    changes = {"name": "renamed", "tag": ["keep", "a"], "note": "<script>alert(1)</script>"}
    labels = client.patch(RUN, json=changes).json()
    assert (labels["name"], labels["tags"], labels["note"]) == ("renamed", ["a", "keep"], changes["note"])
    (row,) = client.get(RUNS, params={"filter": '"keep" in tags'}).json()["runs"]
    assert row["name"] == "renamed"
    back = client.patch(f"{RUNS}/renamed", json={"name": "", "untag": ["a"], "note": ""}).json()
    assert (back["name"], back["tags"], back["note"]) == ("first", ["keep"], "")


def test_the_log_is_json_lines_without_secrets(connect, open_to_others, tokens, tmp_path):
    _, secret = tokens.create("laptop", (READ,))
    with (tmp_path / "log").open("w") as stream, logs.logged_to(stream):
        client = connect(open_to_others)
        client.get(RUNS, params={"filter": f'name == "{secret}"'}, headers=_bearer(secret))
        client.get(f"{RUNS}/{secret}", headers=_bearer(secret))
    text = (tmp_path / "log").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    requests = [line for line in lines if line["event"] == "request"]
    assert [line["status"] for line in requests] == [200, 404]
    assert requests[1]["path"].startswith(RUNS)
    assert {"time", "level", "client", "method", "seconds", "bytes"} <= set(requests[0])
    assert secret not in text
    assert secret[10:] not in text


def test_an_unread_log_blocks_nothing_and_counts_dropped_lines(client):
    reading, writing = os.pipe()
    with open(reading, "rb") as pipe, open(writing, "w") as stream:  # noqa: PTH123 - of a descriptor
        began = time.monotonic()
        with logs.logged_to(stream):
            for _ in range(logs.MAX_WAITING + 3_000):
                logs.LOG.info("said")
            assert client.get("/healthz").status_code == 200
            assert time.monotonic() - began < 10
            read = ThreadPoolExecutor(1).submit(pipe.read)
            while logging.getLogger(logs.NAME).handlers[0].queue.qsize():
                time.sleep(0.01)
            logs.LOG.info("last")
        stream.close()
        lines = [json.loads(line) for line in read.result(20).splitlines()]
    left_out = [line["lines"] for line in lines if line["event"] == "lines left out"]
    logged = sum(line["event"] == "said" for line in lines)
    assert left_out, "the queue was full"
    assert sum(left_out) + logged == logs.MAX_WAITING + 3_000
    assert lines[-1]["event"] == "last"


def test_a_service_with_an_unread_log_responds_and_stops(recordings, tmp_path):
    os.mkfifo(tmp_path / "log")
    unread = os.open(tmp_path / "log", os.O_RDWR)
    with os.fdopen(unread), Served(recordings, "--log", str(tmp_path / "log")) as served:
        for number in range(100):  # 2 kB of log each, more than a pipe holds
            params = {"filter": f"n{number}{'x' * 2_000}"}
            assert served.client.get("/runs", params=params).status_code == 200
        assert served.stop() == 0


def test_no_message_contains_paths_of_the_server(client, recordings):
    run = find_run("first", recordings)
    run.recording.write_bytes(run.recording.read_bytes()[:100] + bytes(100))
    for address in (f"{RUNS}/first/metrics", f"{RUNS}/first/episodes/train", "/runs/first/evaluations"):
        answer = client.get(address, headers={"Accept": "text/html"})
        assert answer.status_code == 409, address
        assert f"{run.run_id}/recording.mcap" in answer.text
        assert str(recordings) not in answer.text


def test_readiness_names_the_failed_check(client, recordings):
    answer = client.get("/readyz")
    assert (answer.status_code, answer.json()["ready"]) == (200, True)
    recordings.rename(recordings.with_name("gone"))
    answer = client.get("/readyz")
    assert answer.status_code == 503
    assert not answer.json()["checks"]["recordings_can_be_written"]


def test_the_command_creates_lists_and_revokes_tokens(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))

    def token_command(*words):
        return CliRunner().invoke(cli, ["token", *words])

    secret = token_command("create", "laptop").stdout.strip()
    writes = json.loads(token_command("create", "pusher", "--scope", "write", "--json").stdout)
    kept = Tokens(tokens_file())
    assert kept.find(secret).scopes == (READ,)
    assert kept.find(writes["token"]).scopes == (READ, WRITE)
    listed = json.loads(token_command("ls", "--json").stdout)["tokens"]
    assert [token["name"] for token in listed] == ["laptop", "pusher"]
    assert secret not in token_command("ls").stdout
    refused = token_command("revoke", "nobody")
    assert refused.exit_code == 2
    assert "no token has the id or name 'nobody'. `dualtaxi token ls` lists them." in refused.stderr
    assert token_command("revoke", "laptop").exit_code == 0
    with pytest.raises(Unauthorized, match="was revoked"):
        kept.find(secret)


@pytest.mark.parametrize(("target", "where"), [("/disk", "/disk"), ("//evil.example", "/"), ("", "/")])
def test_no_token_is_asked_for_where_none_is_needed(client, target, where):
    answer = client.get("/login", params={"next": target}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, where)


def test_the_login_fits_a_narrow_screen(browser, recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    Tokens(tmp_path / "dualtaxi" / "tokens.json").create("laptop", (READ,))
    size = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    with Served(recordings, "--require-token") as served:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get(f"{served.url}/login")
        assert browser.execute_script("return document.documentElement.scrollWidth") == 390
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_headers_of_a_trusted_proxy_are_used(recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    tokens = Tokens(tmp_path / "dualtaxi" / "tokens.json")
    _, secret = tokens.create("laptop", (READ,))
    words = ("--require-token", "--allow-host", "Runs.example.org", "--proxy", "127.0.0.1")
    headers = {"Host": "runs.example.org", "Origin": "https://runs.example.org"}
    headers |= {"X-Forwarded-Proto": "https", "X-Forwarded-For": "203.0.113.7"}
    with Served(recordings, *words) as served:
        assert httpx2.get(f"{served.url}/api/v1/runs").status_code == 401
        entered = httpx2.post(f"{served.url}/login", data={"token": secret}, headers=headers)
        assert httpx2.get(f"{served.url}/api/v1/runs", headers=_bearer(secret)).status_code == 200
    assert entered.status_code == 303
    assert "Secure" in entered.headers["set-cookie"]

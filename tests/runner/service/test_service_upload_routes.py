"""Uploads over HTTP: pieces, owners, limits."""

from __future__ import annotations

import secrets
from dataclasses import replace

import pytest
from blake3 import blake3

from runner.runs.run import list_runs
from runner.service.settings import ServiceLimits
from runner.service.tokens import Tokens
from tests.waiting import until

UPLOADS = "/api/v1/uploads"
PIECE = {"Content-Type": "application/octet-stream"}


@pytest.fixture
def data(recorded):
    return list_runs(recorded)[0].recording.read_bytes()


@pytest.fixture
def elsewhere(settings, tmp_path):
    """Return the settings of a service that has no runs yet."""
    return replace(settings, recordings=(tmp_path / "theirs",))


def put(client, upload, data=None, **known):
    """Send what is known of an upload: digest and size of its bytes, if they are given."""
    known |= {} if data is None else {"digest": digest(data), "size": len(data)}
    return client.put(f"{UPLOADS}/{upload}", json=known)


def over(client, upload, data, **known):
    """Return the result of an upload."""
    return until(
        lambda upload: upload["state"] in ("stored", "refused"),
        lambda: put(client, upload, data, **known).json(),
    )


def begin(client, data=None, **known):
    """Begin an upload, of unknown bytes by default; return its id."""
    answer = put(client, secrets.token_hex(32) if data is None else digest(data), data, **known)
    assert answer.status_code == 200, answer.text
    return answer.json()["id"]


def digest(data):
    return blake3(data).hexdigest()


def patch(client, upload, data, offset, **headers):
    all_headers = PIECE | {"Upload-Offset": str(offset)} | headers
    return client.patch(f"{UPLOADS}/{upload}", content=data, headers=all_headers)


def message(answer):
    return answer.json()["error"]["message"]


def test_a_run_is_sent_in_pieces_and_listed_when_it_is_verified(connect, elsewhere, data):
    client = connect(elsewhere)
    upload = begin(client, data, name="mine", run_id="abc", run={"labels": {"tags": ["sent"]}})
    half = len(data) // 2
    answer = patch(client, upload, data[:half], 0)
    assert (answer.status_code, answer.json()["offset"]) == (200, half)
    assert client.get(UPLOADS).json()["uploads"][0]["size"] == len(data)
    answer = patch(client, upload, data[half:], 0)
    assert (answer.status_code, "expected" in message(answer)) == (409, True)
    assert patch(client, upload, iter([data[half : half + 7], data[half + 7 : -9]]), half).status_code == 200
    assert client.get("/api/v1/runs").json()["total"] == 0
    assert patch(client, upload, data[-9:], len(data) - 9).json()["state"] == "verifying"
    (listed,) = client.get(UPLOADS).json()["uploads"]
    assert (listed["state"], listed["name"]) in (("verifying", "mine"), ("stored", "mine"))
    stored = over(client, upload, data, run={"labels": {"tags": ["sent"]}})
    assert (stored["state"], stored["problem"]) == ("stored", "")
    (run,) = client.get("/api/v1/runs").json()["runs"]
    assert (run["run_id"], run["tags"]) == (stored["run_id"], ["sent"])
    assert client.get(UPLOADS).json()["uploads"] == []
    (there,) = list_runs(elsewhere.recordings[0])
    known = {"run_id": there.run_id, "content_digest": there.summary.content_digest}
    again = put(client, upload, data, **known).json()
    assert (again["state"], again["run_id"], again["already"]) == ("stored", there.run_id, True)
    assert client.delete(f"{UPLOADS}/{upload}").status_code == 404
    assert client.get(UPLOADS).json()["uploads"] == []
    assert client.get("/api/v1/runs").json()["total"] == 1


def test_a_refused_run_has_a_message_and_is_not_listed(connect, elsewhere, data):
    client = connect(elsewhere)
    wrong = data[:-1] + b"?"
    upload = begin(client, wrong)
    patch(client, upload, wrong, 0)
    refused = until(
        lambda upload: upload["state"] != "verifying", lambda: client.get(UPLOADS).json()["uploads"][0]
    )
    assert refused["state"] == "refused"
    assert refused["problem"].startswith("the upload: ")
    page = client.get("/queue").text
    assert "refused" in page
    assert "the upload: " in page
    assert client.get("/api/v1/runs").json()["total"] == 0


def test_more_bytes_than_announced_are_refused(connect, elsewhere, data):
    client = connect(replace(elsewhere, limits=ServiceLimits(upload_bytes=100_000)))
    too_large = put(client, "0" * 64, size=100_001)
    assert (too_large.status_code, "100,000" in message(too_large)) == (413, True)
    upload = begin(client, data[:1000])
    assert patch(client, upload, bytes(1001), 0).status_code == 413
    assert patch(client, upload, iter([bytes(900), bytes(200)]), 0).status_code == 413
    assert put(client, upload, data[:1000]).json()["offset"] <= 1000
    undeclared = begin(client)
    assert patch(client, undeclared, (bytes(50_000) for _ in range(3)), 0).status_code == 413
    assert client.put(f"{UPLOADS}/{upload}", content=b"[" + b"0," * 600_000 + b"0]").status_code == 413


@pytest.mark.parametrize(
    "body",
    [
        {"digest": "short"},
        {"size": -1},
        {"size": 1 << 70},
        {"run_id": "x" * 101},
        {"path": "/etc/passwd"},
        {"digest": ["0" * 64]},
    ],
)
def test_an_invalid_announcement_is_refused(connect, elsewhere, body):
    answer = connect(elsewhere).put(f"{UPLOADS}/{'0' * 64}", json=body)
    assert answer.status_code == 422
    assert answer.json()["error"]["problems"][0]["path"].startswith("body.")


def test_invalid_ids_and_offsets_are_refused(connect, elsewhere, data):
    client = connect(elsewhere)
    for odd in ("../../run", "%2e%2e%2fetc", "0" * 32, "0" * 65, "A" * 64, "é" * 64):
        assert client.put(f"{UPLOADS}/{odd}", json={}).status_code in (404, 405, 422)
        assert patch(client, odd, b"x", 0).status_code in (404, 405, 422)
        assert client.delete(f"{UPLOADS}/{odd}").status_code in (404, 405, 422)
    assert client.get(UPLOADS).json()["uploads"] == []
    upload = begin(client, data)
    for offset in ("-1", "1e3", "", "9" * 30):
        assert patch(client, upload, b"x", offset).status_code == 422
    assert client.patch(f"{UPLOADS}/{upload}", content=b"x").status_code == 422
    odd = begin(client, data, run_id="../../../tmp", content_digest=digest(b""))
    assert odd == upload


def test_another_token_has_no_access_to_an_upload(connect, elsewhere, data):
    tokens = Tokens(elsewhere.tokens)
    anna, ben = (tokens.create(name, ("write",))[1] for name in ("anna", "ben"))
    client = connect(elsewhere)
    own = {"Authorization": f"Bearer {anna}"}
    other = {"Authorization": f"Bearer {ben}"}
    body = {"digest": digest(data), "size": len(data)}
    upload = client.put(f"{UPLOADS}/{digest(data)}", json=body, headers=own).json()["id"]
    assert patch(client, upload, data[:7], 0, **own).json()["offset"] == 7
    for headers in (other, {}):
        assert patch(client, upload, data, 0, **headers).status_code == 404
        assert client.delete(f"{UPLOADS}/{upload}", headers=headers).status_code == 404
        assert client.get(UPLOADS, headers=headers).json()["uploads"][0]["id"] == ""
        theirs = client.put(f"{UPLOADS}/{upload}", json=body, headers=headers).json()
        assert (theirs["offset"], theirs["state"]) == (0, "receiving")
    assert patch(client, upload, data[7:], 7, **own).status_code == 200


def test_a_page_of_another_site_cannot_upload(connect, elsewhere, data):
    client = connect(elsewhere, **{"Sec-Fetch-Site": "cross-site", "Origin": "http://evil.example"})
    assert put(client, "0" * 64).status_code == 403
    assert patch(client, "0" * 64, data, 0).status_code == 403

"""Uploads over HTTP: pieces, owners, limits."""

from __future__ import annotations

from dataclasses import replace

import pytest
from blake3 import blake3

from runner.runs.listing import list_runs
from runner.service.settings import Limits
from runner.service.tokens import Tokens

UPLOADS = "/api/v1/uploads"
PIECE = {"Content-Type": "application/octet-stream"}


@pytest.fixture
def data(recorded):
    return list_runs(recorded)[0].recording.read_bytes()


@pytest.fixture
def elsewhere(settings, tmp_path):
    """Return the settings of a service that has no runs yet."""
    return replace(settings, recordings=(tmp_path / "theirs",))


def begin(client, data, **more):
    answer = client.post(UPLOADS, json={"digest": digest(data), "size": len(data)} | more)
    assert answer.status_code in (200, 201), answer.text
    return answer.json()["id"]


def digest(data):
    return blake3(data).hexdigest()


def patch(client, upload, data, offset, **headers):
    all_headers = PIECE | {"Upload-Offset": str(offset)} | headers
    return client.patch(f"{UPLOADS}/{upload}", content=data, headers=all_headers)


def complete(client, upload, data, **more):
    body = {"digest": digest(data), "size": len(data)} | more
    return client.post(f"{UPLOADS}/{upload}/complete", json=body)


def message(answer):
    return answer.json()["error"]["message"]


def test_a_run_is_sent_in_pieces_and_listed_when_it_is_verified(connect, elsewhere, data):
    client = connect(elsewhere)
    upload = begin(client, data, name="mine", run_id="abc")
    half = len(data) // 2
    answer = patch(client, upload, data[:half], 0)
    assert (answer.status_code, answer.json()["offset"]) == (200, half)
    assert client.get(f"{UPLOADS}/{upload}").json()["size"] == len(data)
    answer = patch(client, upload, data[half:], 0)
    assert (answer.status_code, "expected" in message(answer)) == (409, True)
    assert patch(client, upload, iter([data[half : half + 7], data[half + 7 :]]), half).status_code == 200
    assert client.get("/api/v1/runs").json()["total"] == 0
    assert complete(client, upload, data, labels={"tags": ["sent"]}).status_code == 202
    (listed,) = client.get(UPLOADS).json()["uploads"]
    assert (listed["state"], listed["name"]) in (("verifying", "mine"), ("stored", "mine"))
    stored = client.get(f"{UPLOADS}/{upload}", params={"wait": 30}).json()
    assert (stored["state"], stored["problem"]) == ("stored", "")
    (run,) = client.get("/api/v1/runs").json()["runs"]
    assert (run["run_id"], run["tags"]) == (stored["run_id"], ["sent"])
    answer = client.post(UPLOADS, json={"digest": digest(data), "size": len(data)})
    assert (answer.status_code, answer.json()["id"]) == (200, upload)
    assert client.delete(f"{UPLOADS}/{upload}").status_code == 204
    assert client.get(f"{UPLOADS}/{upload}").status_code == 404
    assert client.get("/api/v1/runs").json()["total"] == 1


def test_a_refused_run_has_a_message_and_is_not_listed(connect, elsewhere, data):
    client = connect(elsewhere)
    wrong = data[:-1] + b"?"
    upload = begin(client, wrong)
    patch(client, upload, wrong, 0)
    complete(client, upload, wrong)
    refused = client.get(f"{UPLOADS}/{upload}", params={"wait": 30}).json()
    assert refused["state"] == "refused"
    assert refused["problem"].startswith("the upload: ")
    page = client.get("/queue").text
    assert "refused" in page
    assert "the upload: " in page
    assert client.get("/api/v1/runs").json()["total"] == 0


def test_more_bytes_than_announced_are_refused(connect, elsewhere, data):
    client = connect(replace(elsewhere, limits=Limits(upload_bytes=100_000)))
    too_large = client.post(UPLOADS, json={"size": 100_001})
    assert (too_large.status_code, "100,000" in message(too_large)) == (413, True)
    upload = begin(client, data[:1000])
    assert patch(client, upload, bytes(1001), 0).status_code == 413
    assert patch(client, upload, iter([bytes(900), bytes(200)]), 0).status_code == 413
    assert client.get(f"{UPLOADS}/{upload}").json()["offset"] <= 1000
    undeclared = client.post(UPLOADS, json={}).json()["id"]
    assert patch(client, undeclared, (bytes(50_000) for _ in range(3)), 0).status_code == 413
    assert client.post(UPLOADS, content=b"[" + b"0," * 600_000 + b"0]").status_code == 413


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
    answer = connect(elsewhere).post(UPLOADS, json=body)
    assert answer.status_code == 422
    assert answer.json()["error"]["problems"][0]["path"].startswith("body.")


def test_invalid_ids_and_offsets_are_refused(connect, elsewhere, data):
    client = connect(elsewhere)
    for odd in ("../../run", "%2e%2e%2fetc", "0" * 32, "0" * 33, "é" * 32):
        assert client.get(f"{UPLOADS}/{odd}").status_code in (404, 422)
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
    upload = client.post(UPLOADS, json=body, headers=own).json()["id"]
    for headers in (other, {}):
        assert client.get(f"{UPLOADS}/{upload}", headers=headers).status_code == 404
        assert patch(client, upload, data, 0, **headers).status_code == 404
        assert client.delete(f"{UPLOADS}/{upload}", headers=headers).status_code == 404
        assert client.get(UPLOADS, headers=headers).json()["uploads"][0]["id"] == ""
        assert client.post(UPLOADS, json=body, headers=headers).json()["id"] != upload
    assert patch(client, upload, data, 0, **own).status_code == 200


def test_a_page_of_another_site_cannot_upload(connect, elsewhere, data):
    client = connect(elsewhere, **{"Sec-Fetch-Site": "cross-site", "Origin": "http://evil.example"})
    assert client.post(UPLOADS, json={}).status_code == 403
    assert patch(client, "0" * 32, data, 0).status_code == 403

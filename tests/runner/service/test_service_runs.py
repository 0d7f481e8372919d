"""The list of runs over HTTP equals that of `dualtaxi ls`."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

import runner
from runner.cli import cli


def _ls(recordings, *words):
    result = CliRunner().invoke(cli, ["ls", *words, "--json", "--recordings", str(recordings)])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)["runs"]


def test_the_list_equals_ls(client, recordings):
    answer = client.get("/api/v1/runs")
    assert answer.status_code == 200
    assert answer.json() == {"runs": _ls(recordings), "total": 2, "offset": 0, "limit": 50}


def test_filter_sort_columns_and_paging_equal_ls(client, recordings):
    params = {
        "filter": 'status == "finished"',
        "sort": "-seed",
        "columns": "id,seed",
        "limit": 1,
        "offset": 1,
    }
    page = client.get("/api/v1/runs", params=params).json()
    assert page["runs"] == _ls(
        recordings,
        'status == "finished"',
        "--sort",
        "-seed",
        "--columns",
        "id,seed",
        "--limit",
        "1",
        "--offset",
        "1",
    )
    assert page["total"] == 2
    assert [run["seed"] for run in page["runs"]] == [0]


def test_a_wrong_filter_is_refused_with_a_suggestion(client):
    answer = client.get("/api/v1/runs", params={"filter": "stauts:finished"})
    assert answer.status_code == 400
    assert "Did you mean 'status'?" in answer.json()["error"]["message"]


@pytest.mark.parametrize(
    ("method", "address", "sent", "message"),
    [
        ("GET", "runs?limit=many", {}, "query.limit: found 'many', expected a whole number"),
        ("GET", "runs?limit=-1", {}, "query.limit: found '-1', expected 0 or more"),
        ("GET", "jobs/0", {}, "path.number: found '0', expected 1 or more"),
        ("GET", "runs/first/when", {}, "query.expression: missing"),
        ("GET", "runs/first/stepss/train.arrow", {}, "expected 'steps' or 'episodes'"),
        (
            "POST",
            "jobs?source=a/b",
            {"content": "x"},
            "query.source: found 'a/b', expected the name of a file, without its folder",
        ),
        ("GET", "runs?limt=3", {}, "query.limt: unknown parameter. Did you mean 'limit'?"),
        ("GET", "runs/first/when?expresion=1", {}, "query.expresion: unknown parameter. Did you mean"),
        ("GET", "runs/first/checkpoints?run=first", {}, "query.run: unknown parameter. Known: none"),
        ("POST", "jobs?runs=3", {"content": "x"}, "query.runs: unknown parameter. Known: source, workers"),
        ("POST", "explanations", {"content": "{"}, "body: found a body without the type application/json"),
        ("POST", "explanations", {"json": [1]}, "body: found a list of 1, expected a mapping"),
        ("POST", "explanations", {"json": {"a": 3}}, "body.a: found 3, expected text; body.b: missing"),
        ("POST", "explanations", {"json": {"a": "x", "b": "y", "c": 1}}, "body.c: unknown key"),
    ],
)
def test_an_invalid_parameter_is_named_with_what_was_expected(client, method, address, sent, message):
    answer = client.request(method, f"/api/v1/{address}", **sent)
    assert answer.status_code == 422
    error = answer.json()["error"]
    assert message in error["message"]
    assert error["problems"][0]["path"] == error["message"].partition(":")[0]


def test_a_run_begun_after_the_last_scan_is_found_at_once(client, recordings):
    assert client.get("/api/v1/runs/fresh").status_code == 404
    runner.run({"name": "fresh", "env": {"id": "FrozenLake-v1"}, "episodes": 300}, recordings=recordings)
    assert client.get("/api/v1/runs/fresh").status_code == 200


def test_the_page_of_runs_is_current_after_a_change(client, recordings):
    run = client.get("/api/v1/runs").json()["runs"][0]["run_id"]
    for name in ("once", "twice", "thrice"):
        client.patch(f"/api/v1/runs/{run}", json={"name": name})
        assert f">{name}<" in client.get("/runs").text

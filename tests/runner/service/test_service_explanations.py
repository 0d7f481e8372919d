"""The pages of explanations: listed with the sweeps, and shown with pictures and links."""

from __future__ import annotations

import html
import re
from pathlib import Path

import runner

LAKE = {
    "env": {"id": "FrozenLake-v1", "kwargs": {"is_slippery": False}},
    "episodes": 400,
    "evaluation": {"every": 50, "trials": 5},
    "discount": 0.9,
    "epsilon": 0.0,
}


def test_an_explanation_is_listed_and_shown(client, recordings: Path):
    found = runner.explain(LAKE, LAKE | {"epsilon": 0.9}, seeds=2, workers=1, recordings=recordings)
    listed = client.get("/sweeps").text
    address = f"/sweeps/explanations/{found.name}"
    assert f'href="{address}"' in listed
    shown = client.get(address)
    assert shown.status_code == 200
    assert shown.text.count("<svg") >= 2 + 1 * bool(found.interactions)
    assert "alone makes 100 % of it" in shown.text
    links = [html.unescape(link) for link in re.findall(r'href="(/runs/[^"]+/replay[^"]+)"', shown.text)]
    assert {link.split("/")[2] for link in links} == {found.first_step.run_a, found.first_step.run_b}
    assert [client.get(link).status_code for link in links] == [200, 200]
    assert client.get("/api/v1/explanations").json() == [found.name]
    assert client.get(f"/api/v1/explanations/{found.name}").json()["smallest"]["settings"] == ["epsilon"]


def test_a_missing_or_damaged_explanation_is_named(client, recordings: Path):
    page = {"accept": "text/html"}
    missing = client.get("/sweeps/explanations/none/success_percent", headers=page)
    assert (missing.status_code, "No explanation" in missing.text) == (404, True)
    folder = recordings / ".explain" / "pair"
    folder.mkdir(parents=True)
    (folder / "metric.json").write_text('{"name": "<script>"}')
    damaged = client.get("/sweeps/explanations/pair/metric", headers=page)
    assert damaged.status_code < 500
    assert "no longer describes an explanation" in damaged.text
    assert client.get("/sweeps").status_code == 200
    assert client.get("/api/v1/explanations/pair/metric").status_code == 400
    assert client.get("/api/v1/explanations/pair/other").status_code == 404

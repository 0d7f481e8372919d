"""`when` over HTTP: the API prints what the command prints, and the page links to the replay."""

from __future__ import annotations

import html
import json
import re

import runner
from runner.runs.resolve import find_run
from tests.runner.export.outline import Outline

RUN = "/runs/first"
EXPRESSION = "visits[{state}] >= 2 and max(q[{state}]) < 1000"


def expression_of(recordings):
    """Return an expression that holds somewhere in the middle of the run."""
    run = find_run("first", recordings)
    steps = runner.frames.steps(run, "train")
    state = steps["state"].value_counts().index[0]
    return run, EXPRESSION.format(state=state)


def test_the_api_returns_what_python_does(client, recordings):
    run, expression = expression_of(recordings)
    for query, options in (
        ({}, {}),
        ({"all": "true", "from": "3:0", "to": "step:4000"}, {"first": "3:0", "last": 4000}),
    ):
        found = client.get(f"/api/v1{RUN}/when", params={"expression": expression, **query})
        expected = runner.when(run, expression, every="all" in query, **options).as_json()
        assert found.status_code == 200, found.text
        assert found.json() == json.loads(json.dumps(expected))


def test_the_api_refuses_what_is_wrong_with_a_mark(client):
    answer = client.get(f"/api/v1{RUN}/when", params={"expression": "visist[0] > 1"})
    assert answer.status_code == 400
    assert answer.json()["error"]["message"].endswith("\n  visist[0] > 1\n  ^^^^^^")
    assert client.get(f"/api/v1{RUN}/when").status_code == 422
    assert client.get(f"/api/v1{RUN}/when", params={"expression": "1" * 2000}).status_code == 422
    wrong = {"expression": "step > 1", "from": "99999999"}
    assert client.get(f"/api/v1{RUN}/when", params=wrong).status_code == 404


def test_the_page_answers_with_links_to_the_replay(client, recordings):
    run, expression = expression_of(recordings)
    form = client.get(f"{RUN}/when", headers={"Accept": "text/html"})
    assert form.status_code == 200
    assert 'name="expression"' in form.text
    answer = client.get(f"{RUN}/when", params={"expression": expression, "all": "true"})
    outline = Outline()
    outline.feed(answer.text)
    assert outline.open == []
    first = runner.when(run, expression).first
    replay = f"/runs/{run.run_id}/replay/train/{first.episode}?t={first.t + 1}"
    assert replay in outline.addresses
    assert client.get(replay).status_code == 200
    assert html.escape(expression) in answer.text
    assert f">{first.step:,}</a>" in answer.text


def test_the_page_shows_a_mistake_in_a_fixed_width_and_escapes_it(client):
    answer = client.get(f"{RUN}/when", params={"expression": "q[0] > <b>"}, headers={"Accept": "text/html"})
    assert answer.status_code == 400
    assert "<b>" not in answer.text
    assert re.search(r"<pre>  q\[0\] &gt; &lt;b&gt;\n +\^</pre>", answer.text)
    assert 'value="q[0] &gt; &lt;b&gt;"' in answer.text


def test_a_loop_has_neither_the_page_nor_an_answer(loops_client, loops):
    run = next(run for run in runner.list_runs(loops) if not run.can_train_again)
    assert "When?" not in loops_client.get(f"/runs/{run.run_id}").text
    assert loops_client.get(f"/api/v1/runs/{run.run_id}/when?expression=step>1").status_code == 400

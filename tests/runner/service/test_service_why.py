"""`why` over HTTP: the API returns what Python does, and the page links to the replay."""

from __future__ import annotations

import html
import json

import pytest
from loop_replays import serving

import runner
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.views.tables import WHY
from tests.runner.export.outline import Outline
from tests.runner.recording.making import LAKE, make_run

RUN = "/runs/first"


def question(recordings):
    """Return a run, and the state and the learner's action of its last step."""
    run = find_run("first", recordings)
    with open_recording(run.recording) as recording:
        total = recording.train.steps.count()
        (step,) = next(recording.train.steps.blocks(total - 1, total))
        agent = recording.agents[0]
        joint = len(recording.agents) < len(recording.mdp.agents)
        action = step["action"] if joint else recording.mdp.own_actions[step["action"], 0]
    return run, {"state": int(step["state"]), "action": int(action), "agent": agent}


def test_the_api_returns_what_python_does(client, recordings):
    run, asked = question(recordings)
    for more in ({}, {"limit": 3, "at": "5:2"}):
        answer = client.get(f"/api/v1{RUN}/why", params=asked | more)
        assert answer.status_code == 200, answer.text
        expected = runner.why(run, **asked, **more).as_json()
        assert answer.json() == json.loads(json.dumps(expected))


def test_the_api_refuses_what_is_wrong(client, recordings):
    _, asked = question(recordings)
    for wrong in ({"state": "99999999"}, {"action": "fly"}, {"agent": "nobody"}, {"at": "9999:0"}):
        answer = client.get(f"/api/v1{RUN}/why", params=asked | wrong)
        assert answer.status_code in (400, 404, 409, 422), wrong
        assert "expected" in answer.text or "there are" in answer.text
    assert client.get(f"/api/v1{RUN}/why").status_code == 422
    assert client.get(f"/api/v1{RUN}/why", params=asked | {"limit": 100_001}).status_code == 422


def test_the_page_draws_the_moves_and_links_to_the_replay(client, recordings):
    run, asked = question(recordings)
    form = client.get(f"{RUN}/why")
    assert form.status_code == 200
    assert 'name="state"' in form.text
    answer = client.get(f"{RUN}/why", params=asked)
    outline = Outline()
    outline.feed(answer.text)
    assert outline.open == []
    found = runner.why(run, **asked)
    assert found.picture in answer.text
    assert "not a counterfactual" in answer.text
    episode, _, t = found.steps[0].at.partition(":")
    replay = f"/runs/{run.run_id}/replay/train/{episode}?t={int(t) + 1}"
    assert replay in outline.addresses
    shown = client.get(replay)
    assert shown.status_code == 200
    assert f'data-why="/runs/{run.run_id}/why?at={episode}"' in shown.text


def test_the_page_shows_a_mistake_escaped(client):
    answer = client.get(f"{RUN}/why", params={"state": "<b>", "action": "0"}, headers={"Accept": "text/html"})
    assert answer.status_code == 400
    assert "<b>" not in answer.text
    assert f'value="{html.escape("<b>")}"' in answer.text


@pytest.mark.parametrize("algorithm", ["sarsa_lambda", "n_step_q_learning", "random"])
def test_the_page_of_values_without_an_explanation_has_no_form(tmp_path, algorithm):
    run = make_run(tmp_path, LAKE, algorithm=algorithm)
    with serving(tmp_path) as client:
        form = client.get(f"/runs/{run.run_id}/why")
        asked = client.get(f"/runs/{run.run_id}/why?state=0&action=0")
        refused = client.get(f"/api/v1/runs/{run.run_id}/why?state=0&action=0")
    assert (form.status_code, asked.status_code, refused.status_code) == (200, 400, 400)
    for page in (form, asked):
        outline = Outline()
        outline.feed(page.text)
        assert outline.open == []
        assert "choose a run of an" in page.text
        assert 'name="state"' not in page.text
        assert "weighted sum" not in page.text
        assert "recording.mcap" not in page.text


def test_a_loop_has_neither_the_page_nor_an_answer(loops_client, loops):
    run = next(run for run in runner.list_runs(loops) if not run.can_train_again)
    assert "Why?" not in loops_client.get(f"/runs/{run.run_id}").text
    answer = loops_client.get(f"/api/v1/runs/{run.run_id}/why?state=0&action=0")
    assert answer.status_code == 400
    assert "dualtaxi values" in answer.json()["error"]["message"]


def test_the_page_and_the_api_do_not_share_what_is_cached(client, recordings):
    _, asked = question(recordings)
    assert client.get(f"{RUN}/why", params=asked).status_code == 200
    answer = client.get(
        f"/api/v1{RUN}/why",
        params={name: str(value) for name, value in asked.items()}
        | {"limit": dict(WHY.page_values)["limit"]},
    )
    assert answer.json()["run_id"]

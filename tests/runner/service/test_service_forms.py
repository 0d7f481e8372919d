"""Forms of pages: what they change, and what they refuse."""

from __future__ import annotations

import json
import re
import sys

import gymnasium
import pytest
from checked_pages import ACCEPT_HTML, page_of
from submitted import ICY

import runner
from runner.analysis.episodes import EpisodeRef
from runner.archive.runs import restore_run
from runner.errors import MissingExtra, RunnerError
from runner.export.film import frames_of
from runner.runs.resolve import find_run
from runner.runs.run import label
from runner.service import computed
from runner.service.settings import ServiceSettings
from tests.waiting import until


def test_the_form_describes_the_keys(client):
    config, sweep = page_of(client, "/submit"), page_of(client, "/submit?sweep=true")
    assert "<code>epsilon</code>" in config
    assert "<code>strategy</code>" not in config
    assert re.search("<dd>[^<]*`", config) is None, "code is set as code"
    assert (
        sweep.index("<code>strategy</code>")
        < sweep.index("Keys of its base")
        < sweep.index("<code>epsilon</code>")
    )


def test_labels_are_changed_by_a_form(client):
    fields = {"name": "renamed", "tags": "keep good", "note": "<b>bold</b>\r\nand more"}
    assert client.post("/runs/first/labels", data=fields, follow_redirects=False).status_code == 303
    page = page_of(client, "/runs/renamed")
    assert "&lt;b&gt;bold&lt;/b&gt;\nand more" in page
    assert "filter=%22keep%22%20in%20tags" in page
    assert client.get("/api/v1/runs/renamed").json()["tags"] == ["good", "keep"]
    answer = client.post("/runs/renamed/labels", data=fields | {"tags": "$$"}, headers=ACCEPT_HTML)
    assert answer.status_code == 400
    assert "expected 1 to 64 letters" in answer.text
    assert 'value="$$"' in answer.text  # what was typed stays in the form


def test_mistakes_are_shown_at_their_lines(client):
    text = "name: mistaken\nepisodes: many\nepisode: 3\n"
    answer = client.post("/submit", data={"text": text, "action": "submit"}, headers=ACCEPT_HTML)
    assert answer.status_code == 422
    assert 'data-line="2"' in answer.text
    assert "<pre>episodes: many</pre>" in answer.text
    assert 'data-line="3"' in answer.text
    assert "episodes: many\nepisode: 3" in answer.text
    assert client.get("/api/v1/jobs").json()["total"] == 0


def test_a_form_of_another_site_is_refused(client):
    for act in ("labels", "remove", "archive", "film"):
        answer = client.post(f"/runs/first/{act}", data={}, headers={"Origin": "http://evil.example"})
        assert answer.status_code == 403
    for address in ("/submit", "/queue/1/cancel"):
        answer = client.post(address, data={"text": "name: x"}, headers={"Origin": "http://evil.example"})
        assert answer.status_code == 403


def test_a_job_is_shown_and_cancelled(client):
    text = "name: shown\nmode: cooperative\nepisodes: 1000000\nrecording: {steps: none}\n"
    answer = client.post("/submit", data={"text": text}, headers=ACCEPT_HTML, follow_redirects=False)
    assert answer.headers["location"] == "/queue/1"
    assert "episodes: 1000000" in page_of(client, "/queue/1")
    assert 'class="status' in page_of(client, "/queue")
    assert client.post("/queue/1/cancel", follow_redirects=False).status_code == 303
    assert "cancelled" in page_of(client, "/queue/1")
    assert client.post("/queue/1/cancel", headers=ACCEPT_HTML).status_code == 409


def test_the_page_of_a_finished_job_links_to_its_run_and_requests_no_events(client):
    number = client.post("/api/v1/jobs", content=json.dumps(ICY | {"seeds": [0]})).json()["number"]
    job = until(lambda job: job["state"] == "finished", lambda: client.get(f"/api/v1/jobs/{number}").json())
    page = page_of(client, f"/queue/{number}")
    run_id = job["begun"][0]["run_id"]
    assert f'href="/runs/{run_id}">The run</a>' in page
    assert f'run <a href="/runs/{run_id}">{run_id}</a> started' in page
    assert "started</small>" not in page
    assert "data-live" not in page
    assert re.search(r"ago, finished <time[^>]* data-age>[^<]+</time> ago, took [\d.]+ s<", page)
    place = re.findall(r'data-id="(\d+)"', page)[-1]
    assert client.get(f"/api/v1/jobs/{number}/events?after={place}").status_code == 204


def test_a_run_is_removed_when_its_id_is_typed(client, recordings):
    run = find_run("first", recordings)
    for typed in ("", "first", find_run("second", recordings).run_id):
        answer = client.post("/runs/first/remove", data={"confirm": typed}, headers=ACCEPT_HTML)
        assert (answer.status_code, f"type its id, {run.run_id}" in answer.text) == (400, True)
    label(run, tag=["keep"])
    answer = client.post("/runs/first/remove", data={"confirm": run.run_id}, headers=ACCEPT_HTML)
    assert (answer.status_code, "it is tagged keep" in answer.text) == (400, True)
    label(run, untag=["keep"])
    answer = client.post("/runs/first/remove", data={"confirm": run.run_id}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/runs")
    assert not run.folder.exists()
    assert "1 run" in page_of(client, "/runs")


def test_a_run_of_a_folder_that_is_only_read_is_not_changed(connect, recordings, tmp_path):
    run = find_run("first", recordings)
    client = connect(ServiceSettings((tmp_path / "written", recordings), tokens=tmp_path / "tokens.json"))
    answer = client.post("/runs/first/remove", data={"confirm": run.run_id}, headers=ACCEPT_HTML)
    assert (answer.status_code, "stays" in answer.text) == (400, True)
    answer = client.post("/runs/first/archive", data={"remove": "yes"}, headers=ACCEPT_HTML)
    assert (answer.status_code, "archive it where it was recorded" in answer.text) == (400, True)
    assert run.recording.is_file()
    assert not (recordings.parent / "archive").exists()
    answer = client.post("/runs/first/labels", data={"name": "x"}, headers=ACCEPT_HTML)
    assert (answer.status_code, "change it where it was recorded" in answer.text) == (400, True)
    for address, sent in (("/runs/first/replay/mark", {}), ("/api/v1/runs/first/marks", {"at": "0:1"})):
        answer = client.post(address, data={"at": "0:1"}) if not sent else client.post(address, json=sent)
        assert (answer.status_code, "change it where it was recorded" in answer.text) == (409, True)
    assert client.patch("/api/v1/runs/first", json={"note": "x"}).status_code == 409
    now = find_run("first", recordings)
    assert (now.name, now.marks) == (run.name, run.marks)


def test_a_run_is_archived_and_its_recording_removed_when_the_form_says_so(client, recordings):
    run = find_run("first", recordings)
    digest = run.summary.content_digest
    for data in ({}, {"remove": ""}, {"remove": "no"}):
        assert client.post("/runs/first/archive", data=data, follow_redirects=False).status_code == 303
        assert run.recording.is_file()
    assert "It has an archive" in page_of(client, "/runs/first")
    assert (
        client.post("/runs/first/archive", data={"remove": "yes"}, follow_redirects=False).status_code == 303
    )
    assert not run.recording.exists()
    page = page_of(client, "/runs/first")
    assert f"dualtaxi restore {run.run_id}" in page
    assert "archived" in page_of(client, "/runs")
    assert page_of(client, "/runs/first/replay/train/0"), "its archive is read"
    answer = client.post("/runs/first/archive", data={}, headers=ACCEPT_HTML)
    assert (answer.status_code, "is archived already" in answer.text) == (400, True)
    assert str(recordings.parent) not in answer.text
    assert restore_run(find_run("first", recordings)).summary.content_digest == digest


def test_a_run_that_is_recorded_right_now_is_not_archived(client, recordings):
    with runner.record(gymnasium.make("CartPole-v1"), recordings, name="going") as env:
        env.reset(seed=0)
        answer = client.post("/runs/going/archive", data={}, headers=ACCEPT_HTML)
        assert (answer.status_code, "is running" in answer.text) == (400, True)
        assert "It can be archived when it has ended" in page_of(client, "/runs/going")
        env.step(0)


@pytest.mark.parametrize(("at", "ending"), [("", ".gif"), ("best", ".webm"), ("3:2", ".mp4")])
def test_a_film_of_an_episode_is_downloaded(client, recordings, tmp_path, at, ending):
    answer = client.post("/runs/first/film", data={"at": at, "ending": ending})
    assert answer.status_code == 200, answer.text
    name = f"{find_run('first', recordings).file_stem}{ending}"
    assert answer.headers["content-disposition"] == f"attachment; filename*=utf-8''{name}"
    film = tmp_path / name
    film.write_bytes(answer.content)
    assert len(list(frames_of(film))) > 1


def test_a_film_shows_the_present_name_of_its_run(client):
    fields = {"at": "3:2", "ending": ".gif"}
    before = client.post("/runs/first/film", data=fields).content
    assert client.patch("/api/v1/runs/first", json={"name": "renamed"}).status_code == 200
    renamed = until(lambda answer: answer.is_success, lambda: client.post("/runs/renamed/film", data=fields))
    assert renamed.content != before


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"at": "nothing"}, "expected EPISODE:T"),
        ({"at": "999999"}, "episode"),
        ({"at": "0:999999"}, "step"),
        ({"ending": ".exe"}, "expected one of .mp4"),
        ({"ending": "/../x.mp4"}, "expected one of .mp4"),
    ],
)
def test_a_film_that_cannot_be_made_is_refused_on_the_page(client, fields, reason):
    answer = client.post("/runs/first/film", data={"ending": ".gif"} | fields, headers=ACCEPT_HTML)
    assert (answer.status_code, reason in answer.text) == (400, True), answer.text
    assert "<h1" in answer.text


def test_a_film_of_very_many_steps_is_refused(client, monkeypatch):
    monkeypatch.setattr(computed, "MAX_FILM_STEPS", 0)  # checked before the film is begun
    step = EpisodeRef.parse("3:0")
    with pytest.raises(RunnerError, match=r"found \d+ steps to film, expected at most 0"):
        computed.film(client.app.state.catalogue.find("first").recording, "first", step, ".gif")


def test_a_run_is_filmed_and_archived_by_routes(client, recordings, tmp_path):
    run = find_run("first", recordings)
    answer = client.post("/api/v1/runs/first/film", params={"at": "3:2", "ending": ".gif"})
    assert answer.headers["content-disposition"] == f"attachment; filename*=utf-8''{run.file_stem}.gif"
    film = tmp_path / "film.gif"
    film.write_bytes(answer.content)
    assert len(list(frames_of(film))) > 1
    answer = client.post("/api/v1/runs/first/film", params={"ending": ".exe"})
    assert (answer.status_code, "expected one of .mp4" in answer.text) == (400, True)
    answer = client.post("/api/v1/runs/first/archive", params={"remove": True})
    values = answer.json()
    assert (values["run_id"], values["content_digest"]) == (run.run_id, run.summary.content_digest)
    assert (values["new"], values["removed"]) == (True, True)
    assert "place" not in values
    assert not run.recording.exists()
    answer = client.post("/api/v1/runs/first/archive")
    assert (answer.status_code, "is archived already" in answer.text) == (400, True)


def test_an_archive_and_a_film_name_the_extra_that_they_lack(recordings, monkeypatch):
    run = find_run("first", recordings)
    for module in ("pyarrow", "av"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtra, match=r"an archive needs pyarrow.*\[archive\]"):
        computed.archive(run, remove=False)
    with pytest.raises(MissingExtra, match=r"a film needs .*\[film\]"):
        computed.film(run.recording, run.title, EpisodeRef.parse("best"), ".gif")


def test_a_report_is_downloaded_and_not_shown_as_a_page(client):
    answer = client.get("/api/v1/runs/first/report.html")
    assert answer.headers["content-disposition"].startswith("attachment")
    assert "text/html" not in answer.headers["content-type"]
    assert answer.text.startswith("<!doctype html>")
    assert "http" not in "".join(re.findall(r'(?:src|href)="([^"]*)"', answer.text))


def test_a_report_that_was_made_before_shows_a_new_name_and_marks(client):
    run_id = client.get("/api/v1/runs/first").json()["run_id"]

    def report() -> str:
        return client.get(f"/api/v1/runs/{run_id}/report.html").text

    assert "patient" not in report()
    client.patch(f"/api/v1/runs/{run_id}", json={"name": "patient"})
    assert "patient" in report()
    client.post(f"/api/v1/runs/{run_id}/marks", json={"at": "0:1", "text": "both stuck"})
    assert "both stuck" in report()

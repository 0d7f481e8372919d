"""SQL and marks over HTTP: routes of the API, and pages."""

from __future__ import annotations

import html
import re

import gymnasium
import numpy as np
import pytest
from selenium.webdriver.common.by import By
from served import wait

import runner
from runner.runs.resolve import find_run


class Stranger(gymnasium.Env):
    """An environment of nobody's package, whose rewards are not all finite."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._t = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self._t += 1
        return np.zeros(2, np.float32), np.nan if self._t == 3 else 1.0, self._t == 5, False, {}


def test_the_route_answers_a_query(client, recordings):
    query = "SELECT name, seed FROM runs ORDER BY seed"
    answer = client.get("/api/v1/sql", params={"query": query}).json()
    assert answer == {
        "columns": ["name", "seed"],
        "rows": [["first", 0], ["second", 1]],
        "more": False,
        "left_out": [],
    }
    answer = client.get("/api/v1/sql", params={"query": "FROM steps", "runs": 'name == "first"'}).json()
    assert (len(answer["rows"]), answer["more"]) == (1000, True)
    find_run("second", recordings).recording.write_bytes(b"nothing")
    answer = client.get("/api/v1/sql", params={"query": "SELECT count(*) FROM episodes"}).json()
    assert len(answer["left_out"]) == 1
    assert str(recordings) not in answer["left_out"][0]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("SELECT rewrd FROM steps", "reward"),
        ("COPY runs TO 'x'", "expected one SELECT"),
        ("SELECT * FROM '/etc/passwd'", "does not exist"),
    ],
)
def test_a_wrong_query_is_refused_in_both_forms(client, query, message):
    response = client.get("/api/v1/sql", params={"query": query})
    assert response.status_code == 400
    assert message in response.json()["error"]["message"]
    response = client.get("/sql", params={"query": query})
    assert response.status_code == 400
    assert message in response.text


def test_the_page_shows_what_it_is_asked(client):
    assert "placeholder" in client.get("/sql").text
    text = client.get("/sql", params={"query": "SELECT name, '<b>' AS tag FROM runs"}).text
    assert "2 rows" in text
    assert "&lt;b&gt;" in text
    assert "<b>" not in text


def test_columns_of_a_query_are_shown_as_they_are_whatever_their_names(client):
    text = client.get("/sql", params={"query": "SELECT 1 AS i, 7 AS state, 'a b' AS \"same as\""}).text
    assert "<td>7</td>" in text
    assert '<td class="text">a b</td>' in text


def test_hits_have_pictures_that_take_no_environment(client, recordings):
    with runner.record(Stranger(), recordings, name="own") as rec:
        rec.reset(seed=1)
        while not any(rec.step(1)[2:4]):
            pass
    text = client.get("/find", params={"expression": "length > 0", "limit": 1000}).text
    pictures = [html.unescape(address) for address in re.findall(r'src="(/runs/[^"]+thumbnail[^"]+)"', text)]
    assert 0 < len(pictures) <= 24
    for address in pictures[:3]:
        answer = client.get(address)
        assert (answer.status_code, answer.headers["content-type"]) == (200, "image/svg+xml")
    own = client.get(f"/runs/{rec.run.run_id}/replay/thumbnail?at=0").text
    assert own.count("<polyline") == 1
    assert "g-trail" in client.get("/runs/first/replay/thumbnail?at=eval:10:1").text
    assert client.get("/runs/first/replay/thumbnail?at=99999").status_code == 404
    assert client.get("/runs/first/replay/thumbnail?at=<b>").status_code == 400


def test_the_route_finds_episodes(client, recordings):
    search = {"expression": "length > 0 and count(reward < 0) > 1", "sort": "-length", "limit": 3}
    answer = client.get("/api/v1/find", params=search).json()
    found = runner.find(search["expression"], recordings, sort="-length", limit=3)
    assert answer == found.as_json()
    text = client.get("/find", params=search).text
    for hit in found.hits:
        assert f'<a href="{hit.replay}?found=expression%3D' in text
        assert client.get(hit.replay).status_code == 200
    assert found.sentence in text
    find_run("second", recordings).recording.write_bytes(b"nothing")
    (reason,) = client.get("/api/v1/find", params={"expression": "length > 0"}).json()["left_out"]
    assert str(recordings) not in reason


def test_a_wrong_search_is_refused_in_both_forms(client):
    assert "placeholder" in client.get("/find").text
    search = {"expression": "lenght > 0"}
    response = client.get("/api/v1/find", params=search)
    assert response.status_code == 400
    assert "Did you mean 'length'" in response.json()["error"]["message"]
    response = client.get("/find", params=search)
    assert response.status_code == 400
    assert "lenght" in response.text
    assert client.get("/find", params={"expression": "length > 0", "limit": 1001}).status_code == 422


@pytest.mark.parametrize("address", ["/find", "/runs/first/episodes"])
def test_a_form_names_the_phases_as_pages_do(client, address):
    text = client.get(address, params={"phase": "eval"}).text
    assert '<option value="train">training</option>' in text
    assert '<option value="eval" selected>evaluation</option>' in text


def test_a_limit_of_0_is_the_most_of_a_server(client, recordings):
    every = runner.find("length > 0", recordings, limit=None)
    for path in ("/api/v1/find", "/find"):
        assert client.get(path, params={"expression": "length > 0", "limit": 0}).status_code == 200
    answer = client.get("/api/v1/find", params={"expression": "length > 0", "limit": 0}).json()
    assert len(answer["hits"]) == min(len(every.hits), 1000) > 20
    assert answer["count"] == every.count


def test_marks_are_set_listed_and_removed(client, recordings):
    run = find_run("first", recordings)
    path = f"/api/v1/runs/{run.run_id}/marks"
    (mark,) = client.post(path, json={"at": "3:1", "text": "<i>", "tags": ["stuck"]}).json()["marks"]
    assert client.get(f"/api/v1/runs/{run.run_id}").json()["marks"] == [mark]
    page = client.get("/runs/first/replay/train/3").text
    assert "&lt;i&gt;" in page
    assert "&lt;i&gt;" not in client.get("/runs/first/replay/train/4").text
    assert client.post(path, json={"at": "3:99999"}).status_code == 404
    assert client.post(path, json={"at": "x"}).status_code == 400
    assert client.delete(f"{path}/{mark['mark']}").json()["marks"] == []
    assert client.delete(f"{path}/{mark['mark']}").status_code == 404


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ({"text": "both <stuck>", "tags": "no,tag"}, "1 to 64 letters, digits or any of _ . - = + / @"),
        ({"text": " ", "tags": ""}, "expected a text or tags"),
    ],
)
def test_a_mark_that_is_refused_is_explained_in_the_replay(client, recordings, form, message):
    response = client.post("/runs/first/replay/mark", data={"at": "3:1"} | form)
    assert response.status_code == 400
    assert message in html.unescape(response.text)
    assert "regex" not in response.text
    assert f'value="{html.escape(form["text"])}"' in response.text
    assert 'name="at" value="3:1"' in response.text
    assert find_run("first", recordings).marks == ()


def test_only_a_writer_marks(connect, settings):
    client = connect(settings, Origin="http://elsewhere.example")
    assert client.post("/api/v1/runs/first/marks", json={"at": "3:1"}).status_code == 403
    assert client.post("/runs/first/replay/mark", data={"at": "3:1"}).status_code == 403


def test_a_step_is_marked_by_a_key(page, served_folder):
    run = find_run("first", served_folder)
    runner.mark(run, "3:2", "earlier")
    browser = page("/runs/first/replay/train/3?t=1")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#mark-ticks option[value='2']"))
    browser.find_element(By.CSS_SELECTOR, ".step").send_keys("m")
    field = browser.switch_to.active_element
    assert field.get_attribute("name") == "text"
    field.send_keys("both stuck\n")
    wait(browser, lambda: "both stuck" in browser.find_element(By.ID, "marks").text)
    assert [(mark.at, mark.text) for mark in run.marks] == [("3:1", "both stuck"), ("3:2", "earlier")]
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#mark-ticks option[value='1']"))
    link = browser.find_element(By.CSS_SELECTOR, "[data-mark='2']")
    browser.execute_script("arguments[0].click()", link)
    wait(browser, lambda: browser.find_element(By.CSS_SELECTOR, ".count").text.startswith("step 2 of"))


def test_hits_are_played_one_after_the_other(page, served_folder):
    first, second, _ = (
        hit.replay for hit in runner.find("length > 1", served_folder, sort="length", limit=3).hits
    )
    browser = page("/find?expression=length+>+1&sort=length&limit=3")
    link = browser.find_element(By.CSS_SELECTOR, f'a[href^="{first}?"]')
    browser.get(link.get_attribute("href"))
    wait(browser, lambda: "Hit 1 of 3" in browser.find_element(By.CSS_SELECTOR, "[data-hits]").text)
    browser.execute_script("document.querySelector('.play').click()")
    wait(browser, lambda: f"{second}?" in browser.current_url)
    wait(browser, lambda: "Hit 2 of 3" in browser.find_element(By.CSS_SELECTOR, "[data-hits]").text)
    wait(browser, lambda: "?t=" in browser.current_url and "&found=" in browser.current_url)
    assert browser.find_element(By.LINK_TEXT, "‹ Previous hit").get_attribute("href").count(first)

"""The actions at a step, by the API and in a browser: from the replay to where each leads."""

from __future__ import annotations

import json
import re

import pytest
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from served import wait

import runner
from runner.analysis.episodes import EpisodeRef
from runner.debugging.what_if import branched
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run

AT = "eval:60:1:2"
API = f"/api/v1/runs/first/what-if/{AT}"


def test_the_api_returns_what_python_does(client, recordings):
    run = find_run("first", recordings)
    expected = json.loads(json.dumps(runner.what_if(run, at=AT).as_json()))
    assert client.get(API).json() == expected
    one = client.get(API, params={"action": ["north+east", "3"]}).json()["actions"]
    assert one == [row for row in expected["actions"] if row["name"] in ("north + east", "south + west")]
    with open_recording(run.recording) as recording:
        branch = branched(recording, EpisodeRef.parse(AT), "north + east")
    part = client.get(f"{API}/north + east", params={"start": 1, "steps": 4}).json()["episode"]
    assert part["length"] == branch.outcome.length
    assert [reward for (reward,) in part["reward"]] == branch.steps["rewards"][0:4, 0].tolist()


@pytest.mark.parametrize(
    ("path", "status", "message"),
    [
        ("first/what-if/eval:60:1:9999", 404, "found no step 9,999"),
        ("first/what-if/9999:0", 404, "has no training episode 9,999"),
        ("first/what-if/eval:61:1:2", 404, "found no evaluation after 61"),
        ("first/what-if/eval:60:1:2/nrth", 422, "expected a joint action"),
        ("first/what-if/eval:60:1:2/36", 422, "a number from 0 to 35"),
        ("first/what-if/then", 400, "EPISODE:T"),
        ("pole/what-if/0:0", 400, "runner.branch"),
    ],
)
def test_what_is_not_there_is_explained(client, loops_client, path, status, message):
    own = loops_client if path.startswith("pole") else client
    for address in (f"/api/v1/runs/{path}", f"/runs/{path}"):
        response = own.get(address)
        assert response.status_code == status, address
        assert message in response.text


def test_the_replay_leads_to_every_action_and_each_to_its_episode(page):
    browser = page("/runs/first/replay/eval/60/1?t=0")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".values section, .choice ol"))
    browser.find_element(By.CSS_SELECTOR, ".step").send_keys(Keys.ARROW_RIGHT * 2)
    wait(browser, lambda: browser.find_element(By.CSS_SELECTOR, ".count").text.startswith("step 2 of"))
    browser.find_element(By.PARTIAL_LINK_TEXT, "What if").click()
    wait(browser, lambda: f"/what-if/{AT}" in browser.current_url)
    assert "step 2" in browser.find_element(By.CSS_SELECTOR, "h2").text
    rows = browser.find_elements(By.CSS_SELECTOR, "tbody th a")
    assert len(rows) == len(browser.find_elements(By.CSS_SELECTOR, ".matrix a")) == 36
    other = next(row for row in rows if "recorded" not in row.text)
    name, address = other.text, other.get_attribute("href")
    other.send_keys(Keys.ENTER)  # the page scrolls smoothly, and a click would miss
    wait(browser, lambda: browser.current_url.startswith(address))
    assert browser.find_element(By.CSS_SELECTOR, "#branch h2").text.startswith(f"If {name}")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".choice ol"))
    assert browser.find_element(By.CSS_SELECTOR, ".count").text.startswith("step 2 of")
    browser.find_element(By.CSS_SELECTOR, ".step").send_keys(Keys.ARROW_RIGHT)
    wait(browser, lambda: browser.find_element(By.CSS_SELECTOR, ".count").text.startswith("step 3 of"))
    first, second = name.split(" + ")
    assert f"taxi 1 {first}, taxi 2 {second}" in browser.find_element(By.CSS_SELECTOR, ".caption").text
    browser.find_element(By.CSS_SELECTOR, ".step").send_keys(Keys.HOME)
    wait(browser, lambda: "none yet" in browser.find_element(By.CSS_SELECTOR, ".caption").text)
    wait(browser, lambda: browser.current_url.endswith("?t=0"))


def test_the_last_frame_of_a_replay_asks_for_the_last_step(page, recorded):
    with open_recording(find_run("first", recorded).recording) as recording:
        length = len(recording.train.episode(0))
    browser = page(f"/runs/first/replay/train/0?t={length}")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".choice p"))
    link = browser.find_element(By.PARTIAL_LINK_TEXT, "What if")
    assert link.get_attribute("href").endswith(f"/what-if/0:{length - 1}")


def test_a_loop_has_a_form_instead_of_the_page(loops_client):
    replay = loops_client.get("/runs/pole/replay/train/0").text
    assert "/what-if/" not in replay
    assert re.search(r'href="/runs/\w+/branch\?at=0:0">What if another action were next', replay)


def test_nothing_sticks_out_of_a_narrow_page(page, browser):
    size = {"width": 380, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        page(f"/runs/first/what-if/{AT}")
        wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".choice ol"))
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 380
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})

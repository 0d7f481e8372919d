"""Replays of loops in a real browser, and comparisons of two."""

from __future__ import annotations

import re
import shutil

import gymnasium
import numpy as np
import pytest
from loop_replays import play, serving
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from served import Served, wait

import runner
from runner.runs.resolve import find_run


@pytest.fixture(scope="module")
def served(loops, tmp_path_factory):
    own = shutil.copytree(loops, tmp_path_factory.mktemp("served") / "recordings")
    with Served(own) as server:
        yield server.url
    assert "Traceback" not in server.log.read_text()


def shown_pictures(browser):
    """Return the address of each picture that is shown."""
    return browser.execute_script(
        "return [...document.querySelectorAll('img.frame')]"
        ".filter((image) => image.complete && image.naturalWidth && !image.hidden).map((image) => image.src)"
    )


@pytest.mark.parametrize("name", ["pole", "framed", "game", "poles"])
def test_pictures_appear_and_follow_the_slider(page, name):
    browser = page(f"/runs/{name}/replay/train/1?t=3")
    wait(browser, lambda: shown_pictures(browser))
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".series b"))
    slider = browser.find_element(By.CSS_SELECTOR, ".step")
    before = shown_pictures(browser)
    slider.send_keys(Keys.END)
    wait(browser, lambda: shown_pictures(browser) not in ([], before))
    end = shown_pictures(browser)
    slider.send_keys(Keys.HOME)
    wait(browser, lambda: shown_pictures(browser) not in ([], before, end))
    assert browser.find_element(By.CSS_SELECTOR, ".count").text.startswith("step 0 of")
    cursor = browser.find_element(By.CSS_SELECTOR, ".series .cursor")
    assert cursor.get_attribute("x1") == "0"
    slider.send_keys(Keys.ARROW_RIGHT)
    wait(browser, lambda: cursor.get_attribute("x1") == "1")
    assert "Return so far" in browser.find_element(By.CSS_SELECTOR, ".replay").text
    wait(browser, lambda: browser.current_url.endswith("?t=1"))


def test_what_was_logged_after_the_episode_before_is_not_of_the_first_frame(page):
    browser = page("/runs/pole/replay/train/1?t=0")
    (logged,) = wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".logged tr"))
    assert logged.text == "loss 1 before the first step"


@pytest.mark.parametrize("name", ["pole", "poles"])
def test_the_numbers_of_a_known_environment_have_names(page, name):
    browser = page(f"/runs/{name}/replay/train/1?t=3")
    rows = wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".series"))
    names = " ".join(row.text for row in rows)
    for number in ("cart position", "cart velocity", "pole angle", "pole angular velocity"):
        assert number in names
    assert "[2]" not in names


def test_two_loops_are_played_in_step(page):
    browser = page("/compare/replay?run=pole&run=framed&at=2:1")
    wait(browser, lambda: len(shown_pictures(browser)) == 2)
    slider = browser.find_element(By.CSS_SELECTOR, "[data-together] .step")
    before = shown_pictures(browser)
    slider.send_keys(Keys.ARROW_RIGHT * 3)
    wait(browser, lambda: not set(before) & set(shown_pictures(browser)))
    assert browser.find_element(By.CSS_SELECTOR, "[data-together] .count").text.startswith("step 4 of")


def test_the_environments_of_a_vector_are_played_in_step(page):
    browser = page("/runs/poles/replay/train/1")
    browser.find_element(By.PARTIAL_LINK_TEXT, "side by side").click()
    wait(browser, lambda: len(shown_pictures(browser)) == 3)
    slider = browser.find_element(By.CSS_SELECTOR, "[data-together] .step")
    before = shown_pictures(browser)
    slider.send_keys(Keys.ARROW_RIGHT)
    wait(browser, lambda: before != shown_pictures(browser))
    assert browser.find_element(By.CSS_SELECTOR, "[data-together] .count").text.startswith("step 1 of")
    wait(browser, lambda: browser.current_url.endswith("/environments?t=1"))


def test_the_report_contains_pictures(browser, loops, tmp_path):
    from runner.export.reports.report import render_report

    text, _ = render_report([find_run("pole", loops).recording])
    assert len(text) < 3_000_000
    path = tmp_path / "report.html"
    path.write_text(text, encoding="utf-8")
    browser.get(path.as_uri())
    wait(browser, lambda: shown_pictures(browser))
    before = shown_pictures(browser)
    assert before[0].startswith("data:image/webp")
    browser.find_element(By.CSS_SELECTOR, ".step").send_keys(Keys.END)
    wait(browser, lambda: shown_pictures(browser) not in ([], before))
    assert "What was learned" not in text
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


@pytest.mark.parametrize("name", ["pole", "game", "rooms"])
def test_nothing_sticks_out_of_a_narrow_page(page, browser, name):
    size = {"width": 380, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        page(f"/runs/{name}/replay/train/0")
        wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".values section"))
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 380
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """Return recordings of loops that play alike but for one action, a seed, or the number of episodes."""
    folder = tmp_path_factory.mktemp("pairs") / "recordings"

    def record(name, seed=1, episodes=3, other=None):
        with runner.record(gymnasium.make("CartPole-v1"), folder, name=name) as rec:
            for phase in ("train", "eval"):
                rng = np.random.default_rng(0)
                with rec.phase(phase):
                    for episode in range(episodes):
                        rec.reset(seed=seed if episode == 0 else None)
                        over, t = False, 0
                        while not over:
                            action = int(rng.integers(2)) ^ ((phase, episode, t) == other)
                            *_, terminated, truncated, _ = rec.step(action)
                            over, t = terminated or truncated, t + 1

    record("first")
    record("again")
    record("seeded", seed=2)
    record("trained", other=("train", 2, 5))
    record("tried", other=("eval", 1, 3))
    record("shorter", episodes=2)
    for name in ("lake", "slipped"):
        with runner.record(gymnasium.make("Taxi-v4"), folder, name=name) as rec:
            rec.reset(seed=0)
            for t in range(20):
                rec.step(4 if (name, t) == ("slipped", 7) else t % 4)
    return folder


@pytest.mark.parametrize(
    ("a", "b", "episode", "at"),
    [
        ("first", "again", "Training episode 0", "0:0"),
        ("first", "seeded", "Training episode 0", "0:0"),
        ("first", "trained", "Training episode 2", "2:6"),
        ("trained", "first", "Training episode 2", "2:6"),
        ("first", "tried", "Trial 1 of the evaluation after 3 episodes", "eval:3:1:4"),
        ("shorter", "first", "Training episode 2", "2:1"),
        ("lake", "slipped", "Training episode 0", "0:8"),
    ],
)
def test_two_loops_are_compared_from_where_they_diverge(pairs, tmp_path, a, b, episode, at):
    with serving(pairs) as client:
        page = client.get(f"/compare/replay?run={a}&run={b}").text
        assert f"<h2>{episode}</h2>" in page
        assert f'name="at" value="{at}"' in page
        where = client.get(f"/compare/divergence?run={a}&run={b}").text
        assert ("Both replays at this step" in where) == (b != "again")
        assert (f'at={at.replace(":", "%3A")}"' in where) == (b != "again")


def test_a_branch_is_listed_by_its_parent_and_shown_next_to_it(tmp_path):
    folder = tmp_path / "recordings"
    play(gymnasium.make("CartPole-v1"), folder, "pole")
    run = find_run("pole", folder)
    trained = runner.branch(run, at="2:3", action=0, policy="constant", recordings=folder).run.run_id
    tried = runner.branch(run, at="eval:4:1:2", action=1, policy="constant", recordings=folder).run.run_id
    with serving(folder) as client:
        page = client.get(f"/runs/{run.run_id}/replay/train/2").text
        own = client.get(f"/runs/{trained}/replay/train/0").text
        for branch, at, places in (
            (trained, "2:3", ("train/2", "train/0")),
            (tried, "eval:4:1:2", ("eval/4/1", "eval/0/0")),
        ):
            address = f"/compare/replay?run={run.run_id}&run={branch}&at={at.replace(':', '%3A')}"
            assert address.replace("&", "&amp;") in page
            compared = client.get(address)
            assert compared.status_code == 200
            for name, place in zip((run.run_id, branch), places, strict=True):
                assert f"/api/v1/runs/{name}/replay/{place}" in compared.text
        assert f"Branch of {run.run_id} at 2:3, action 0 (left), then constant" in own
        assert tried not in own
        divergence = client.get(f"/compare/divergence?run={run.run_id}&run={trained}").text
        assert "B is a branch of A, at 2:3, action 0 (left), then constant" in divergence
        assert f"/runs/{run.run_id}/rerun?at=2%3A" in divergence
        assert f"/runs/{trained}/rerun?at=0%3A" in divergence
        for branch, episode, t in ((trained, "2", 3), (tried, "eval:4:1", 2)):
            unplaced = client.get(f"/compare/replay?run={run.run_id}&run={branch}").text
            assert int(re.search(f'name="at" value="{episode}:([0-9]+)"', unplaced)[1]) > t

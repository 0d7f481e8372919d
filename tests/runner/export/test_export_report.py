"""The report: self-contained, readable by machines and people, its replay the recording, in a browser."""

from __future__ import annotations

import json
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

import runner
from runner.analysis.episodes import last_whole_evaluation, ranked
from runner.cli import cli
from runner.drawing.svg import SvgDrawing, trail_points, transform
from runner.environments.naming import agent_actions_in_words, states_in_words
from runner.errors import RunnerError
from runner.export.reports.report import render_report
from runner.integrations.tensorboard import SummaryWriter
from runner.recording.reader import open_recording
from tests.runner.export.outline import Outline, check_page


def report(*words):
    return CliRunner().invoke(cli, ["report", *map(str, words)])


def data_of(page, number=0):
    found = re.search(
        rf'<script type="application/json" id="replay-{number}-data">(.*?)</script>', page, re.DOTALL
    )
    return json.loads(found[1])


def test_a_page_is_whole_needs_no_network_and_is_small(recording, page_of):
    page = page_of(recording.run["name"])
    check_page(page)


def test_replays_are_the_recorded_episodes_best_and_worst_among_them(recording, page_of):
    page = page_of(recording.run["name"])
    episodes = data_of(page)
    titles = [episode["title"] for episode in episodes]
    last = last_whole_evaluation(recording)
    worst, _, best = ranked(recording, "eval", last.start, last.stop)
    assert titles[0] == "Chosen: training episode 7"
    assert any(
        title.startswith(("Best trial", "Typical trial and best")) and best.title in title for title in titles
    )
    assert any("worst trial" in title.lower() and worst.title in title for title in titles)
    steps, words = recording.train.episode_steps(7), states_in_words(recording.mdp)
    shown = episodes[0]
    (state,), (action,) = shown["texts"], shown["actions"]
    states = np.append(steps["state"], steps["next_state"][-1])
    assert [state["values"][i] for i in state["at"]] == words[states].tolist()
    deeds = agent_actions_in_words(recording.mdp)
    assert [action["values"][i] for i in action["at"]] == [deeds[number] for number in steps["action"]]
    assert shown["explored"] == steps["explored"].tolist()
    assert np.allclose(shown["reward"], steps["rewards"])
    if recording.mdp.scene is None:
        assert shown["grid"] is None
    else:
        places = SvgDrawing(recording.mdp.scene).places(recording.mdp, states)
        assert [shown["grid"]["places"][i] for i in shown["grid"]["at"]] == places.reshape(
            len(states), -1
        ).tolist()


def test_q_values_are_those_before_each_step(recording, page_of):
    from runner.replay.tables import tables_at

    data = data_of(page_of(recording.run["name"]))[1]
    steps = recording.train.episode_steps(30)
    for k in (0, len(steps) // 2, len(steps) - 1):
        tables = tables_at(recording, int(steps["step"][k]))
        for table, shown in zip(tables, data["values"], strict=True):
            row = table[steps["state"][k]]
            pairs = shown["rows"][shown["row"][k]]
            assert [value for _, value in pairs] == pytest.approx(
                [row[action] for action, _ in pairs], rel=1e-4
            )
            assert shown["taken"][k] in [action for action, _ in pairs]
            assert max(value for _, value in pairs) == pytest.approx(row.max(), rel=1e-4)


def test_several_runs_are_one_page_with_a_summary(pictured, tmp_path):
    path = tmp_path / "all.html"
    runs = [pictured("rivals"), pictured("rivals", seed=2), pictured("lake")]
    result = report(*(run.recording for run in runs), "-o", path)
    assert result.exit_code == 0, result.output
    page = path.read_text()
    assert "<p>The last evaluation of each run.</p>" in page
    assert all(run.run_id in page for run in runs)
    outline = Outline()
    outline.feed(page)
    assert len(outline.ids) == len(set(outline.ids))


def test_a_run_without_steps_is_shown_without_replay_and_with_a_note(pictured, tmp_path):
    run, path = pictured("lake", recording={"steps": "none"}), tmp_path / "r.html"
    result = report(run.recording, "-o", path)
    assert result.exit_code == 0
    assert "dualtaxi rerecord" in result.stderr
    assert "dualtaxi rerecord" in path.read_text()
    result = report(run.recording, "-o", path, "--force", "--episode", 0)
    assert "rerecord" in result.stderr


def test_a_run_without_any_metric_is_shown_without_curves(pictured):
    run = pictured("lake", evaluation=None, log={"every_steps": 10**6})
    page, _ = render_report([run.recording])
    assert "No metrics were recorded" in page
    assert 'id="replay-0-data"' in page


@pytest.mark.parametrize("share", [0.6, 0.8, 0.95])
def test_an_interrupted_run_is_shown_as_far_as_it_got(pictured, tmp_path, share):
    whole = pictured("taxis").recording
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * share)])
    result = report(cut, "-o", tmp_path / "r.html")
    assert result.exit_code == 0, result.output
    assert "did not finish (interrupted)" in result.stderr
    assert "did not finish (interrupted)" in (tmp_path / "r.html").read_text()


def test_what_is_not_there_is_refused(pictured, tmp_path):
    path = tmp_path / "r.html"
    assert (
        "no training episode 999" in report(pictured("lake").recording, "--episode", 999, "-o", path).stderr
    )
    assert not path.exists()
    path.write_text("mine")
    assert "--force" in report(pictured("lake").recording, "-o", path).stderr
    assert path.read_text() == "mine"


def test_names_cannot_break_out_of_the_page(pictured):
    from runner.export.reports.rendering import embedded

    assert "</script>" not in embedded({"a": "</script><b>"})
    assert json.loads(embedded({"a": "</script>\u2028"})) == {"a": "</script>\u2028"}


# --- in a browser -------------------------------------------------------------------------------------


@pytest.fixture
def opened(browser, page_of, tmp_path):
    """Return a function that opens the report of a world's run in the browser."""

    def open_report(world: str):
        path: Path = tmp_path / f"{world}.html"
        path.write_text(page_of(world), encoding="utf-8")
        browser.get(path.as_uri())
        return browser

    yield open_report
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def places_of(browser):
    groups = browser.find_elements(By.CSS_SELECTOR, "[data-thing]")
    return {int(group.get_attribute("data-thing")): group.get_attribute("transform") for group in groups}


@pytest.mark.parametrize("world", ["taxis", "rivals", "taxi", "lake", "cliff"])
def test_the_slider_is_moved_by_keys_and_shows_the_recorded_frames(opened, pictured, world):
    driver = opened(world)
    with open_recording(pictured(world).recording) as recording:
        mdp, words = recording.mdp, states_in_words(recording.mdp)
        last = last_whole_evaluation(recording)
        _, typical, _ = ranked(recording, "eval", last.start, last.stop)
        steps = recording.eval.episode_steps(typical.number_in(recording))
    states = np.append(steps["state"], steps["next_state"][-1])
    places = SvgDrawing(mdp.scene).places(mdp, states)
    choose = Select(driver.find_element(By.CSS_SELECTOR, ".episode"))
    choose.select_by_index(next(i for i, o in enumerate(choose.options) if "ypical trial" in o.text))
    slider = driver.find_element(By.CSS_SELECTOR, ".step")
    keys = [(Keys.ARROW_RIGHT, 1), (Keys.ARROW_RIGHT, 2), (Keys.PAGE_DOWN, 12), (Keys.ARROW_LEFT, 11)]
    for key, wanted in [*keys, (Keys.END, 10_000), (Keys.HOME, 0)]:
        slider.send_keys(key)
        k = int(slider.get_attribute("value"))
        assert k == min(wanted, len(steps)) or len(steps) < 12
        assert places_of(driver) == {i: transform(place) for i, place in enumerate(places[k])}
        text = driver.find_element(By.CSS_SELECTOR, ".caption").text
        assert words[states[k]] in text.replace("\n", " ")
        assert slider.get_attribute("aria-valuetext") == f"step {k} of {len(steps)}"
        for mover in SvgDrawing(mdp.scene).movers:
            trail = driver.find_element(By.CSS_SELECTOR, f'[data-trail="{mover}"]').get_attribute("points")
            assert trail == trail_points(places[: k + 1, mover])


def test_the_space_bar_plays_and_pauses(opened):
    driver = opened("taxis")
    slider = driver.find_element(By.CSS_SELECTOR, ".step")
    button = driver.find_element(By.CSS_SELECTOR, ".play")
    slider.send_keys(Keys.SPACE)
    assert button.get_attribute("aria-label") == "Pause"
    slider.send_keys(Keys.SPACE)
    assert button.get_attribute("aria-label") == "Play"


def test_without_a_scene_steps_are_shown_as_text(opened):
    driver = opened("corridor")
    slider = driver.find_element(By.CSS_SELECTOR, ".step")
    slider.send_keys(Keys.ARROW_RIGHT)
    text = driver.find_element(By.CSS_SELECTOR, ".replay").text
    assert re.search(r"State\s+state \d", text)
    assert re.search(r"Last action\s+action \d", text)


@pytest.mark.parametrize("width", [360, 1280])
def test_nothing_sticks_out_of_the_page(opened, width):
    driver = opened("rivals")
    metrics = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    driver.refresh()
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_its_ground(opened, scheme):
    """Contrast of at least 4.5 to 1, as WCAG 2 wants it (level AA)."""
    driver = opened("lake")
    features = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", features)
    for selector in ("body", ".description", ".hint", "nav a", ".caption dt", "caption", "footer"):
        colours = driver.execute_script(
            "let e = document.querySelector(arguments[0]), ink = getComputedStyle(e).color, ground;"
            "do { ground = getComputedStyle(e).backgroundColor; e = e.parentElement }"
            "while (e && ground === 'rgba(0, 0, 0, 0)'); return [ink, ground]",
            selector,
        )
        light, dark = sorted((_luminance(colour) for colour in colours), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 4.5, (selector, colours)
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def _luminance(colour: str) -> float:
    parts = [int(part) / 255 for part in re.findall(r"\d+", colour)[:3]]
    linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


def test_controls_and_pictures_have_names_for_screen_readers(opened):
    driver = opened("rivals")
    tree = driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    shown = [node for node in tree if not node.get("ignored")]
    for role in ("slider", "button", "combobox", "image", "table", "link", "region"):
        nodes = [node for node in shown if node["role"]["value"] == role]
        assert nodes, role
        assert all(node["name"]["value"] for node in nodes), role


def test_a_loop_without_evaluations_is_introduced_by_its_last_episodes(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, seed=1) as env:
        env.action_space.seed(1)
        env.reset(seed=1)
        for _ in range(100):
            if any(env.step(env.action_space.sample())[2:4]):
                env.reset()
    page, _ = render_report([env.run.recording])
    recent = env.run.summary.recent_training
    expected = f"The last {recent.episodes} training episodes returned {recent.mean_return:.1f} on average"
    assert expected in " ".join(page.split())


def test_a_run_of_values_alone_is_introduced_as_such(tmp_path):
    with SummaryWriter(
        str(tmp_path / "runs" / "values"), recordings=tmp_path / "made", monitor_gym=False
    ) as writer:
        writer.add_scalar("loss", 0.5, 1)
    page, _ = render_report([writer.run.recording])
    assert "Logged values, recorded by" in page
    assert "over <b>none" not in page


def test_a_report_needs_a_run():
    with pytest.raises(RunnerError, match="found no runs"):
        render_report([])

"""The pages in a browser: a configuration submitted, watched, replayed, compared, and opened in Rerun."""

from __future__ import annotations

import csv
import re
import shutil
import urllib.request

import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select
from served import Served, wait

import runner
from runner.drawing.svg import SvgDrawing, transform
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run

CONFIG = """\
name: asked
mode: cooperative
episodes: {episodes}
env: {{kwargs: {{max_episode_steps: 60}}}}
seed: 7
evaluation: {{every: 60, trials: 4}}
"""
PAGES = (
    "/runs",
    "/runs/first",
    "/runs/first/replay",
    "/runs/first/episodes",
    "/runs/first/evaluations",
    "/runs/first/learned",
    "/runs/first/config",
    "/runs/first/system",
    "/runs/first/console",
    "/compare?run=first&run=second",
    "/compare/divergence?run=first&run=second",
    "/compare/replay?run=first&run=second",
    "/compare/tables?run=first&run=second",
    "/sweeps",
    "/queue",
    "/submit",
    "/disk",
)


@pytest.fixture(scope="module")
def folder(recorded, tmp_path_factory):
    return shutil.copytree(recorded, tmp_path_factory.mktemp("served") / "recordings")


@pytest.fixture(scope="module")
def served(folder):
    """Return the address of a service in a process of its own."""
    with Served(folder) as server:
        yield server.url
    assert "Traceback" not in server.log.read_text()


def text_of(browser, selector):
    return browser.find_element(By.CSS_SELECTOR, selector).text


def test_a_mistake_is_shown_at_its_line_then_a_job_is_submitted_and_watched(page, folder):
    browser = page("/submit")
    field = browser.find_element(By.ID, "text")
    field.clear()
    field.send_keys(CONFIG.format(episodes="-5"))
    wait(browser, lambda: "Line 3" in text_of(browser, "#problems"))
    assert "episodes: -5" in text_of(browser, "#problems pre")
    browser.find_element(By.CSS_SELECTOR, "#problems a").click()
    selected = browser.execute_script(
        "let t = arguments[0]; return t.value.slice(t.selectionStart, t.selectionEnd)", field
    )
    assert selected == "episodes: -5"
    field.clear()
    field.send_keys(CONFIG.format(episodes=180))
    wait(browser, lambda: "1 run" in text_of(browser, "#valid"))
    browser.find_element(By.CSS_SELECTOR, "button[value=submit]").click()
    wait(browser, lambda: "/queue/" in browser.current_url)
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".titled .finished"))
    browser.find_element(By.CSS_SELECTOR, ".runs a").click()
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "#status"))
    assert find_run("asked", folder).run_id in browser.current_url
    assert "180" in text_of(browser, "#status")


def test_metrics_are_drawn_and_zoomed_and_the_address_follows(page):
    browser = page("/runs/first")
    wait(browser, lambda: len(browser.find_elements(By.CSS_SELECTOR, ".uplot canvas")) > 3)
    assert "as reported" in text_of(browser, ".plots > p")
    browser.find_element(By.NAME, "from").send_keys("10")
    browser.find_element(By.NAME, "to").send_keys("40" + Keys.ENTER)
    wait(browser, lambda: "from=10&to=40" in browser.current_url)
    browser.refresh()
    assert browser.find_element(By.NAME, "to").get_attribute("value") == "40"


def test_charts_are_pinned_hidden_and_downloaded(page, tmp_path):
    browser = page("/runs/first")
    browser.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)}
    )

    def titles():
        return [title.text for title in browser.find_elements(By.CSS_SELECTOR, ".plots figcaption b")]

    def click(name):
        offered = browser.find_element(By.CSS_SELECTOR, f"[aria-label='{name}']")
        browser.execute_script("arguments[0].click()", offered)

    try:
        wait(browser, lambda: len(titles()) > 3)
        all_titles = titles()
        click(f"Pin: {all_titles[2]}")
        wait(browser, lambda: titles()[0] == all_titles[2])
        click(f"Hide: {all_titles[0]}")
        wait(browser, lambda: all_titles[0] not in titles())
        browser.refresh()
        wait(browser, lambda: len(titles()) == len(all_titles) - 1)
        assert titles()[0] == all_titles[2]
        browser.find_element(By.CSS_SELECTOR, "[data-hidden] button").click()
        wait(browser, lambda: all_titles[0] in titles())
        click(f"CSV: {all_titles[0]}")
        click(f"SVG: {all_titles[0]}")
        table = wait(browser, lambda: [*tmp_path.glob("*.csv")])[0].read_text()
        head, *rows = csv.reader(table.splitlines())
        assert (head[0], len(rows)) == ("episodes", len({row[0] for row in rows}))
        assert all(float(row[1]) >= 0 for row in rows)
        assert wait(browser, lambda: [*tmp_path.glob("*.svg")])[0].read_text().count("<svg") == 1
    finally:
        browser.execute_script("localStorage.clear()")


def test_a_run_is_filmed_and_archived_from_its_page(page, folder, tmp_path):
    browser = page("/runs/second")
    behavior = {"behavior": "allow", "downloadPath": str(tmp_path)}
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", behavior)

    def press(section, tag):
        browser.execute_script("arguments[0].click()", section.find_element(By.TAG_NAME, tag))

    film, archive = (
        browser.find_element(By.XPATH, f"//details[summary='{summary}']")
        for summary in ("Make a film", "Archive this run")
    )
    wait(browser, film.is_displayed)  # the charts above it are drawn
    press(film, "summary")
    film.find_element(By.NAME, "at").send_keys("best")
    Select(film.find_element(By.NAME, "ending")).select_by_visible_text("GIF")
    press(film, "button")
    file = wait(browser, lambda: [*tmp_path.glob("*.gif")])[0]
    assert file.read_bytes().startswith(b"GIF8")
    press(archive, "button")
    wait(browser, lambda: "It has an archive" in browser.page_source)
    assert (folder.parent / "archive" / find_run("second", folder).run_id).is_dir()
    browser = page("/runs/second/replay/eval/60/1")
    press(browser.find_element(By.CSS_SELECTOR, ".replay .onward:has(button)"), "button")
    assert wait(browser, lambda: [*tmp_path.glob("*.mp4")])[0].read_bytes()[4:8] == b"ftyp"


def test_what_was_learned_is_shown_in_a_situation_that_is_chosen(page):
    browser = page("/runs/first/learned")
    fields = browser.find_elements(By.NAME, "state")
    assert "passenger at Y" not in text_of(browser, ".maps ~ p")
    for field, text in zip(
        fields, ("taxi 1 (0,0)", "taxi 2 (3,3)", "passenger at Y", "destination G"), strict=True
    ):
        Select(field).select_by_visible_text(text)
    browser.find_element(By.XPATH, "//button[text()='Show this situation']").click()
    wait(browser, lambda: "taxi 2 (3,3), passenger at Y, destination G" in text_of(browser, "main"))
    assert Select(browser.find_elements(By.NAME, "state")[2]).first_selected_option.text == "passenger at Y"


def test_the_legend_of_a_plot_distinguishes_lines_and_shows_values(page):
    browser = page("/compare?run=first&run=second")
    wait(browser, lambda: len(browser.find_elements(By.CSS_SELECTOR, ".uplot canvas")) > 3)
    looks = browser.execute_script(
        """return [...document.querySelectorAll(".plots figure")].map((figure) =>
            [...figure.querySelectorAll(".key line")].map((line) =>
                [line.getAttribute("stroke"), line.getAttribute("stroke-dasharray")].join(" ")))"""
    )
    assert max(map(len, looks)) >= 4
    assert all(len(set(lines)) == len(lines) for lines in looks)
    assert "--" not in text_of(browser, ".plots")
    plot = browser.find_element(By.CSS_SELECTOR, ".u-over")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", plot)
    ActionChains(browser).move_to_element(plot).perform()
    wait(browser, lambda: re.search(r"training episodes \d", text_of(browser, ".key")))
    entry = browser.find_element(By.CSS_SELECTOR, ".key button")
    entry.click()
    assert entry.get_attribute("aria-pressed") == "false"


def set_field(browser, name, value):
    browser.execute_script(
        """const field = document.querySelector(`[name=${arguments[0]}]`);
        if (field.type === "checkbox") field.checked = arguments[1]; else field.value = arguments[1];
        field.dispatchEvent(new Event("input", {bubbles: true}));
        field.dispatchEvent(new Event("change", {bubbles: true}));""",
        name,
        value,
    )


def test_axis_smoothing_and_logarithmic_scales_are_chosen_and_kept_in_the_address(page):
    browser = page("/runs/first")
    wait(browser, lambda: len(browser.find_elements(By.CSS_SELECTOR, ".uplot canvas")) > 3)
    assert "axis=" not in browser.current_url
    set_field(browser, "axis", "steps")
    wait(browser, lambda: "axis=steps" in browser.current_url)
    set_field(browser, "smooth", "5")
    wait(browser, lambda: "5 % of the axis" in text_of(browser, "form.zoom"))
    set_field(browser, "log_y", True)
    wait(browser, lambda: "log_y=1" in browser.current_url)
    caption = "no value is positive in"  # returns of the taxis are negative
    wait(browser, lambda: caption in text_of(browser, ".plots > p"))
    browser.refresh()
    wait(browser, lambda: caption in text_of(browser, ".plots > p"))
    assert browser.find_element(By.NAME, "axis").get_attribute("value") == "steps"
    plot = browser.find_element(By.CSS_SELECTOR, ".u-over")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", plot)
    ActionChains(browser).move_to_element(plot).perform()
    wait(browser, lambda: re.search(r"training steps \d", text_of(browser, ".key")))


def test_seeds_are_one_line_and_single_runs_are_drawn_on_request(page, folder):
    config = {"name": "several", "env": {"id": "FrozenLake-v1"}, "episodes": 60, "seeds": [0, 1, 2, 3]}
    runs = list(runner.run_all(config | {"evaluation": {"every": 20, "trials": 5}}, recordings=folder))
    browser = page("/compare?run=first&" + "&".join(f"run={run.run_id}" for run in runs))
    wait(browser, lambda: "B, C, D, E: several" in text_of(browser, ".key"))
    looks = "return [...document.querySelectorAll('.legend .swatch')].map((one) => one.className)"
    first, *others = browser.execute_script(looks)
    assert first not in others
    assert len(set(others)) == 1
    set_field(browser, "lines", True)
    wait(browser, lambda: "D: several" in text_of(browser, ".key").split("B, C, D, E: several")[0])


def test_a_narrow_screen_shows_the_open_tab_the_results_and_both_sides(page):
    browser = page("/runs")
    size = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        for address, selector in (
            ("/runs", "tbody .status"),
            ("/runs", "thead th:nth-of-type(8)"),
            ("/runs/first/config", ".tabs [aria-current]"),
            ("/compare?run=first&run=second", "#results-title ~ .scroll td:last-child"),
        ):
            shown = page(address).find_element(By.CSS_SELECTOR, selector)
            box = browser.execute_script("return arguments[0].getBoundingClientRect().toJSON()", shown)
            assert box["width"] > 0, selector
            assert 0 <= box["left"] < box["right"] <= 390, selector
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_thinned_curves_say_so_and_are_read_again_where_one_zooms(page, folder):
    runner.run(
        {
            "name": "long",
            "env": {"id": "FrozenLake-v1"},
            "episodes": 1600,
            "log": {"every_steps": 5},
            "evaluation": {"every": 1600, "trials": 2},
        },
        recordings=folder,
    )
    browser = page("/runs/long")
    wait(browser, lambda: "Thinned: of up to" in text_of(browser, ".plots > p"))
    assert ", thinned" in text_of(browser, ".plots")
    plot = browser.find_element(By.CSS_SELECTOR, ".u-over")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})", plot)
    drag = ActionChains(browser).move_to_element_with_offset(plot, -40, 0).click_and_hold()
    drag.move_by_offset(2, 0).move_by_offset(10, 0).release().perform()
    wait(browser, lambda: "as reported" in text_of(browser, ".plots > p"))
    assert "from=" in browser.current_url
    ActionChains(browser).double_click(browser.find_element(By.CSS_SELECTOR, ".u-over")).perform()
    wait(browser, lambda: "Thinned" in text_of(browser, ".plots > p"))


@pytest.mark.parametrize(("address", "phase", "number"), [("train/7", "train", 7), ("train/59", "train", 59)])
def test_any_episode_is_scrubbed_and_each_step_has_an_address(page, folder, address, phase, number):
    browser = page(f"/runs/first/replay/{address}?t=2")
    with open_recording(find_run("first", folder).recording) as recording:
        mdp = recording.mdp
        steps = recording.phase(phase).episode_steps(number)
    states = np.append(steps["state"], steps["next_state"][-1])
    places = SvgDrawing(mdp.scene).places(mdp, states)
    slider = browser.find_element(By.CSS_SELECTOR, ".step")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".choice ol"))

    def shown():
        groups = browser.find_elements(By.CSS_SELECTOR, "[data-thing]")
        return {int(group.get_attribute("data-thing")): group.get_attribute("transform") for group in groups}

    def drawn(k):
        return {thing: transform(place) for thing, place in enumerate(places[k])}

    assert shown() == drawn(2)
    for key, k in (
        (Keys.ARROW_RIGHT, 3),
        (Keys.PAGE_DOWN, 13),
        (Keys.END, len(steps)),
        (Keys.HOME, 0),
        (Keys.ARROW_RIGHT, 1),
    ):
        slider.send_keys(key)
        wait(browser, lambda k=k: shown() == drawn(min(k, len(steps))))
    wait(browser, lambda: browser.current_url.endswith("?t=1"))


def test_a_replay_has_the_space_of_its_picture_and_facts_before_scripts_run(page, served):
    with urllib.request.urlopen(f"{served}/runs/first/replay/train/7?t=2") as answer:
        html = answer.read().decode()
    assert 'data-thing="0"' in html
    assert "dualtaxi play" in html
    browser = page("/runs/first/replay/train/7?t=2")
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".choice ol"))
    height = "return arguments[0].getBoundingClientRect().height"
    caption = browser.find_element(By.CSS_SELECTOR, ".caption")
    filled = browser.execute_script(height, caption)
    browser.execute_script("arguments[0].replaceChildren()", caption)
    assert browser.execute_script(height, caption) == filled


def test_two_runs_are_chosen_in_the_table_and_replayed_in_step(page):
    browser = page("/runs?filter=name in ('first', 'second')")
    for box in browser.find_elements(By.NAME, "run"):
        box.click()
    browser.find_element(By.CSS_SELECTOR, "[data-compare]").click()
    wait(browser, lambda: "/compare?" in browser.current_url)
    assert "seed" in text_of(browser, "[aria-label='Settings that differ']")
    browser.find_element(By.LINK_TEXT, "Replays in step").click()
    wait(browser, lambda: len(browser.find_elements(By.CSS_SELECTOR, ".choice ol")) == 2)
    slider = browser.find_element(By.CSS_SELECTOR, "[data-together] .step")
    before = slider.get_attribute("value")
    slider.send_keys(Keys.ARROW_RIGHT)
    wait(browser, lambda: slider.get_attribute("value") == str(int(before) + 1))
    assert f"step {int(before) + 1} of" in text_of(browser, "[data-together] .count")


def test_a_step_is_opened_in_rerun(page, folder):
    pytest.importorskip("rerun")
    browser = page("/runs/first/replay/train/7?t=3")
    wait(
        browser,
        lambda: "at=7:2" in browser.find_element(By.CSS_SELECTOR, "[data-step=last]").get_attribute("href"),
    )
    browser.find_element(By.CSS_SELECTOR, "[data-step=last]").click()
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, "iframe.viewer"))
    browser.switch_to.frame(browser.find_element(By.CSS_SELECTOR, "iframe.viewer"))
    wait(browser, lambda: browser.execute_script("return document.body.dataset.opened"), 240)
    with open_recording(find_run("first", folder).recording) as recording:
        step = recording.train.episode_steps(7)[2]
    opened = browser.execute_script(
        "return [document.body.dataset.opened, document.getElementById('message').hidden]"
    )
    assert opened == [str(int(step["log_time"]) // 100_000_000), True]
    browser.switch_to.default_content()


SHIFTED = """
const done = arguments[0];
new PerformanceObserver((list) => done(list.getEntries().reduce((sum, { value }) => sum + value, 0)))
  .observe({ type: "layout-shift", buffered: true });
setTimeout(done, 500, 0);
"""
"""Returns by how much what is in sight of a page has moved, as a browser measures it; 0.1 is too much."""


@pytest.mark.parametrize("address", ["/runs/first", "/runs/first/replay", "/compare?run=first&run=second"])
def test_nothing_in_sight_moves_while_parts_of_a_page_arrive(page, address):
    browser = page(address)
    wait(browser, lambda: browser.find_elements(By.CSS_SELECTOR, ".u-over, .choice li"))
    wait(browser, lambda: not browser.find_elements(By.CSS_SELECTOR, "[aria-busy]"))
    assert browser.execute_async_script(SHIFTED) < 0.02


@pytest.mark.parametrize("width", [400, 1400])
def test_nothing_sticks_out_of_any_page(page, browser, width):
    size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    for address in PAGES:
        page(address)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width, address
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_a_narrow_comparison_cuts_no_word(page, browser):
    size = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page("/compare?run=first&run=second")
    lines = browser.execute_script(
        """
        const cells = [...document.querySelectorAll(".against tbody td")];
        return cells.filter((cell) => !/\\s/.test(cell.textContent)).map((cell) => {
          const words = document.createRange();
          words.selectNodeContents(cell);
          return words.getClientRects().length;
        })"""
    )
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert set(lines) == {1}


def test_everything_has_a_name_and_text_stands_out(page):
    """Names for screen readers; contrast of at least 4.5 to 1, as WCAG 2 wants it (level AA)."""
    for address in PAGES:
        browser = page(address)
        tree = browser.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
        for node in tree:
            if not node.get("ignored") and node["role"]["value"] in (
                "button",
                "link",
                "slider",
                "textbox",
                "combobox",
                "checkbox",
                "table",
            ):
                named = node.get("name", {}).get("value") or node["role"]["value"] == "table"
                assert named, (address, node["role"]["value"], node.get("properties"))
        for scheme in ("light", "dark"):
            features = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", features)
            for selector in ("body", ".soft", ".hint", ".bar nav a", ".tabs a", "button", "dt", ".status"):
                for colours in browser.execute_script(COLOURS, selector):
                    light, dark = sorted((luminance(colour) for colour in colours[:2]), reverse=True)
                    assert (light + 0.05) / (dark + 0.05) >= 4.5, (address, scheme, selector, colours)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


COLOURS = """
const shown = [...document.querySelectorAll(arguments[0])].filter((e) => e.offsetParent && !e.disabled);
return shown.slice(0, 5).map((e) => {
  const ink = getComputedStyle(e).color;
  let ground;
  do { ground = getComputedStyle(e).backgroundColor; e = e.parentElement }
  while (e && ground === 'rgba(0, 0, 0, 0)');
  return [ink, ground];
});
"""


def luminance(colour):
    parts = [int(part) / 255 for part in re.findall(r"\d+", colour)[:3]]
    linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

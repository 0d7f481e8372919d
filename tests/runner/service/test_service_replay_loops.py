"""Episodes of loops in pages: their values, their pictures, and what cannot be shown, with the reason."""

from __future__ import annotations

import asyncio
import io
import re
import shutil
import struct
import sys
import time
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from PIL import Image
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait
from served import Served
from starlette.testclient import TestClient

import runner
from runner.recording.reader import open_recording
from runner.replay.environment import redo_in_child
from runner.runs.resolve import find_run
from runner.service.app import create_app
from runner.service.errors import Busy
from runner.service.pictures import MAX_STREAMS, PictureStreams
from runner.service.settings import Settings
from tests.runner.loops.making import Rooms

SECONDS = 60


def play(env, folder, name, episodes=4, **options):
    with runner.record(env, folder, name=name, seed=1, **options) as rec:
        rng = np.random.default_rng(0)
        for episode in range(episodes):
            rec.reset(seed=1 if episode == 0 else None)
            over = False
            while not over:
                if rec.action_space.__class__ is gymnasium.spaces.Discrete:
                    action = int(rng.integers(rec.action_space.n))
                else:
                    action = rec.action_space.sample()
                *_, terminated, truncated, _ = rec.step(action)
                over = terminated or truncated
            rec.log("loss", 1 / (episode + 1))
        with rec.phase("eval"):
            for trial in range(3):
                rec.reset(seed=100 + trial)
                over = False
                while not over:
                    *_, terminated, truncated, _ = rec.step(rec.action_space.sample())
                    over = terminated or truncated


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loops") / "recordings"
    play(gymnasium.make("CartPole-v1"), folder, "pole")
    play(gymnasium.make("CartPole-v1", render_mode="rgb_array"), folder, "framed", frames_every=3)
    play(Rooms(with_text=True), folder, "rooms")
    with runner.record_vector(
        SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3), folder, name="poles"
    ) as rec:
        rec.reset(seed=0)
        for _ in range(120):
            rec.step(rec.action_space.sample())
    from mpe2 import simple_spread_v3

    with runner.record_parallel(simple_spread_v3.parallel_env(max_cycles=12), folder, name="game") as rec:
        for episode in range(2):
            rec.reset(seed=episode)
            while rec.agents:
                rec.step({agent: rec.action_space(agent).sample() for agent in rec.agents})
    return folder


@pytest.fixture(scope="module")
def client(folder, tmp_path_factory):
    settings = Settings(recordings=(folder,), tokens=tmp_path_factory.mktemp("tokens") / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:
        yield client


def part(client, address, **query):
    answer = client.get(f"/api/v1/runs/{address}", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()["episode"]


def pictures(client, address, notes=None, **query):
    """Return the pictures of a stream, and the reason why there are no more; collect its notes."""
    notes = [] if notes is None else notes
    answer = client.get(f"/api/v1/runs/{address}/pictures", params=query)
    assert answer.status_code == 200, answer.text
    data, found = answer.content, []
    while data:
        (length,) = struct.unpack_from(">I", data)
        if length == 2**32 - 1:
            return found, data[4:].decode()
        if length == 2**32 - 2:
            (length,) = struct.unpack_from(">I", data, 4)
            notes.append(data[8 : 8 + length].decode())
            data = data[8 + length :]
            continue
        found.append(data[4 : 4 + length])
        data = data[4 + length :]
    return found, ""


def page(client, address, status=200):
    answer = client.get(address, headers={"Accept": "text/html"})
    assert answer.status_code == status, answer.text
    return answer.text


def taken(words):
    return [words["values"][i] for i in words["at"]]


def steps_of(folder, name, phase, episode):
    with open_recording(find_run(name, folder).recording) as recording:
        return recording.episode_steps(phase, episode)


@pytest.mark.parametrize(
    ("address", "phase", "episode"),
    [("train/0", "train", 0), ("train/3", "train", 3), ("eval/4/2", "eval", 2)],
)
def test_a_part_has_the_recorded_values_from_the_reset_on(client, folder, address, phase, episode):
    steps = steps_of(folder, "pole", phase, episode)
    whole = part(client, f"pole/replay/{address}")
    assert whole["length"] == len(steps) == len(whole["reward"])
    assert taken(whole["actions"][0]) == [("left", "right")[action] for action in steps["action"]]
    with open_recording(find_run("pole", folder).recording) as recording:
        first = [reset["observation"].copy() for reset in recording.resets(phase)][episode]
    for k, series in enumerate(whole["series"]):
        assert series["name"] == f"[{k}]"
        expected = np.append(first[k], steps["next_observation"][:, k])
        assert series["values"] == pytest.approx(expected, rel=1e-4)
    later = part(client, f"pole/replay/{address}", start=5, steps=4)
    assert later["first"] == 4
    assert later["before"] == [4]
    assert later["series"][0]["values"] == whole["series"][0]["values"][4:9]


def test_what_was_logged_near_a_step_is_there_with_its_place(client, folder):
    shown = part(client, "pole/replay/train/1")
    (loss,) = shown["logged"]
    lengths = [len(steps_of(folder, "pole", "train", episode)) for episode in range(4)]
    assert loss["name"] == "loss"
    assert loss["at"] == np.cumsum(lengths).tolist()
    assert loss["values"] == pytest.approx([1, 1 / 2, 1 / 3, 1 / 4], rel=1e-4)
    assert shown["time"][0] == lengths[0]


def test_the_episode_of_a_vector_is_that_of_its_environment(client, folder):
    steps = steps_of(folder, "poles", "train", 4)
    shown = part(client, "poles/replay/train/4")
    assert f"in environment {steps['step'][0] % 3}" in shown["title"]
    assert shown["series"][2]["values"][1:] == pytest.approx(steps["next_observation"][:, 2], rel=1e-4)
    found, problem = pictures(client, "poles/replay/train/4", steps=1000)
    assert (len(found), problem) == (len(steps) + 1, "")


def test_the_environments_of_a_vector_are_shown_side_by_side_from_the_same_step(client, folder):
    own = steps_of(folder, "poles", "train", 4)
    text = page(client, "/runs/poles/replay/train/4/environments?t=2")
    panels = re.findall(
        r'data-source="/api/v1/runs/\w+/replay/train/(\d+)" data-offset="(-?\d+)".*?Environment (\d)',
        text,
        re.DOTALL,
    )
    assert [environment for *_, environment in panels] == ["0", "1", "2"]
    for episode, offset, environment in panels:
        steps = steps_of(folder, "poles", "train", int(episode))
        assert set(steps["step"] % 3) == {int(environment)}
        first, last = (int(steps["step"][i]) // 3 for i in (0, -1))
        assert first == own["step"][0] // 3 + int(offset)
        assert last >= own["step"][0] // 3
    assert "4" in [episode for episode, *_ in panels]


def test_agents_are_shown_by_name(client, folder):
    shown = part(client, "game/replay/train/1")
    assert [words["agent"] for words in shown["actions"]] == ["agent_0", "agent_1", "agent_2"]
    steps = steps_of(folder, "game", "train", 1)
    assert shown["reward"] == pytest.approx(steps["rewards"], rel=1e-4)
    series = [one for one in shown["series"] if one["agent"] == "agent_1"]
    assert series[3]["values"][1:] == pytest.approx(steps["next_observation"]["agent_1"][:, 3], rel=1e-4)
    found, problem = pictures(client, "game/replay/train/1")
    assert (len(found), problem) == (13, "")


def test_extras_are_shown_before_the_step_that_they_were_recorded_with(tmp_path):
    env, rng = gymnasium.make("CartPole-v1"), np.random.default_rng(0)
    logits = rng.normal(size=(200, 2))
    with runner.record(env, tmp_path / "r", name="mind") as rec:
        rec.reset(seed=1)
        for t in range(200):
            extras = {"logits": logits[t], "value": 2.0} if t != 3 else {"logits": logits[t]}
            *_, over, _, _ = rec.step(t % 2, extras=extras)
            if over:
                break
    with TestClient(
        create_app(Settings(recordings=(tmp_path / "r",), tokens=tmp_path / "t.json")),
        base_url="http://localhost",
    ) as client:
        shown = {one["name"]: one for one in part(client, "mind/replay/train/0")["series"]}
    assert shown["value"]["kind"] == "extras"
    assert shown["value"]["values"] == [2 if k != 3 else None for k in range(t + 1)] + [None]
    assert shown["logits[1]"]["values"][:-1] == pytest.approx(logits[: t + 1, 1], rel=1e-4)


def test_recorded_frames_are_passed_on_as_they_are(client, folder, monkeypatch):
    monkeypatch.setattr("runner.export.pictures.why_not_redone", lambda *_: "It is not installed.")
    length = len(steps_of(folder, "framed", "train", 1))
    with open_recording(find_run("framed", folder).recording) as recording:
        recorded = [frame["data"] for frame in recording.decoded(recording.topic("/train/frame"))]
    found, problem = pictures(client, "framed/replay/train/1", steps=1000)
    assert problem == ""
    assert len(found) == length + 1
    assert {data for data in found if data} <= set(recorded)
    due = [k % 3 == 0 or k == length for k in range(length + 1)]
    assert [bool(data) for data in found] == due
    later, _ = pictures(client, "framed/replay/train/1", start=4, steps=3)
    assert later == [found[3], b"", found[6]]


def test_pictures_that_were_not_recorded_are_those_that_the_environment_draws(client, folder):
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    env.reset(seed=102)
    drawn = [env.render()]
    for action in steps_of(folder, "pole", "eval", 2)["action"].tolist():
        env.step(action)
        drawn.append(env.render())
    found, problem = pictures(client, "pole/replay/eval/4/2", steps=1000)
    assert problem == ""
    assert len(found) == len(drawn)
    for data, expected in zip(found, drawn, strict=True):
        shown = np.asarray(Image.open(io.BytesIO(data)), np.float64)
        assert np.abs(shown - expected).mean() < 2
    for start in (1, 5, len(drawn) - 1):
        again, _ = pictures(client, "pole/replay/eval/4/2", start=start, steps=2)
        assert again == found[start : start + 2]


def test_without_a_picture_the_page_gives_the_reason_and_the_values(client):
    """An environment of the user's own is not imported."""
    known = set(sys.modules)
    text = page(client, "/runs/rooms/replay/train/0?t=2")
    assert "There is no picture." in text
    assert "data-pictures" not in text
    assert "<dt>Mission</dt>" in text
    assert "<dt>Position[1]</dt>" in text
    found, problem = pictures(client, "rooms/replay/train/0")
    assert found == []
    assert problem.startswith("There is no picture.")
    assert {name for name in set(sys.modules) - known if name.startswith("tests.")} == set()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("pole/replay/train/99", "no training episode 99"),
        ("pole/replay/eval/4/9", "no trial 9"),
        ("pole/replay/eval/3/0", "nearest after 4"),
        ("poles/replay/train/9999", "no training episode 9999"),
    ],
)
def test_an_episode_that_is_not_there_is_refused(client, address, message):
    for path in (f"/api/v1/runs/{address}", f"/api/v1/runs/{address}/pictures"):
        answer = client.get(path)
        assert answer.status_code == 409, path
        assert message in answer.json()["error"]["message"]
    assert message in page(client, f"/runs/{address}", 404)


def test_pictures_after_the_end_are_none(client):
    assert pictures(client, "pole/replay/train/0", start=10**6) == ([], "")


def test_an_environment_that_takes_too_long_is_given_up_with_a_reason(client, monkeypatch):
    monkeypatch.setattr("runner.export.painting.redo_in_child", partial(redo_in_child, seconds=1e-3))
    found, problem = pictures(client, "pole/replay/train/2")
    assert found == []
    assert "took longer than 0.001 s" in problem


def test_where_an_environment_cannot_draw_the_recorded_frames_are_shown_with_the_reason(client, monkeypatch):
    monkeypatch.setattr("runner.export.painting.redo_in_child", partial(redo_in_child, seconds=1e-3))
    notes = []
    found, problem = pictures(client, "framed/replay/train/2", notes, steps=1000)
    assert found[0].startswith(b"\x89PNG")
    assert found[1:4] == [b"", b"", found[3]]
    assert "took longer than 0.001 s" in notes[0]
    assert problem == ""


def test_a_damaged_recording_ends_the_pictures_with_a_reason(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("runner.export.pictures.why_not_redone", lambda *_: "It is not installed.")
    data = bytearray(find_run("framed", folder).recording.read_bytes())
    place = data.rindex(b"\x89PNG")  # frames are stored as they are, in chunks with a checksum
    data[place + 100] ^= 255
    run = tmp_path / "recordings" / "framed"
    run.mkdir(parents=True)
    for file in find_run("framed", folder).folder.iterdir():
        (run / file.name).write_bytes(data if file.suffix == ".mcap" else file.read_bytes())
    settings = Settings(recordings=(run.parent,), tokens=tmp_path / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:
        for address in ("train/3", "eval/4/2"):
            answer = client.get(f"/api/v1/runs/framed/replay/{address}/pictures?steps=1000")
            assert answer.status_code in (200, 409)
        assert "checksum" in answer.text or "damaged" in answer.text


# --- streams ------------------------------------------------------------------------------------------


def endless(closed, begins=0.0):
    def make(start):
        try:
            time.sleep(begins)
            while True:
                yield str(start).encode()
                start += 1
        finally:
            closed.append(start)

    return make


async def read(streams, stream, start, stop):
    return [record[4:] async for record in streams.send(stream, start, stop)]


def test_a_stream_continues_for_the_next_request_and_begins_again_for_an_earlier_step():
    async def run():
        streams, closed = PictureStreams(), []
        first = streams.open("a", endless(closed), 3)
        assert await read(streams, first, 3, 5) == [b"3", b"4"]
        second = streams.open("a", endless(closed), 7)
        assert second is first
        assert await read(streams, second, 7, 9) == [b"7", b"8"]
        third = streams.open("a", endless(closed), 2)
        assert third is not first
        assert await read(streams, third, 2, 3) == [b"2"]
        await until(lambda: len(closed) == 1)
        streams.close()
        await until(lambda: len(closed) == 2)

    asyncio.run(run())


def test_streams_are_limited_kept_ones_give_way_and_are_closed_when_nobody_comes_back(monkeypatch):
    monkeypatch.setattr("runner.service.pictures.IDLE_SECONDS", 0.3)

    async def run():
        streams, closed = PictureStreams(), []
        opened = [streams.open(number, endless(closed), 0) for number in range(MAX_STREAMS)]
        with pytest.raises(Busy):
            streams.open("another", endless(closed), 0)
        await read(streams, opened[0], 0, 1)
        opened.append(streams.open("another", endless(closed), 0))
        await until(lambda: len(closed) == 1)
        for stream in opened[1:]:
            await read(streams, stream, 0, 1)
        await until(lambda: len(closed) == MAX_STREAMS + 1)

    asyncio.run(run())


async def until(holds):
    end = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


# --- in a browser -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def served(folder, tmp_path_factory):
    own = shutil.copytree(folder, tmp_path_factory.mktemp("served") / "recordings")
    with Served(own) as server:
        yield server.url
    assert "Traceback" not in server.log.read_text()


@pytest.fixture
def opened(browser, served):
    browser.get_log("browser")

    def open_page(address):
        browser.get(served + address)
        return browser

    yield open_page
    assert [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def wait(browser, done):
    return WebDriverWait(browser, SECONDS, poll_frequency=0.05).until(lambda _: done())


def shown_pictures(browser):
    """Return the address of each picture that is shown."""
    return browser.execute_script(
        "return [...document.querySelectorAll('img.frame')]"
        ".filter((image) => image.complete && image.naturalWidth && !image.hidden).map((image) => image.src)"
    )


@pytest.mark.parametrize("name", ["pole", "framed", "game", "poles"])
def test_pictures_appear_and_follow_the_slider(opened, name):
    browser = opened(f"/runs/{name}/replay/train/1?t=3")
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


def test_two_loops_are_played_in_step(opened):
    browser = opened("/compare/replay?run=pole&run=framed&at=2:1")
    wait(browser, lambda: len(shown_pictures(browser)) == 2)
    slider = browser.find_element(By.CSS_SELECTOR, ".both")
    before = shown_pictures(browser)
    slider.send_keys(Keys.ARROW_RIGHT * 3)
    wait(browser, lambda: not set(before) & set(shown_pictures(browser)))
    assert browser.find_element(By.CSS_SELECTOR, ".both-count").text.startswith("step 4 of")


def test_the_environments_of_a_vector_are_played_in_step(opened):
    browser = opened("/runs/poles/replay/train/1")
    browser.find_element(By.PARTIAL_LINK_TEXT, "side by side").click()
    wait(browser, lambda: len(shown_pictures(browser)) == 3)
    slider = browser.find_element(By.CSS_SELECTOR, ".both")
    before = shown_pictures(browser)
    slider.send_keys(Keys.ARROW_RIGHT)
    wait(browser, lambda: before != shown_pictures(browser))
    assert browser.find_element(By.CSS_SELECTOR, ".both-count").text.startswith("step 1 of")
    wait(browser, lambda: browser.current_url.endswith("/environments?t=1"))


def test_the_report_contains_pictures(browser, folder, tmp_path):
    from runner.export.reports.report import render_report

    text, _ = render_report([find_run("pole", folder).recording])
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
def test_nothing_sticks_out_of_a_narrow_page(opened, name):
    browser = opened(f"/runs/{name}/replay/train/0")
    size = {"width": 380, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.refresh()
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
    settings = Settings(recordings=(pairs,), tokens=tmp_path / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:
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
    settings = Settings(recordings=(folder,), tokens=tmp_path / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:
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
        assert f"Branch of {run.run_id} at 2:3, action 0, then constant" in own
        assert tried not in own
        divergence = client.get(f"/compare/divergence?run={run.run_id}&run={trained}").text
        assert "B is a branch of A, at 2:3, action 0, then constant" in divergence
        assert f"/runs/{run.run_id}/rerun?at=2%3A" in divergence
        assert f"/runs/{trained}/rerun?at=0%3A" in divergence
        for branch, episode, t in ((trained, "2", 3), (tried, "eval:4:1", 2)):
            unplaced = client.get(f"/compare/replay?run={run.run_id}&run={branch}").text
            assert int(re.search(f'name="at" value="{episode}:([0-9]+)"', unplaced)[1]) > t

"""Pages as programs see them: answered, escaped, well formed, with nothing inline that the policy forbids."""

from __future__ import annotations

import asyncio
import contextlib
import html
import json
import math
import re
import shutil
import sys

import numpy as np
import pytest
from checked_pages import ACCEPT_HTML, page_of

import runner
from runner.analysis.episodes import EpisodeRef
from runner.environments.naming import agent_actions_in_words, states_in_words
from runner.execution.branching import branch_training
from runner.integrations.tensorboard import SummaryWriter
from runner.recording import reader
from runner.recording.reader import Recording, open_recording
from runner.recording.record_store import RecordStore
from runner.recording.schema import LOG_TOPIC
from runner.runs.resolve import find_run
from runner.runs.run import RUN_FILE, Run
from runner.service.computed import load_sweep_libraries
from runner.service.processes import ProcessPool
from runner.service.settings import ServiceSettings
from runner.sweep import FILE, folder_of
from tests.runner.loops.making import make, play
from tests.waiting import until


def test_the_first_page_is_the_runs(client):
    answer = client.get("/", follow_redirects=False)
    assert answer.headers["location"] == "/runs"
    page = page_of(client, "/runs")
    assert page.count("<tr>") == 3
    assert "2 runs" in page
    assert "No run is on this page." in page_of(client, "/runs?page=9")


def test_runs_are_searched_sorted_and_their_columns_chosen(client):
    page = page_of(client, "/runs?filter=name=='second'&columns=name,config.discount&sort=-name")
    assert "1 of 2 run" in page
    assert re.search(r"<a[^>]*>second</a></td>\s*<td>0.99</td>", page)
    assert "first</a>" not in page


def test_runs_of_a_name_are_one_row_that_opens_sorts_and_is_compared(client, recordings):
    changes = ["name=many", "episodes=20", "seeds=[1, 2, 3]", "evaluation.trials=5"]
    runs = list(runner.run_all("quick", overrides=changes, recordings=recordings))
    page = until(lambda page: "5 runs" in page, lambda: page_of(client, "/runs"))
    assert page.count("<tr>") == 4
    (address,) = re.findall(r'href="([^"]+)">many \(3 runs\)</a>', page)
    opened = page_of(client, html.unescape(address))
    assert "3 of 5 runs" in opened
    assert opened.count("<tr>") == 4
    shown = [
        re.findall(r">(many|first|second)\b", page_of(client, f"/runs?sort={sort}"))
        for sort in ("name", "-name")
    ]
    assert shown == [["first", "many", "second"], ["second", "many", "first"]]
    assert page_of(client, "/runs?group=none").count("<tr>") == 6
    compared = page_of(client, "/compare?name=many&run=first")
    assert all(f"/runs/{run.run_id}" in compared for run in runs)
    assert "/runs/second" not in compared


def test_the_caret_of_a_wrong_filter_stands_under_its_place_in_a_fixed_width(client):
    page = page_of(client, "/runs?filter=status=='finishd'", 400)
    assert "Did you mean &#39;finished&#39;?</p>" in page
    assert "<pre>  status==&#39;finishd&#39;\n          ^^^^^^^^^</pre>" in page


def test_each_evaluation_leads_to_its_replay(client):
    page = page_of(client, "/runs/first/evaluations")
    assert re.findall(r'replay/eval/(\d+)/0"', page) == ["60", "50", "40", "30", "20", "10", "0"]
    assert "There are 7 evaluations, from 0." in page_of(client, "/runs/first/evaluations?page=2")


def test_a_page_of_episodes_leads_to_the_others(client):
    first = client.get("/api/v1/runs/first").json()["run_id"]
    page = page_of(client, "/runs/first/episodes?phase=eval&page=2")
    pages = re.findall(r'rel="(prev|next)" href="([^"]*)"', page)
    assert pages[-1] == ("prev", f"/runs/{first}/episodes?phase=eval&amp;order=number")
    assert page_of(client, f"/runs/first/episodes?phase=eval&page={10**8}").count("<tr") == 0


def test_episodes_come_in_the_order_that_is_chosen(client):
    def read(order, start, stop):
        address = f"/api/v1/runs/first/episodes?phase=eval&order={order}&start={start}&stop={stop}"
        return client.get(address).json()["columns"]

    whole = read("number", 0, 140)
    rank = list(zip(whole["success"], sums(whole), [-n for n in whole["length"]], strict=True))
    expected = {
        "newest": sorted(whole["episode"], reverse=True),
        "longest": sorted(whole["length"], reverse=True),
        "shortest": sorted(whole["length"]),
        "best": sorted(rank, reverse=True),
        "worst": sorted(rank),
    }
    for order, values in expected.items():
        found = read(order, 20, 50)
        if order in ("best", "worst"):
            found["rank"] = list(
                zip(found["success"], sums(found), [-n for n in found["length"]], strict=True)
            )
        key = {"newest": "episode", "best": "rank", "worst": "rank"}.get(order, "length")
        assert found[key] == values[20:50]
    page = page_of(client, "/runs/first/episodes?phase=eval&order=longest&page=2")
    assert 'episodes?phase=eval&amp;order=longest"' in page


def sums(columns):
    returns = [column for name, column in columns.items() if name.startswith("return.")]
    return list(map(sum, zip(*returns, strict=True)))


def test_a_search_keeps_the_columns_and_their_order(client):
    page = page_of(client, "/runs?columns=age,name,id&filter=first")
    assert '<input type="hidden" name="columns" value="age,name,id">' in page
    assert re.findall(r'<input type="checkbox" name="columns" value="(\w+)" checked>', page) == [
        "age",
        "name",
        "id",
    ]
    assert 'name="columns" value="id' not in re.sub(
        r'<input type="checkbox"[^>]*>', "", page_of(client, "/runs")
    )


@pytest.mark.parametrize(
    "query", ["filter=status:finished", "filter=status%3D%3D", "sort=bogus", "columns=bogus"]
)
def test_an_invalid_filter_is_explained(client, query):
    page = page_of(client, f"/runs?{query}", 400)
    assert 'role="alert"' in page


def test_missing_pages_are_pages(client):
    assert "There is nothing at /nowhere." in page_of(client, "/nowhere", 404)
    assert client.get("/nowhere").json()["error"]["message"]


def test_files_are_cached_for_ever(client):
    address = re.search(r'"(/static/[^"]*style.css)"', page_of(client, "/runs"))[1]
    answer = client.get(address)
    assert "immutable" in answer.headers["cache-control"]
    assert client.get("/static/older/style.css").headers["cache-control"] == "no-cache"
    assert client.get("/static/x/../../app.py").status_code >= 400
    for missing in ("/static/x/missing.js", "/static/rerun/0.0.0/re_viewer.js", "/nothing"):
        assert client.get(missing).status_code == 404


def test_a_runs_name_cannot_break_out(client, recordings):
    run = next(path.parent for path in recordings.glob("*/run.json"))
    fresh = run / "labels.json.fresh"
    fresh.write_text('{"name": "<script>alert(1)</script>", "note": "\\"><img src=x>"}')
    fresh.replace(run / "labels.json")  # as the program replaces it: the folder shows that something changed
    address = "/runs?columns=id,name,note"
    until(lambda page: "&lt;script&gt;alert(1)" in page, lambda: page_of(client, address))
    assert "<img src=x" not in page_of(client, address)


PAGES = (
    "/runs/first",
    "/runs/first/replay",
    "/runs/first/replay/train/3?t=5",
    "/runs/first/replay/eval/60/2",
    "/runs/first/episodes",
    "/runs/first/episodes?phase=eval&page=2",
    "/runs/first/evaluations",
    "/runs/first/learned",
    "/runs/first/config",
    "/runs/first/system",
    "/runs/first/console",
    "/runs/first/rerun?at=3:2",
    "/runs/first/rerun?at=3",
    "/runs/first/rerun?at=eval:10",
    "/runs/first/rerun/frame?at=3:2",
    "/compare?run=first&run=second",
    "/compare/divergence?run=first&run=second",
    "/compare/replay?run=first&run=second",
    "/compare/replay?run=first&run=second&at=eval:60:0:1",
    "/compare/tables?run=first&run=second",
    "/sweeps",
    "/queue",
    "/submit",
    "/submit?from=first",
    "/submit?sweep=true",
    "/disk",
    "/compare/replay?run=first&run=second&at=eval:60",
)


def test_the_page_of_a_run_shows_what_a_random_policy_achieves(client):
    (address,) = re.findall(r'data-later="(\S+/random-policy)"', page_of(client, "/runs/first"))
    assert re.search(
        r"A random policy succeeds in [\d.]+ % of episodes within the limit of 300 steps",
        client.get(address).text,
    )


def test_the_page_of_a_run_waits_for_no_child_process(client, monkeypatch):
    def hang(*_, **__):
        raise AssertionError("a child process is called")

    monkeypatch.setattr(ProcessPool, "submit", hang)
    for name in ("first", "second"):
        assert client.get(f"/runs/{name}").status_code == 200


def test_the_event_loop_reads_no_files_of_compared_runs_and_of_the_viewer(client, monkeypatch):
    read = Run.labels.func
    on_loop = []

    def labels(run):
        with contextlib.suppress(RuntimeError):
            on_loop.append(asyncio.get_running_loop())
        return read(run)

    monkeypatch.setattr(Run, "labels", property(labels))
    for tab in ("divergence", "tables", "code"):
        page_of(client, f"/compare/{tab}?run=first&run=second")
    page_of(client, "/runs/first/rerun/frame?at=3")
    assert on_loop == []


def test_the_event_loop_searches_no_answer_for_folders(client, monkeypatch):
    on_loop, search = [], ServiceSettings.without_folders

    def without_folders(settings, text):
        with contextlib.suppress(RuntimeError):
            on_loop.append(asyncio.get_running_loop())
        return search(settings, text)

    monkeypatch.setattr(ServiceSettings, "without_folders", without_folders)
    for address in ("/runs/first/report.html", "/sql?query=SELECT 1", "/find?expression=length > 0"):
        assert client.get(f"/api/v1{address}").status_code == 200
    assert on_loop == []


def test_the_page_of_a_run_opens_its_recording_once(client, recordings, monkeypatch):
    opened, init = [], Recording.__init__

    def count(recording, path):
        opened.append(path)
        init(recording, path)

    with runner.record(make("CartPole-v1"), recordings, name="going") as env:
        for _ in play(env, 20):
            pass
        until(lambda answer: answer.is_success, lambda: client.get("/api/v1/runs/going"))
        monkeypatch.setattr(Recording, "__init__", count)
        for name in ("going", "first"):
            page_of(client, f"/runs/{name}")
            assert len(opened) == 1
            opened.clear()


def test_a_run_that_is_named_twice_is_not_compared_with_itself(client, recordings):
    run = find_run("first", recordings)
    page = page_of(client, f"/compare?run=first&run={run.run_id}&name=first", 400)
    assert "Found 1 run, expected 2 to 60" in page


def test_only_differences_in_settings_can_be_explained(client, recordings):
    pair = "/compare?run=first&run=second"
    assert "Explain the difference" not in page_of(client, pair), "only their seeds differ"
    run = find_run("second", recordings)
    facts = json.loads((run.folder / RUN_FILE).read_text())
    facts["config"]["discount"] = 0.5
    (run.folder / RUN_FILE).write_text(json.dumps(facts))
    assert "Explain the difference" in page_of(client, pair)


def test_every_page_is_well_formed_and_has_nothing_inline(client):
    for address in PAGES:
        page_of(client, address)


MISSING = [
    ("/runs/nothing", 404, "No run"),
    ("/runs/first/replay/train/60", 404, "there are 60, from 0"),
    ("/runs/first/replay/eval/7/0", 404, "the nearest after 10"),
    ("/runs/first/replay/train/3?t=99999", 404, "from 0; found no step 99,999"),
    ("/runs/first/replay?at=eval:9999:1", 404, "the nearest after 60"),
    ("/runs/first/replay?at=train:x", 400, "expected EPISODE:T"),
    ("/runs/first/replay?at=step:999999", 404, "found no training step 999,999"),
    ("/runs/first/rerun?at=1:x", 400, "expected EPISODE:T"),
    ("/runs/first/rerun?at=eval:9999:1", 404, "the nearest after 60"),
    ("/compare?run=first", 400, "expected 2 to 60"),
    ("/compare/nothing?run=first&run=second", 404, "nothing at /compare/nothing"),
    ("/compare/replay?run=first&run=second&at=eval", 400, "expected EPISODE:T"),
    ("/sweeps/nothing", 404, "No sweep"),
    ("/queue/9", 404, "No job 9"),
]


def test_missing_pages_say_what_exists(client):
    for address, status, message in MISSING:
        assert message in page_of(client, address, status)
    part = client.get("/api/v1/runs/first/replay/train/3?start=99999")
    assert part.status_code == 404
    assert "from 0; found no step 99,999" in part.json()["error"]["message"]


def test_pages_take_every_reference_to_a_step(client, recordings):
    with open_recording(find_run("first", recordings).recording) as recording:
        run_id = recording.run_id
        steps = {
            at: EpisodeRef.parse(at).resolved(recording)
            for at in ("3:2", "eval:60:1:2", "typical", "best:1", "worst", "last:1", "step:100")
        }
    for at, step in steps.items():
        address = client.get(f"/runs/first/replay?at={at}", follow_redirects=False).headers["location"]
        query = f"?t={step.t}" if step.t else ""
        assert address == f"/runs/{run_id}/replay/{step.episode_path}{query}"
        assert f"{step.heading}, step {step.t}." in page_of(client, f"/runs/first/rerun?at={at}")
        page_of(client, f"/runs/first/rerun/frame?at={at}")
        what_if = page_of(client, f"/runs/first/what-if/{at}")
        assert f"What if? {step.heading}, step {step.t:,}" in what_if


@pytest.mark.parametrize(
    "address",
    [
        "/runs/first/replay?episode=x",
        "/runs/first/replay?after=60&trial=-1",
        "/runs/first/replay?at=step:999999",
        "/compare/replay?run=first&run=second&at=x",
    ],
)
def test_a_replay_that_there_is_not_keeps_tabs_and_form(client, address):
    answer = client.get(address, headers=ACCEPT_HTML)
    assert answer.status_code in (400, 404)
    for part in ('<div class="episode-forms"', 'class="tabs"', 'class="problem"'):
        assert part in answer.text


def test_the_fields_of_a_replay_lead_to_an_episode(client):
    for query, path in (
        ("episode=5", "train/5"),
        ("episode=", "train/0"),
        ("trial=2&after=60", "eval/60/2"),
        ("trial=&after=60", "eval/60/0"),
    ):
        answer = client.get(f"/runs/first/replay?{query}", follow_redirects=False)
        assert answer.headers["location"].endswith(f"/replay/{path}")


def test_the_page_of_the_disk_links_runs_and_the_runs_that_they_repeat(client, recordings):
    first = find_run("first", recordings)
    again = runner.run({**first.file.config, "name": "again"}, seed=first.seed, recordings=recordings)
    assert again.summary.content_digest == first.summary.content_digest
    page = until(lambda page: "same as" in page, lambda: page_of(client, "/disk"))
    assert f'<a href="/runs/{again.run_id}">{again.run_id}</a>' in page
    assert '<span class="status finished">finished</span>' in page
    assert re.findall('<td class="text"><a href="/runs/([^"]*)">', page) == [first.run_id]


def test_only_the_frame_of_the_viewer_may_compile(client):
    assert "wasm" not in client.get("/runs/first").headers["content-security-policy"]
    policy = client.get("/runs/first/rerun/frame").headers["content-security-policy"]
    assert "script-src 'self' 'wasm-unsafe-eval';" in policy
    assert "unsafe-inline" not in policy


def test_the_parts_of_an_episode_are_the_recorded_steps(client, recordings):
    with open_recording(find_run("first", recordings).recording) as recording:
        steps = recording.train.episode_steps(2)
        mdp, words = recording.mdp, states_in_words(recording.mdp)
    whole = client.get("/api/v1/runs/first/replay/train/2?steps=2000").json()["episode"]
    assert whole["length"] == len(steps)
    facts = {fact["name"]: [fact["values"][i] for i in fact["at"]] for fact in whole["facts"]}
    assert [fact[0] for fact in facts.values()] == ["none yet: the episode begins", "", "", "0"]
    assert float(facts["return so far"][-1]) == steps["rewards"].sum()
    deeds = agent_actions_in_words(mdp)

    def actions(part):
        (action,) = part["actions"]
        return [action["values"][i] for i in action["at"]]

    assert actions(whole) == [deeds[number] for number in steps["action"]]
    for start in (0, 1, len(steps) // 2, len(steps) - 3):
        part = client.get(f"/api/v1/runs/first/replay/train/2?start={start}&steps=101").json()["episode"]
        first = max(0, start - 1)
        assert part["first"] == first
        assert part["before"] == (steps["rewards"][:first].sum(axis=0).tolist() if first else [])
        assert actions(part) == actions(whole)[first : first + 101]
        assert part["values"][0]["taken"] == whole["values"][0]["taken"][first : first + 101]
        (state,) = part["texts"]
        shown = [state["values"][i] for i in state["at"]][:-1]
        assert shown == words[steps["state"][first : first + 101]].tolist()


def test_output_is_shown_escaped_and_searched(client, recordings, capsys):
    with runner.record(make("CartPole-v1"), recordings, name="printing") as env:
        for _ in play(env, 20):
            pass
        print("<script>alert(1)</script> \x1b[31mred\x1b[0m")
        print("a warning", file=sys.stderr)
        shown = page_of(client, "/runs/printing/console")
        assert "data-live" in shown
    shown = page_of(client, "/runs/printing/console")
    assert "&lt;script&gt;alert(1)&lt;/script&gt; red" in shown
    assert "a warning" in shown
    assert "data-live" not in shown
    assert "script&gt;" not in page_of(client, "/runs/printing/console?stream=stderr")
    found = page_of(client, "/runs/printing/console?search=WARN")
    assert "script&gt;" not in found
    assert "1 line found, of 2" in found
    assert "No line was found" in page_of(client, "/runs/printing/console?search=nothing")
    assert client.get("/runs/printing/console/part?status=running").status_code == 204
    assert client.get("/runs/printing/console?stream=else", headers=ACCEPT_HTML).status_code == 400


def test_a_run_that_only_logged_has_no_replay(client, recordings, monkeypatch):
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(recordings))
    writer = SummaryWriter("logged")
    writer.add_scalar("loss", 1.0, 0)
    writer.close()
    for tab, status in (("replay", 409), ("rerun", 200), ("episodes", 200)):
        page = page_of(client, f"/runs/logged/{tab}", status)
        assert "There is nothing to show here: the run has no recorded steps." in page
        assert "<form" not in page.partition("<main")[2]


def test_logged_pictures_are_shown_newest_first_with_their_steps(client, recordings):
    with SummaryWriter("runs/pictured", recordings=recordings, monitor_gym=False) as writer:
        for step in (1, 2):
            writer.add_image("<b>", np.full((3, 4, 4), 50 * step, np.uint8), step)
        writer.add_video("film", np.zeros((1, 2, 3, 4, 4), np.uint8), 1_234)
    page = page_of(client, "/runs/pictured/pictures")
    assert page.count("<figure><img src=") == 3
    assert page.index("film, step 1,234") < page.index("&lt;b&gt;, step 2") < page.index("&lt;b&gt;, step 1<")
    assert "data:image/webp;base64," in page
    assert "/pictures" in page_of(client, "/runs/pictured")
    assert "/pictures" not in page_of(client, "/runs/first")
    assert "No picture was logged" in page_of(client, "/runs/first/pictures")


def test_the_end_of_a_log_is_shown_in_its_order_and_only_that_is_read(client, recordings, monkeypatch):
    texts = [f"line {i:04}" for i in range(2000)]
    with SummaryWriter("runs/wordy", recordings=recordings, monitor_gym=False) as writer:
        for step, text in enumerate(texts):
            writer.add_text("said", text + "." * 2000, step)
    read = []
    chunk = RecordStore.chunk
    monkeypatch.setattr(RecordStore, "chunk", lambda store, entry: read.append(entry) or chunk(store, entry))
    shown = re.findall(r"line \d{4}", page_of(client, "/runs/wordy/config"))
    assert shown == texts[-500:]
    with open_recording(find_run("wordy", recordings).recording) as recording:
        assert len(read) < len(recording.table(LOG_TOPIC)) / 2


def test_a_run_of_values_alone_has_their_curves_and_no_empty_pages(client, recordings):
    with SummaryWriter("runs/alone", recordings=recordings, monitor_gym=False) as writer:
        for step in range(20):
            writer.add_scalars("v", {str(i): i + step for i in range(100)}, step)
    page = page_of(client, "/runs/alone")
    tabs = re.findall(r'<li><a href="/runs/\w+/?(\w*)"', page[page.index("tabs") :])
    assert tabs == ["", "system", "console", "code", "config"]
    assert "Training steps" not in page
    curves = client.get("/api/v1/curves?run=alone").json()
    assert ([axis["label"] for axis in curves["axes"]], curves["axis"]) == (
        ["steps", "wall time, seconds", *curves["names"]],
        "steps",
    )
    assert [len(curve["positions"]) for curve in curves["curves"]] == [20] * 64
    assert (curves["averaged"], len(curves["names"])) == ("", 100)
    assert "720 values. Choose others by their names" in curves["notes"][0]
    curves = client.get("/api/v1/curves?run=alone&axis=v/0&metric=training.logged.v/99").json()
    assert [(one["metric"], one["values"][:2]) for one in curves["curves"]] == [
        ("training.logged.v/99", [99.0, 100.0])
    ]
    assert (curves["axis"], curves["notes"]) == (
        "v/0",
        ["Every recorded point is drawn.", "Each line is one run, as reported."],
    )
    curves = client.get("/api/v1/curves?run=alone&metric=training.logged.v/0&log_y=true").json()
    (note,) = curves["notes"]
    assert note.startswith(
        "Each line is one run, as reported. On logarithmic axes points at 0 or below are left out"
    )


def test_the_libraries_of_sweeps_are_loaded_when_sweeps_are_listed(
    connect, settings, recordings, monkeypatch
):
    submitted = []
    monkeypatch.setattr(ProcessPool, "submit", lambda _, seconds, function: submitted.append(function))
    folder = folder_of("small", recordings)
    folder.mkdir(parents=True)
    (folder / FILE).touch()
    client = connect(settings)
    assert submitted == []
    assert "small" in client.get("/sweeps").text
    assert submitted == [load_sweep_libraries]


def test_every_axis_that_is_offered_can_be_chosen(client, recordings):
    for run in range(2):
        with SummaryWriter(f"runs/axes{run}", recordings=recordings, monitor_gym=False) as writer:
            for step in range(20):
                values = {
                    "epoch": step // 2,
                    "loss": -step,
                    "gap": math.nan if step == 9 else step,
                    f"only{run}": step,
                }
                writer.add_scalars("v", values, step)
    query = "run=axes0&run=axes1&metric=training.logged.v/loss"
    axes = [axis["name"] for axis in client.get(f"/api/v1/curves?{query}").json()["axes"]]
    assert axes == ["steps", "time", "v/epoch"]
    for axis in axes:
        assert client.get(f"/api/v1/curves?{query}&axis={axis}").status_code == 200
    assert client.get(f"/api/v1/curves?{query}&axis=v/loss").status_code == 409


def test_variations_are_of_jobs(client, recordings):
    with runner.record(make("CartPole-v1"), recordings, name="alone") as env:
        list(play(env, 5))
    assert "Submit a variation" in page_of(client, "/runs/first/config")
    assert "Submit a variation" not in page_of(client, "/runs/alone/config")


def test_the_time_and_the_machine_are_shown(client, recordings):
    with runner.record(make("CartPole-v1"), recordings, name="alone", system=False) as env:
        list(play(env, 50))
    page = page_of(client, "/runs/alone/system")
    assert "Steps a second, mean" in page
    assert "No use of the machine was recorded" in page
    assert page.count("<figure") == 1
    assert client.get("/runs/first/system/part?status=running").status_code == 204
    assert "<figure" in client.get("/runs/first/system/part?status=finished").text


def test_the_status_of_a_run_is_updated_while_it_runs_only(client, recordings):
    assert client.get("/runs/first/status").status_code == 204
    file = find_run("first", recordings).folder / "run.json"
    facts = json.loads(file.read_text())
    owner = facts["owner"] | {"host": "elsewhere"}  # who lives as long as the file is young
    file.write_text(json.dumps(facts | {"status": "running", "summary": {}, "owner": owner}))
    page = page_of(client, "/runs/first")
    assert 'data-live="/runs/' in page
    assert "so far" in client.get("/runs/first/status").text


@pytest.mark.parametrize("error", [None, 5, ["no", "text"]])
def test_an_error_that_is_no_text_is_no_fault(client, recordings, error):
    run = find_run("first", recordings)
    run.update(status="failed", summary={**run.summary, "error": error})
    page_of(client, "/runs/first")
    answer = client.get("/api/v1/runs/first")
    assert (answer.status_code, answer.json()["error"]) == (200, None), "an invalid error is left out"


def test_the_page_of_a_run_is_live_once_a_job_will_resume_it(client, recordings, monkeypatch):
    monkeypatch.setattr("runner.service.jobs.queue.RESERVE_BYTES", 1 << 62)  # so that no job is begun
    run = find_run("first", recordings).update(status="interrupted")
    assert "data-live" not in page_of(client, "/runs/first")
    assert client.get("/runs/first/status?status=interrupted").status_code == 204
    assert client.post("/api/v1/jobs", content="env: {id: FrozenLake-v1}\nepisodes: 60").status_code == 201
    client.app.state.jobs.store.update(1, run_ids={0: run.run_id}, begun=1)
    page = page_of(client, "/runs/first")
    assert f'data-live="/runs/{run.run_id}/status?status=interrupted"' in page
    assert client.get("/runs/first/status?status=interrupted").status_code == 200
    assert client.get("/runs/first/status?status=running").status_code == 204, "the page says otherwise"
    client.post("/queue/1/cancel")
    assert client.get("/runs/first/status?status=interrupted").status_code == 204


def test_the_pages_of_a_finished_run_say_that_its_recording_is_cut_off(client, recordings):
    run = find_run("first", recordings)
    assert "cut off" not in page_of(client, "/runs/first") + page_of(client, "/runs/first/config")
    content = run.recording.read_bytes()
    run.recording.write_bytes(content[: len(content) * 9 // 10])
    assert "recording.mcap: is cut off, though its run is finished" in page_of(client, "/runs/first")
    assert "is cut off, though its run is finished" in page_of(client, "/runs/first/config")
    assert "is cut off" in client.get("/api/v1/runs/first").json()["damage"]


def test_the_error_of_a_run_hides_its_folder(client, recordings):
    run = find_run("first", recordings)
    error = f"{run.recording.absolute()}: cannot be written"
    run.update(status="failed", summary={**run.summary, "error": error})
    run.recording.write_bytes(b"no recording")
    answer = client.get("/api/v1/runs/first")
    assert answer.json()["error"] == f"{run.run_id}/recording.mcap: cannot be written"
    assert answer.json()["problems"]
    pages = [page_of(client, "/runs/first"), page_of(client, "/runs/first/config")]
    assert answer.json()["error"] in pages[0]
    assert [text for text in (answer.text, *pages) if str(recordings) in text] == []


@pytest.mark.parametrize(
    "address", ["/runs/first/replay/train/3", "/compare/replay?run=first&run=second&at=3"]
)
def test_no_recording_is_read_by_the_event_loop(client, monkeypatch, address):
    """A slow disk delays only the requests that read from it."""
    read = reader.open_recording
    read_by_loop = []

    def opened(path):
        with contextlib.suppress(RuntimeError):
            read_by_loop.append(asyncio.get_running_loop())
        return read(path)

    monkeypatch.setattr(reader, "open_recording", opened)
    monkeypatch.setattr("runner.service.pages.replay.open_recording", opened)
    assert client.get(address).status_code == 200
    assert read_by_loop == []


def test_pages_link_a_run_with_its_branches(client, recordings):
    parent = find_run("first", recordings)
    branch = branch_training(
        parent, at="2:1", overrides=["epsilon=0.5"], name="curious", recordings=recordings
    )
    own = branch.run.run_id

    def tree(run_id):
        (address,) = re.findall(r'data-later="(\S+/branches)"', page_of(client, f"/runs/{run_id}"))
        return client.get(address).text

    until(lambda part: "branches-title" in part, lambda: tree(parent.run_id))
    assert f'<a href="/runs/{own}">curious</a>' in tree(parent.run_id)
    page = tree(own)
    assert f'<a href="/runs/{parent.run_id}">first</a>' in page
    assert '<strong aria-current="true">curious</strong>' in page
    assert str(branch.origin) in page
    for run_id, name in ((parent.run_id, own), (own, f"of {parent.run_id}")):
        page = page_of(client, f"/runs/{run_id}/replay/train/2")
        assert f"Branch {name} {branch.origin}" in page
        assert f'href="/compare/replay?run={parent.run_id}&amp;run={own}&amp;at=2%3A1"' in page
    shutil.rmtree(parent.folder)
    until(lambda page: "a run that was removed" in page, lambda: tree(own))


def test_some_of_the_runs_are_counted_in_the_plural(client):
    assert "1 of 2 runs" in page_of(client, "/runs?filter=name=='first'")

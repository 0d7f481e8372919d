"""What a training prints, next to its steps."""

from __future__ import annotations

import io
import os
import sys
import threading
import time
from functools import partial
from types import SimpleNamespace

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import runner
from runner.errors import RecordingError
from runner.execution.resume import resume
from runner.execution.verify import verify
from runner.export.mcap import export_mcap
from runner.recording import console, machine, observer, schema
from runner.recording.console import MAX_CONSOLE_BYTES, Screen, read_console
from runner.recording.machine import Clock, read_clock
from runner.recording.messages import encode
from runner.recording.reader import open_recording
from runner.runs.run import list_runs
from tests.runner.altering import altered
from tests.runner.loops.making import make
from tests.runner.recording.making import TAXIS, copy_of, make_run, stopping_after
from tests.waiting import until


@pytest.fixture
def often(monkeypatch):
    """Watch fifty times a second."""
    monkeypatch.setattr(observer, "SAMPLE_SECONDS", 0.02)
    monkeypatch.setattr(machine, "SAMPLE_SECONDS", 0.02)


def lines_of(run) -> list[tuple[str, str]]:
    with open_recording(run.recording) as recording:
        return [(line.stream, line.text) for line in read_console(recording, read_clock(recording))]


def screen_of(*writes: str) -> list[str]:
    screen = Screen()
    for text in writes:
        screen.write(0.0, text)
    return [text for _, _, text in screen.take(1e9, is_last=True)]


@pytest.mark.parametrize(
    ("writes", "lines"),
    [
        (["one\ntwo\n"], ["one", "two"]),
        (["a", " ", "b", "\n"], ["a b"]),
        (["no end"], ["no end"]),
        (["\r 10 %", "\r 50 %", "\r100 %", "\n"], ["100 %"]),
        (["loading\rdone\n"], ["done"]),
        (["loading\r\x1b[Kdone\n"], ["done"]),
        (["\x1b[31mred\x1b[0m \x1b]0;title\x07text\n"], ["red text"]),
        (["one\ntwo\n\x1b[2Aeins\n\n"], ["eins", "two"]),
        (["a\tb\x00\x07\n"], ["a       b"]),
        (["abc\b\bX\n"], ["aX"]),
        (["one\r\n", "two\r\n"], ["one", "two"]),
        (["half\r", "\x1b[K"], []),
        (
            ["\router 1", "\n", "\rinner 1", "\x1b[A", "\router 2", "\n\rinner 2\x1b[A", "\n\n"],
            ["outer 2", "inner 2"],
        ),
        (["one\ntwo\n\x1b[2A\x1b[2Bthree\n"], ["one", "two", "three"]),
        (["x" * 5000 + "\n"], ["x" * 4096, "x" * 904]),
        (["Zürich 日本\n"], ["Zürich 日本"]),
    ],
)
def test_text_after_a_return_or_a_move_of_the_cursor_replaces_its_line(writes, lines):
    assert screen_of(*writes) == lines


def test_a_progress_bar_is_recorded_now_and_then_and_at_its_end():
    screen, seen = Screen(), []
    for second in range(60):
        screen.write(second, f"\r{second} of 60")
        seen += screen.take(second)
    screen.write(60.0, "\rdone    \n")
    seen += screen.take(99.0)
    assert {number for _, number, _ in seen} == {0}
    assert 4 < len(seen) < 10
    assert seen[-1][2] == "done"


def test_what_a_loop_prints_is_recorded_in_order_with_its_stream(tmp_path, capsys):
    print("before")
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        print("first")
        print("second", file=sys.stderr)
        for k in range(50):
            print(f"\r{k + 1} of 50", end="")
        print("\nlast", flush=True)
    print("after")
    assert lines_of(env.run) == [
        *[("stdout", "first"), ("stderr", "second"), ("stdout", "50 of 50"), ("stdout", "last")]
    ]
    shown = capsys.readouterr()
    assert shown.out.startswith("before\nfirst\n\r1 of 50\r2 of 50")
    assert shown.out.endswith("\nlast\nafter\n")
    assert shown.err == "second\n"
    assert verify(env.run.recording).sound


def test_two_loops_at_once_have_what_was_printed_while_each_was_open(tmp_path):
    write = vars(sys.stdout).get("write")
    with runner.record(make("CartPole-v1"), tmp_path) as outer:
        print("outer")
        with runner.record(make("CartPole-v1"), tmp_path) as inner:
            print("both")
        print("outer again")
    assert lines_of(inner.run) == [("stdout", "both")]
    assert [text for _, text in lines_of(outer.run)] == ["outer", "both", "outer again"]
    assert vars(sys.stdout).get("write") is write


def test_a_script_may_replace_its_streams_and_close_them(tmp_path, monkeypatch):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        print("seen")
        monkeypatch.setattr(sys, "stdout", io.StringIO())
        print("elsewhere")
        assert sys.stdout.getvalue() == "elsewhere\n"
        sys.stdout.close()
        with pytest.raises(ValueError, match="closed"):
            print("nowhere")
    assert lines_of(env.run) == [("stdout", "seen")]


@pytest.mark.parametrize("stream", [None, object(), SimpleNamespace(write=lambda text: None)])
def test_streams_of_other_kinds_are_left_as_they_are(tmp_path, monkeypatch, stream):
    before = dict(vars(stream)) if isinstance(stream, SimpleNamespace) else None
    monkeypatch.setattr(sys, "stdout", stream)
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        if before:
            print("text")
    assert lines_of(env.run) == ([("stdout", "text")] if before else [])
    assert before is None or vars(stream) == before


def test_who_replaces_the_method_later_keeps_theirs(tmp_path, monkeypatch):
    stream, later = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), []
    monkeypatch.setattr(sys, "stdout", stream)
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        ours = stream.write
        stream.write = lambda text: (later.append(text), ours(text))[1]
        print("both")
    print("theirs")
    assert "".join(later) == "both\ntheirs\n"
    stream.flush()
    assert stream.buffer.getvalue() == b"both\ntheirs\n"
    assert lines_of(env.run) == [("stdout", "both")]


def test_a_method_that_is_replaced_and_restored_by_somebody_is_replaced_again(tmp_path, monkeypatch, often):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    original = stream.write
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        stream.write = original
        time.sleep(0.6)  # the observer begins after half a second
        until(lambda write: write is not original, lambda: stream.write)
        stream.write = theirs = partial(stream.write)
        until(lambda write: write is not theirs, lambda: stream.write)
        print("once")
    assert lines_of(env.run) == [("stdout", "once")]


def test_a_notebook_has_the_output_of_its_cells_recorded_and_shown(tmp_path):
    record = f"env = runner.record(gymnasium.make('CartPole-v1'), recordings={str(tmp_path)!r})"
    cells = [
        f"import gymnasium, runner, sys\n{record}\nprint('first')",
        "print('second', file=sys.stderr)",
        "print('third'); env.close()",
        "print('after')",
    ]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in cells])
    NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    shown = ["".join(output["text"] for output in cell.outputs) for cell in notebook.cells]
    assert shown == ["first\n", "second\n", "third\n", "after\n"]
    (run,) = list_runs(tmp_path)
    assert lines_of(run) == [("stdout", "first"), ("stderr", "second"), ("stdout", "third")]


def test_secrets_in_the_output_are_shown_but_not_recorded(tmp_path, capsys):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        print("logged in with hf_" + "aBcD" * 8)
        print("WANDB_API_KEY=" + "0a" * 20)
    assert [text for _, text in lines_of(env.run)] == [
        "logged in with [redacted]",
        "WANDB_API_KEY=[redacted]",
    ]
    assert "hf_aBcD" in capsys.readouterr().out


def test_an_anonymous_file_has_no_output(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        print("/home/somebody")
    export_mcap(env.run, tmp_path / "anonymous.mcap", anonymous=True)
    with open_recording(tmp_path / "anonymous.mcap") as recording:
        assert read_console(recording, None) == []
        assert read_clock(recording) is not None


def test_threads_print_whole_texts(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        threads = [
            threading.Thread(target=lambda k=k: [sys.stdout.write(f"{k}\n") for _ in range(200)])
            for k in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    texts = [text for _, text in lines_of(env.run)]
    assert sorted(texts) == sorted(str(k) for k in range(4) for _ in range(200))


def test_a_forked_process_prints_into_nobody_elses_recording(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        print("parent")
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            print("child")
            os._exit(0 if "write" not in vars(sys.stdout) else 3)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
        print("parent again")
    assert [text for _, text in lines_of(env.run)] == ["parent", "parent again"]


def test_output_is_bounded_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(console, "MAX_CONSOLE_BYTES", 5_000)
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        for k in range(1_000):
            print(k)
    lines = lines_of(env.run)
    assert 20 < len(lines) < 100
    assert ("", "Console output beyond 10 MB is not recorded.") in lines
    assert MAX_CONSOLE_BYTES == 10 << 20


def test_too_much_in_a_second_is_left_out_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(console, "_MAX_WAITING", 1_000)
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        print("x" * 900)
        print("y" * 900)
    (_, first), (stream, note) = lines_of(env.run)
    assert first == "x" * 900
    assert stream == ""
    assert note.startswith("901 characters are left out") or note.startswith("900 characters")


def test_a_job_has_what_its_process_prints(tmp_path, capsys):
    run = make_run(tmp_path, TAXIS)
    assert lines_of(run) == []
    with open_recording(run.recording) as recording:
        assert recording.config["recording"]["console"]


def test_a_resumed_job_that_stops_before_it_has_new_steps_leaves_the_streams_as_they_were(tmp_path):
    run = copy_of(make_run(tmp_path, TAXIS, episodes=2000), tmp_path / "cut", summary={})
    os.truncate(run.recording, int(0.97 * run.recording.stat().st_size))
    before = vars(sys.stdout).get("write"), vars(sys.stderr).get("write")
    assert resume(run, stop=stopping_after(1)).status == "interrupted"
    assert (vars(sys.stdout).get("write"), vars(sys.stderr).get("write")) == before


def test_a_line_of_no_stream_is_refused(tmp_path):
    run = make_run(tmp_path, TAXIS)
    line = (0, encode(schema.CONSOLE, {"stream": 7, "text": "x"}))
    path = altered(run.recording, tmp_path / "forged.mcap", schema.CONSOLE_TOPIC, lambda _: [line])
    with open_recording(path) as recording, pytest.raises(RecordingError, match="stream 7"):
        read_console(recording, None)


def test_a_later_state_of_a_line_replaces_the_earlier_one_in_its_session_only(tmp_path):
    run = make_run(tmp_path, TAXIS)
    states = [(1.0, "10 %"), (1.0, "20 %"), (2.0, "again")]
    messages = [
        (0, encode(schema.CONSOLE, {"started": started, "stream": 1, "line": 4, "text": text}))
        for started, text in states
    ]
    path = altered(run.recording, tmp_path / "two.mcap", schema.CONSOLE_TOPIC, lambda _: messages)
    sessions = Clock(np.zeros(1, np.int64), np.zeros(1), np.zeros(1), {1.0: 0.0, 2.0: 50.0})
    with open_recording(path) as recording:
        lines = read_console(recording, sessions)
    assert [(line.seconds, line.text) for line in lines] == [(0.0, "20 %"), (50.0, "again")]

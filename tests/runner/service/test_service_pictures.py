"""Pictures of the episodes of loops: recorded or drawn, streamed, limited, and missing with a reason."""

from __future__ import annotations

import asyncio
import io
import itertools
import threading
import time

import gymnasium
import numpy as np
import pytest
from loop_replays import block_of, pictures, serving, steps_of
from PIL import Image

from runner.recording.reader import open_recording
from runner.replay.steps import recorded_frames
from runner.runs.resolve import find_run
from runner.service.errors import Busy
from runner.service.pictures import MAX_STREAMS, PictureStreams


def test_recorded_frames_are_passed_on_as_they_are(loops_client, loops, monkeypatch):
    monkeypatch.setattr("runner.export.pictures.why_not_rerun", lambda *_: "It is not installed.")
    length = len(steps_of(loops, "framed", "train", 1))
    with open_recording(find_run("framed", loops).recording) as recording:
        recorded = [frame["data"] for frame in recorded_frames(recording, "train", 1)]
    found, problem = pictures(loops_client, "framed/replay/train/1", steps=1000)
    assert problem == ""
    assert len(found) == length + 1
    assert filled(found) == recorded
    assert not any(data for k, data in enumerate(found) if k % 3 and k < length), "a frame every 3 steps"
    later, _ = pictures(loops_client, "framed/replay/train/1", start=4, steps=3)
    assert filled(later) == recorded[4:7]


def filled(found):
    """Return the picture at each step."""
    return list(itertools.accumulate(found, lambda before, data: data or before))


def test_pictures_that_were_not_recorded_are_those_that_the_environment_draws(loops_client, loops):
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    env.reset(seed=102)
    drawn = [env.render()]
    for action in steps_of(loops, "pole", "eval", 2)["action"].tolist():
        env.step(action)
        drawn.append(env.render())
    found, problem = pictures(loops_client, "pole/replay/eval/4/2", steps=1000)
    assert problem == ""
    assert len(found) == len(drawn)
    for data, expected in zip(filled(found), drawn, strict=True):
        shown = np.asarray(Image.open(io.BytesIO(data)), np.float64)
        assert np.abs(shown - expected).mean() < 2
    for start in (1, 5, len(drawn) - 1):
        again, _ = pictures(loops_client, "pole/replay/eval/4/2", start=start, steps=2)
        assert filled(again) == filled(found)[start : start + 2]


def test_pictures_after_the_end_are_none(loops_client):
    assert pictures(loops_client, "pole/replay/train/0", start=10**6) == ([], "")


@pytest.fixture
def too_long(monkeypatch):
    """Let environments take too long, also those whose process is quicker than this one."""
    monkeypatch.setattr("runner.replay.makers.SECONDS", 1e-3)
    monkeypatch.setattr("multiprocessing.connection.Connection.poll", lambda *_: False)


def test_an_environment_that_takes_too_long_is_given_up_with_a_reason(loops_client, too_long):
    found, problem = pictures(loops_client, "pole/replay/train/2")
    assert found == []
    assert "took longer than 0.001 s" in problem


def test_where_an_environment_cannot_draw_the_recorded_frames_are_shown_with_the_reason(
    loops_client, too_long
):
    notes = []
    found, problem = pictures(loops_client, "framed/replay/train/2", notes, steps=1000)
    assert found[0].startswith(b"\x89PNG")
    assert found[1:4] == [b"", b"", found[3]]
    assert "took longer than 0.001 s" in notes[0]
    assert problem == ""


def test_a_damaged_recording_ends_the_pictures_with_a_reason(loops, tmp_path, monkeypatch):
    monkeypatch.setattr("runner.export.pictures.why_not_rerun", lambda *_: "It is not installed.")
    data = bytearray(find_run("framed", loops).recording.read_bytes())
    place = data.rindex(b"\x89PNG")  # frames are stored as they are, in chunks with a checksum
    data[place + 100] ^= 255
    run = tmp_path / "recordings" / "framed"
    run.mkdir(parents=True)
    for file in find_run("framed", loops).folder.iterdir():
        (run / file.name).write_bytes(data if file.suffix == ".mcap" else file.read_bytes())
    with serving(run.parent) as client:
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


async def read(streams, key, make, start, stop):
    block = await streams.block(key, make, start, stop, here)
    return [block.pictures[number] for number in block.shown]


async def here():
    return False


def test_a_stream_continues_for_the_next_request_and_begins_again_for_an_earlier_step():
    async def run():
        streams, closed, begun = PictureStreams(), [], []

        def make(start):
            begun.append(start)
            return endless(closed)(start)

        assert await read(streams, "a", make, 3, 5) == [b"3", b"4"]
        assert await read(streams, "a", make, 7, 9) == [b"7", b"8"]
        assert begun == [3]
        assert await read(streams, "a", make, 2, 3) == [b"2"]
        assert begun == [3, 2]
        await until(lambda: len(closed) == 1)
        streams.close()
        await until(lambda: len(closed) == 2)

    asyncio.run(run())


def test_streams_are_limited_kept_ones_give_way_and_are_closed_when_nobody_comes_back(monkeypatch):
    monkeypatch.setattr("runner.service.pictures.IDLE_SECONDS", 0.3)

    async def run():
        streams, closed = PictureStreams(), []
        for number in range(MAX_STREAMS):
            streams.open(number, endless(closed), 0)
        with pytest.raises(Busy):
            await read(streams, "another", endless(closed), 0, 1)
        streams._keep(streams._streams[0])
        assert await read(streams, "another", endless(closed), 0, 1) == [b"0"]
        await until(lambda: len(closed) == 1)
        for stream in streams._streams:
            streams._keep(stream)
        await until(lambda: len(closed) == MAX_STREAMS + 1)

    asyncio.run(run())


def test_a_block_has_each_picture_once_and_ends_when_they_take_long_or_nobody_waits(monkeypatch):
    monkeypatch.setattr("runner.service.pictures.BLOCK_SECONDS", 0.3)

    def slow(start):
        yield "a note"
        yield from (b"a", b"a", b"", b"b", b"a")
        time.sleep(1)
        while True:
            yield b"c"
            time.sleep(5)

    async def run():
        streams, begun = PictureStreams(), time.monotonic()
        block = await streams.block("a", slow, 0, 64, here)
        assert (block.pictures, block.shown, block.note) == ([b"a", b"b", b"a"], [0, 0, 0, 1, 2], "a note")
        assert time.monotonic() - begun < 1
        block = await streams.block("a", slow, 5, 64, here)
        assert (block.pictures, block.shown, block.note) == ([b"c"], [0], "a note")
        gone = time.monotonic() + 0.5

        async def is_gone():
            return time.monotonic() > gone

        assert (await streams.block("a", slow, 6, 64, is_gone)).shown == []
        assert time.monotonic() < gone + 2
        streams.close()

    asyncio.run(run())


def test_a_whole_block_has_a_tag_by_which_it_is_not_sent_again(loops_client, monkeypatch):
    address = "/api/v1/runs/pole/replay/train/1/pictures?start=0&steps=4"
    first = loops_client.get(address)
    tag = first.headers["etag"]
    assert len(block_of(first.content)[0]["shown"]) == 4
    monkeypatch.setattr("runner.service.pictures.PictureStreams.block", None)  # nothing is made again
    assert loops_client.get(address).content == first.content
    again = loops_client.get(address, headers={"If-None-Match": tag})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)


def test_a_picture_that_arrives_while_the_client_is_looked_for_is_sent_at_once(monkeypatch):
    monkeypatch.setattr("runner.service.pictures._LOOK_SECONDS", 20)

    async def run():
        streams, asked = PictureStreams(), threading.Event()

        def make(start):
            asked.wait()
            yield b"picture"

        async def look():
            asked.set()
            await asyncio.sleep(0.2)
            return False

        began = time.monotonic()
        assert (await streams.block("a", make, 0, 1, look)).pictures == [b"picture"]
        assert time.monotonic() - began < 10
        streams.close()

    asyncio.run(run())


async def until(holds):
    end = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


# --- in a browser -------------------------------------------------------------------------------------

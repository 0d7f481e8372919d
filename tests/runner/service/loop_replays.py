"""Loops of every kind, recorded, and what a service answers about their replays."""

from __future__ import annotations

import contextlib
import itertools
import json
import struct
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv
from starlette.testclient import TestClient

import runner
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.runs.trust_marks import MARK_FILE
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from tests.runner.loops.making import Rooms


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


def record_loops(folder: Path) -> None:
    """Record the loops `pole`, `framed`, `rooms`, `poles` (a vector) and `game` (two agents)."""
    play(gymnasium.make("CartPole-v1"), folder, "pole")
    play(gymnasium.make("CartPole-v1", render_mode="rgb_array"), folder, "framed", frames_every=3)
    play(Rooms(with_text=True), folder, "rooms")
    (find_run("rooms", folder).folder / MARK_FILE).unlink()  # as of one that was pushed
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


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[TestClient]:
    """Yield a client of a service for the runs of a folder."""
    settings = ServiceSettings(recordings=(folder,), tokens=folder.with_name("tokens.json"))
    with TestClient(create_app(settings), base_url="http://localhost") as client:
        yield client


def part(client, address, **query):
    answer = client.get(f"/api/v1/runs/{address}", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()["episode"]


def pictures(client, address, notes=None, start=0, steps=64):
    """Return the pictures of steps, empty where one stays, and why there are no more; collect notes."""
    found = []
    while True:
        query = {"start": start + len(found), "steps": steps - len(found)}
        answer = client.get(f"/api/v1/runs/{address}/pictures", params=query)
        assert answer.status_code == 200, answer.text
        head, own = block_of(answer.content)
        before = -1
        for number in head["shown"]:
            found.append(own[number] if number != before else b"")
            before = number
        if head["note"] and notes is not None:
            notes.append(head["note"])
        if head["problem"] or start + len(found) > head["last"] or len(found) == steps:
            return found, head["problem"]


def block_of(data):
    """Return the head and the pictures of a block."""
    (length,) = struct.unpack_from(">I", data)
    head, data = json.loads(data[4 : 4 + length]), data[4 + length :]
    ends = list(itertools.accumulate(head["sizes"]))
    assert len(data) == (ends[-1] if ends else 0)
    return head, [data[end - size : end] for end, size in zip(ends, head["sizes"], strict=True)]


def page(client, address, status=200):
    answer = client.get(address, headers={"Accept": "text/html"})
    assert answer.status_code == status, answer.text
    return answer.text


def taken(words):
    return [words["values"][i] for i in words["at"]]


def steps_of(folder, name, phase, episode):
    with open_recording(find_run(name, folder).recording) as recording:
        return recording.phase(phase).episode_steps(episode)

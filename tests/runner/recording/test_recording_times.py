"""Logical time: how many environment steps were executed, training and evaluation together, 0.1 s each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from runner.recording import schema
from runner.recording.messages import message_class
from runner.recording.reader import open_recording
from tests.runner.recording.making import LAKE, TAXIS, make_run

TENTH = 100_000_000
"""Nanoseconds of an environment step."""


def all_of(recording, topic):
    return recording.table(topic).array()


@pytest.fixture(
    params=[TAXIS, LAKE, TAXIS | {"evaluation": None}, LAKE | {"evaluation": {"every": 1, "trials": 1}}]
)
def recording(request, tmp_path):
    """Return recordings with and without evaluation, opened."""
    with open_recording(
        make_run(tmp_path, request.param, {"recording": {"chunk_steps": 256}}).recording
    ) as opened:
        yield opened


def test_each_step_of_either_phase_takes_the_next_tenth_of_a_second(recording):
    plan = recording.config["evaluation"]
    training = all_of(recording, schema.TRAIN_STEP)
    evaluated = all_of(recording, schema.EVAL_STEP) if plan else training[:0]
    # Evaluation e comes after a number of training episodes; its steps come before those of the next one.
    executed = []
    due = [n for n in range(recording.config["episodes"] + 1) if plan and n % plan["every"] == 0]
    for number, episodes in enumerate(due):
        earlier = due[number - 1] if number else 0
        executed += training[(training["episode"] >= earlier) & (training["episode"] < episodes)].tolist()
        executed += evaluated[evaluated["episode"] // plan["trials"] == number].tolist()
    executed += training[training["episode"] >= (due[-1] if due else 0)].tolist()
    at = training.dtype.names.index("log_time")
    assert len(executed) == len(training) + len(evaluated)
    assert [step[at] for step in executed] == [TENTH * n for n in range(1, len(executed) + 1)]


def test_an_episode_has_the_time_of_its_last_step(recording):
    for steps, episodes in (
        (schema.TRAIN_STEP, schema.TRAIN_EPISODE),
        (schema.EVAL_STEP, schema.EVAL_EPISODE),
    ):
        if recording.table(steps).count():
            ended, taken = all_of(recording, episodes), all_of(recording, steps)
            assert ended["log_time"].tolist() == taken["log_time"][ended["last_step"]].tolist()


def test_measures_and_tables_have_the_time_of_the_last_step_before_them(recording):
    training = all_of(recording, schema.TRAIN_STEP)
    evaluated = all_of(recording, schema.EVAL_STEP) if recording.eval.steps.count() else training[:0]
    times = np.sort(np.concatenate([training["log_time"], evaluated["log_time"]]))
    assert recording.train.all_metrics(), "the case must have measures of training"
    for metrics in recording.train.all_metrics():
        assert metrics["log_time"] == training["log_time"][metrics["step"] - 1]
    for number, metrics in enumerate(recording.eval.all_metrics()):
        trials = evaluated["episode"] // metrics["trials"]
        assert metrics["evaluation"] == number
        assert metrics["log_time"] == evaluated["log_time"][trials == number][-1]
    for log_time, payload in recording.table(schema.Q_TABLE_TOPIC).messages():
        step = message_class(schema.Q_TABLE).FromString(payload).step
        assert log_time == 0 or log_time in times
        assert (training["log_time"] <= log_time).sum() == step


def test_times_do_not_decrease_within_a_topic_and_equal_publish_times(recording):
    topics: dict[str, list[int]] = {}
    with Path(recording.path).open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            assert message.publish_time == message.log_time
            topics.setdefault(channel.topic, []).append(message.log_time)
    for topic, times in topics.items():
        assert times == sorted(times), topic


def test_the_time_in_a_text_is_that_of_its_message(recording):
    lines = [
        (time, message_class(schema.LOG).FromString(payload))
        for time, payload in recording.table(schema.LOG_TOPIC).messages()
    ]
    assert len(lines) >= 2
    for time, line in lines:
        assert line.timestamp.seconds * 10**9 + line.timestamp.nanos == time

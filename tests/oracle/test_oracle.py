"""Every kind of recording has the logical content that it had, whatever became of its format."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from runner.recording import schema
from runner.recording.messages import decode, decode_q_table, encode, encode_q_table
from tests.oracle import reading, storing
from tests.oracle.recipes import ALGORITHMS, DATA, MORE_ALGORITHMS, contents
from tests.runner.altering import altered


@pytest.fixture(scope="module")
def kept():
    return storing.read()


@pytest.mark.timeout(900)  # it compiles the kernel for several kinds of jobs
def test_every_recording_has_the_content_that_it_had(kept, tmp_path):
    found = contents(tmp_path, ALGORITHMS)
    assert found.keys() == kept.keys() - {f"job-{algorithm}" for algorithm in MORE_ALGORITHMS}
    differ = [line for run, content in found.items() for line in storing.differences(run, kept[run], content)]
    assert not differ, "\n".join(differ)


def _changed(column: str, row: int) -> Any:
    """Return what changes a value of a block."""

    def change(block: Any) -> Any:
        block[column][row] = ~block[column][row] if block[column].dtype == bool else block[column][row] + 1
        return block

    return change


def _changed_message(message: schema.MessageType, row: int, **turns: Any) -> Any:
    """Return what changes fields of a message of variable size."""

    def change(messages: Any) -> Any:
        time, payload = messages[row]
        fields = decode(message, payload)
        fields |= {name: turn(fields[name]) for name, turn in turns.items()}
        messages[row] = time, encode(message, fields)
        return messages

    return change


def _changed_table(messages: Any) -> Any:
    time, payload = messages[1]
    table = decode_q_table(payload)
    values = table.values.copy()
    values[3, 2] = np.nextafter(values[3, 2], 1)
    changed = type(table)(table.step, table.episode, table.agent, table.table, values)
    messages[1] = time, encode_q_table(changed)
    return messages


def _other_luck(text: str) -> str:
    return text.replace("0.5", "0.25", 1)


ALTERATIONS = {
    "steps": ("cooperative", schema.TRAIN_STEP, _changed("rewards", 17), "train.steps.rewards, row 17:"),
    "flags": ("vector", schema.TRAIN_STEP, _changed("truncated", 5), "train.steps.truncated, row 5:"),
    "resets": ("pole", schema.TRAIN_RESET, _changed("seed", 2), "train.resets.seed, row 2:"),
    "episodes": ("pole", schema.TRAIN_EPISODE, _changed("length", 3), "train.episodes.length, row 3:"),
    "evaluations": (
        "cooperative",
        schema.EVAL_METRICS_TOPIC,
        _changed_message(schema.EVAL_METRICS, 1, eval_mean_length=lambda value: value + 2**-40),
        "eval.metrics.eval_mean_length, row 1:",
    ),
    "scalars": (
        "pole",
        schema.SCALAR_TOPIC,
        _changed_message(schema.SCALAR, 0, value=lambda value: -value),
        "scalars.value, row 0:",
    ),
    "snapshots": ("competitive", schema.Q_TABLE_TOPIC, _changed_table, "q_tables.values, row 1:"),
    "infos": (
        "rooms",
        schema.TRAIN_INFO,
        _changed_message(schema.INFO, 4, json=_other_luck),
        "train.infos.info, row 4:",
    ),
}


@pytest.mark.parametrize("what", ALTERATIONS)
def test_one_altered_value_is_found_with_its_place(what, kept, tmp_path):
    name, topic, change, place = ALTERATIONS[what]
    path = altered(DATA / f"{name}.mcap", tmp_path / "altered.mcap", topic, change)
    (line,) = storing.differences(name, kept[name], reading.read(path))
    assert line.startswith(f"{name}: {place} found ")
    assert not list(storing.differences(name, kept[name], reading.read(DATA / f"{name}.mcap")))


def test_what_is_missing_is_named(kept):
    content = {table: dict(columns) for table, columns in kept["pole"].items()}
    del content["train.resets"], content["scalars"]["value"]
    content["train.steps"]["rewards"] = content["train.steps"]["rewards"].astype("<f4")
    found = list(storing.differences("pole", kept["pole"], content))
    assert "pole: train.resets: missing" in found
    assert "pole: scalars.value: missing" in found
    assert any(line.startswith("pole: train.steps.rewards: found <f4") for line in found)


def test_the_index_shows_the_columns_of_each_run(kept):
    index = json.loads(storing.INDEX.read_text(encoding="utf-8"))
    kind, shape, *_, first = index["pole"]["train.steps"]["next_observation"]
    assert (kind, shape[1:], np.float32(first).tolist()) == (
        "<f4",
        [4],
        kept["pole"]["train.steps"]["next_observation"][0].tolist(),
    )

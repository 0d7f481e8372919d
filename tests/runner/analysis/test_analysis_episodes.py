"""One grammar for references to steps, of commands and pages."""

from __future__ import annotations

import pytest

from runner.analysis.episodes import EXPECTED_OF_TRAINING, EpisodeRef
from runner.errors import RunnerError
from runner.recording import recorder
from runner.recording.reader import open_recording
from runner.views.recorded import episodes


@pytest.mark.parametrize(
    ("text", "step"),
    [
        ("120", EpisodeRef(120)),
        ("train:120", EpisodeRef(120)),
        ("train:120:5", EpisodeRef(120, 5)),
        ("120:5", EpisodeRef(120, 5)),
        ("eval:3000", EpisodeRef(0, after=3000)),
        ("eval:3000:17", EpisodeRef(17, after=3000)),
        ("eval:3000:17:5", EpisodeRef(17, 5, 3000)),
        ("best", EpisodeRef(word="best")),
        ("last:5", EpisodeRef(t=5, word="last")),
    ],
)
def test_what_is_left_out_is_0(text, step):
    assert EpisodeRef.parse(text) == step
    assert EpisodeRef.parse(str(step)) == step


def test_a_training_step_by_its_number_is_named_as_such():
    assert EpisodeRef.parse("step:120") == EpisodeRef.parse(120) == EpisodeRef(t=120, word="step")
    assert str(EpisodeRef.parse("step:120")) == "step:120"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "step:",
        "step:1:2",
        "1:",
        ":5",
        "1:2:3",
        "bestest",
        "train:",
        "eval:",
        "eval:1:2:3:4",
        "-1",
        "1_0",
        "٣",
        " 1",
    ],
)
def test_anything_else_is_refused_with_what_is_expected(text):
    with pytest.raises(RunnerError, match="expected EPISODE:T such as 120:5, step:N, or eval:N:TRIAL:T"):
        EpisodeRef.parse(text)


def test_the_nearest_word_is_suggested_where_it_is_accepted():
    for text in ("bset", "bset:5"):
        with pytest.raises(RunnerError, match=r"worst or last\. Did you mean 'best'\?"):
            EpisodeRef.parse(text)
    with pytest.raises(RunnerError, match=r"step by its number\.$"):
        EpisodeRef.parse("bset", EXPECTED_OF_TRAINING)


@pytest.mark.parametrize("phase", ["train", "eval"])
def test_episodes_come_in_an_order(record, phase, monkeypatch):
    """A part of an order is the same as that part of all episodes."""
    monkeypatch.setattr(recorder, "FLUSH_SECONDS", -1)  # many chunks, however quickly the run goes
    with open_recording(record("recording.chunk_steps=256", "episodes=600")) as recording:
        table = recording.phase(phase).episodes
        assert phase == "eval" or len(table) > 1  # chunks
        everything = table.array()
        for order, field, sign in (
            ("longest", "length", -1),
            ("shortest", "length", 1),
            ("newest", "episode", -1),
        ):
            columns = episodes(recording, phase, order, 5, 25).as_json()["columns"]
            lengths = sorted(everything[field].tolist(), key=lambda value: sign * value)
            assert columns[field] == lengths[5:25]
            for i, number in enumerate(columns["episode"]):
                assert columns["length"][i] == everything["length"][number]
                assert columns["last_step"][i] == everything["last_step"][number]
        best, worst = (
            episodes(recording, phase, order, 0, len(everything)).as_json()["columns"]
            for order in ("best", "worst")
        )
        assert best["episode"] == worst["episode"][::-1]
        assert best["success"] == sorted(everything["success"].tolist(), reverse=True)

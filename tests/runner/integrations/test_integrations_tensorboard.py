"""Scripts that log in the shape of TensorBoard."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from scripts import arrays, images, scalars, the_run

import runner
from runner.analysis.series import read_series, values_left_out
from runner.integrations import shapes
from runner.integrations.script import MAX_NAMES
from runner.integrations.tensorboard import SummaryWriter
from runner.recording import schema


def test_numbers_of_every_kind_are_logged_and_others_left_out():
    with SummaryWriter() as writer:
        for value in (1, True, np.int64(3), np.array([0.5], np.float32), np.nan, np.inf):
            writer.add_scalar("x", value)
        with pytest.warns(RuntimeWarning, match="a value was left out: add_scalar: found str"):
            writer.add_scalar("x", "text")
        writer.add_scalar("y", None)  # a second warning would be an error
        with pytest.warns(RuntimeWarning, match="a step was left out: found the step 'two'"):
            writer.add_scalar("x", 1.0, "two")
    np.testing.assert_equal(
        [value for _, value, _ in scalars(the_run())], [1, 1, 3, 0.5, np.nan, np.inf, 1.0]
    )


def test_values_without_a_step_are_numbered_by_name():
    with SummaryWriter() as writer:
        for value in range(3):
            writer.add_scalars("x", {"a": value, "b": value})
    assert [step for *_, step in scalars(the_run())] == [0, 0, 1, 1, 2, 2]


def test_histograms_pictures_films_and_figures_are_recorded():
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1, 1), dpi=50)
    with SummaryWriter() as writer:
        writer.add_histogram("weights", np.arange(128.0), 5)
        writer.add_image("chw", np.zeros((3, 8, 6), np.uint8), 5)
        writer.add_image("hw", np.ones((8, 6)), 5, dataformats="HW")
        writer.add_images("four", np.zeros((4, 1, 8, 6)), 5)
        writer.add_video("film", np.zeros((2, 5, 3, 8, 6), np.uint8), 5, fps=10)
        writer.add_figure("figure", figure, 5)
        with pytest.warns(RuntimeWarning, match=r"found shape \[8, 6\], expected the axes CHW"):
            writer.add_image("bad", np.zeros((8, 6)))
    found = arrays(the_run())
    assert found["weights/counts"].sum() == 128
    assert found["weights/edges"].shape == (65,)
    assert [(name, kind) for name, kind, _ in images(the_run())] == [
        *(("chw", "png"), ("hw", "png"), ("four", "png"), ("film", "webp"), ("figure", "png"))
    ]


def test_each_method_warns_once_of_what_it_leaves_out():
    with SummaryWriter() as writer:
        for method in (writer.add_image, writer.add_images):
            with pytest.warns(RuntimeWarning, match=r"found shape \[8\], expected the axes"):
                method("bad", np.zeros(8))
            method("bad", np.zeros(8))  # a second warning would be an error


def test_pictures_keep_their_pixels():
    import io

    from PIL import Image

    pixels = np.random.default_rng(0).integers(0, 256, (8, 6, 3), np.uint8)
    with SummaryWriter() as writer:
        writer.add_image("a", pixels, dataformats="HWC")
        writer.add_image("b", pixels.transpose(2, 0, 1) / 255.0 + 1e-6)
        writer.add_video("c", np.stack([pixels, 255 - pixels])[None].transpose(0, 1, 4, 2, 3))
    for name, _, data in images(the_run()):
        image = Image.open(io.BytesIO(data))
        assert image.size == ((6, 8))
        if name != "c":
            assert (np.asarray(image) == pixels).all()
        else:
            assert image.n_frames == 2


def test_what_a_recording_has_no_place_for_says_so_once(monkeypatch):
    monkeypatch.setattr(shapes, "_warned", set())
    with SummaryWriter() as writer:
        with pytest.warns(RuntimeWarning, match="add_graph does nothing"):
            writer.add_graph(None)
        writer.add_graph(None)  # a second warning would be an error
        with pytest.warns(RuntimeWarning, match="add_what_comes_later does nothing"):
            writer.add_what_comes_later()


def test_hyperparameters_of_tensorboard_are_the_settings():
    with SummaryWriter() as writer:
        writer.add_hparams({"lr": 0.1}, {"score": 2.0})
    assert the_run().facts["config"]["config"] == {"lr": 0.1}
    assert the_run().summary["logged"] == {"score": 2.0}


def test_hyperparameters_after_the_beginning_are_a_text_without_secrets():
    env = gymnasium.make("CartPole-v1")
    with SummaryWriter() as writer:
        env.reset(seed=0)
        writer.add_hparams({"lr": 0.1, "api_key": "hunter2"}, {})
    with runner.open_recording(the_run().recording) as recording:
        texts = [row["message"] for row in recording.table(schema.LOG_TOPIC).decoded()]
    assert texts == ["{'lr': 0.1, 'api_key': '[redacted]'}"]


def test_the_folder_that_the_script_names_is_there_for_its_own_files(folder):
    with SummaryWriter("runs/ALE/Pong-v5__ppo__1") as writer:
        writer.add_scalar("x", 1.0)
        assert (folder / writer.get_logdir()).is_dir()
    assert the_run().name == "ALE/Pong-v5__ppo__1"


def test_names_are_bounded():
    with SummaryWriter() as writer:
        for number in range(MAX_NAMES):
            writer.add_scalar(f"step {number}", 1.0)
        with pytest.warns(RuntimeWarning, match="more than 10,000 names"):
            writer.add_scalar("one more", 1.0)
        writer.add_scalar("another", 1.0)
    assert len({name for name, *_ in scalars(the_run())}) == MAX_NAMES
    with runner.open_recording(the_run().recording) as recording:
        series = read_series(recording)
    (sentence,) = values_left_out([series])
    assert "other names than the first 64 that were logged: 9,936 values" in sentence

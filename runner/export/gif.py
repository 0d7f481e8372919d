"""A short film of a recorded episode: the SVG frames with step, actions and rewards below them.

The frames are those of `svg`, made into pixels by resvg (a small, self-contained renderer: no cairo, no
browser), with the one font that Matplotlib brings along, so that a film looks the same everywhere.
"""

from __future__ import annotations

import textwrap
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from runner.errors import RecordingError
from runner.export import svg
from runner.export.plots_figure import matplotlib_of
from runner.export.report_replay import Episode, deeds_in_words
from runner.extras import require
from runner.frames import agents_of
from runner.mdp import Mdp
from runner.recording.reader import Recording
from runner.words import events_in_words, exploration_in_words, spoken, states_in_words

if TYPE_CHECKING:
    from PIL.Image import Image

WIDTH: Final = 480
"""Pixels across."""
MOST_STEPS: Final = 200
"""Steps that a film shows, unless told."""
LAST_SECONDS: Final = 2.5
"""For how long the last frame stays."""
_FONT: Final = 17
_LINE: Final = 24
_MARGIN: Final = 14
_LETTER: Final = 0.615
"""Width of a letter of DejaVu Sans, on average and generously, as a share of the font's size."""
_TALLEST: Final = 480
_COLOURS: Final = 128


def write_gif(
    path: Path, recording: Recording, episode: Episode, steps_a_second: float = 2.0, width: int = WIDTH
) -> int:
    """Write the film of an episode, and return how many frames it has.

    Raises:
        MissingExtra: a package that draws it is not installed.
        OSError: the file cannot be written.
    """
    require_packages()
    frames = [_pixels(picture, width) for picture in pictures(recording, episode, width)]
    palette = _palette(frames)
    from PIL import Image

    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    step = round(1000 / steps_a_second)
    durations = [step] * (len(frames) - 1) + [round(1000 * LAST_SECONDS)]
    indexed[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=indexed[1:],
        duration=durations,
        loop=0,
        optimize=True,
    )
    return len(frames)


def require_packages() -> None:
    """Refuse to begin where a package is missing that a film needs.

    Raises:
        MissingExtra: it is.
    """
    require("resvg_py", "PIL", extra="plots", purpose="a film")
    matplotlib_of("a film")


def require_states(recording: Recording) -> None:
    """Refuse a loop over an environment whose states are not told, so that there is nothing to draw.

    Raises:
        RecordingError: it is one.
    """
    if not recording.tabular:
        raise RecordingError(
            f"{recording.path}: found a loop over {recording.environment.get('env_id')}, expected a tabular "
            "environment, whose states can be drawn; `dualtaxi view` shows the numbers and pictures that it "
            "recorded."
        )


def pictures(recording: Recording, episode: Episode, width: int = WIDTH) -> list[str]:
    """Return the frames of an episode as SVG, T + 1 of them."""
    mdp = recording.mdp
    drawing = None if mdp.scene is None or mdp.scene_cells is None else svg.Drawing(mdp.scene)
    places = None if drawing is None else drawing.places(mdp, episode.states)
    title = f"{recording.run['name']}, seed {recording.run['seed']}: {episode.title}"
    captions = captions_of(mdp, agents_of(recording), episode, scene=drawing is not None)
    room = int((width - 2 * _MARGIN) / (_FONT * _LETTER))
    heads = textwrap.wrap(title, room)
    wrapped = [
        [line for text in caption for line in textwrap.wrap(text, room) or [""]] for caption in captions
    ]
    lines = max(map(len, wrapped))
    made = []
    for number, caption in enumerate(wrapped):
        grid = ""
        if drawing is not None and places is not None:
            grid = drawing.frame(places[number], "", places[: number + 1])
        made.append(_framed(heads, grid, drawing, caption, lines, width))
    return made


def captions_of(mdp: Mdp, learners: list[str], episode: Episode, scene: bool = True) -> list[list[str]]:
    """Return for each frame what is written below it: step, actions, rewards, events."""
    actions = deeds_in_words(mdp)
    totals = np.cumsum(episode.rewards, axis=0)
    captions = [[f"step 0 of {episode.length:,}", "the episode begins", ""]]
    for k in range(episode.steps):
        explorers = exploration_in_words(int(episode.explored[k]), learners)
        explored = f" ({explorers})" if explorers else ""
        rewards = _rewards(learners, episode.rewards[k].tolist(), totals[k].tolist())
        captions.append(
            [
                f"step {k + 1:,} of {episode.length:,}: {actions[episode.actions[k]]}{explored}",
                rewards,
                events_in_words(mdp, int(episode.events[k])),
            ]
        )
    if episode.steps < episode.length:
        captions[-1].append(f"the film ends here, after {episode.steps:,} of {episode.length:,} steps")
    if not scene:
        words = states_in_words(mdp)[episode.states]
        captions = [[str(state), *caption] for state, caption in zip(words, captions, strict=True)]
    return captions


def _rewards(learners: list[str], rewards: list[float], totals: list[float]) -> str:
    if len(rewards) == 1:
        return f"reward {rewards[0]:+g}, sum {totals[0]:+g}"
    each = [f"{spoken(name)} {own:+g}" for name, own in zip(learners, rewards, strict=True)]
    return f"reward {', '.join(each)}; sum {sum(totals):+g}"


def _framed(
    heads: list[str], grid: str, drawing: svg.Drawing | None, caption: list[str], lines: int, width: int
) -> str:
    """Return a frame with its title above and its caption below, room left for the longest caption."""
    top = 10 + _LINE * len(heads)
    across, down = 0, 0
    if drawing is not None:
        scale = min((width - 2 * _MARGIN) / drawing.width, _TALLEST / drawing.height)
        across, down = round(drawing.width * scale), round(drawing.height * scale)
        left = (width - across) // 2
        grid = grid.replace("<svg ", f'<svg x="{left}" y="{top}" width="{across}" height="{down}" ', 1)
    height = top + down + 8 + _LINE * lines + 8
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}"><rect width="{width}" height="{height}" fill="#ffffff"/>'
        f"{_text(heads, 4, 'bold')}{grid}{_text(caption, top + down + 8, 'normal')}</svg>"
    )


def _text(lines: list[str], top: int, weight: str) -> str:
    return "".join(
        f'<text x="{_MARGIN}" y="{top + _LINE * (number + 1) - 7}" font-family="DejaVu Sans" '
        f'font-size="{_FONT}" font-weight="{weight}" fill="#1b1f24">{escape(line)}</text>'
        for number, line in enumerate(lines)
    )


def _pixels(picture: str, width: int) -> Image:
    """Return an SVG as an image."""
    import resvg_py
    from PIL import Image

    fonts = Path(matplotlib_of("a film").get_data_path()) / "fonts" / "ttf"
    names: list[Any] = [str(fonts / name) for name in ("DejaVuSans.ttf", "DejaVuSans-Bold.ttf")]
    png = resvg_py.svg_to_bytes(
        svg_string=picture, width=width, font_files=names, skip_system_fonts=True, font_family="DejaVu Sans"
    )
    return Image.open(BytesIO(bytes(png))).convert("RGB")


def _palette(frames: list[Image]) -> Image:
    """Return one palette for all frames: the commonest colours of the first, a middle and the last."""
    from PIL import Image

    some = [frames[0], frames[len(frames) // 2], frames[-1]]
    pixels = np.concatenate([np.asarray(frame).reshape(-1, 3) for frame in some])
    colours, counts = np.unique(pixels, axis=0, return_counts=True)
    palette = Image.new("P", (1, 1))
    palette.putpalette(colours[np.argsort(-counts)[:_COLOURS]].tobytes())
    return palette

"""The pytest plugin: the fixture `golden`, and the options `--golden-update` and `--golden-pages`.

pytest loads it wherever the project is installed, so heavy packages are imported only when a test uses it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from runner.environments.gym_types import Env
    from runner.runs.run import Run

FOLDER = "golden"
"""The folder of golden runs, next to the file of the test."""
_PROPERTY = "golden"
"""The property of a test's report that holds what the test has to tell."""
_UPDATE = "If the change is intended, keep the new one by `pytest --golden-update` and commit it."


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of golden runs."""
    group = parser.getgroup("golden", "golden runs: learning under test")
    group.addoption(
        "--golden-update", action="store_true", help="Keep the runs of these tests as the golden ones."
    )
    group.addoption(
        "--golden-pages",
        metavar="DIR",
        default="golden-differences",
        help="Folder for the pages that show differences (default: %(default)s).",
    )


@pytest.fixture
def golden(request: pytest.FixtureRequest, tmp_path: Path) -> Golden:
    """Compare runs of this test with its golden ones."""
    config = request.config
    pages = Path(config.getoption("--golden-pages"))
    return Golden(
        folder=request.path.parent / FOLDER / request.path.stem,
        test=_file_name(request.node.name),
        recordings=tmp_path / "recordings",
        pages=pages if pages.is_absolute() else config.rootpath / pages,
        is_update=config.getoption("--golden-update"),
        tell=lambda text: request.node.user_properties.append((_PROPERTY, text)),
    )


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what the tests of golden scores have to tell, after a run that keeps them."""
    lines = [
        f"{report.nodeid}: {text}"
        for report in terminalreporter.stats.get("passed", ())
        for name, text in report.user_properties
        if name == _PROPERTY
    ]
    if lines:
        terminalreporter.section("golden scores")
        terminalreporter.write_line("\n".join(lines))


def _file_name(name: str) -> str:
    """Return a test's name, with its parameters, as a file name."""
    return re.sub(r"[^\w.=+-]+", "-", name).strip("-.")[:150]


class Golden:
    """The golden runs of one test.

    Attributes:
        recordings: a recordings folder for this test, to run or record in.
    """

    def __init__(
        self,
        folder: Path,
        test: str,
        recordings: Path,
        pages: Path,
        is_update: bool,
        tell: Callable[[str], None],
    ) -> None:
        self.recordings = recordings
        self._folder = folder
        self._test = test
        self._pages = pages
        self._is_update = is_update
        self._tell = tell

    def same_bytes(self, run: Run, name: str = "") -> None:
        """Fail unless a run has the content of its golden run, to the last byte.

        Args:
            run: a finished run, of a job or of a loop.
            name: tells several golden runs of one test apart.
        """
        from runner.errors import RunnerError
        from runner.export.mcap import export_mcap
        from runner.golden.comparison import compare_bytes

        if run.status != "finished":
            pytest.fail(
                f"run {run.run_id} is {run.status}, expected finished: {run.summary.error or ''}",
                pytrace=False,
            )
        file = self._file(name, ".mcap")
        if self._is_update and not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            export_mcap(run, file, anonymous=True)
            return
        self._require(file)
        try:
            difference = compare_bytes(file, run.recording)
        except RunnerError as error:
            if not self._is_update:
                pytest.fail(f"{error}\n{_UPDATE}", pytrace=False)
        else:
            if difference is None:
                return
            if not self._is_update:
                self._pages.mkdir(parents=True, exist_ok=True)
                page = self._pages / f"{file.parent.name}--{file.stem}.html"
                page.write_text(difference.page, encoding="utf-8")
                pytest.fail(
                    f"differs from the golden run {file.name}.\n{difference.text}\npage: {page}\n{_UPDATE}",
                    pytrace=False,
                )
        export_mcap(run, file, anonymous=True, force=True)

    def same_environment(
        self,
        make: Callable[[], Env],
        episodes: int = 10,
        max_steps: int = 1_000,
        tolerance: float = 0.0,
        name: str = "",
    ) -> None:
        """Fail unless the recorded actions give the recorded observations, rewards and ends.

        The golden run has episodes of random actions, each with its number as seed.

        Args:
            make: returns the environment: a Gymnasium environment, wrapped or not.
            episodes: number of episodes when it is recorded.
            max_steps: the most steps of an episode when it is recorded.
            tolerance: absolute and relative, for observations and rewards of floating-point numbers, where
                machines differ; 0 compares bytes.
            name: tells several golden runs of one test apart.
        """
        from runner.errors import CannotRedo, RunnerError
        from runner.export.mcap import export_mcap
        from runner.golden.comparison import compare_environment, record_environment

        file = self._file(name, ".mcap")
        if not self._is_update:
            self._require(file)
        verdict = "the environment differs from"
        try:
            text = compare_environment(file, make, tolerance) if file.exists() else "there is none"
        except RunnerError as error:
            text = str(error)
            verdict = "cannot be rerun:" if isinstance(error, CannotRedo) else "damaged:"
        if text and self._is_update:
            file.parent.mkdir(parents=True, exist_ok=True)
            run = record_environment(make, episodes, max_steps, self.recordings)
            export_mcap(run, file, anonymous=True, force=True)
        elif text:
            pytest.fail(
                f"{verdict} the golden run {file.name}.\n{text}\n{_UPDATE}",
                pytrace=False,
            )

    def no_worse(
        self, scores: Sequence[float], margin: float, error_rate: float = 0.05, name: str = ""
    ) -> None:
        """Fail unless scores are shown to be no worse than the golden ones by a margin or more.

        If the true interquartile mean, or the mean of scores with two values, is worse by the margin or
        more, this passes with a probability of at most `error_rate`; see
        `runner.golden.comparison.non_inferiority`.

        Args:
            scores: one of each seed, higher is better; six or more.
            margin: the loss of the interquartile mean that is accepted.
            error_rate: the greatest probability to pass although it is worse by the margin or more.
            name: tells several golden scores of one test apart.
        """
        from runner.golden.comparison import error_rates, non_inferiority
        from runner.util.files import read_object, write_object

        scores = [float(score) for score in scores]
        file = self._file(name, ".json")
        if self._is_update:
            non_inferiority(scores, scores, margin, error_rate)  # refuses what could not be compared later
            file.parent.mkdir(parents=True, exist_ok=True)
            write_object(file, {"scores": scores})
            alarms, misses = error_rates(scores, margin, error_rate)
            self._tell(
                f"with a margin of {margin:g}, scores like these fail {alarms:.0%} of the time though "
                f"nothing changed, and pass {misses:.0%} of the time though worse by the margin"
            )
            return
        self._require(file)
        result = non_inferiority(read_object(file, 1 << 20)["scores"], scores, margin, error_rate)
        print(result)  # `pytest -rA` shows it of tests that pass, too
        if not result.is_shown:
            pytest.fail(
                f"not shown to be as good as the golden scores in {file.name}.\n{result}\n{_UPDATE}",
                pytrace=False,
            )

    def _file(self, name: str, suffix: str) -> Path:
        return self._folder / f"{self._test}{f'--{_file_name(name)}' if name else ''}{suffix}"

    def _require(self, file: Path) -> None:
        if not file.exists():
            pytest.fail(
                f"there is no golden run {file}; record it by `pytest --golden-update`.", pytrace=False
            )

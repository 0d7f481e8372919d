"""Numba's cache notices an edit of any file that goes into the compiled kernel."""

import subprocess
import sys
from pathlib import Path

from runner.learning import kernel, schedules
from runner.learning.numba_cache import stamp


def test_the_stamp_changes_with_any_file_of_the_folder(tmp_path):
    folders = [tmp_path / name for name in "abc"]
    for folder, text in zip(folders, ["x = 1", "x = 1", "x = 2"], strict=True):
        folder.mkdir()
        (folder / "kernel.py").write_text("import draws")
        (folder / "draws.py").write_text(text)
    same, equal, other = map(stamp, folders)
    assert same == equal != other


def test_the_kernel_is_cached_by_it():
    expected = stamp(Path(kernel.__file__).resolve().parent)
    for function in (kernel.train, kernel.evaluate, kernel.replay, schedules.schedule_value):
        assert function._cache._impl.locator.get_source_stamp() == expected


def test_scipy_is_left_to_functions_that_need_it():
    program = (
        "import sys, numba, numpy as np\n"
        "from runner.learning import kernel\n"
        "kernel.fill_random(np.zeros(1), np.uint64(0), 0.0, 1.0)\n"
        "print('scipy.linalg' in sys.modules)\n"
        "print(numba.njit(lambda a: np.linalg.det(a @ a))(np.eye(2)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "1.0"]

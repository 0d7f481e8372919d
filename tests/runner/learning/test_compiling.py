"""Numba's cache notices an edit of any file that goes into the compiled kernel."""

import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import caching

from runner.learning import algorithms, kernel, schedules
from runner.learning.compiling import stamp


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
    functions = (kernel.train, kernel.evaluate, kernel.replay, algorithms.choose, schedules.schedule_value)
    for function in functions:
        assert function._cache._impl.locator.get_source_stamp() == expected


def _printed(program: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_an_index_with_a_class_that_was_renamed_is_made_anew(tmp_path):
    (tmp_path / "kinds.py").write_text(
        "import sys\nfrom typing import NamedTuple\n"
        "class Old(NamedTuple):\n    value: int\n"
        "globals()[sys.argv[1]] = Old\nOld.__name__ = Old.__qualname__ = sys.argv[1]\n"
        "if sys.argv[1] != 'Old':\n    del Old\n"
    )
    (tmp_path / "loops.py").write_text(
        "import runner.learning.compiling, numba\n"
        "@numba.njit(cache=True)\ndef plus_one(pair):\n    return pair.value + 1\n"
    )
    program = "import sys, kinds; from loops import plus_one; print(plus_one(getattr(kinds, sys.argv[1])(1)))"
    for name in ("Old", "New"):
        command = [sys.executable, "-c", program, name]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        assert done.stdout == "2\n"
    assert list(tmp_path.glob("__pycache__/*.nbi"))


def test_scipy_is_left_to_functions_that_need_it():
    program = (
        "import sys, numba, numpy as np\n"
        "from runner.learning import kernel\n"
        "kernel.fill_random(np.zeros(1), np.uint64(0), 0.0, 1.0)\n"
        "print('scipy.linalg' in sys.modules)\n"
        "print(numba.njit(lambda a: a @ a)(np.eye(2))[0, 0])\n"
    )
    assert _printed(program) == ["False", "1.0"]


@pytest.mark.long
def test_a_function_of_the_user_calculates_with_blas():
    """Without it, `convolve` would add the products one by one, and round otherwise."""
    program = (
        "import numba, numpy as np\n"
        "from runner.learning import kernel\n"
        "a = np.random.default_rng(1).normal(size=500)\n"
        "dot = numba.njit(lambda a, b: np.dot(a, b))\n"
        "parts = [a[max(0, k - 499) : k + 1] for k in range(999)]\n"
        "sums = [dot(part, part[::-1].copy()) for part in parts]\n"
        "print(numba.njit(lambda a: np.convolve(a, a))(a).tolist() == sums)\n"
    )
    assert _printed(program) == ["True"]


def test_another_thread_can_import_scipy_while_numba_begins():
    program = (
        "import threading, numba\n"
        "from numba.core.cpu import CPUContext\n"
        "from runner.learning import kernel\n"
        "load = CPUContext.load_additional_registries\n"
        "def load_while_importing(context):\n"
        "    other = threading.Thread(target=exec, args=('import scipy.linalg; print(True)', {}))\n"
        "    other.start()\n"
        "    other.join(20)\n"
        "    load(context)\n"
        "CPUContext.load_additional_registries = load_while_importing\n"
        "print(numba.njit(lambda a: a + 1)(1))\n"
    )
    assert "True" in _printed(program)


def test_a_process_that_is_killed_while_it_saves_leaves_no_entry(tmp_path, monkeypatch):
    def cache(source):
        return caching.IndexDataCacheFile(str(tmp_path), "choose-1", source)

    cache("old").save("key", "old code")
    with monkeypatch.context() as killed:
        killed.setattr(caching.IndexDataCacheFile, "_save_index", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            cache("new").save("key", "new code")
    assert cache("new").load("key") is None
    assert cache("old").load("key") is None, "whose data was removed"
    for key in ("key", "other"):
        cache("new").save(key, f"{key} of new code")
    assert [cache("new").load(key) for key in ("key", "other")] == ["key of new code", "other of new code"]
    assert len(list(tmp_path.glob("*.nbc"))) == 2

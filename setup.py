"""Put the shipped experiments of `configs/` into the wheel; everything else stands in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithConfigs(build_py):
    """Build the packages, with a copy of `configs/` as data of the package `runner`."""

    def run(self) -> None:
        """Copy the experiments too; an editable install reads them where they are."""
        super().run()
        if not self.editable_mode:
            shutil.copytree("configs", Path(self.build_lib, "runner", "configs"), dirs_exist_ok=True)


setup(cmdclass={"build_py": BuildWithConfigs})

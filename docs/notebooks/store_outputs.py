"""Execute the notebooks next to this file and store them with those outputs that are the same every time.

    python docs/notebooks/store_outputs.py

The frames in which runs show themselves are left out: viewers of stored notebooks do not show them, and they
name the machine that made them. What stands above a frame stays.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def execute(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Return a notebook executed in a folder, with all its outputs."""
    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(folder)}}
    return NotebookClient(notebook, timeout=240, resources=place, coalesce_streams=True).execute()


def reproducible(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Return a notebook without what differs from one execution to the next: frames, times and addresses."""
    for number, cell in enumerate(cell for cell in notebook.cells if cell.cell_type == "code"):
        cell.metadata.pop("execution", None)
        cell.execution_count = number + 1
        cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
        for output in cell.outputs:
            if "execution_count" in output:
                output.execution_count = number + 1
            shown = output.get("data", {})
            if "text/html" in shown:
                shown["text/html"] = re.sub(r"<iframe.*?</iframe>", "", shown["text/html"], flags=re.DOTALL)
            if " object at 0x" in shown.get("text/plain", "") or shown.get("text/plain", "").startswith(
                "Run("
            ):
                shown.pop("text/plain")
    notebook.metadata.language_info = {"name": "python"}
    return notebook


if __name__ == "__main__":
    for notebook_path in sorted(Path(__file__).parent.glob("*.ipynb")):
        with tempfile.TemporaryDirectory() as temporary:
            nbformat.write(reproducible(execute(notebook_path, Path(temporary))), notebook_path)

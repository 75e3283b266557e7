"""Runs the published examples: the Python blocks of the manual's page, and the notebook with its picture."""

import base64
import os
import re
import shutil

import nbclient
import nbformat
from conftest import BINARY, CONFIG, ROOT

PAGE = ROOT / "docs/src/lab/python.md"
NOTEBOOK = ROOT / "docs/notebooks/soc.ipynb"


def test_page_blocks_run_in_order(tmp_path, monkeypatch):
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 6
    shutil.copytree(CONFIG, tmp_path / "config")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{BINARY.parent}:{os.environ['PATH']}")
    names = {}
    for number, block in enumerate(blocks, 1):
        exec(compile(block, f"{PAGE.name}, block {number}", "exec"), names)  # noqa: S102


def test_notebook_draws_soc_with_interval(tmp_path, monkeypatch):
    monkeypatch.setenv("PACKWATCH_BIN", str(BINARY.resolve()))
    monkeypatch.delenv("PACKWATCH_FILE", raising=False)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "the notebook in the repository must have no output"
    (tmp_path / "docs").mkdir()
    shutil.copytree(CONFIG, tmp_path / "config")
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path / "docs")}}).execute()
    pictures = [
        output["data"]["image/png"]
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == 1
    picture = base64.b64decode(pictures[0])
    assert picture.startswith(b"\x89PNG") and len(picture) > 10_000
    if "PACKWATCH_PICTURE" in os.environ:  # for inspection
        with open(os.environ["PACKWATCH_PICTURE"], "wb") as file:
            file.write(picture)

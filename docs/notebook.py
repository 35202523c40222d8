"""The tutorial as a Jupyter notebook, made of its page while the site is built: blocks of Python, what they print, and
the words between."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PAGE = "tutorial.md"
CELL = re.compile(r"^```python\n(?P<code>.*?)^```\n(?:\n```text\n(?P<prints>.*?)^```\n)?", re.MULTILINE | re.DOTALL)


def blocks(markdown: str) -> Iterator[tuple[str, str, str]]:
    """(words, code, what it prints) in their order; the last has words alone."""
    place = 0
    for match in CELL.finditer(markdown):
        yield markdown[place : match.start()], match["code"], match["prints"] or ""
        place = match.end()
    yield markdown[place:], "", ""


def notebook(markdown: str) -> dict:
    """The page in the notebook format 4.5."""
    cells = []
    for words, code, prints in blocks(markdown):
        # Equations as notebooks write them; links to other pages of the site lead nowhere from a folder of one's own.
        words = re.sub(r"\\[()]", "$", re.sub(r"\\[\[\]]", "$$", words))
        words = re.sub(r"\[([^]]+)\]\((?!http)[^)]+\)(?:\{[^}]*\})?", r"\1", words).strip()
        if words:
            cells.append({"cell_type": "markdown", "id": f"cell-{len(cells)}", "metadata": {}, "source": words})
        if code:
            output = [{"output_type": "stream", "name": "stdout", "text": prints}] if prints else []
            cell = {"cell_type": "code", "id": f"cell-{len(cells)}", "metadata": {}, "source": code.strip()}
            cells.append(cell | {"execution_count": None, "outputs": output})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def on_files(files: Files, *, config: MkDocsConfig, **_) -> Files:
    """Put the notebook beside its page, where links find it."""
    page = (Path(config.docs_dir) / PAGE).read_text(encoding="utf-8")
    content = json.dumps(notebook(page), indent=1, ensure_ascii=False) + "\n"
    files.append(File.generated(config, PAGE.replace(".md", ".ipynb"), content=content))
    return files

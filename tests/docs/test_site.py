"""The site of docs/: every page is reached, every public name is documented, the examples of its pages run."""

import re
from pathlib import Path

import pytest

import robcal

DOCS = Path(__file__).parents[2] / "docs"
API = sorted((DOCS / "api").glob("*.md"))


def listed() -> list[str]:
    """Pages in the tables of contents of index.md."""
    blocks = re.findall(r"```\{toctree\}\n(.*?)```", (DOCS / "index.md").read_text(encoding="utf-8"), re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line and not line.startswith(":")]


def test_every_page_is_reached_once() -> None:
    pages = {str(path.relative_to(DOCS).with_suffix("")) for path in DOCS.rglob("*.md")} - {"index"}
    assert set(listed()) == pages
    assert len(listed()) == len(pages)


def test_every_public_name_has_its_entry() -> None:
    entries = re.findall(r"^\.\. auto\w+:: (\S+)", "\n".join(p.read_text(encoding="utf-8") for p in API), re.MULTILINE)
    homes = {f"{home}.{name}" for name, home in robcal._MODULE_OF.items()}
    assert set(entries) == homes
    assert len(entries) == len(homes)


def test_examples_of_the_library_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "api" / "index.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) > 4
    for block in blocks:
        exec(block, names)
    assert names["error"].max() < 1e-4

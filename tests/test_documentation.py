"""The README and docs/ as a whole: what they point to is there, and every page can be found."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        assert "://" in target or (page.parent / target).exists(), target


def test_the_readme_leads_to_every_page() -> None:
    linked = set(re.findall(r"\]\(docs/([^)#]+\.md)", (ROOT / "README.md").read_text()))
    assert linked == {page.name for page in DOCS.glob("*.md")}


def test_the_readme_names_every_program() -> None:
    text = (ROOT / "README.md").read_text()
    programs = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for name in programs.keys() - {"bridge-client"}:  # which is `ros2 run bridge client`
        assert name in text, name


def test_the_pointers_of_the_docs_lead_somewhere() -> None:
    """`FILE.py`: `NAME`, where NAME is a function, Class.method or table of that file."""
    named = re.findall(r"^\| .+\? \| (.+) \|$", (DOCS / "architecture.md").read_text(), re.MULTILINE)
    assert len(named) >= 20
    for row in named:
        assert re.findall(r"`[\w./]+/`|`[\w./]+\.py`: `", row), row
    text = "".join(page.read_text() for page in DOCS.glob("*.md"))
    for name in re.findall(r"`((?:protocol|ethercat_server|ros2_bridge|clients)/[\w./]+)`", text):
        assert (ROOT / name).exists(), name
    for file, name in re.findall(r"`([\w./]+\.py)`: `([\w.]+)`", text):
        code = (ROOT / file).read_text()
        for part in name.split("."):
            assert re.search(rf"^ *(?:def |class |){part}(?:\(|:| = )", code, re.MULTILINE), (file, name)


def test_the_troubleshooting_page_is_one_screen_and_quotes_what_is_said() -> None:
    text = (ROOT / "docs" / "troubleshooting.md").read_text()
    assert len(text.split()) <= 300
    said = "".join(path.read_text() for path in sorted((ROOT / "ethercat_server").rglob("*.py")))
    symptoms = re.findall(r"^\| ((?:`[^`]+`(?:, )?)+) \|", text, re.MULTILINE)
    assert len(symptoms) > 5
    for quoted in re.findall(r"`([^`]+)`", " ".join(symptoms)):
        assert quoted in said, quoted

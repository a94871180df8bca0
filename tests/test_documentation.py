"""The README and docs/ as a whole: what they point to is there, and every page can be found."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("*.md"))]

FUNCTIONS = r"`[\w.]+`(?:, `[\w.]+`)*"
FILE = r"(?:protocol|ethercat_server|ros2_bridge|clients)/[\w./]+|[\w./]+/\w+\.(?:py|hpp)"


def anchors(page: Path) -> set[str]:
    """Of its headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for link, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", page.read_text()):
        if "://" in link:
            continue
        target = page.parent / link if link else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), f"{link}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_use_what_is_installed(page: Path) -> None:
    assert not re.findall(r"^(?:from|import) tests\b.*", page.read_text(), re.MULTILINE)


def test_the_readme_leads_to_every_page_and_program() -> None:
    text = (ROOT / "README.md").read_text()
    linked = set(re.findall(r"\]\(docs/([^)#]+\.md)", text))
    assert linked == {page.name for page in DOCS.glob("*.md")}
    programs = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert not [name for name in programs if name not in text and not name.startswith("bridge-")]


def defined(path: Path) -> set[str]:
    """The functions, classes, methods and constants in a file."""
    text = path.read_text()
    if path.suffix != ".py":
        return set(re.findall(r"^(?:class|struct|inline [\w:]+) (\w+)", text, re.MULTILINE))
    names = set()
    for node in ast.parse(text).body:
        match node:
            case ast.FunctionDef(name=name):
                names.add(name)
            case ast.ClassDef(name=name, body=body):
                methods = {each.name for each in body if isinstance(each, ast.FunctionDef)}
                names |= {name} | {f"{name}.{method}" for method in methods}
            case ast.AnnAssign(target=ast.Name(id=name)):
                names.add(name)
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_hold_what_the_pages_say(page: Path) -> None:
    for file, functions in re.findall(rf"`({FILE})`(?:: ({FUNCTIONS}))?", page.read_text()):
        assert (ROOT / file).exists(), file
        for function in re.findall(r"`([\w.]+)`", functions):
            assert function in defined(ROOT / file), f"{function} is not in {file}"


PLACEHOLDER = r"%[+.\d]*[a-z]|\{\}|\0"
VALUE = r"(?:.+?)"


def patterns(source: str) -> set[str]:
    """Of every sentence in it, as regular expressions; also of those that end before a clause or a value."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.JoinedStr(values=values):
                text = "".join(str(each.value) if isinstance(each, ast.Constant) else "\0" for each in values)
            case ast.Constant(value=str(text)):
                pass
            case _:
                continue
        text = re.sub(
            rf"^(?:{PLACEHOLDER}) ", "", text.replace("%%", "%")
        )  # who is it, which may be left out
        ends = [match.start() for match in re.finditer(rf"[:;,] |{PLACEHOLDER}", text)]
        for cut in (text[:end].rstrip(" (") for end in [*ends, len(text)]):
            parts = re.split(PLACEHOLDER, cut)
            if sum(map(len, parts)) > 10:
                found.add(VALUE.join(map(re.escape, parts)))
    return found


def test_the_troubleshooting_page_quotes_what_is_said() -> None:
    text = re.sub(r"\n +", " ", (ROOT / "docs" / "troubleshooting.md").read_text())
    files = [
        path
        for part in ("ethercat_server", "protocol", "ros2_bridge")
        for path in (ROOT / part).rglob("*.py")
    ]
    sentences = set().union(*(patterns(path.read_text()) for path in files))
    said = re.compile(rf"(?:\S+ ){{0,3}}(?:{'|'.join(sorted(sentences))})")
    quoted = [
        each
        for line in re.findall(r"^- ((?:`[^`]+`(?:, )?)+)", text, re.M)
        for each in line[1:-1].split("`, `")
    ]
    assert len(quoted) > 30
    assert [each for each in quoted if not said.fullmatch(each)] == []

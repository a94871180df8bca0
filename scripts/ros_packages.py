"""What an index of ROS packages wants in the folder of each package, from where the project has it once.

`python -m scripts.ros_packages [REPOSITORY]`: writes CHANGELOG.rst, in catkin's form, of the releases in
CHANGELOG.md, and to package.xml the URLs of the repository and of its bug tracker. `scripts/release` runs it.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import Final

_ROOT: Final = Path(__file__).parents[1]
_REPOSITORY: Final = re.compile(r"https://[a-z0-9-]+(\.[a-z0-9-]+)+(/[\w.-]+){2,}")
_PLACEHOLDER: Final = re.compile(
    r"\b(example|placeholder|todo|your|owner|user|organization|repository)\b", re.I
)
_URL: Final = '  <url type="{}">{}</url>\n'
_RELEASE: Final = re.compile(r"^## \[(\d+\.\d+\.\d+)\] - (\S+)\n(.*?)(?=^## |\Z)", re.M | re.S)
_ITEM: Final = re.compile(r"^(?:### (.+)|- (.+(?:\n  .+)*))$", re.M)


def folders(root: Path = _ROOT) -> list[Path]:
    """Of the packages."""
    return sorted(path.parent for path in [*root.glob("*/package.xml"), *root.glob("clients/*/package.xml")])


def restructured(text: str) -> str:
    """A line of Markdown as reStructuredText: links are their text."""
    text = re.sub(r"\[([^]]+)\]\([^)]*\)", r"\1", " ".join(text.split()))
    parts = text.split("`")  # every second is code
    parts[::2] = [re.sub(r"[\\*|]|_\b", r"\\\g<0>", part) for part in parts[::2]]
    return "``".join(parts)


def changelog(package: str, markdown: str) -> str:
    """All packages are released together and have the same one."""
    title = f"Changelog for package {package}"
    lines = ["^" * len(title), title, "^" * len(title)]
    for version, day, text in _RELEASE.findall(markdown):
        lines += ["", heading := f"{version} ({day})", "-" * len(heading)]
        for kind, item in _ITEM.findall(text):
            lines += ["", f"* {kind}", ""] if kind else [f"  * {restructured(item)}"]
    return "\n".join(lines) + "\n"


def with_urls(manifest: str, repository: str) -> str:
    for kind, url in (("bugtracker", f"{repository}/issues"), ("repository", repository)):
        without = re.sub(rf'  <url type="{kind}">.*\n', "", manifest)
        manifest = re.sub(r'  <url type="website">.*\n', rf"\g<0>{_URL.format(kind, url)}", without)
    return manifest


def main(arguments: list[str], root: Path = _ROOT) -> int:
    manifests = {folder: (folder / "package.xml").read_text() for folder in folders(root)}
    known = [re.findall('type="repository">(.+)<', text) for text in manifests.values()]
    parser = argparse.ArgumentParser(prog="scripts.ros_packages", description=__doc__)
    parser.add_argument("repository", nargs="?", help="URL of this project's, to be given once")
    repository = (parser.parse_args(arguments).repository or (min(known) or [""])[0]).rstrip("/")
    if not _REPOSITORY.fullmatch(repository) or _PLACEHOLDER.search(repository):
        what = (
            f"{repository!r} is no repository's URL"
            if repository
            else "the packages have no repository's URL"
        )
        print(f"{what}: give that of this project, https://HOST/.../NAME, after the folder", file=sys.stderr)
        return 1
    markdown = (root / "CHANGELOG.md").read_text()
    for folder, manifest in manifests.items():
        (folder / "package.xml").write_text(with_urls(manifest, repository))
        (name,) = re.findall("<name>(.+)</name>", manifest)
        (folder / "CHANGELOG.rst").write_text(changelog(name, markdown))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

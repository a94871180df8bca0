"""The C++ headers as a user includes them: alone, in several files, in every form shown to them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.clients.cpp_programs import CLIENT, HEADERS, INCLUDE, ROOT, build, needs_gxx, patient

pytestmark = [needs_gxx, patient]

PLAIN: Final = ("-O0", "-fno-exceptions", "-fno-rtti", "-Wsign-conversion", "-Wold-style-cast")
EXAMPLES: Final = sorted((CLIENT / "examples").glob("*.cpp"))
PAGES: Final = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *CLIENT.rglob("*.md")])
INCLUDED: Final = re.compile(r"(?m)^#include.*\n")
IN_A_COMMENT: Final = re.compile(r"(?:^[ \t]*///? {5}.*\n)+", re.MULTILINE)
IN_A_PAGE: Final = re.compile(
    r"^[ \t]*```(?:cpp|c\+\+|cc|hpp)\b[^\n]*\n(.*?)^[ \t]*```", re.MULTILINE | re.DOTALL
)

BEFORE_SNIPPETS: Final = """
#include <bota_ethercat.hpp>
extern bool running;
extern long due, period;
void sleep_until(long);
void control(const bota_ethercat::Vector3&, const bota_ethercat::Vector3&);
void stop_safely(const char*);
int fail(const char*);
"""

CONSTRUCTED: Final = """
#include <memory>
#include <optional>
#include <vector>
namespace constructed {
using bota_ethercat::Client;
using bota_ethercat::Options;
static_assert(std::is_nothrow_move_constructible_v<Client> && std::is_nothrow_move_assignable_v<Client>);
static_assert(!std::is_copy_constructible_v<Client> && !std::is_copy_assignable_v<Client>);
static_assert(!std::is_convertible_v<Options, Client> && !std::is_convertible_v<const char*, Client>);
static_assert(!std::is_constructible_v<Client, const char*> && !std::is_constructible_v<Client, int>);
Client made(bool which) {
    Client one("localhost", 12001), other;
    if (which) return one;
    return other;
}
int all(const std::string& host, std::uint16_t port) {
    Options options;
    const Options constant;
    Client a("localhost", 12001), b{"localhost", 12001}, c(host, port), d({"localhost", 12001});
    Client e{{"localhost", 12001}}, f, g{}, h(options), i{options}, j(constant), k{Options{}}, l({});
    Client m({host, port, {0, 2}}), n(std::move(options));
    Client o = Client("localhost", 12001), p = std::move(a), q(std::move(b)), r{std::move(c)}, s = made(true);
    auto t = std::make_unique<Client>("localhost", port);
    std::optional<Client> u;
    u.emplace(host, port);
    u = std::move(d);
    std::vector<Client> v;
    v.push_back(std::move(e));
    v.emplace_back(constant);
    v.erase(v.begin());
    f = Client(constant);
    g = made(false);
    for (Client* each : {&h, &i, &j, &k, &l, &m, &n, &o, &p, &q, &r, &s, t.get()}) each->close();
    return 0;
}
}  // namespace constructed
"""


ANOTHER_FILE: Final = """
#include <bota_ethercat/stream.hpp>
bool another_file() { return bota_ethercat::Client().latest().fresh(); }
"""


def snippets() -> Iterator[tuple[str, str]]:
    """Every piece of C++ in the documentation and in comments of headers, with where it is from."""
    for path in PAGES:
        yield from ((path.name, code) for code in IN_A_PAGE.findall(path.read_text()))
    for path in HEADERS:
        for comment in IN_A_COMMENT.findall(path.read_text()):
            yield path.name, re.sub(r"(?m)^[ \t]*//+", "", comment)


def test_examples_and_snippets_need_no_exceptions_and_give_no_warning(tmp_path: Path) -> None:
    """Each in a namespace or function of its own, so that g++ has to read the headers only once.

    Linked with another file, as a shared object: what the snippets call is missing.
    """
    found = list(snippets())
    assert {"cpp.md", "bota_ethercat.hpp", "stream.hpp"} <= {name for name, _ in found}
    assert all(";" in snippet for _, snippet in found)
    assert len(EXAMPLES) == 2
    code = "".join(line for path in EXAMPLES for line in INCLUDED.findall(path.read_text()))
    code += "".join(line for _, snippet in found for line in INCLUDED.findall(snippet)) + BEFORE_SNIPPETS
    for number, path in enumerate(EXAMPLES):
        inside = INCLUDED.sub("", path.read_text()).replace("int main", "int run")
        code += f'#line 1 "{path.name}"\nnamespace example_{number} {{\n{inside}\n}}\n'
    for number, (name, snippet) in enumerate(found):
        inside, function = INCLUDED.sub("", snippet), f"int snippet_{number}"
        code += f'#line 1 "snippet of {name}"\n'
        if "int main" in inside:
            code += inside.replace("int main", function)
        else:
            code += f"{function}() {{\n{inside}\n{{ return 0; }}\n}}\n"
    source, other = tmp_path / "snippets.cpp", tmp_path / "other.cpp"
    source.write_text(code + CONSTRUCTED)
    other.write_text(ANOTHER_FILE)
    build(source, (*PLAIN, "-shared", "-fPIC"), (other,))


def test_the_conditions_are_documented_with_their_numbers() -> None:
    header = (INCLUDE / "bota_ethercat/reading.hpp").read_text()
    body = header[header.index("enum class Condition") :].partition("};")[0]
    numbered = re.findall(r"(\w+) = (\d+),", body)
    assert [int(number) for _, number in numbered] == list(range(10))
    page = (ROOT / "docs" / "cpp.md").read_text()
    assert re.findall(r"(?m)^\| (\d+) \| `(\w+)` \|", page) == [(number, name) for name, number in numbered]


@pytest.mark.long
def test_every_header_alone(tmp_path: Path) -> None:
    """A file for each: g++ reads each of them from nothing."""
    sources = []
    for path in HEADERS:
        sources.append(tmp_path / f"alone_{path.stem}.cpp")
        sources[-1].write_text(f"#include <{path.relative_to(INCLUDE)}>\n")
    (tmp_path / "alone.cpp").write_text("int main() {}\n")
    build(tmp_path / "alone.cpp", PLAIN, tuple(sources))


def includes(name: str) -> set[str]:
    """The headers of this project that a header includes, directly or not."""
    own = set(re.findall(r'#include "(.*)"', (INCLUDE / name).read_text()))
    return own.union(*map(includes, own))


def test_a_controller_gets_nothing_of_the_requests() -> None:
    stream = includes("bota_ethercat/stream.hpp")
    assert "bota_ethercat/control.hpp" not in stream
    everything = {"bota_ethercat.hpp"} | includes("bota_ethercat.hpp")
    assert everything == {str(path.relative_to(INCLUDE)) for path in HEADERS}

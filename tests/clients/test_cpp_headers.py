"""The C++ headers as a user has them: alone, in several files, in every form shown, as a package."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest

from bota_ethercat.client.reading import Condition
from bota_ethercat.world import Felt, encode
from tests.clients.cpp_programs import (
    CLIENT,
    HEADERS,
    INCLUDE,
    ROOT,
    build,
    driver_program,
    needs_gxx,
    patient,
)
from tests.rights import limited, needs_root, skip_if_forbidden

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
int all(const std::string& host, std::uint16_t port, const Options& options) {
    Client a{"localhost", 12001}, b(host, port), c(Options{"localhost", 12001}), d{{host, port, {0, 2}}};
    Client e{}, f(options), g = Client(Options{}), h = std::move(a), i{std::move(b)};
    std::vector<Client> v;
    v.push_back(std::move(c));
    v.emplace_back(options);
    e = made(false);
    for (Client* each : {&d, &e, &f, &g, &h, &i}) each->close();
    return 0;
}
}  // namespace constructed
"""


ANOTHER_FILE: Final = """
#include <bota_ethercat/stream.hpp>
bool another_file() { return bota_ethercat::Client().latest().fresh(); }
"""


def run(*command: str | Path, limit: Callable[[], None] | None = None, **environment: str) -> str:
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, env=os.environ | environment, preexec_fn=limit
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


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
    assert {"cpp.md", "bota_ethercat.hpp"} <= {name for name, _ in found}
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


def test_the_conditions_are_those_of_python_and_documented_with_their_numbers() -> None:
    found = [line.split(" ", 2) for line in run(driver_program(), "conditions").splitlines()]
    assert [(number, name) for number, name, _ in found] == [
        (str(c.value), c.name.lower()) for c in Condition
    ]
    assert [meaning for *_, meaning in found] == [str(c) for c in Condition]
    page = (ROOT / "docs" / "cpp.md").read_text()
    assert re.findall(r"(?m)^- (\d+) `(\w+)`: ", page) == [(number, name) for number, name, _ in found]


@pytest.mark.long
def test_every_header_alone(tmp_path: Path) -> None:
    """A file for each: g++ reads each of them from nothing."""
    sources = []
    for path in HEADERS:
        sources.append(tmp_path / f"alone_{path.stem}.cpp")
        sources[-1].write_text(f"#include <{path.relative_to(INCLUDE)}>\n")
    (tmp_path / "alone.cpp").write_text("int main() {}\n")
    build(tmp_path / "alone.cpp", PLAIN, tuple(sources))


def test_a_world_sends_what_the_python_one_does(tmp_path: Path) -> None:
    command = [str(driver_program()), "world", str(tmp_path / "world")]
    assert subprocess.run(command, check=False).returncode == 1, "no sensor"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sensor:
        sensor.bind(command[-1])
        subprocess.run(command, check=True)
        felt = Felt((1, 2, 3, 4, 5, 6), (7, 8, 9), (10, 11, 12), 13)
        assert sensor.recv(200) == encode(0.5, felt, 2)


# -- real time, in the words of the Python client


def scheduled(priority: int, cpu: int, limit: Callable[[], None] | None = None) -> tuple[list[int], str]:
    numbers, refused = run(driver_program(), "real_time", str(priority), str(cpu), limit=limit).split("\n")[
        :2
    ]
    skip_if_forbidden(refused)
    return [int(number) for number in numbers.split()], refused


@needs_root
def test_real_time_scheduling_that_is_granted() -> None:
    cpu = min(os.sched_getaffinity(0))
    assert scheduled(40, cpu) == ([os.SCHED_FIFO, 40, 40, cpu, 1], "")


def test_real_time_scheduling_that_is_refused() -> None:
    numbers, refused = scheduled(40, 9999, limited())
    assert numbers[:4] == [os.SCHED_OTHER, 0, 0, -1]
    assert refused.startswith(
        "CPU 9999; SCHED_FIFO 40 ('rtprio 40' in a file in /etc/security/limits.d, LimitRTPRIO=40 in a "
        "service's unit)"
    )


# -- a package that CMake, colcon and rosdep can find

USER = {
    "CMakeLists.txt": """
cmake_minimum_required(VERSION 3.14)
project(user LANGUAGES CXX)
find_package(bota_ethercat 99.1 QUIET)
if(bota_ethercat_FOUND)
  message(FATAL_ERROR "another version was found")
endif()
find_package(bota_ethercat 0.1 REQUIRED)
add_executable(user user.cpp)
target_link_libraries(user PRIVATE bota_ethercat::client)
""",
    "user.cpp": """
#include <bota_ethercat/stream.hpp>
int main() { return bota_ethercat::Client().latest().fresh(); }
""",
}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake here: sudo apt install cmake")
def test_cmake_installs_the_headers_and_a_program_finds_them(tmp_path: Path) -> None:
    """Installed without a compiler, below a prefix as colcon has it."""
    prefix, user = tmp_path / "prefix", tmp_path / "user"
    settings = (f"-DCMAKE_INSTALL_PREFIX={prefix}", "-Werror=dev")
    run("cmake", "-S", CLIENT, "-B", tmp_path / "b", *settings, CXX="false")
    run("cmake", "--install", tmp_path / "b")
    overlaid = prefix / "include/bota_ethercat"
    installed = {path.relative_to(overlaid): path for path in prefix.rglob("*.hpp")}
    assert {name: path.read_bytes() for name, path in installed.items()} == {
        path.relative_to(INCLUDE): path.read_bytes() for path in HEADERS
    }
    assert (prefix / "share/bota_ethercat/package.xml").exists()
    user.mkdir()
    for name, text in USER.items():
        (user / name).write_text(text)
    run("cmake", "-S", user, "-B", user / "b", f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", user / "b")
    run(user / "b/user")


def test_the_version_is_the_projects() -> None:
    text = (CLIENT / "CMakeLists.txt").read_text()
    assert f"project(bota_ethercat VERSION {PROJECT['version']} " in text

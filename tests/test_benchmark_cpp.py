"""The benchmark of the C++ client: what it makes of made-up ages, and a short run of its program."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.benchmarks import program as benchmark
from scripts.benchmarks.modes import cpp
from scripts.benchmarks.modes.cpp import build, figures, run
from scripts.demonstration.child import DemoError
from tests.clients import cpp_programs
from tests.clients.cpp_programs import needs_gxx, patient


def lines(way: str, who: str, *ages_us: float) -> list[str]:
    return [f"{way} {who} {int(age * 1000)}" for age in ages_us]


def test_the_ratio_is_of_medians_and_of_99th_percentiles() -> None:
    made_up = [
        *lines("waiting", "bare", 20, 20, 30),
        *lines("waiting", "client", 25, 25, 15),
        *lines("polling", "bare", 10),
        *lines("polling", "client", 11),
    ]
    result = figures(made_up)
    assert result["waiting"]["ratio"]["p50"] == 1.25
    assert result["polling"]["ratio"] == {"p50": 1.1, "p99": 1.1}
    assert result["waiting"]["samples"] == 3
    with pytest.raises(DemoError, match="too few samples while polling"):
        figures(made_up[:7])


def test_the_client_is_measured_on_one_configuration() -> None:
    options = benchmark.parse(["--cpp"])
    assert (options.rates, options.sensors) == ([800], [1])


@needs_gxx
@patient
def test_a_short_run_of_the_pair() -> None:
    program = str(cpp_programs.build(Path(cpp.__file__).with_suffix(".cpp"), ("-O0",)))
    result = run([program, "pair", "1600", "0.05"], 0.05)
    for way in ("waiting", "polling"):
        assert result[way]["samples"] > 0
        assert result[way]["bare_us"]["min"] > 0
        assert result[way]["client_us"]["min"] > 0
    with pytest.raises(DemoError, match="usage"):
        run([program, "nonsense"], 1)


def test_it_is_built_with_the_compiler_that_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = tmp_path / "g++"
    compiler.write_text('#!/bin/sh\necho "$@" >"$6"\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert "-O2 " in build(tmp_path).read_text()
    compiler.write_text("#!/bin/sh\necho an error >&2\nexit 1\n")
    with pytest.raises(DemoError, match=r"could not build the C\+\+ benchmark:\nan error"):
        build(tmp_path)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(DemoError, match=r"apt install g\+\+"):
        build(tmp_path)

"""The benchmark's plot: for each configuration, which part of the samples was older than a given age."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np

from scripts.benchmarks.chain import ScriptError
from scripts.benchmarks.statistics import Floats

_LONGEST_US: Final = 30_000
Curves = Mapping[str, Floats]  # ages in ns, by program

_LOOKS: Final = {
    "bare C": ("bare C program, C client", "0.45", "-"),
    "this": ("this project, TCP client", "tab:blue", "-"),
    "this, ROS": ("this project, ROS subscriber", "tab:blue", "--"),
    "Bota's driver": ("Bota's driver, its caller", "tab:red", "-"),
    "polling": ("polling, TCP client", "tab:orange", "-"),
    "polling, ROS": ("polling, ROS subscriber", "tab:orange", "--"),
}


def tail(ages_ns: Floats) -> tuple[Floats, Floats]:
    """Ages in µs, ascending, and the part of all that is at least as old."""
    ascending = np.sort(ages_ns) / 1000
    return ascending, 1 - np.arange(len(ascending)) / max(1, len(ascending))


def draw(configurations: Mapping[tuple[int, int], Curves], path: Path) -> None:
    """Write the plot as PNG; ScriptError if there is nothing to draw it with."""
    if find_spec("matplotlib") is None:
        raise ScriptError("there is no plot: matplotlib is missing (pip install matplotlib)")
    import matplotlib as mpl  # noqa: PLC0415 - slow, and an extra

    mpl.use("Agg")
    from matplotlib import pyplot  # noqa: PLC0415

    # With several sensors two of the curves are left, much the same.
    configurations = {key: curves for key, curves in configurations.items() if key[1] == 1} or configurations
    everything = np.concatenate([ages for curves in configurations.values() for ages in curves.values()])
    columns = min(2, len(configurations))
    lines = -(-len(configurations) // columns)
    figure, axes = pyplot.subplots(
        lines, columns, figsize=(6.8 * columns, 4.4 * lines + 0.9), squeeze=False, sharex=True, sharey=True
    )
    for position, ((rate, sensors), curves) in enumerate(configurations.items()):
        panel = axes[position // columns][position % columns]
        for name, (_, colour, style) in _LOOKS.items():
            if len(curves.get(name, ())):
                panel.plot(*tail(curves[name]), color=colour, linestyle=style, linewidth=1.6)
        panel.set_title(f"{rate} Hz, {sensors} sensor{'s' * (sensors > 1)}")
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xlim(max(everything.min() / 1200, 10), min(everything.max() / 800, _LONGEST_US))
        panel.set_ylim(5e-5, 1.3)
        panel.axvline(1e6 / rate, color="0.7", linestyle=":", linewidth=1)
        panel.annotate(
            "one sample period", (1e6 / rate, 7e-5), rotation=90, fontsize=7, color="0.5", ha="right"
        )
        panel.grid(True, which="major", alpha=0.35)
        panel.grid(True, which="minor", alpha=0.12)
        panel.set_xlabel("age of the sample when it arrives, µs")
        panel.set_ylabel("part of the samples that is older")
        panel.tick_params(labelbottom=True, labelleft=True)
    for position in range(len(configurations), lines * columns):
        axes[position // columns][position % columns].set_axis_off()
    shown = [look for name, look in _LOOKS.items() if any(name in c for c in configurations.values())]
    handles = [pyplot.Line2D([], [], color=colour, linestyle=style) for _, colour, style in shown]
    figure.legend(
        handles, [text for text, _, _ in shown], loc="lower center", ncols=1 + columns, frameon=False
    )
    figure.tight_layout(rect=(0, 0.9 / figure.get_figheight(), 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90, facecolor="white")  # a page in dark colors shows it as well
    pyplot.close(figure)

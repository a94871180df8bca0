"""The benchmark's plot: for each configuration, which part of the samples was older than a given age."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

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


def draw(configurations: Mapping[tuple[int, int], Curves], path: Path) -> None:
    """Write the plot as PNG. ImportError without matplotlib."""
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
        panel = axes.flat[position]
        for name, (_, colour, style) in _LOOKS.items():
            if count := len(curves.get(name, ())):
                ages_us, older = np.sort(curves[name]) / 1000, 1 - np.arange(count) / count
                panel.plot(ages_us, older, color=colour, linestyle=style, linewidth=1.6)
        panel.set_title(f"{rate} Hz, {sensors} sensor{'s' * (sensors > 1)}")
        limits = max(everything.min() / 1200, 10), min(everything.max() / 800, _LONGEST_US)
        panel.set(xscale="log", yscale="log", xlim=limits, ylim=(5e-5, 1.3))
        panel.axvline(1e6 / rate, color="0.7", linestyle=":", linewidth=1)
        panel.annotate(
            "one sample period", (1e6 / rate, 7e-5), rotation=90, fontsize=7, color="0.5", ha="right"
        )
        panel.grid(True, which="both", alpha=0.2)
        panel.set(xlabel="age of the sample on arrival, µs", ylabel="part of the samples that is older")
        panel.tick_params(labelbottom=True, labelleft=True)
    for panel in axes.flat[len(configurations) :]:
        panel.set_axis_off()
    shown = [look for name, look in _LOOKS.items() if any(name in c for c in configurations.values())]
    handles = [pyplot.Line2D([], [], color=colour, linestyle=style) for _, colour, style in shown]
    figure.legend(
        handles, [text for text, _, _ in shown], loc="lower center", ncols=1 + columns, frameon=False
    )
    figure.tight_layout(rect=(0, 0.9 / figure.get_figheight(), 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90, facecolor="white")  # a page in dark colors shows it as well
    pyplot.close(figure)

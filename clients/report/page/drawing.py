"""From a Matplotlib figure to inline SVG: colors as CSS variables, text as text, reproducible.

Figures are drawn in placeholder colors, which become CSS variables: the style sheet defines `--ink` or `--x`
for light, dark and print. No text from a device is drawn.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

INK, MUTED, GRID = "#010101", "#010102", "#010103"
X, Y, Z = "#020101", "#020102", "#020103"
BAD, LIMIT, PLAIN = "#030101", "#030102", "#030103"
AXES: Final = (X, Y, Z)
DASHES: Final[tuple[str, ...]] = ("-", "--", ":")
"""Line styles of x, y and z, so that nothing depends on color."""
_VARIABLES: Final = {
    INK: "--ink", MUTED: "--muted", GRID: "--grid", X: "--x", Y: "--y", Z: "--z",
    BAD: "--bad", LIMIT: "--limit", PLAIN: "--plain",
}  # fmt: skip

STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "ethercat-report",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.labelsize": 8.5,
    "text.color": INK,
    "text.parse_math": False,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.formatter.useoffset": False,
    "figure.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.0,
    "path.simplify_threshold": 0.2,
    "agg.path.chunksize": 0,
}
WIDTH_IN: Final = 9.0

_DROPPED: Final = re.compile(
    r"<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>|<style type=\"text/css\">.*?</style>",
    re.DOTALL,
)
_OPENING: Final = re.compile(r"<svg\b[^>]*?(viewBox=\"[^\"]*\")[^>]*>", re.DOTALL)
_COLOR: Final = re.compile("|".join(_VARIABLES))
_PATH: Final = re.compile(r'\bd="([^"]*)"')
_NUMBER: Final = re.compile(r"-?\d+\.\d+")
_IDENTIFIER: Final = re.compile(r'(\bid="|url\(#|href="#)')
_FONT_FAMILY: Final = re.compile(r"'?DejaVu Sans'?(, sans-serif)*")


def draw(name: str, title: str, description: str, height_in: float, paint: Callable[[Figure], None]) -> str:
    """The SVG of a figure that `paint` fills; `name` must be unique in the page.

    `title` and `description` are for screen readers.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        figure = Figure(figsize=(WIDTH_IN, height_in))
        FigureCanvasSVG(figure)
        paint(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return _inline(buffer.getvalue(), name, title, description)


def _inline(svg: str, name: str, title: str, description: str) -> str:
    svg = _DROPPED.sub("", svg)
    svg = _PATH.sub(lambda m: f'd="{_NUMBER.sub(_rounded, " ".join(m[1].split()))}"', svg)
    svg = _IDENTIFIER.sub(rf"\1{name}-", svg)
    svg = _COLOR.sub(lambda m: f"var({_VARIABLES[m[0]]})", svg)
    svg = _FONT_FAMILY.sub("var(--font)", svg)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" {{box}} '
        f'role="img" '
        f'aria-labelledby="{name}-title {name}-desc">'
        f'<title id="{name}-title">{html.escape(title)}</title>'
        f'<desc id="{name}-desc">{html.escape(description)}</desc>'
    )
    svg = _OPENING.sub(lambda m: head.format(box=m[1]), svg, count=1)
    return re.sub(r"\n\s*\n+", "\n", re.sub(r"[ \t]+\n", "\n", re.sub(r"\n +", "\n", svg))).strip()


def _rounded(match: re.Match[str]) -> str:
    return f"{float(match[0]):.2f}".rstrip("0").rstrip(".")


def margins(
    figure: Figure, *, left: float = 0.09, top_in: float = 0.08, hspace: float = 0.2, wspace: float = 0.2
) -> None:
    """Fixed margins around the axes, independent of fonts; `top_in` in inches."""
    height = figure.get_figheight()
    figure.subplots_adjust(
        left=left, right=0.985, top=1 - top_in / height, bottom=0.44 / height, hspace=hspace, wspace=wspace
    )


def rows(figure: Figure, count: int) -> list[Axes]:
    """`count` axes above one another that share the time axis, aligned in all figures."""
    margins(figure, hspace=0.13)
    made = [row[0] for row in figure.subplots(count, 1, sharex=True, squeeze=False)]
    for panel in made:
        panel.yaxis.set_label_coords(-0.072, 0.5)
    return made


def plain_log(panel: Axes) -> None:
    """Label the decades of both axes with plain numbers instead of exponents."""
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())

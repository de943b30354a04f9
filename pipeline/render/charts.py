"""Line charts, bars, histograms as small inline SVG, without any library, so a report stays one light file.

Colours come from the page's style (`.s0` to `.s7`, `.axis`), so charts follow the light and dark theme. Long
curves are thinned to the lowest and highest point of each of 200 stretches, which keeps every spike.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike

WIDTH = 640
HEIGHT = 320
LEFT = 62
RIGHT = 24
TOP = 14
BOTTOM = 46
STRETCHES = 200
COLOURS = 8
"""Colours of the page's style, `.s0` to `.s7`."""


@dataclass(frozen=True)
class Line:
    """One curve: x and y [K]; points that are not finite are left out; `dashed` sets validation off."""

    name: str
    x: ArrayLike
    y: ArrayLike
    dashed: bool = False


def own_lines(rows: Sequence[Mapping[str, float]], figure: str) -> list[Line]:
    """A figure of a flight log, one line for each optimizer that has one (`lr/pose`)."""
    out = []
    for key in sorted({key for row in rows for key in row if key.partition("/")[0] == figure}):
        own = [row for row in rows if key in row]
        out.append(Line(label(key), [row["step"] for row in own], [row[key] for row in own]))
    return out


def log_lines(
    rows: Sequence[Mapping[str, float]], figure: str, name: str, splits: tuple[str, str] = ("train", "val")
) -> list[Line]:
    """A figure of a training log, that of the second split dashed; nothing where it was not logged."""
    out = []
    for split in splits:
        points = [(row["step"], row[f"{split}/{figure}"]) for row in rows if f"{split}/{figure}" in row]
        if points:
            steps, values = zip(*points, strict=True)
            out.append(Line(f"{name} ({split})", steps, values, split == splits[1]))
    return out


def line_chart(lines: Sequence[Line], title: str, marks: Sequence[float] = ()) -> str:
    """SVG of curves over a training's steps, with a legend and the data for the page's hover script.

    `marks` are steps with a line from top to bottom.
    """
    curves = []
    for line in lines:
        x = np.asarray(line.x, np.float64).ravel()
        y = np.asarray(line.y, np.float64).ravel()
        good = np.isfinite(x) & np.isfinite(y)
        curves.append((x[good], y[good]))
    filled = [(x, y) for x, y in curves if len(x)]
    if not filled:
        return _svg(title, [_text(WIDTH / 2, HEIGHT / 2, "no data yet", "middle")], None)
    low_x = min(float(x.min()) for x, _ in filled)
    high_x = max(float(x.max()) for x, _ in filled)
    low_y = min(float(y.min()) for _, y in filled)
    high_y = max(float(y.max()) for _, y in filled)
    x_axis = _Axis(low_x, high_x, LEFT, WIDTH - RIGHT)
    y_axis = _Axis(low_y, high_y, HEIGHT - BOTTOM, TOP)
    parts = _axes(x_axis, y_axis, "step", "")
    for at in (x_axis(step) for step in marks if low_x <= step <= high_x):
        parts.append(f'<line class="mark" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
    hover = []
    for index, (line, (x, y)) in enumerate(zip(lines, curves, strict=True)):
        colour = index % COLOURS
        if len(x) > 2 * STRETCHES:
            keep = {0, len(x) - 1}
            for stretch in np.array_split(np.arange(len(x)), STRETCHES):
                keep |= {int(stretch[np.argmin(y[stretch])]), int(stretch[np.argmax(y[stretch])])}
            x = x[sorted(keep)]
            y = y[sorted(keep)]
        points = [
            (round(x_axis(a), 1), round(y_axis(b), 1)) for a, b in zip(x.tolist(), y.tolist(), strict=True)
        ]
        path = " ".join(f"{px:g},{py:g}" for px, py in points)
        dash = ' stroke-dasharray="6 4"' if line.dashed else ""
        if len(points) > 1:
            parts.append(f'<polyline class="curve s{colour}" points="{path}"{dash}/>')
        else:
            parts += [f'<circle class="dot s{colour}" cx="{px:g}" cy="{py:g}" r="4"/>' for px, py in points]
        values = [[float(f"{a:.6g}"), float(f"{b:.4g}")] for a, b in zip(x.tolist(), y.tolist(), strict=True)]
        hover.append({"name": line.name, "at": points, "values": values})
    return _svg(title, parts, {"x": "step", "lines": hover}) + _legend(lines)


def histogram(
    counts: Mapping[str, ArrayLike], edges: tuple[float, float], title: str, x_label: str, y_label: str
) -> str:
    """SVG of stacked counts: for each name one count per equal bin [K] of the range `edges`, and a legend.

    A name alone has its empty bins marked below the axis: unused codes of a codebook.
    """
    stacks = {name: np.asarray(values, np.float64).ravel() for name, values in counts.items()}
    tallest = float(np.sum(list(stacks.values()), axis=0).max(initial=0.0)) if stacks else 0.0
    if tallest <= 0:
        return _svg(title, [_text(WIDTH / 2, HEIGHT / 2, "no data yet", "middle")], None)
    bins = len(next(iter(stacks.values())))
    x_axis = _Axis(*edges, LEFT, WIDTH - RIGHT, nice=False)
    y_axis = _Axis(0.0, tallest, HEIGHT - BOTTOM, TOP)
    parts = _axes(x_axis, y_axis, x_label, y_label)
    step = (edges[1] - edges[0]) / bins
    # Each name is stacked on the sum of those before it.
    below = np.zeros(bins)
    for index, (name, values) in enumerate(stacks.items()):
        for number, value in enumerate(values.tolist()):
            low = edges[0] + number * step
            high = edges[0] + (number + 1) * step
            left = x_axis(low)
            right = x_axis(high)
            gap = min(0.5, 0.1 * (right - left))
            base = y_axis(below[number])
            top = y_axis(below[number] + value)
            kind = f"stack s{index % COLOURS}"
            tall = base - top
            if not value:  # an unused code, which is worth seeing
                if len(stacks) > 1:
                    continue
                kind = "dead"
                top = base
                tall = 5.0
            tip = f"<title>{escape(f'{name}, {low:.4g} to {high:.4g}: {value:g}')}</title>"
            parts.append(
                f'<rect class="{kind}" x="{left + gap:.2f}" y="{top:.1f}" '
                f'width="{right - left - 2 * gap:.2f}" height="{tall:.1f}">{tip}</rect>'
            )
        below += values
    return _svg(title, parts, None) + _legend([Line(name, (), ()) for name in stacks])


class _Axis:
    """A linear map from values to pixels whose ends are moved out to round numbers."""

    def __init__(self, low: float, high: float, start: float, end: float, nice: bool = True) -> None:
        if high - low < 1e-12 * max(abs(low), abs(high), 1e-300):
            pad = abs(low) * 0.1 or 0.5
            low = low - pad
            high = high + pad
        rough = (high - low) / 5
        power = 10 ** math.floor(math.log10(rough))
        self.step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= rough * 0.999)
        self.low = math.floor(low / self.step) * self.step if nice else low
        self.high = math.ceil(high / self.step) * self.step if nice else high
        self.start = start
        self.end = end

    def __call__(self, value: float) -> float:
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        first = math.ceil(self.low / self.step - 1e-9)
        last = math.floor(self.high / self.step + 1e-9)
        return [k * self.step for k in range(first, last + 1)]


def _axes(x: _Axis, y: _Axis, x_label: str, y_label: str) -> list[str]:
    parts = []
    for tick in y.ticks():
        at = y(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(_text(LEFT - 8, at + 4, _number(tick), "end"))
    base = HEIGHT - BOTTOM
    parts.append(f'<line class="axis" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{base}" y2="{base}"/>')
    for tick in x.ticks():
        parts.append(_text(x(tick), base + 17, _number(tick), "middle"))
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, x_label, "middle"))
    if y_label:
        middle = (TOP + base) / 2
        parts.append(
            f'<text transform="translate(14 {middle:g}) rotate(-90)" text-anchor="middle">'
            f"{escape(y_label)}</text>"
        )
    return parts


def _number(value: float) -> str:
    if value == 0 or abs(value) < 1e-12:
        return "0"
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    if abs(value) >= 1e4:
        return f"{value / 1e3:g}k"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:g}"


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _legend(lines: Sequence[Line]) -> str:
    if len(lines) < 2:
        return ""
    marks = "".join(
        f'<span><i class="key s{k % COLOURS}'
        f'{" dashed" if line.dashed else ""}"></i>'
        f"{escape(line.name)}</span>"
        for k, line in enumerate(lines)
    )
    return f'<div class="legend">{marks}</div>'


def _svg(title: str, parts: Sequence[str], hover: dict[str, object] | None) -> str:
    data = (
        ""
        if hover is None
        else f' data-hover="{escape(json.dumps(hover, separators=(",", ":")), quote=True)}"'
    )
    label = escape(title, quote=True)
    return (
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}"{data}>'
        + "".join(parts)
        + "</svg>"
    )


# Keys as people read them.

_SHORT = {
    "align": "alignment",
    "ce": "cross-entropy",
    "commit": "commitment",
    "dead": "dead codes",
    "kl": "KL",
    "rec": "reconstructed",
    "recon": "reconstruction",
    "resets": "reset codes",
    "usage": "used codes",
}
"""Abbreviations of the training log -> words for a page."""
_OF_STREAM = re.compile(r"((?:tokens_)?(?:accuracy|dead|penalty|perplexity|resets|usage))_(.+)")
_LEVEL = re.compile(r"level(\d+)")
_ONLY = "code"
"""The stream of a tokenizer that has no other."""


def label(key: str) -> str:
    """An attribute, a feature or the value of one, in words."""
    return key.replace("_", " ")


def curve_label(key: str) -> str:
    """A figure of a training log: "accuracy: body" for `accuracy_body`, "cross-entropy" for `ce`."""
    match = _OF_STREAM.fullmatch(key)
    figure, stream = match.groups() if match else (key, "")
    words = " ".join(_SHORT.get(piece, piece) for piece in figure.split("_"))
    if stream in ("", _ONLY):
        return words
    level = _LEVEL.fullmatch(stream)
    return f"{words}: {f'level {level[1]}' if level else label(stream)}"

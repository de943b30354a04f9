"""A report as one self-contained HTML page built from blocks: text, tables, charts, pictures, motion viewers.

Every string handed in is untrusted and escaped; nothing is loaded from outside. The viewer's script is
inlined once, and only into pages that hold a viewer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path

from numpy.typing import ArrayLike

from motionloom.datasets.base.files import write_text
from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.body_map import body_map
from motionloom.pipeline.render.charts import Line, histogram, line_chart
from motionloom.pipeline.render.viewer import (
    ViewerMotion,
    fill,
    has_bodies,
    media_policy,
    resource,
    safe_json,
    viewer_data,
    viewer_script,
)

Value = str | float | int | None
SHORT = 24
"""Columns whose cells have no more letters than this are not broken into lines."""


class Page:
    """Collects blocks in order; `write` makes the file. Each `add_` returns the page, so calls chain."""

    def __init__(self, title: str, subtitle: str = "") -> None:
        self.title = title
        self.subtitle = subtitle
        self._blocks: list[str] = []
        self._contents: list[tuple[str, str]] = []
        self._viewers = 0
        self._shown: list[ViewerMotion] = []
        self._choosing = False

    def add_heading(self, text: str) -> Page:
        """Start a section; sections are listed at the head of the page."""
        anchor = f"section-{len(self._contents) + 1}"
        self._contents.append((anchor, text))
        self._blocks.append(f'<h2 id="{anchor}">{escape(text)}</h2>')
        return self

    def add_subheading(self, text: str) -> Page:
        """A heading within a section."""
        self._blocks.append(f"<h3>{escape(text)}</h3>")
        return self

    def add_text(self, text: str) -> Page:
        """Paragraphs, parted by empty lines."""
        for paragraph in text.split("\n\n"):
            if paragraph.strip():
                self._blocks.append(f"<p>{escape(paragraph.strip())}</p>")
        return self

    def add_list(self, lines: Sequence[str]) -> Page:
        """A list with a point before each line."""
        self._blocks.append("<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>")
        return self

    def add_table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[Value]],
        caption: str = "",
        digits: int = 3,
        pinned: bool = False,
    ) -> Page:
        """A table: numbers with `digits` decimals, None as a dash; a `pinned` first column stays."""
        numeric = [
            any(_is_number(row[k]) for row in rows)
            and all(_is_number(row[k]) or row[k] is None for row in rows)
            for k in range(len(columns))
        ]
        short = [all(len(str(row[k])) <= SHORT for row in rows) for k in range(len(columns))]
        align = [
            ' class="number"' if number else ' class="short"' if brief else ""
            for number, brief in zip(numeric, short, strict=True)
        ]
        head = "".join(
            f'<th scope="col"{a}>{_cell(name, digits)}</th>' for name, a in zip(columns, align, strict=True)
        )
        body = "".join(
            "<tr>"
            + "".join(f"<td{a}>{_cell(v, digits)}</td>" for v, a in zip(row, align, strict=True))
            + "</tr>"
            for row in rows
        )
        title = f"<caption><span>{escape(caption)}</span></caption>" if caption else ""
        kind = ' class="pinned"' if pinned else ""
        inner = f"{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
        self._blocks.append(f'<div class="scroll"><table{kind}>{inner}</table></div>')
        return self

    @contextmanager
    def folded(self, summary: str) -> Iterator[Page]:
        """Blocks that are closed until the reader opens them."""
        self._blocks.append(f'<details class="fold"><summary>{escape(summary)}</summary>')
        yield self
        self._blocks.append("</details>")

    def add_facts(self, facts: Mapping[str, Value]) -> Page:
        """A short list of names and values, shown as tiles."""
        tiles = "".join(
            f"<div><dt>{escape(name)}</dt>"
            f"<dd>{_cell(f'{value:.4g}' if isinstance(value, float) else value, 3)}</dd></div>"
            for name, value in facts.items()
        )
        self._blocks.append(f'<dl class="facts">{tiles}</dl>')
        return self

    def add_plot(self, lines: Sequence[Line], title: str, marks: Sequence[float] = ()) -> Page:
        """A chart of training curves with marks at some steps; nothing without curves.

        Neighbouring charts stand side by side where there is room.
        """
        return self._add_chart(line_chart(lines, title, marks), title) if lines else self

    def add_histogram(
        self,
        counts: Mapping[str, ArrayLike],
        edges: tuple[float, float],
        title: str,
        x_label: str,
        y_label: str,
    ) -> Page:
        """Stacked counts per bin of a range, one colour a name; of one name the empty bins are marked."""
        return self._add_chart(histogram(counts, edges, title, x_label, y_label), title)

    def add_joint_errors(self, errors: Mapping[str, float], skeleton: Skeleton, title: str) -> Page:
        """The error of each joint on a figure and, where it has fingers, on two hands beside it."""
        for part, drawing in body_map(errors, skeleton).items():
            self._add_chart(drawing, f"{title}: {part}")
        return self

    def add_matrix(self, counts: Mapping[str, Mapping[str, int]], title: str) -> Page:
        """A table of what was taken for what; the darker a cell, the larger its share of the row."""
        names = sorted({*counts, *(name for row in counts.values() for name in row)})
        head = "".join(f'<th scope="col">{escape(name)}</th>' for name in names)
        body = ""
        for name, row in counts.items():
            cells = "".join(
                f'<td class="{"right" if name == column else "wrong"}" style="--p:'
                f'{100 * row.get(column, 0) / sum(row.values()):.0f}%">{row.get(column) or "·"}</td>'
                for column in names
            )
            body += f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>'
        inner = f"<caption><span>{escape(title)}</span></caption><thead><tr><td></td>{head}</tr></thead>"
        self._blocks.append(
            f'<div class="scroll"><table class="matrix">{inner}<tbody>{body}</tbody></table></div>'
        )
        return self

    def add_viewer(self, motions: Sequence[ViewerMotion], note: str = "") -> Page:
        """Motions that play in the page, with their own controls below."""
        self._viewers += 1
        name = f"viewer-{self._viewers}"
        if note:
            self.add_text(note)
        self._shown += motions
        data = safe_json(viewer_data(motions))
        self._blocks.append(
            f'<div class="mlv viewer" id="{name}"></div>'
            f'<script type="application/json" id="{name}-data">{data}</script>'
            f'<script>motionloomViewer(document.getElementById("{name}"), '
            f'JSON.parse(document.getElementById("{name}-data").textContent), {{ page: false }});</script>'
        )
        return self

    def add_choices(self, choices: Sequence[tuple[str, str] | None], file: str) -> Page:
        """To be decided about each motion of the last viewer: leave it out, or keep it; saved as `file`.

        `choices` are name and reason of a motion, or None where there is nothing to decide.
        """
        self._choosing = True
        name = f"viewer-{self._viewers}"
        data = safe_json({"choices": choices, "file": file})
        self._blocks.append(
            f'<div class="choices" id="{name}-choices"></div>'
            f'<script>motionloomChoices(document.getElementById("{name}"), '
            f'document.getElementById("{name}-choices"), {data});</script>'
        )
        return self

    def html(self) -> str:
        links = "".join(f'<a href="#{anchor}">{escape(text)}</a>' for anchor, text in self._contents)
        contents = f'<nav aria-label="Sections">{links}</nav>' if len(self._contents) > 1 else ""
        return fill(
            resource("report/page.html"),
            MEDIA=media_policy(self._shown),
            TITLE=escape(self.title),
            SUBTITLE=f"<p>{escape(self.subtitle)}</p>" if self.subtitle else "",
            STYLE=resource("report/page.css") + (resource("viewer/viewer.css") if self._viewers else ""),
            SCRIPT=(viewer_script(has_bodies(self._shown)) if self._viewers else "")
            + (resource("report/choices.js") if self._choosing else ""),
            CONTENTS=contents,
            BODY="\n".join(self._blocks),
            HOVER=resource("report/page.js"),
        )

    def write(self, path: Path) -> None:
        write_text(path, self.html())

    def _add_chart(self, chart: str, title: str) -> Page:
        block = f'<figure class="plot"><figcaption>{escape(title)}</figcaption>{chart}</figure>'
        if self._blocks and self._blocks[-1].startswith('<div class="plots">'):  # beside its neighbour
            self._blocks[-1] = self._blocks[-1].removesuffix("</div>") + block + "</div>"
        else:
            self._blocks.append(f'<div class="plots">{block}</div>')
        return self


def _is_number(value: Value) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cell(value: Value, digits: int) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return escape(
            f"{value:.{digits}f}" if 1e-3 <= abs(value) < 1e5 or value == 0 else f"{value:.{digits}g}"
        )
    return escape(f"{value:,}" if _is_number(value) else str(value))

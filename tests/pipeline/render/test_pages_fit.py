"""Pages on a phone, upright and on its side, on a desktop: no bar over a figure, nothing cut unsaid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.pipeline.render.page import Page
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

pytestmark = pytest.mark.browser

SIZES = [(390, 844), (844, 390), (1280, 900)]
PARENTS = Skeleton.named("smplx52").parents
LONG = "a person walks forward, turns around on the left foot and waves with both hands above the head"

# What is seen of a stage: its box, cut by the board's and the window's. The bar must not touch that.
COVERED = """() => {
    const cut = (a, b) => [0, 1, 2, 3].map((k) => (k < 2 ? Math.max : Math.min)(a[k], b[k]));
    const sides = ({left, top, right, bottom}) => [left, top, right, bottom];
    const box = (node) => sides(node.getBoundingClientRect());
    const area = ([left, top, right, bottom]) => Math.max(right - left, 0) * Math.max(bottom - top, 0);
    const screen = [0, 0, innerWidth, innerHeight];
    const seen = [...document.querySelectorAll(".mlv-stage")].map((stage) =>
        cut(cut(box(stage), box(stage.closest(".mlv-scroll"))), screen));
    const bars = [...document.querySelectorAll(".mlv-bar")].map(box);
    return Math.max(...seen.flatMap((stage) => bars.map((bar) => area(cut(stage, bar)))));
}"""
# Elements that reach out of the window, unless a box around them cuts or scrolls them.
OUTSIDE = """() => [...document.body.querySelectorAll(":not(svg *)")].filter((node) => {
    const r = node.getBoundingClientRect();
    if (!r.width || (r.left > -1 && r.right < innerWidth + 1)) return false;
    for (let up = node.parentElement; up; up = up.parentElement)
        if (getComputedStyle(up).overflowX !== "visible") return false;
    return true;
}).map((node) => `${node.tagName}.${node.className}`)"""
# Boxes that scroll and have more than they show, and what they say about it.
SCROLLING = """() => [...document.body.querySelectorAll("*")].filter((node) => {
    const {overflowX, overflowY} = getComputedStyle(node);
    const moves = (flow) => flow === "auto" || flow === "scroll";
    return node.clientWidth && ((moves(overflowX) && node.scrollWidth > node.clientWidth + 2)
        || (moves(overflowY) && node.scrollHeight > node.clientHeight + 2));
}).map((node) => {
    const more = node.classList.contains("mlv-scroll") ? node.nextElementSibling : null;
    const said = more ? more.textContent : getComputedStyle(node, "::after").content;
    return [node.className, node.scrollWidth > node.clientWidth + 2, said];
})"""
SHOW = """(index) => {
    const stage = document.querySelectorAll(".mlv-stage")[index], box = stage.closest(".mlv-scroll");
    box.parentElement.scrollIntoView({block: "start"});
    stage.scrollIntoView({block: "nearest"});
    const bar = box.parentElement.querySelector(".mlv-bar");
    const ends = (node) => [node.getBoundingClientRect().top, node.getBoundingClientRect().bottom];
    return {stage: ends(stage), box: ends(box), bar: ends(bar), window: innerHeight};
}"""


def sweep(page: Any) -> None:
    """Nowhere on the way down, of the page and of each board, is a bar over a figure."""
    for share in (0, 0.25, 0.5, 0.75, 1):
        page.evaluate(
            """(share) => {
                for (const box of [document.scrollingElement, ...document.querySelectorAll(".mlv-scroll")])
                    box.scrollTop = share * (box.scrollHeight - box.clientHeight);
            }""",
            share,
        )
        assert page.evaluate(COVERED) == 0, f"scrolled by {share:.0%}"


def whole(page: Any, index: int) -> None:
    """A figure and the bar can be seen together, whole."""
    at = page.evaluate(SHOW, index)
    assert at["stage"][0] >= at["box"][0] - 1 and at["stage"][1] <= at["box"][1] + 1, at
    for name in ("stage", "bar"):
        assert at[name][0] >= -1 and at[name][1] <= at["window"] + 1, at


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, walk: Any) -> Path:
    """`one.html`, `many.html` (with a driving script's bands) and `report.html`."""
    root = tmp_path_factory.mktemp("fit")
    joints = walk(30)
    bands = [(0.0, 0.7, LONG), (0.7, 1.5, "turns")]
    write_viewer(root / "one.html", [ViewerMotion(joints, 20, PARENTS, "generated", LONG)], LONG)
    many = [
        ViewerMotion(joints, 20, PARENTS, label, LONG, f"row {row}", segments=bands)
        for row in range(3)
        for label in ("recorded", "reconstruction", "generated")
    ]
    write_viewer(root / "many.html", many, "Nine motions", "made from text")
    page = Page("Report", "of a run").add_heading("Watch").add_viewer(many).add_viewer(many[:1])
    wide = [f"column {k} of the table" for k in range(14)]
    page.add_heading("Tables").add_table(wide, [[1.5] * 14] * 3, LONG, pinned=True)
    page.add_table(["name", "value"], [["x" * 90, 1.0]], "narrow").add_text("y" * 300).add_list(
        [LONG, "z" * 200]
    )
    with page.folded("listed"):
        page.add_table(["where", "what"], [[f"clip {k}", LONG] for k in range(60)])
    page.add_facts({"a fact": "w" * 60, "clips": 12}).write(root / "report.html")
    return root


def controls_in_sight(page: Any, width: int, height: int) -> None:
    """All of a viewer's controls are in the window, and so is the page: only its board scrolls."""
    controls = page.locator(".mlv-bar :is(button, select, input):visible")
    for box in (controls.nth(k).bounding_box() for k in range(controls.count())):
        assert box["x"] >= 0 and box["x"] + box["width"] <= width
        assert box["y"] >= 0 and box["y"] + box["height"] <= height
    assert page.evaluate("document.scrollingElement.scrollHeight") <= height


def nothing_cut_unsaid(page: Any, width: int) -> list[tuple[str, bool, str]]:
    """What is out of sight is in a box that says so; returns the boxes."""
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(OUTSIDE) == []
    boxes = [tuple(box) for box in page.evaluate(SCROLLING)]
    for kind, wide, said in boxes:
        assert ("sideways" if wide else "more") in said, (kind, said)
    return boxes


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("name", ["one", "many"])
def test_a_page_of_motions_fits(visit: Any, folder: Path, name: str, width: int, height: int) -> None:
    page = visit(folder / f"{name}.html", width=width, height=height)
    controls_in_sight(page, width, height)
    nothing_cut_unsaid(page, width)
    if name == "one":
        stage = page.locator(".mlv-stage").bounding_box()
        assert stage["height"] > 0.45 * height, "the figure has what the bar and the words leave"
    sweep(page)
    for index in {0, page.locator(".mlv-stage").count() - 1}:
        whole(page, index)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_report_fits(visit: Any, folder: Path, width: int, height: int) -> None:
    page = visit(folder / "report.html", width=width, height=height)
    sweep(page)
    for index in (0, 4, 9):
        whole(page, index)
    for fold in page.locator("summary").all():
        fold.click()
    page.wait_for_timeout(50)
    boxes = nothing_cut_unsaid(page, width)
    assert any(wide for _, wide, _ in boxes) and any("down" in said for _, _, said in boxes)


def test_print_has_every_figure_and_no_controls(visit: Any, folder: Path) -> None:
    drawn = """(index) => {
        const drawn = document.querySelectorAll("canvas")[index], {width, height} = drawn;
        const ctx = new OffscreenCanvas(width, height).getContext("2d", {willReadFrequently: true});
        ctx.drawImage(drawn, 0, 0);
        const floor = ctx.getImageData(0, Math.floor(height * 0.9), width, 1).data;
        const seen = floor.filter((value, k) => k % 4 === 0 && floor[k + 3] > 99);
        return seen.reduce((sum, value) => sum + value, 0) / seen.length;
    }"""
    for name in ("many", "report"):
        page = visit(folder / f"{name}.html", width=1280, height=900, color_scheme="dark")
        figures = page.locator("canvas").count()
        assert page.evaluate(drawn, 0) < 120, "a dark floor on a dark screen"
        page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
        page.emulate_media(media="print")
        assert min(page.evaluate(drawn, k) for k in range(figures)) > 180, "light ones on paper, all of them"
        assert page.locator(".mlv-bar:visible, .mlv-more:visible, .mlv-help:visible").count() == 0
        assert page.evaluate(SCROLLING) == [], "paper does not scroll"
        ink = page.evaluate("getComputedStyle(document.querySelector('.mlv-cell figcaption')).color")
        assert ink == "rgb(29, 35, 48)", "dark letters on white paper, whatever the screen has"

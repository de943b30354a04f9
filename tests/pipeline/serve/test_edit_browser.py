"""Changing a motion in a real headless Chromium: mark, pull, draw, undo, make, save."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.browser

SIZES = {"desktop": (1280, 800), "phone": (390, 780)}
WRIST = 20


def why(page: Any) -> str:
    return str(page.locator("#edit-why").text_content())


def drag(page: Any, start: tuple[float, float], *way: tuple[float, float]) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    for place in way:
        page.mouse.move(*place, steps=4)
    page.mouse.up()


@pytest.fixture(params=SIZES)
def page(visit: Any, until: Any, request: Any) -> Any:
    """A page on which a generated walk of two seconds is to be changed."""
    page = visit(*SIZES[request.param])
    page.get_by_label("What the person does").first.fill("a person walks")
    page.keyboard.press("Enter")
    page.get_by_role("button", name="Change this motion").click()
    until(page, "!document.getElementById('edit').hidden && __viewer.draws > 0")
    return page


def test_a_motion_is_changed(page: Any, until: Any, quick: Any) -> None:
    go = page.get_by_role("button", name="Make the change")
    assert go.is_disabled() and "Nothing would change yet" in why(page)
    legs = page.get_by_role("slider", name="Legs")
    box = legs.bounding_box()
    y = box["y"] + box["height"] / 2
    drag(page, (box["x"] + 0.25 * box["width"] + 1, y), (box["x"] + 0.75 * box["width"] - 1, y))
    assert go.is_enabled() and legs.locator(".edit-run").count() == 3
    legs.focus()
    page.keyboard.press("Home")
    for _ in range(2):
        page.keyboard.press("Shift+ArrowRight")
    assert legs.locator(".edit-run").count() == 4, "three frames from the first on are made anew too"
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Undo").click()

    page.evaluate("__viewer.setFrame(20)")
    canvas = page.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    x, y = page.evaluate(
        f"(() => {{ const at = __viewer.joints(0).slice({3 * WRIST}, {3 * WRIST + 3});"
        "return [...__viewer.project(__viewer.lens(0), at)].slice(0, 2); })()"
    )
    place = box["x"] + x, box["y"] + y
    drag(page, place, (place[0] + 20, place[1] - 40))
    assert page.get_by_role("button", name="left hand at 1.00 s").first.is_visible()

    go.click()
    until(page, "document.querySelectorAll('.mlv-cell').length === 2")
    [task] = quick.edited
    [pin] = task.pins
    assert (pin.joint, pin.at) == ("left_wrist", 1.0)
    assert task.keep[0].model_dump() == {"start": 0.0, "end": 0.5, "parts": ("all",), "but": ()}
    assert why(page).startswith("Made in") and "Pin left_wrist at 1.00 s: 0.0 cm off" in why(page)
    assert page.locator(".mlv-label").all_text_contents() == ["before", "after"]
    with page.expect_download() as found:
        page.get_by_role("button", name="BVH").click()
    assert Path(found.value.path()).read_bytes().startswith(b"HIERARCHY")

    page.get_by_role("button", name="Done").click()
    assert page.get_by_label("What the person does").first.is_visible()
    page.get_by_role("button", name="Change this motion").click()
    assert page.locator("#edit-name").text_content() == "a person walks, changed" and go.is_disabled()
    page.get_by_role("button", name="Done").click()
    wide = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide[0] <= wide[1], "nothing hangs over the window's side"


def test_keys_move_a_joint_and_a_request_is_stopped(page: Any, until: Any, quick: Any) -> None:
    page.evaluate("__viewer.setFrame(20)")
    stood = page.evaluate(f"__viewer.joints(0)[{3 * WRIST + 1}]")
    page.get_by_label("Joint to move").select_option("left hand")
    page.get_by_role("button", name="Move by keys").click()
    for key in ("ArrowUp", "Shift+ArrowUp", "ArrowUp"):
        page.keyboard.press(key)
    assert page.evaluate("document.activeElement.textContent") == "left hand at 1.00 s"

    quick.open.clear()
    page.get_by_role("button", name="Make the change").click()
    page.get_by_role("button", name="Stop").click()
    assert why(page) == "Stopped."
    quick.open.set()
    page.get_by_role("button", name="Make the change").click()
    until(page, "document.querySelectorAll('.mlv-cell').length === 2")
    [pin] = quick.edited[-1].pins
    assert (pin.joint, pin.at) == ("left_wrist", 1.0) and pin.position[1] > stood + 0.05


def test_a_path_is_drawn(page: Any, until: Any, quick: Any) -> None:
    page.evaluate("__viewer.setFrame(0)")
    page.get_by_role("button", name="Draw a path").click()
    box = page.locator("canvas").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    drag(page, (x, y + 5), (x + 40, y + 10), (x + 60, y - 20))
    assert "path of" in str(page.locator("#edit-marks").text_content())
    page.get_by_role("button", name="Make the change").click()
    until(page, "document.querySelectorAll('.mlv-cell').length === 2")
    [task] = quick.edited
    assert task.path[0].at > 0 and task.path[-1].at == pytest.approx(1.95) and not task.keep[1:]
    assert [point.at for point in task.path] == sorted(point.at for point in task.path)


def test_a_file_is_chosen(visit: Any, until: Any, walk: Callable[..., Any]) -> None:
    from tests.pipeline.serve.test_editing import npz

    page = visit()
    until(page, "!document.getElementById('start-file').hidden")
    page.locator("#clip").set_input_files(
        {"name": "mine.npz", "mimeType": "application/zip", "buffer": npz(walk(40))}
    )
    until(page, "document.getElementById('edit-name').textContent === 'mine.npz'")
    page.get_by_role("button", name="Done").click()

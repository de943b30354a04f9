"""The page of `motionloom serve` in a real headless Chromium: type, generate, watch, save, drop music."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.pipeline.serve.test_server import tone

pytestmark = pytest.mark.browser

DRAWN = "window.__viewer && window.__viewer.draws > 0"
SIZES = {"desktop": (1200, 800), "phone": (390, 780)}


def status(page: Any) -> str:
    return str(page.locator("#status").text_content())


def test_what_it_knows_is_offered_before_anything_is_asked(visit: Any, until: Any, quick: Any) -> None:
    page = visit()
    page.get_by_role("button", name="a person stretches").click()
    until(page, DRAWN)
    assert quick.asked == ["a person stretches"] and page.locator("#start").is_hidden()


@pytest.mark.parametrize("size", SIZES)
def test_type_and_watch(visit: Any, until: Any, quick: Any, size: str, tmp_path: Path) -> None:
    page = visit(*SIZES[size])
    page.get_by_label("What the person does").fill("a person waves <b>&")
    if size == "phone":
        page.get_by_text("Settings").click()
    page.get_by_label("Seconds").fill("1.5")
    if size == "phone":
        page.get_by_text("Settings").click()
    page.get_by_role("button", name="Generate").click()
    until(page, DRAWN)
    until(page, "!document.getElementById('go').disabled")
    assert quick.asked == ["a person waves <b>&"] and status(page).startswith("1.5 s of motion")
    assert page.evaluate("__viewer.frames") == 30
    assert page.locator("figcaption").text_content() == "a person waves <b>&"
    page.screenshot(path=str(tmp_path / f"{size}.png"), full_page=True)
    wide = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide[0] <= wide[1], "nothing hangs over the window's side"
    figure = page.locator("canvas").bounding_box()
    assert figure["height"] >= 250 and figure["y"] + figure["height"] <= SIZES[size][1]


@pytest.mark.parametrize("size", SIZES)
def test_what_the_model_does_not_know_stands_beside_the_motion(visit: Any, until: Any, size: str) -> None:
    page = visit(*SIZES[size])
    note = page.get_by_role("note")
    page.get_by_label("What the person does").fill("someone plays the <i>violin")
    page.keyboard.press("Enter")
    until(page, DRAWN)
    assert note.is_visible() and page.locator("#notes p *").count() == 0, "the words are text, not markup"
    said = str(note.text_content())
    assert (
        said.startswith("'someone plays the <i>violin' is unlike all captions")
        and "a person stretches" in said
    )
    above, figure = note.bounding_box(), page.locator("canvas").bounding_box()
    assert above["y"] + above["height"] <= figure["y"] and figure["y"] < SIZES[size][1]
    note.get_by_role("button", name="a person stretches").click()
    until(page, "document.querySelector('figcaption')?.textContent === 'a person stretches'")
    assert page.locator("#caption").input_value() == "a person stretches" and note.is_hidden()


def test_guidance_is_the_models_until_it_is_changed(visit: Any, until: Any, quick: Any) -> None:
    page = visit()
    assert page.get_by_label("Guidance").input_value() == "1.25"
    for caption in ("one", "two"):
        page.get_by_label("What the person does").fill(caption)
        page.keyboard.press("Enter")
        until(page, f"document.querySelector('figcaption')?.textContent === '{caption}'")
        page.get_by_label("Guidance").fill("1")
    assert [asked.model_dump(exclude_unset=True) for asked in quick.sampling] == [{}, {"cfg_scale": 1.0}]


def test_what_is_refused_is_said(visit: Any, until: Any, quick: Any) -> None:
    page = visit()
    page.get_by_role("button", name="Generate").click()
    until(page, "document.getElementById('status').className.includes('wrong')")
    assert status(page) == "Say what the person does, or choose music." and not quick.asked
    page.get_by_label("What the person does").fill("break")
    page.keyboard.press("Enter")
    until(page, "document.getElementById('status').textContent.startsWith('something broke')")
    assert page.get_by_role("button", name="Generate").is_enabled()


def test_saving_asks_for_the_same_motion(visit: Any, until: Any, quick: Any) -> None:
    page = visit()
    page.get_by_label("What the person does").fill("a person stretches")
    page.get_by_label("Seed").fill("12")
    page.keyboard.press("Enter")
    until(page, DRAWN)
    page.get_by_label("What the person does").fill("something else")
    with page.expect_download() as found:
        page.get_by_role("button", name="npz").click()
    assert found.value.suggested_filename == "12-a-person-stretches.npz"
    with np.load(found.value.path(), allow_pickle=False) as file:
        assert json.loads(str(file["metadata"]))["caption"] == "a person stretches"
    assert quick.asked == ["a person stretches"]


def test_music_is_chosen_and_heard(visit: Any, until: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "motionloom.pipeline.inference.files.outputs.beats", lambda samples, rate: np.array([0.5])
    )
    page, music = visit(), {"name": "tone.wav", "mimeType": "audio/wav", "buffer": tone(2.5)}
    page.locator("#sound").set_input_files(music)
    until(page, "document.getElementById('status').textContent === 'tone.wav: 2.5 s of music'")
    page.get_by_role("button", name="Generate").click()
    until(page, DRAWN)
    assert page.evaluate("__viewer.frames") == 50
    page.get_by_role("button", name="Sound on (M)").click()
    until(page, "__viewer.sound && __viewer.audio && __viewer.audio.currentTime > 0.05")
    page.evaluate(
        """() => {
        const given = new DataTransfer();
        given.items.add(new File(["no music"], "dropped.wav", { type: "audio/wav" }));
        document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: given, bubbles: true }));
    }"""
    )
    until(page, "document.getElementById('status').className.includes('wrong')")
    assert status(page).startswith("the sound: ")

"""Captions made tidy, names refused; named emotions."""

from __future__ import annotations

import pytest

from motionloom.datasets.text.clean import clean_caption, emotion_of, usable_caption


@pytest.mark.parametrize(
    ("raw", "clean"),
    [
        ("Dance_Break_Back_Cc_clip_2", "Dance Break Back Cc"),
        ("synthetic_stand_casual_chat_clip1", "synthetic stand casual chat"),
        ("Walking_And_Turn_Left_CLIP 12", "Walking And Turn Left"),
        ("  a  person\twalks \r\n", "a person walks"),
        ("\ufeffa person\u200b bows\x00", "a person bows"),
        ("a person holds a paper clip.", "a person holds a paper clip."),
        ("a video clip 2 starts", "a video clip 2 starts"),
        ("walk clip_1 clip_2", "walk"),
        ("clip_3", ""),
        (" _ ", ""),
        ("eine Person läuft im Kreis", "eine Person läuft im Kreis"),
    ],
)
def test_clean_caption(raw: str, clean: str) -> None:
    assert clean_caption(raw) == clean
    assert clean_caption(clean) == clean


WORDS = (
    "a person walks forward.", "jump", "neutral", "Dance_Break_Back_Cc_clip_2", "Walking_001", "walk/run",
    "StandCasualChat", "ein Mann läuft", "человек идёт", "the person takes 3 steps",
)  # fmt: skip
NAMES = (
    "", "   ", "...", "42", "M007482", "007482", "clip_2", "subset_0001", "body_idx_0",
    "recording_20210918_S05_S06_04", "gBR_sBM_cAll_d04_mBR0_ch01", "idea400/subset_0001/Some_Name_clip_2",
    "walk.npy", "Dance_Break.mp4", "nan", "None",
)  # fmt: skip


@pytest.mark.parametrize("text", WORDS)
def test_words_are_usable(text: str) -> None:
    assert usable_caption(text)
    assert usable_caption(clean_caption(text))


@pytest.mark.parametrize("text", NAMES)
def test_names_and_ids_are_not(text: str) -> None:
    assert not usable_caption(text)


@pytest.mark.parametrize(
    ("captions", "emotion"),
    [
        (["A person happily waves."], "happy"),
        (["someone walks", "someone walks, smiling"], "happy"),
        (["he is unhappy"], "sad"),
        (["she does not smile"], None),
        (["without anger he turns"], None),
        (["a person laughs and then cries"], None),
        (["a person made a cake"], None),
        ([], None),
    ],
)
def test_emotions(captions: list[str], emotion: str | None) -> None:
    assert emotion_of(captions) == emotion

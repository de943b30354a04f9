"""BLEU, ROUGE-L, CIDEr-D and BERTScore: values of public code, values by hand, and a slow CIDEr-D.

The public values are those of pycocoevalcap 1.2 (without its tokenizer) and of bert-score 0.3.13 over the
text encoder of the installation, computed once for the sentences below.
"""

from __future__ import annotations

import math

import pytest
import torch

from motionloom.datasets.text.encoder import load_text_encoder
from motionloom.models.metrics.captions import bert_score, bleu, cider_d, rouge_l, words_of

SAID = [
    "a person walks forward and turns left",
    "the man waves with his right hand twice",
    "someone jumps",
    "a person sits down on a chair slowly",
]
KNOWN = [
    ["a person walks forward then turns to the left", "someone is walking forward and turning left"],
    ["a man waves his right hand two times", "the person waves with the right hand", "a figure waves hello"],
    ["a person jumps up in place three times"],
    [
        "a person sits down on a chair",
        "someone slowly takes a seat on a chair and stays there",
        "a person is seated",
    ],
]
WORDS = [words_of(text) for text in SAID]
BY = [[words_of(text) for text in own] for own in KNOWN]


def test_public_values() -> None:
    assert bleu(WORDS, BY) == pytest.approx([0.7532322928, 0.6411939084, 0.5410702409, 0.4639124248])
    assert cider_d(WORDS, BY) == pytest.approx([2.817386626, 2.1259717352, 0.5919133151, 3.6288900349])
    found = [rouge_l(words, own) for words, own in zip(WORDS, BY, strict=True)]
    assert found == pytest.approx([0.7334669339, 0.6747787611, 0.1804733728, 0.9446902655])


def test_public_values_of_bert_score() -> None:
    texts = [*SAID[:3], KNOWN[0][1], KNOWN[1][2], KNOWN[2][0]]
    encoded = load_text_encoder("minilm").encode(texts)
    states = [torch.from_numpy(encoded.tokens[row][encoded.mask[row]]) for row in range(6)]
    found = [bert_score(states[row], states[row + 3]) for row in range(3)]
    precision = [0.929530143737793, 0.3137364685535431, 0.8919037580490112]
    recall = [0.935497522354126, 0.4427149295806885, 0.6173592209815979]
    f1 = [0.9325042963027954, 0.36723002791404724, 0.7296608090400696]
    for row, values in enumerate(zip(precision, recall, f1, strict=True)):
        assert found[row] == pytest.approx(values, abs=2e-5)  # the noise of two implementations of BERT


def test_by_hand() -> None:
    """Papineni's "the the the ..." counts twice; a short answer pays; nothing shared is 0, itself is 1."""
    cat = words_of("The cat is on the mat.")
    assert bleu([["the"] * 7], [[cat]])[0] == pytest.approx(2 / 7)
    assert bleu([["the", "cat"]], [[cat]])[:2] == pytest.approx([math.exp(-2), math.exp(-2)])
    assert bleu([cat], [[cat]]) == pytest.approx([1] * 4) and bleu([["dog"]], [[cat]]) == [0] * 4
    assert bleu([[]], [[cat]]) == [0] * 4
    # Lin's police killed the gunman: three of four words in order, both ways.
    assert rouge_l(words_of("police kill the gunman"), [words_of("police killed the gunman")]) == 0.75
    assert rouge_l([], [cat]) == 0 and rouge_l(cat, [cat]) == pytest.approx(1)
    assert cider_d([cat, ["dog"]], [[cat], [["dog"]]]) == pytest.approx([10, 2.5])  # of one word, one of four
    assert cider_d([cat], [[cat]]) == [0]
    assert words_of("A counter-clockwise TURN, man's!") == ["a", "counter-clockwise", "turn", "man's"]

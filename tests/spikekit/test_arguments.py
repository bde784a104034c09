"""Argument types of the command line, at their limits."""

import argparse

import pytest

from spikekit.arguments import frames_of, positive, whole


def test_positive_numbers():
    assert positive("1e-300") == 1e-300
    for text in ("0", "-1", "inf", "nan", "x"):
        with pytest.raises(argparse.ArgumentTypeError, match=f"expected a number above 0, got {text}"):
            positive(text)


def test_whole_numbers():
    assert whole(2)("2") == 2
    for text in ("1", "2.0", "x"):
        with pytest.raises(argparse.ArgumentTypeError, match=f"expected a whole number, 2 or more, got {text}"):
            whole(2)(text)


def test_frame_ranges_at_the_ends():
    assert frames_of("--frame", "3:", 3, 9) == range(3, 10) == frames_of("--frame", ":", 3, 9)
    assert frames_of("--frame", "9", 3, 9) == range(9, 10)
    for text in ("2", "10", "3:11", "5:5", "-1", "3:9:0"):
        with pytest.raises(ValueError, match="got " + text):
            frames_of("--frame", text, 3, 9)
    with pytest.raises(ValueError, match="expected A below B in A:B, got 7:5"):
        frames_of("--frame", "7:5", 3, 9)

from __future__ import annotations

import math
import re

import pytest
import torch

from cotap import checks


@pytest.mark.parametrize("value", [1, 4096])
def test_positive_int_passes(value):
    assert checks.require_positive_int("n", value) == value


@pytest.mark.parametrize("value", [0, -3, 2.0, True, "4", None])
def test_positive_int_refuses(value):
    with pytest.raises(ValueError, match=re.escape(f"n must be a positive integer, got {value!r}")):
        checks.require_positive_int("n", value)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 10**400, -(10**400), True, "1.0", None])
def test_finite_refuses(value):
    with pytest.raises(ValueError, match=re.escape(f"gain must be a finite number, got {checks.quoted(value)}")):
        checks.require_finite("gain", value)


def test_range_includes_its_ends():
    assert checks.require_range("alpha", 0.0, 0.0, 1.0) == 0.0
    assert checks.require_range("alpha", 1, 0.0, 1.0) == 1


@pytest.mark.parametrize("value", [-1e-9, 1.0000001])
def test_range_refuses_what_is_outside(value):
    with pytest.raises(ValueError, match=re.escape(f"alpha must lie in [0.0, 1.0], got {value!r}")):
        checks.require_range("alpha", value, 0.0, 1.0)


def test_interval():
    assert checks.require_interval("delay", (0.0, 0.0)) == (0.0, 0.0)
    with pytest.raises(ValueError, match="delay must have low <= high"):
        checks.require_interval("delay", (0.2, 0.1))
    with pytest.raises(ValueError, match=r"delay\[1\] must be a finite number, got nan"):
        checks.require_interval("delay", (0.0, math.nan))
    with pytest.raises(ValueError, match="delay must be a pair"):
        checks.require_interval("delay", (0.0, 1.0, 2.0))  # pyright: ignore[reportArgumentType]


def test_one_of_lists_what_is_known_and_guesses():
    assert checks.require_one_of("robot", "h1", ("h1", "g1")) == "h1"
    with pytest.raises(ValueError, match=r"robot 'h11' is unknown \(did you mean 'h1'\?\); known: g1, h1"):
        checks.require_one_of("robot", "h11", ("h1", "g1"))


def test_shape():
    x = torch.zeros(2, 3)
    assert checks.require_shape("q", x, (2, 3)) is x
    with pytest.raises(ValueError, match=re.escape("q must have shape (3, 2), got (2, 3)")):
        checks.require_shape("q", x, (3, 2))


def test_all_finite_names_value_and_place():
    x = torch.zeros(2, 3)
    assert checks.require_all_finite("q", x) is x
    x[1, 2] = math.nan
    with pytest.raises(ValueError, match=re.escape("q must be finite, got nan at index (1, 2)")):
        checks.require_all_finite("q", x)

"""The script that times the page and films it: bad input, and one small film."""

from __future__ import annotations

import math
import os
import shutil
import time
from pathlib import Path

import pytest

from benchmarks import page as play_page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["dance"], "command 'dance' is unknown"), (["speed", "--viewers", "0"], "viewers must lie in"),
     (["film", "--output", "no/such/play.webp"], "'no/such/play.webp': its folder does not exist"),
     (["film", "--output", "play.mp3"], "--output must end in .webp or .gif, got 'play.mp3'"),
     (["film", "--picture", "play.jpg"], "--picture must end in .png"), (["film", "--fps", "0"], "fps must lie in"),
     (["speed"], "no browser")],
)  # fmt: skip
def test_bad_input_is_named(arguments, message, capsys, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert play_page.main(arguments) == 2
    assert message in capsys.readouterr().err


def test_the_rate_is_the_slope_whatever_single_times_are_late_by():
    late = [0.0, 0.1, 0.1, 0.0, 0.0, 0.1, 0.1, 0.0]
    assert play_page.slope([[0.5 * i + d, 0.4 * i] for i, d in enumerate(late)]) == pytest.approx(0.8, rel=0.01)
    with pytest.raises(ValueError, match="changed 2 times"):
        play_page.slope([[0.0, 0.0], [1.0, 1.0]])


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc")
def test_processor_time_is_the_process_own():
    assert play_page.processor_s(os.getpid()) == pytest.approx(time.process_time(), abs=0.1)


def test_processor_time_of_no_process_is_no_number():
    assert math.isnan(play_page.processor_s(2**30))


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, play_page.BROWSERS)), reason="no browser")
def test_a_small_film(tmp_path, capsys, checkpoint, monkeypatch):
    from PIL import Image

    monkeypatch.setattr("cotap.evaluation.policy.shipped_checkpoint", lambda _: checkpoint)
    film, still = tmp_path / "play.webp", tmp_path / "play.png"
    arguments = ["film", "--output", str(film), "--picture", str(still), "--scale", "0.2", "--fps", "2"]
    assert play_page.main(arguments) == 0
    with Image.open(film) as moving:
        assert moving.n_frames == 9
        assert moving.size == (220, 140)
    with Image.open(still) as picture:
        assert picture.size == (1100, 700)
    assert "MB" in capsys.readouterr().out

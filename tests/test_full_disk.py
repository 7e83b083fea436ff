"""A disk that is full, by the system's own limit on a file's size: errors name the file, and nothing is left of it."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from full_disk import full_after

from cotap.agents.checkpoint import save_checkpoint, write_json
from cotap.evaluation.render import contact_sheet, mp4_boxes, write_video
from cotap.evaluation.report import save_figure
from cotap.files import require_output, write_arrays
from cotap.motions import __main__ as motions
from cotap.motions.library import shipped_library
from cotap.robots import h1

FRAMES = [np.random.default_rng(k).integers(0, 255, (64, 64, 3), dtype=np.uint8) for k in range(30)]


def a_figure(path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    save_figure(plt.figure(), path)


WRITERS: dict[str, Callable[[Path], Any]] = {
    "json": lambda path: write_json(path, list(range(1000))),
    "pt": lambda path: save_checkpoint(path, {"x": torch.zeros(1000)}),
    "npz": lambda path: write_arrays(path, {"x": np.random.default_rng(0).normal(size=1000)}),
    "library.npz": lambda path: shipped_library(h1()).save(path),
    "png": a_figure,
    "sheet.png": lambda path: contact_sheet(path, FRAMES, 5),
    "mp4": lambda path: write_video(path, iter(FRAMES), 25.0),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_for_which_there_is_no_room_is_named_and_the_old_one_kept(kind: str, tmp_path: Path):
    path = tmp_path / f"out.{kind}"
    path.write_text("old")
    with full_after(100), pytest.raises(OSError, match=re.escape(str(path))):
        WRITERS[kind](path)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == [path.name]
    WRITERS[kind](path)
    assert path.stat().st_size > 100


def test_a_film_that_ffmpeg_cannot_even_begin_is_named_in_a_line(tmp_path: Path):
    rng, path = np.random.default_rng(0), tmp_path / "film.mp4"
    many = [rng.integers(0, 255, (256, 256, 3), np.uint8) for _ in range(200)]
    with full_after(0), pytest.raises(OSError, match=rf"^cannot write film {re.escape(str(path))}: .*$"):
        write_video(path, iter(many), 25.0)
    assert not list(tmp_path.iterdir())


def test_a_film_is_whole_only_with_its_index(tmp_path: Path):
    path = tmp_path / "film.mp4"
    write_video(path, iter(FRAMES), 25.0)
    assert {"ftyp", "mdat", "moov"} <= set(mp4_boxes(path))
    data = path.read_bytes()
    for size in (0, 4, 8, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        assert "moov" not in mp4_boxes(path)
    path.write_bytes(b"\0\0\0\1wide" + (16).to_bytes(8, "big") + b"\0\0\0\0zero")
    assert mp4_boxes(path) == ["wide"]


def test_importing_motion_onto_a_full_disk_names_the_library(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rows = np.zeros((60, 7 + len(h1().joints)))
    rows[:, 6] = 1.0
    rows[:, 2] = 1.0
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "walk.csv").write_text("\n".join(",".join(map(str, row)) for row in rows))
    out = tmp_path / "out.npz"
    arguments = ["import", str(tmp_path / "in"), "--format", "lafan", "--output", str(out)]
    with full_after(100):
        status = motions.main(arguments)
    assert status == 2
    assert re.search(rf"error: .*{re.escape(str(out))}", capsys.readouterr().err)
    assert sorted(os.listdir(tmp_path)) == ["in"]
    assert motions.main(arguments) == 0


def test_a_folder_that_cannot_be_written_to_is_named_by_the_option_and_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(**_: Any) -> None:
        raise PermissionError(13, "Permission denied", "/some/where/.writable.x")

    monkeypatch.setattr("cotap.files.tempfile.mkstemp", refuse)
    with pytest.raises(PermissionError, match=rf"--json: Permission denied: '{re.escape(str(tmp_path / 'o.json'))}'"):
        require_output("--json", tmp_path / "o.json")
    with pytest.raises(PermissionError, match=re.escape(str(tmp_path / "o.json"))):
        write_json(tmp_path / "o.json", {})

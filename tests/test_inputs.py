"""Files that are no such files, in every place that reads one: refused at once, by name and in words of our own."""

from __future__ import annotations

import io
import os
import re
import time
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from recordings import small_recording

from cotap import compare
from cotap.agents.checkpoint import load_checkpoint
from cotap.checks import legible, quoted, shortened
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.scenario import load_scenario
from cotap.evaluation.recording import load_recording
from cotap.inputs import InputError, array_names, read_arrays, read_text
from cotap.motions.__main__ import main as motions
from cotap.motions.formats import FORMATS, detect_format
from cotap.motions.library import MotionLibrary
from cotap.robots import h1


def every_clip(form: str, path: Path) -> None:
    for _, read in FORMATS[form](path, h1()):
        read()


READERS: dict[str, Callable[[Path], Any]] = {
    "a.pt": load_checkpoint,
    "a.onnx": OnnxPolicy,
    "a.toml": partial(load_scenario, spec=h1()),
    "recording.npz": load_recording,
    "a.json": lambda path: compare.read(str(path)),
    "library.npz": partial(MotionLibrary.load, spec=h1()),
    "detected.npz": detect_format,
} | {f"{form}.{suffix}": partial(every_clip, form) for form, suffix in
     (("deepmimic", "txt"), ("amass", "npz"), ("phc", "pkl"), ("lafan", "csv"), ("npz", "npz"))}  # fmt: skip
ARCHIVES = [name for name in READERS if name.endswith("npz")]


def refused(name: str, path: Path) -> str:
    """Why a reader refuses a file; within a second, and with the file's name."""
    begin = time.perf_counter()
    with pytest.raises(ValueError, match=re.escape(str(path))) as error:
        READERS[name](path)
    assert time.perf_counter() - begin < 5.0
    return str(error.value)


@pytest.mark.parametrize("name", READERS)
def test_what_has_no_end_or_is_no_file_is_refused(name: str, tmp_path: Path):
    path = tmp_path / name
    assert "does not exist" in refused(name, path)
    path.symlink_to("/dev/zero")
    assert "is no file but a device or pipe" in refused(name, path)
    path.unlink()
    os.mkfifo(path)
    assert "is no file but a device or pipe" in refused(name, path)
    path.unlink()
    path.mkdir()
    assert "is no file but a folder" in refused(name, path)


@pytest.mark.parametrize("name", READERS)
def test_a_git_lfs_pointer_is_named_as_such(name: str, tmp_path: Path):
    path = tmp_path / name
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    assert "is a Git LFS pointer, which stands for the file itself; git lfs pull fetches it" in refused(name, path)


class Unsafe:
    """Reading it would call something."""

    def __reduce__(self):
        return os.mkdir, ("sprung",)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.usefixtures("in_tmp_path")
def test_no_refusal_advises_to_read_unsafely(name: str, tmp_path: Path):
    """As numpy and torch do, of files that hold objects."""
    path = tmp_path / name
    objects, legacy = io.BytesIO(), io.BytesIO()
    np.savez(objects, **{key: np.array([Unsafe()], dtype=object) for key in ("head", "version", "poses", "trans")})
    torch.save({"model": Unsafe()}, legacy, _use_new_zipfile_serialization=False)
    torch.save({"model": torch.nn.Linear(2, 2)}, both := io.BytesIO())
    np.save(array := io.BytesIO(), np.array([Unsafe()], dtype=object))
    for data in (objects, legacy, both, array):
        path.write_bytes(data.getvalue())
        if name == "detected.npz" and data is objects:
            continue
        said = refused(name, path)
        assert not re.search("allow_pickle|weights_only|trust|unsafe", said), said
    assert not Path("sprung").exists()


def test_a_checkpoint_that_asks_for_code_is_told_what_for(tmp_path: Path):
    torch.save({"model": Unsafe()}, tmp_path / "a.pt")
    assert "it asks for posix.mkdir, which no checkpoint needs; nothing was run" in refused("a.pt", tmp_path / "a.pt")


def bomb(path: Path, names: list[str], megabytes: int) -> None:
    """An archive of a few kilobytes that unpacks to so much of each."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                shape = (megabytes << 17,)
                np.lib.format.write_array_header_1_0(entry, {"descr": "<f8", "fortran_order": False, "shape": shape})
                for _ in range(megabytes):
                    entry.write(bytes(1 << 20))


def test_an_archive_is_unpacked_by_name_and_only_if_it_is_small_enough(tmp_path: Path):
    path = tmp_path / "a.npz"
    bomb(path, ["wanted", "other"], 20)
    with pytest.raises(InputError, match="holds wanted of 20971648 bytes when unpacked; at most 1000000 are read"):
        read_arrays(path, ["wanted"], 1_000_000)
    assert array_names(path) == ["wanted", "other"]
    assert read_arrays(path, ["absent"], 0) == {}
    assert read_arrays(path, ["wanted"], 30_000_000)["wanted"].shape == (20 << 17,)


@pytest.mark.parametrize(
    ("names", "message"), [(["bomb"], "it lacks|is neither"), (["poses", "version", "head"], "when unpacked; at most")]
)
@pytest.mark.parametrize("name", ARCHIVES)
def test_a_zip_bomb_is_refused_by_every_reader_of_archives(
    name: str, names: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """By what is in it, or by the size that it claims; nothing is unpacked."""
    path = tmp_path / name
    bomb(path, names, 2)
    monkeypatch.setattr("cotap.motions.library._LARGEST_FILE", 1 << 20)
    monkeypatch.setattr("cotap.evaluation.recording.MAX_BYTES", 1 << 20)
    monkeypatch.setattr(zipfile.ZipFile, "open", None)
    if name == "detected.npz" and "poses" in names:
        assert READERS[name](path) == "amass"
    else:
        assert re.search(message, refused(name, path))


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (
            {"descr": "<f8", "fortran_order": False, "shape": (10**12,)},
            r"has a of shape \(1000000000000,\) in 80 bytes",
        ),
        ({"descr": "|O", "fortran_order": False, "shape": (10,)}, "has a as Python objects, which could run code"),
        ({"descr": [("x", "|O")], "fortran_order": False, "shape": (10,)}, "has a as Python objects"),
        ({"descr": "<f8", "fortran_order": False, "shape": (-10,)}, "in 80 bytes instead of -80"),
    ],
)
def test_an_array_that_claims_what_it_is_not_is_refused_before_it_is_made(tmp_path: Path, head: Any, message: str):
    np.lib.format.write_array_header_1_0(data := io.BytesIO(), head)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", data.getvalue() + bytes(80))
    with pytest.raises(InputError, match=message):
        read_arrays(tmp_path / "a.npz", ["a"], 1000)


def test_a_file_is_read_no_further_than_it_may_be(tmp_path: Path):
    (tmp_path / "a.txt").write_text("x" * 1001)
    with pytest.raises(InputError, match="has 1001 bytes; at most 1000 are read"):
        read_text(tmp_path / "a.txt", 1000)
    assert len(read_text(tmp_path / "a.txt", 1 << 60)) == 1001  # and no more memory is taken than it needs
    (tmp_path / "a.toml").write_text("#" * (2 << 20))
    assert "has 2097152 bytes; at most 1048576 are read" in refused("a.toml", tmp_path / "a.toml")


def test_what_is_no_text_is_called_that(tmp_path: Path):
    for name in ("a.toml", "a.json", "lafan.csv", "deepmimic.txt"):
        (tmp_path / name).write_bytes(b"ab\xff")
        assert "is no text in UTF-8: invalid start byte at byte 2" in refused(name, tmp_path / name)


def test_what_is_quoted_is_short_however_long_it_is():
    deep: Any = "x" * 1000
    for _ in range(40):  # written out, 2^40 times as long
        deep = [deep, deep]
    for value in (b"x" * 10**7, "x" * 10**7, 10**400, 10**6000, deep, list(range(10**6)), {"k" * 10**6: 1}):
        assert len(quoted(value)) < 500
        assert len(shortened(f"got {'x' * 10**6}; allowed are a and b")) < 2100
    assert quoted("a'b") == repr("a'b")
    assert quoted((0.2, 0.1)) == "(0.2, 0.1)"
    assert legible("läuft 3") == "läuft 3"
    assert legible("a\x1b[2J") == r"'a\x1b[2J'"
    assert shortened(f"{'x' * 10**6}; allowed are a and b").endswith("; allowed are a and b")


@pytest.mark.usefixtures("in_tmp_path")
def test_a_command_line_says_no_more_than_can_be_read(capsys: pytest.CaptureFixture[str]):
    with zipfile.ZipFile("a.npz", "w") as archive:
        archive.writestr("x" * 60_000 + ".npy", b"")
    Path("b.csv").write_text("1,2," + "y" * 1_000_000)
    Path("c.txt").write_text('{"Frames": [["' + "z" * 1_000_000 + '"]]}')
    assert motions(["import", ".", "--output", "o.npz"]) == 2
    said = capsys.readouterr()
    assert len(said.out + said.err) < 3000
    assert "3 could not be used" in said.out


@pytest.mark.parametrize("name", READERS)
def test_more_than_there_is_memory_for_is_not_read(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A file of no bytes on the disk may have a thousand millions of them, and an archive unpack to them."""
    path = tmp_path / name
    monkeypatch.setattr("cotap.inputs.free_bytes", lambda: 1 << 18)
    if name.endswith("npz") and name != "detected.npz":
        bomb(path, ["poses", "version", "head"], 1)
        assert re.search("unpacks to [0-9]+ bytes; there is memory for 262144", refused(name, path))
    elif name in ("a.pt", "a.onnx", "a.json", "deepmimic.txt", "lafan.csv"):
        with path.open("wb") as file:
            file.truncate(1 << 19)
        assert "has 524288 bytes; there is memory for 262144" in refused(name, path)


def test_a_recording_longer_or_of_more_robots_than_any_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """By the numbers that its arrays agree on: what takes one time for every step would take hours."""
    path = tmp_path / "r.npz"
    small_recording().save(path)
    assert load_recording(path).trajectory.fell.shape == (6, 2)
    monkeypatch.setattr("cotap.evaluation.recording.MAX_STEPS", 5)
    assert "is of 6 steps of 2 robots; at most 5 of 16 are read" in refused("recording.npz", path)
    monkeypatch.setattr("cotap.evaluation.recording.MAX_STEPS", 6)
    monkeypatch.setattr("cotap.evaluation.recording.MAX_ROBOTS", 1)
    assert "is of 6 steps of 2 robots; at most 6 of 1 are read" in refused("recording.npz", path)

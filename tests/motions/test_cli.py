"""`cotap motions`, end to end."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from test_formats import write_amass, write_lafan

from cotap.motions import MotionLibrary
from cotap.motions import show as show_module
from cotap.motions.__main__ import main
from cotap.motions.library import shipped_library


def test_import_writes_a_library_and_a_table(tmp_path: Path, spec, capsys):
    write_lafan(tmp_path / "walk.csv")
    write_amass(tmp_path / "dance.npz", spec)
    (tmp_path / "bad.csv").write_text("1,2\n")
    out = tmp_path / "deep" / "mine.npz"
    assert main(["import", str(tmp_path), "--output", str(out), "--mirror", "--licence", "my own"]) == 0
    text = capsys.readouterr().out
    assert "4 clips (2 read), 0.2 minutes" in text
    assert "1 could not be used:" in text
    assert "bad.csv: " in text
    library = MotionLibrary.load(out, spec)
    assert library.names() == ["dance", "dance_mirrored", "walk", "walk_mirrored"]
    assert {c.licence for c in library.clips} == {"my own"}


@pytest.mark.parametrize(("output", "message"), [("d.npz", "is a folder"), ("afile/x.npz", "afile")])
@pytest.mark.usefixtures("in_tmp_path")
def test_an_output_that_cannot_be_written_is_found_before_the_work(
    output: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    Path("d.npz").mkdir()
    Path("afile").write_text("mine")
    monkeypatch.setattr("cotap.motions.__main__.import_motions", None)  # the work must not begin
    assert main(["import", ".", "--output", output]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["import", "nowhere", "--output", "x.npz"], "'nowhere' does not exist"),
        (["import", ".", "--output", "x.pkl"], "--output must end in .npz"),
        (["import", ".", "--output", "x.npz"], "no clip could be used; nothing was written"),
        (["show", "nowhere.npz"], "'nowhere.npz' does not exist"),
        (["show", "--clip", "moonwalk"], "no clip is called 'moonwalk'"),
    ],
)
@pytest.mark.usefixtures("in_tmp_path")
def test_bad_input_is_named_and_writes_nothing(arguments, message, capsys):
    Path("bad.csv").write_text("1,2\n")
    assert main(arguments) == 2
    assert message in capsys.readouterr().err
    assert not Path("x.npz").exists()


@pytest.mark.usefixtures("in_tmp_path")
def test_show_lists_the_library_and_draws_nothing_unless_asked_to(capsys, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(show_module, "draw", None)
    assert main(["show"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "| clip | s | peak rad/s | root m/s | turn rad/s | source | licence |"
    assert len(said) == 2 + 40
    assert list(Path().iterdir()) == []


def test_import_reads_at_the_rate_that_is_given(tmp_path: Path, spec, capsys):
    write_lafan(tmp_path / "walk.csv")
    out = str(tmp_path / "x.npz")
    assert main(["import", str(tmp_path / "walk.csv"), "--output", out, "--fps", "60"]) == 0
    assert MotionLibrary.load(out, spec).clips[0].seconds == pytest.approx(1.5)
    assert main(["import", str(tmp_path / "walk.csv"), "--output", out, "--fps", "0"]) == 2
    assert "--fps must be in [1, 10000] Hz, got 0.0" in capsys.readouterr().err
    assert MotionLibrary.load(out, spec).clips[0].seconds == pytest.approx(1.5)  # the old file is untouched


def test_an_import_does_not_read_what_it_writes(tmp_path: Path, spec, capsys):
    write_lafan(tmp_path / "walk.csv")
    out = tmp_path / "mine.npz"
    assert main(["import", str(tmp_path), "--output", str(out)]) == 0
    assert main(["import", str(tmp_path), "--output", str(out)]) == 2
    assert "mine.npz' is one of the files to be read; write it elsewhere" in capsys.readouterr().err
    assert MotionLibrary.load(out, spec).names() == ["walk"]


def test_no_picture_takes_the_name_of_another(tmp_path: Path, spec, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(show_module, "plot_clip", lambda path, *_: path.touch())
    monkeypatch.setattr(show_module, "_sheet", lambda path, *_: path.touch())
    punch = shipped_library(spec).select(["punch"], spec).clips[0]
    names = ["a/b", "a_b", "contact_sheet", "é" * 200]
    library = MotionLibrary([dataclasses.replace(punch, name=name) for name in names], spec)
    written = list(show_module.draw(library, spec, tmp_path))
    assert sorted(written) == sorted(tmp_path.iterdir())
    assert len(set(written)) == 5


@pytest.mark.slow
def test_show_writes_a_plot_for_every_clip_and_a_sheet(tmp_path: Path, capsys):
    assert main(["show", "--clip", "punch", "--clip", "walk", "--output", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert "| punch | 2.12 | " in said.out
    for name in ("punch", "walk"):
        assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "out" / "contact_sheet.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["import", "a.csv"], "error: the following arguments are required: --output; cotap motions import --help"),
        (["import", "--output", "o.npz"], "error: the following arguments are required: SOURCE"),
        (["import", "a.csv", "--output", "o.npz", "--robot", "h2"], "error: argument --robot: invalid choice: 'h2'"),
    ],
)
def test_a_command_line_that_lacks_something_is_answered_in_a_line(arguments: list[str], message: str, capsys):
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith(message)
    assert said.count("\n") == 1

"""Checkpoint files: whole or not at all, refused with a reason, and never a way to run code."""

from __future__ import annotations

import copy
import errno
import json
import os
import pickle
import random
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import pytest
import torch
from full_disk import full_after

from cotap.agents.checkpoint import (
    FORMAT,
    VERSION,
    CheckpointError,
    load_checkpoint,
    load_weights,
    require_layout,
    save_checkpoint,
    sha256,
    write_json,
)

CONTENT = {"weights": torch.arange(5000.0), "names": ["a", "b"], "nested": {"rate": 1e-3, "flag": True, "none": None}}


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "checkpoint_000001.pt"
    save_checkpoint(path, CONTENT)
    return path


def names(folder: Path) -> list[str]:
    """All there is in a folder, hidden files included."""
    return sorted(os.listdir(folder))


def test_round_trip(good: Path):
    content = load_checkpoint(good)
    assert torch.equal(content.pop("weights"), CONTENT["weights"])
    assert content == {"format": FORMAT, "version": VERSION} | {k: v for k, v in CONTENT.items() if k != "weights"}
    assert names(good.parent) == [good.name]


def test_saving_again_replaces_the_old_file(good: Path):
    save_checkpoint(good, {"weights": torch.zeros(1)})
    assert torch.equal(load_checkpoint(good)["weights"], torch.zeros(1))
    assert names(good.parent) == [good.name]


@pytest.mark.parametrize("mask", [0o022, 0o077], ids=oct)
def test_files_are_readable_by_whom_the_umask_allows(tmp_path: Path, mask: int):
    before = os.umask(mask)
    try:
        save_checkpoint(tmp_path / "a.pt", CONTENT)
        write_json(tmp_path / "a.json", {})
    finally:
        os.umask(before)
    for path in tmp_path.iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask, path.name


def test_a_file_that_the_system_does_not_read_is_called_that(good: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(_path: Path, _mode: str) -> bytes:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(CheckpointError, match=r"cannot be opened or read from disk: .*Input/output error") as error:
        load_checkpoint(good)
    assert "truncated" not in str(error.value)


@pytest.mark.parametrize("name", ["a\0b.pt", "a" * 300])
def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path, name: str):
    with pytest.raises(CheckpointError, match="checkpoint"):
        load_checkpoint(tmp_path / name)


def test_an_archive_that_unpacks_to_more_than_itself_is_refused(good: Path):
    """A few kilobytes that would become gigabytes."""
    with zipfile.ZipFile(good) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    largest = max(entries, key=lambda name: len(entries[name]))
    entries[largest] = bytes(50_000_000)
    with zipfile.ZipFile(good, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    with pytest.raises(CheckpointError, match="unpack to more"):
        load_checkpoint(good)


def test_archives_whose_entries_share_their_bytes_are_refused(good: Path):
    """Each of them fits into the file; all together are many times as large."""
    with zipfile.ZipFile(good, "a") as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
        for i in range(5):
            entry = copy.copy(largest)
            entry.filename = f"{entry.filename}{i}"
            archive.filelist.append(entry)
        archive._didModify = True  # pyright: ignore[reportAttributeAccessIssue]  the list of entries is written again
    with pytest.raises(CheckpointError, match="unpack to more"):
        load_checkpoint(good)


@pytest.mark.parametrize(
    "value",
    [
        torch.zeros(1).expand(10**12),
        torch.zeros(3).to_sparse(),
        torch.zeros(3, device="meta").expand(10**12, 3),
    ],
    ids=["expanded", "sparse", "meta"],
)
def test_tensors_that_claim_more_than_they_hold_are_refused(tmp_path: Path, value: torch.Tensor):
    save_checkpoint(tmp_path / "a.pt", {"model": {"layers": [value]}})
    with pytest.raises(CheckpointError, match=r"a\.pt' has no plain tensor of \(.*\): model\.layers\.0"):
        load_checkpoint(tmp_path / "a.pt")


def test_lists_that_lie_in_each_other_without_end_are_gone_through_once(tmp_path: Path):
    deep: list[Any] = [torch.full((1,), float("nan"))]
    for _ in range(100):  # as a tree, 2^100 places
        deep = [deep, deep]
    save_checkpoint(tmp_path / "a.pt", {"model": deep})
    with pytest.raises(CheckpointError, match=r"has weights that are not finite: model\.\d"):
        load_checkpoint(tmp_path / "a.pt")


@pytest.mark.parametrize("name", ["missing.pt", "missing/checkpoint.pt", "."])
def test_missing_file_is_named(tmp_path: Path, name: str):
    path = tmp_path / name
    with pytest.raises(CheckpointError, match=r"does not exist|is no file") as error:
        load_checkpoint(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.99, -1])
def test_truncated_file_is_refused(good: Path, keep: float):
    """Kept: so many bytes, or that share of the file, or all but one."""
    whole = good.read_bytes()
    length = int(keep * len(whole)) if isinstance(keep, float) else keep
    good.write_bytes(whole[:length])
    with pytest.raises(CheckpointError, match="truncated or foreign") as error:
        load_checkpoint(good)
    assert str(good) in str(error.value)


class Trap:
    """Unpickling it would create a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return os.mkdir, (str(self.path),)


def zip_file(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "not a checkpoint")


FOREIGN: dict[str, Callable[[Path], object]] = {
    "a zip": zip_file,
    "text": lambda p: p.write_text("import os\nos.remove('x')\n"),
    "json": lambda p: p.write_text('{"format": "cotap-checkpoint", "version": 1}'),
    "a pickled list": lambda p: p.write_bytes(pickle.dumps([1, 2, 3])),
    "a bare state dict": lambda p: torch.save({"weight": torch.zeros(3)}, p),
    "a tensor": lambda p: torch.save(torch.zeros(3), p),
    "a list": lambda p: torch.save([FORMAT, VERSION], p),
    "a whole module": lambda p: torch.save(torch.nn.Linear(2, 2), p),
    "zeros": lambda p: p.write_bytes(bytes(4096)),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_file_is_refused(tmp_path: Path, kind: str):
    path = tmp_path / "foreign.pt"
    FOREIGN[kind](path)
    with pytest.raises(CheckpointError, match=r"cannot be read|is not a cotap checkpoint") as error:
        load_checkpoint(path)
    assert str(error.value).removeprefix(f"checkpoint {str(path)!r} ").removeprefix(f"{str(path)!r} ") in (
        "is not a cotap checkpoint",
        "cannot be read (truncated or foreign): it asks for torch.nn.modules.linear.Linear, which no checkpoint needs; "
        "nothing was run",
        "cannot be read (truncated or foreign): it is no archive of plain tensors and numbers, "
        "and nothing else is read",
    )


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_rubbish_is_refused_whatever_it_looks_like(tmp_path: Path, protocol: int):
    """Bytes that begin as pickles do fail in every way that an unpickler can; all are reported alike."""
    rng = random.Random(protocol)
    path = tmp_path / "rubbish.pt"
    whole = pickle.dumps({"format": FORMAT, "version": VERSION, "list": list(range(30))}, protocol=protocol)
    for _ in range(200):
        rubbish = bytearray(whole)
        for _ in range(rng.randrange(1, 6)):
            rubbish[rng.randrange(len(rubbish))] = rng.randrange(256)
        path.write_bytes(bytes(rubbish[: rng.randrange(1, len(rubbish))]))
        with pytest.raises(CheckpointError):
            load_checkpoint(path)


@pytest.mark.parametrize("container", ["pickle", "torch", "torch before zip"])
def test_a_file_that_would_run_code_is_refused_and_runs_none(tmp_path: Path, container: str):
    path, sprung = tmp_path / "trap.pt", tmp_path / "sprung"
    content = {"format": FORMAT, "version": VERSION, "weights": Trap(sprung)}
    if container == "pickle":
        path.write_bytes(pickle.dumps(content))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=container == "torch")
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_checkpoint(path)
    assert not sprung.exists()
    pickle.loads(pickle.dumps(Trap(sprung)))
    assert sprung.exists(), "the trap was no trap"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weight": torch.zeros(3)}, r"weight weight must be of shape \(2, 3\), got torch.Size\(\[3\]\)"),
        ({"weight": [1.0]}, r"weight weight must be of shape \(2, 3\), got None"),
        ({"bias": None}, "weight bias is missing"),
        ({"n" * 10_000: torch.zeros(1)}, r"weight 'n+\.\.\.n+' is of other networks"),
    ],
)
def test_the_first_weight_that_does_not_fit_is_named(change: dict[str, Any], message: str):
    fresh, other = torch.nn.Linear(3, 2), torch.nn.Linear(3, 2)
    load_weights(fresh, other.state_dict())
    assert torch.equal(fresh.weight, other.weight)
    changed = {name: value for name, value in (other.state_dict() | change).items() if value is not None}
    with pytest.raises(ValueError, match=f"^{message}$"):
        load_weights(fresh, changed)


@pytest.mark.parametrize("version", [VERSION + 1, 0, "1", None])
def test_another_version_is_named_with_the_one_that_is_read(tmp_path: Path, version: Any):
    path = tmp_path / "other.pt"
    torch.save({"format": FORMAT, "version": version}, path)
    with pytest.raises(CheckpointError, match=f"version {version!r}; this cotap reads {VERSION}"):
        load_checkpoint(path)


def test_layout_that_differs_is_named_with_both_values():
    present = {"robot": "h1", "joints": ["a", "b"], "history": 5}
    require_layout("c.pt", dict(present), present)
    require_layout("c.pt", present | {"more": 1}, present)
    with pytest.raises(CheckpointError, match=r"'c.pt' was trained with another robot: 'g1', here 'h1'"):
        require_layout("c.pt", present | {"robot": "g1"}, present)
    with pytest.raises(CheckpointError, match=r"another joints: \['b', 'a'\], here \['a', 'b'\]"):
        require_layout("c.pt", present | {"joints": ["b", "a"]}, present)
    with pytest.raises(CheckpointError, match="another history: None, here 5"):
        require_layout("c.pt", {k: v for k, v in present.items() if k != "history"}, present)


def test_tables_of_a_layout_agree_in_what_the_environment_names():
    present = {"actions": {"scale": 0.25, "clip": 20.0}}
    require_layout("c.pt", {"actions": {"scale": 0.25, "clip": 20.0, "lead": 0.03}}, present)
    with pytest.raises(CheckpointError, match=r"another actions: \{'clip': 20.0, 'lead': 0.03, 'scale': 0.5\}, here"):
        require_layout("c.pt", {"actions": {"scale": 0.5, "clip": 20.0, "lead": 0.03}}, present)
    with pytest.raises(CheckpointError, match=r"another actions: \{'scale': 0.25\}, here"):
        require_layout("c.pt", {"actions": {"scale": 0.25}}, present)
    with pytest.raises(CheckpointError, match=r"another actions: 0.25, here"):
        require_layout("c.pt", {"actions": 0.25}, present)


FULL = {
    "torch": RuntimeError("[enforce fail at inline_container.cc:664] . unexpected pos 4096 vs 4000"),
    "system": OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
}


@pytest.mark.parametrize("existed", [True, False])
@pytest.mark.parametrize("error", FULL.values(), ids=FULL.keys())
def test_full_disk_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, existed: bool
):
    path = tmp_path / "checkpoint_000001.pt"
    if existed:
        save_checkpoint(path, CONTENT)
    before = path.read_bytes() if existed else None

    def fail_part_way(_content: Any, target: IO[bytes]) -> None:
        target.write(b"PK" * 2000)
        raise error

    monkeypatch.setattr(torch, "save", fail_part_way)
    with pytest.raises(OSError, match=r"unexpected pos|No space left"):
        save_checkpoint(path, {"weights": torch.zeros(3)})
    assert names(tmp_path) == ([path.name] if existed else [])
    if existed:
        assert path.read_bytes() == before


def test_interrupted_save_leaves_the_old_file_and_nothing_else(good: Path, monkeypatch: pytest.MonkeyPatch):
    before = good.read_bytes()

    def interrupt(_content: Any, target: IO[bytes]) -> None:
        target.write(b"PK")
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(good, {})
    assert names(good.parent) == [good.name]
    assert good.read_bytes() == before


def test_a_file_that_cannot_be_written_whole_is_not_written_at_all(good: Path):
    """As torch itself reports it, with nothing patched."""
    before = good.read_bytes()
    with full_after(8192), pytest.raises(OSError) as error:  # noqa: PT011  the reason is the system's
        save_checkpoint(good, {"weights": torch.randn(100_000)})
    assert names(good.parent) == [good.name]
    assert good.read_bytes() == before
    assert str(error.value)
    with full_after(8192), pytest.raises(OSError, match="File too large"):
        write_json(good.with_suffix(".json"), ["x" * 10_000])
    assert names(good.parent) == [good.name]


def test_a_folder_that_is_none_is_an_os_error(good: Path):
    for path in (good / "checkpoint.pt", good.parent / "missing" / "checkpoint.pt"):
        with pytest.raises(OSError, match=r"Not a directory|No such file"):
            save_checkpoint(path, CONTENT)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_json_refuses_what_json_does_not_know(tmp_path: Path, value: float):
    path = tmp_path / "result.json"
    write_json(path, {"ok": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"deep": [{"er": value}]})
    assert json.loads(path.read_text()) == {"ok": 1}
    assert names(tmp_path) == ["result.json"]


def test_json_is_readable_and_ends_in_a_newline(tmp_path: Path):
    write_json(tmp_path / "a.json", {"a": [1, 2.5, None, "x"]})
    text = (tmp_path / "a.json").read_text()
    assert text.endswith("}\n")
    assert json.loads(text) == {"a": [1, 2.5, None, "x"]}


def test_sha256_of_a_known_text(tmp_path: Path):
    (tmp_path / "abc").write_text("abc")
    assert sha256(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_files_of_equal_content_are_equal(tmp_path: Path):
    content = {"model": {"a": torch.arange(5.0)}, "samples": 3}
    for name in ("one.pt", "other.pt"):
        save_checkpoint(tmp_path / name, content)
    assert sha256(tmp_path / "one.pt") == sha256(tmp_path / "other.pt")

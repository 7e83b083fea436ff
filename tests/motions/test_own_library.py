"""Policies that were trained with a motion library of one's own, in other folders than where they were trained."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch
from random_policy import save_random_policy

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint
from cotap.configs import BASE_RECIPES
from cotap.deployment.scenario import ArmMotion
from cotap.envs import HumanoidEnvConfig
from cotap.evaluate import PROTOCOLS, evaluate, main
from cotap.evaluation.policy import load_policy
from cotap.motions import MotionError, MotionLibrary, shipped_library
from cotap.motions.reference import ClipConfig, load_clips, pin_library, plays_clips
from cotap.play.session import play_config
from cotap.robots import ROBOTS, h1
from cotap.train import _parse_base

OPTIONS = ["--num-envs", "2", "--episode-seconds", "2", "--command-seconds", "2"]


@pytest.fixture
def library(tmp_path: Path) -> Path:
    """Two clips, one of them called as no shipped one is."""
    clips = shipped_library(h1()).select(["walk", "run"], h1()).clips
    object.__setattr__(clips[0], "name", "mine")
    path = tmp_path / "own.npz"
    MotionLibrary(clips, h1()).save(path)
    return path


@pytest.fixture
def trained(tmp_path: Path, library: Path) -> Path:
    """A policy whose config names that library as a training does."""
    path = save_random_policy(tmp_path / "p.pt")
    content = load_checkpoint(path)
    clips = ClipConfig(library=str(library))
    pin_library(clips)
    content["config"]["training"]["env"]["motions"]["clips"] |= {
        "library": clips.library, "library_sha256": clips.library_sha256,
    }  # fmt: skip
    save_checkpoint(path, content)
    return path


def test_a_library_is_pinned_by_its_place_and_content(library: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(library.parent)
    clips = ClipConfig(library="own.npz")
    pin_library(clips)
    assert clips.library == str(library)
    assert clips.library_sha256 == hashlib.sha256(library.read_bytes()).hexdigest()
    monkeypatch.chdir("/")
    assert load_clips(clips, h1()).names() == ["mine", "run"]
    relative = ClipConfig(library=f"gone/../{library.relative_to('/')}")
    pin_library(relative)
    assert relative.library == str(library)  # also after the folder that it was named from is gone
    shipped = ClipConfig(library_sha256=clips.library_sha256)  # the run that is gone on from had one
    pin_library(shipped)
    assert (shipped.library, shipped.library_sha256) == ("", "")
    with pytest.raises(MotionError, match=r"'/nowhere\.npz' does not exist"):
        pin_library(ClipConfig(library="/nowhere.npz"))


def test_a_library_that_has_changed_is_refused_unless_it_is_given(library: Path, trained: Path):
    MotionLibrary(shipped_library(h1()).clips[:1], h1()).save(library)
    clips = load_policy(trained).env_config.motions.clips
    with pytest.raises(MotionError, match="has changed since the policy was trained with it"):
        load_clips(clips, h1())
    args = ["velocity-tracking", "--checkpoint", str(trained), *OPTIONS]
    assert main(args) == 2
    assert main([*args, "--library", str(library)]) == 0
    before = clips.library_sha256
    pin_library(clips)
    assert clips.library_sha256 == before  # a resumed run notices, too


def test_training_takes_a_library_that_is_typed_as_it_now_is(library: Path, monkeypatch: pytest.MonkeyPatch):
    recipe = BASE_RECIPES["default"]()
    recipe.env.motions.clips.library_sha256 = "0" * 64
    monkeypatch.setitem(BASE_RECIPES, "default", lambda robot: recipe)  # noqa: ARG005
    assert _parse_base([]).training.env.motions.clips.library_sha256 == "0" * 64
    typed = _parse_base(["--env.motions.clips.library", str(library)]).training.env.motions.clips
    assert (typed.library, typed.library_sha256) == (str(library), "")


@pytest.mark.parametrize("name", PROTOCOLS)
def test_no_library_is_loaded_where_arms_hold_a_pose(name: str):
    cfg = HumanoidEnvConfig()
    cfg.motions.clips.library = "/nowhere.npz"
    protocol = PROTOCOLS[name]()
    # The tour moves arms itself.
    assert plays_clips(protocol.configure(cfg).motions.clips, h1()) == (protocol.arms == "moving" and name != "tour")


def test_a_policy_whose_library_is_gone_can_be_evaluated(library: Path, trained: Path, capsys):
    library.unlink()
    args = ["velocity-tracking", "--checkpoint", str(trained), *OPTIONS]
    assert main(args) == 2
    assert f"{str(library)!r} does not exist" in capsys.readouterr().err
    assert main([*args, "--motion", "none"]) == 0


def test_any_policy_follows_clips_of_ones_own(tmp_path: Path, library: Path):
    policy = str(save_random_policy(tmp_path / "other.pt"))
    args = ["velocity-tracking", "--checkpoint", policy, *OPTIONS, "--motion", "mine"]
    assert main(args) == 2
    assert evaluate([*args, "--library", str(library)])["settings"]["motion"] == ["mine"]


def test_the_page_offers_the_clips_that_are_there(library: Path, trained: Path, capsys):
    cfg = play_config(load_policy(trained).env_config)
    assert load_clips(cfg.motions.clips, h1()).names() == ["mine", "run"]
    library.write_bytes(library.read_bytes() + b"0")
    assert play_config(load_policy(trained).env_config).motions.clips.library == ""
    assert f"{str(library)!r} of this policy is not here: --library names one" in capsys.readouterr().out
    library.unlink()
    assert play_config(load_policy(trained).env_config).motions.clips.library == ""
    long = load_policy(trained).env_config
    long.motions.clips.library = 1_000_000 * "n"
    assert play_config(long).motions.clips.library == ""
    assert len(capsys.readouterr().out) < 3000
    given = play_config(load_policy(trained).env_config, "given.npz").motions.clips
    assert (given.library, given.library_sha256) == ("given.npz", "")


def test_a_scenario_takes_a_clip_from_a_library(library: Path):
    spec = ROBOTS["h1"]()
    arms = ArmMotion(clip="mine", library=str(library))
    arms.check(spec)
    motion = arms.reference(spec, 0.02)
    motion.reset(torch.ones(1, dtype=torch.bool), torch.Generator().manual_seed(0))
    assert motion.clips is not None
    assert motion.clips.names == ["mine"]
    with pytest.raises(MotionError, match="no clip is called 'mine'"):
        ArmMotion(clip="mine").reference(spec, 0.02)
    with pytest.raises(ValueError, match=r"arms\.library 'x\.npz' does nothing without a clip"):
        ArmMotion(library="x.npz").check(spec)

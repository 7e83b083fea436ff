"""Which backend a name means, and what is said where it cannot be had."""

from __future__ import annotations

import importlib.util
import sys

import pytest
import torch
from random_policy import save_random_policy

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main as evaluate
from cotap.sim import BatchSimulation, backends, make_simulation, resolve_backend
from cotap.train import main as train


@pytest.fixture
def machine(monkeypatch):
    """Pretends that there is a graphics card, or the extra, or not."""

    def pretend(card: bool, extra: bool) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: card)
        monkeypatch.setattr(backends, "find_spec", lambda _: object() if extra else None)

    return pretend


@pytest.mark.parametrize(
    ("card", "extra", "means"),
    [(True, True, "warp"), (True, False, "mjbatch"), (False, True, "mjbatch"), (False, False, "mjbatch")],
)
def test_auto_is_warp_where_a_card_and_the_extra_are(machine, card, extra, means):
    machine(card, extra)
    assert resolve_backend("auto") == means


@pytest.mark.parametrize("card", [True, False])
def test_a_backend_that_is_named_is_taken(machine, card):
    machine(card, True)
    assert resolve_backend("warp") == "warp"
    assert resolve_backend("mjbatch") == "mjbatch"


def test_warp_that_is_not_installed_is_named(machine, capsys, tmp_path):
    policy = str(save_random_policy(tmp_path / "policy.pt"))
    machine(True, False)
    with pytest.raises(ValueError, match=r"backend 'warp' needs mujoco_warp, .* pip install cotap\[warp\]"):
        resolve_backend("warp")
    with pytest.raises(ValueError, match=r"pip install cotap\[warp\]"):
        HumanoidEnv(HumanoidEnvConfig(num_envs=1, backend="warp"))
    for command, args in (
        (train, ["base", "--backend", "warp", "--num-envs", "2"]),
        (train, ["--backend", "warp"]),
        (evaluate, ["impact", "--checkpoint", policy, "--backend", "warp", "--num-envs", "2"]),
    ):
        assert command(args) == 2
        assert "pip install cotap[warp]" in capsys.readouterr().err


def test_unknown_backends_are_refused(capsys):
    with pytest.raises(ValueError, match=r"backend 'wrap' is unknown \(did you mean 'warp'\?\); known: auto, mjbatch"):
        resolve_backend("wrap")
    assert train(["base", "--backend", "wrap"]) == 2
    assert "'wrap' is unknown" in capsys.readouterr().err


def test_mjbatch_needs_nothing_of_warp(model, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    monkeypatch.setitem(sys.modules, "warp", None)
    assert isinstance(make_simulation("mjbatch", model, 2, 2, 1), BatchSimulation)


@pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="needs the extra warp")
def test_warp_that_is_asked_for_on_a_device_that_is_not_there_says_so(model):
    from cotap.sim.warp_simulation import WarpSimulation

    with pytest.raises(ValueError, match="device 'cuda:7' is none of Warp's: cpu"):
        WarpSimulation(model, 1, 1, "cuda:7")

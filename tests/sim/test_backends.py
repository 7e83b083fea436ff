"""Which backend a name means, and what is said where it cannot be had."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from importlib.metadata import PackageNotFoundError

import mujoco
import pytest
import torch
from random_policy import save_random_policy

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main as evaluate
from cotap.sim import BatchSimulation, backends, make_simulation, resolve_backend
from cotap.train import main as train


@pytest.fixture
def machine(monkeypatch):
    """Pretends that there is a GPU, or the extra `warp`, or mjbatch and the MuJoCo that it pins, or not."""

    def pretend(card: bool, warp: bool, mjbatch: bool = True, pin: str = mujoco.__version__) -> None:
        def requires(_: str) -> list[str]:
            if not mjbatch:
                raise PackageNotFoundError
            return [f"mujoco=={pin}", "numpy"]

        monkeypatch.setattr(torch.cuda, "is_available", lambda: card)
        monkeypatch.setattr(backends, "find_spec", lambda _: object() if warp else None)
        monkeypatch.setattr(backends, "requires", requires)

    return pretend


@pytest.mark.parametrize(
    ("card", "warp", "mjbatch", "means"),
    [
        (True, True, True, "warp"),
        (True, True, False, "warp"),
        (True, False, True, "mjbatch"),
        (False, True, True, "mjbatch"),
        (False, False, True, "mjbatch"),
        (True, False, False, "mujoco"),
        (False, True, False, "mujoco"),
    ],
)
def test_auto_is_the_fastest_that_can_be_had(machine, card, warp, mjbatch, means):
    machine(card, warp, mjbatch)
    assert resolve_backend("auto") == means


@pytest.mark.parametrize("card", [True, False])
def test_a_backend_that_is_named_is_taken(machine, card):
    machine(card, True)
    for name in ("warp", "mjbatch", "mujoco"):
        assert resolve_backend(name) == name


def test_mjbatch_is_used_beside_its_own_mujoco_alone(machine):
    """With another MuJoCo, its compiled part would read memory that is laid out otherwise."""
    machine(False, False, pin="2.0.0")
    assert resolve_backend("auto") == "mujoco"
    with pytest.raises(ValueError, match=rf"needs mujoco==2.0.0, and mujoco=={mujoco.__version__} is installed"):
        resolve_backend("mjbatch")


def test_mjbatch_that_is_not_installed_is_named(machine, capsys):
    machine(False, False, mjbatch=False)
    with pytest.raises(ValueError, match=r"backend 'mjbatch' needs mjbatch, .* pip install -e '\.\[mjbatch\]'"):
        HumanoidEnv(HumanoidEnvConfig(num_envs=1, backend="mjbatch"))
    assert train(["base", "--backend", "mjbatch", "--num-envs", "2"]) == 2
    assert "pip install -e '.[mjbatch]'" in capsys.readouterr().err


def test_warp_that_is_not_installed_is_named(machine, capsys, tmp_path):
    policy = str(save_random_policy(tmp_path / "policy.pt"))
    machine(True, False)
    with pytest.raises(ValueError, match=r"backend 'warp' needs mujoco_warp, .* pip install -e '\.\[warp\]'"):
        resolve_backend("warp")
    with pytest.raises(ValueError, match=r"pip install -e '\.\[warp\]'"):
        HumanoidEnv(HumanoidEnvConfig(num_envs=1, backend="warp"))
    for command, args in (
        (train, ["base", "--backend", "warp", "--num-envs", "2"]),
        (train, ["--backend", "warp"]),
        (evaluate, ["impact", "--checkpoint", policy, "--backend", "warp", "--num-envs", "2"]),
    ):
        assert command(args) == 2
        assert "pip install -e '.[warp]'" in capsys.readouterr().err


def test_unknown_backends_are_refused(capsys):
    with pytest.raises(ValueError, match=r"backend 'wrap' is unknown \(did you mean 'warp'\?\); known: auto, mjbatch"):
        resolve_backend("wrap")
    assert train(["base", "--backend", "wrap"]) == 2
    assert "'wrap' is unknown" in capsys.readouterr().err


def test_mujoco_needs_nothing_of_mjbatch_and_warp(model, monkeypatch):
    for name in ("mjbatch", "mujoco_warp", "warp"):
        monkeypatch.setitem(sys.modules, name, None)
    assert isinstance(make_simulation("mujoco", model, 2, 2, 1), BatchSimulation)


@pytest.mark.slow
def test_importing_cotap_loads_neither_mjbatch_nor_warp():
    code = "import sys, cotap.envs, cotap.train; print({'mjbatch', 'mujoco_warp', 'warp'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "set()", done.stderr[-800:]


@pytest.mark.skipif(importlib.util.find_spec("mujoco_warp") is None, reason="needs the extra warp")
def test_warp_that_is_asked_for_on_a_device_that_is_not_there_says_so(model):
    from cotap.sim.warp_simulation import WarpSimulation

    with pytest.raises(ValueError, match="device 'cuda:7' is none of Warp's: cpu"):
        WarpSimulation(model, 1, 1, "cuda:7")

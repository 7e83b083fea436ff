"""More than there is memory for is refused before it is taken, by what was asked for."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cotap import evaluate, export, memory, train
from cotap.agents.actors import DualActorCritic
from cotap.agents.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from cotap.agents.runner import layout_of
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluation.policy import load_policy, shipped_checkpoint
from cotap.evaluation.rollout import idle, record_rollout
from cotap.memory import free_bytes, require_memory

MANY = "1000000000"


@pytest.mark.usefixtures("in_tmp_path")
@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (evaluate.main, ["velocity-tracking", "--num-envs", MANY], "num_envs 1000000000 would take"),
        (evaluate.main, ["velocity-tracking", "--num-envs", "1" + "0" * 400], "would take"),
        (evaluate.main, ["stability", "--poses", MANY], "poses must lie in [1, 1000000]"),
        (evaluate.main, ["tour", "--waypoints", MANY], "waypoints must lie in [1, 10000]"),
        (train.main, ["--num-envs", MANY], "num_envs 1000000000 would take"),
        (train.main, ["base", "--num-envs", MANY], "num_envs 1000000000 would take"),
        (train.main, ["base", "--num-envs", "2", "--ppo.steps", MANY], "ppo.steps 1000000000 of 2 envs would take"),
        (train.main, ["base", "--num-envs", "2", "--ppo.hidden", MANY], "ppo.hidden (1000000000,) would take"),
        (train.main, ["base", "--num-envs", "2", "--env.substeps", MANY], "substeps must lie in [1, 1000]"),
        (export.main, ["--output", "p.onnx", "--checks", MANY], "checks must lie in [1, 1000000]"),
    ],
)
def test_a_command_line_that_asks_for_too_much_is_refused(main, arguments, message, capsys):
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert message in said
    assert not list(Path().iterdir())


def test_a_record_too_long_for_memory_is_refused_after_one_step(monkeypatch):
    """Two envs for a year of steps; a record of a few is made."""
    env = HumanoidEnv(HumanoidEnvConfig(num_envs=2, num_threads=1))
    row = sum(v[0].numel() * v.element_size() for v in vars(record_rollout(env, idle(env), 3, False)).values()
              if isinstance(v, torch.Tensor) and v.shape[:2] == (3, 2))  # fmt: skip
    with pytest.raises(ValueError, match=r"a record of 1000000000 steps of 2 envs would take .* GiB of memory; "):
        record_rollout(env, idle(env), 1_000_000_000, False)
    for free, fits in ((2 * 10 * row, True), (2 * 10 * row - 1, False)):  # with as much again for measures of it
        monkeypatch.setattr(memory, "free_bytes", lambda _, free=free: free)
        if fits:
            record_rollout(env, idle(env), 10, False)
        else:
            with pytest.raises(ValueError, match="a record of 10 steps of 2 envs"):
                record_rollout(env, idle(env), 10, False)


@pytest.mark.parametrize("symmetric", [True, False])
def test_networks_are_counted_as_they_are_made(symmetric):
    layout = layout_of(HumanoidEnv(HumanoidEnvConfig(num_envs=1, num_threads=1)), symmetric)
    model = DualActorCritic(layout, (64, 32, 16), 1.0)
    matrices = [p.numel() for name, p in model.named_parameters() if p.dim() == 2 and "output" not in name]
    outputs = 0 if symmetric else 16 * (layout.num_actions + 2)  # plain networks do not call them so
    assert layout.num_weights((64, 32, 16)) == sum(matrices) - outputs


def test_a_checkpoint_does_not_make_networks_larger_than_itself(tmp_path, monkeypatch):
    """Its config asks for widths of which it has no weights: refused before they are made."""
    content = load_checkpoint(shipped_checkpoint())
    content["config"]["training"]["ppo"]["hidden"] = [4096, 4096]
    save_checkpoint(tmp_path / "wide.pt", content)
    monkeypatch.setattr(DualActorCritic, "__init__", None)
    with pytest.raises(
        CheckpointError, match=r"wide\.pt' has networks .*ppo\.hidden \(4096, 4096\) takes more weights"
    ):
        load_policy(tmp_path / "wide.pt")


def test_what_is_free_is_what_the_system_gives_and_the_container_lets(tmp_path, monkeypatch):
    system, container = tmp_path / "meminfo", tmp_path / "memory.max"
    monkeypatch.setattr(memory, "_SYSTEM", system)
    monkeypatch.setattr(memory, "_CONTAINER", container)
    system.write_text("MemTotal:       16000000 kB\nMemFree:  1 kB\nMemAvailable:    8000000 kB\n")
    assert free_bytes() == 8_000_000 << 10
    container.write_text("max\n")
    assert free_bytes() == 8_000_000 << 10
    container.write_text("1048576\n")
    assert free_bytes() == 1 << 20
    require_memory("a", 1 << 20)
    with pytest.raises(ValueError, match=r"^a would take 0\.0 GiB of memory; 0\.0 GiB are free"):
        require_memory("a", (1 << 20) + 1)
    system.unlink()
    container.unlink()
    assert free_bytes() is None or free_bytes() > 1 << 28  # all that is built in, where that is known
    monkeypatch.setattr(memory, "free_bytes", lambda _: None)
    require_memory("a", 1 << 100)

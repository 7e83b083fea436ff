"""The training loop: it goes on exactly where it stopped, however it stopped, and refuses what it cannot go on from."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import dummy_env
import pytest
import torch
from dummy_env import DummyEnv, make_runner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cotap.agents.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from cotap.agents.runner import DualRunner, TrainingFault, check_run_dir, checkpoints_of, newest_checkpoint, sole_writer
from cotap.agents.runner_config import RunnerConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.observations import NoiseConfig, ObservationConfig
from cotap.envs.terminations import TerminationConfig

STEPS = dummy_env.TINY["steps"]
ENVS = 8


def dummy() -> DummyEnv:
    return DummyEnv(ENVS)


def robots(num_envs: int = ENVS) -> HumanoidEnv:
    """Episodes so short that resets of every kind happen in a few iterations."""
    return HumanoidEnv(
        HumanoidEnvConfig(
            num_envs=num_envs,
            num_threads=1,
            terminations=TerminationConfig(episode_s=0.3),
            observations=ObservationConfig(noise=NoiseConfig(enabled=True)),
        )
    )


def checkpoint(run_dir: Path, iteration: int) -> Path:
    return run_dir / f"checkpoint_{iteration:06d}.pt"


def names(run_dir: Path) -> list[str]:
    """Checkpoints and whatever else is no log."""
    return sorted(n for n in os.listdir(run_dir) if not n.startswith("events."))


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """Nested data are equal, tensors bit for bit."""
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, list):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}/{i}")
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype, where
        assert torch.equal(a, b), where
    else:
        assert a == b, where


def assert_same_run(a: Path, b: Path) -> None:
    """Two checkpoints hold the same but for the time it took."""
    contents = [load_checkpoint(p) for p in (a, b)]
    for content in contents:
        del content["wall_seconds"]
    assert_same(*contents)


def weights(runner: DualRunner) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in runner.alg.model.state_dict().items()}


@pytest.mark.parametrize("make", [dummy, robots])
@pytest.mark.parametrize("stop", [1, 3])
def test_resumed_run_ends_bit_for_bit_where_a_straight_one_does(tmp_path: Path, make: Callable[[], Any], stop: int):
    straight = make_runner(tmp_path / "straight", 5, env=make())
    start = weights(straight)
    straight.learn()
    make_runner(tmp_path / "parts", stop, env=make()).learn()
    # Another seed: everything must come from the file.
    resumed = make_runner(tmp_path / "parts", 5, seed=99, env=make())
    resumed.load(str(checkpoint(tmp_path / "parts", stop)))
    assert resumed.current_learning_iteration == stop
    assert resumed.env.samples == stop * STEPS * ENVS
    resumed.learn()
    assert_same_run(checkpoint(tmp_path / "straight", 5), checkpoint(tmp_path / "parts", 5))
    assert any(not torch.equal(v, start[k]) for k, v in weights(resumed).items())


def test_a_resumed_run_goes_on_counting_its_hours(tmp_path: Path):
    make_runner(tmp_path, 2).learn()
    path = checkpoint(tmp_path, 2)
    spent = load_checkpoint(path)["wall_seconds"]
    assert spent > 0.0
    save_checkpoint(path, load_checkpoint(path) | {"wall_seconds": 7200.0})
    resumed = make_runner(tmp_path, 3)
    resumed.load(str(path))
    assert resumed.wall_seconds == 7200.0
    resumed.learn()
    assert 7200.0 < load_checkpoint(checkpoint(tmp_path, 3))["wall_seconds"] < 7200.0 + 60.0


def test_saving_does_not_disturb_a_run(tmp_path: Path):
    for interval in (1, 100):
        make_runner(tmp_path / str(interval), 4, save_interval=interval, env=robots()).learn()
    assert_same_run(checkpoint(tmp_path / "1", 4), checkpoint(tmp_path / "100", 4))


def test_checkpoints_come_at_intervals_and_at_the_end(tmp_path: Path):
    make_runner(tmp_path, 5, save_interval=2).learn()
    expected = [f"checkpoint_{i:06d}.pt" for i in (2, 4, 5)]
    assert names(tmp_path) == [*expected, "config.json"]
    assert [load_checkpoint(tmp_path / n)["iteration"] for n in expected] == [2, 4, 5]
    assert [load_checkpoint(tmp_path / n)["samples"] for n in expected] == [i * STEPS * ENVS for i in (2, 4, 5)]


def test_only_the_newest_checkpoint_keeps_simulator_states(tmp_path: Path):
    make_runner(tmp_path, 6, save_interval=2).learn()
    older = [load_checkpoint(checkpoint(tmp_path, i)) for i in (2, 4)]
    newest = load_checkpoint(checkpoint(tmp_path, 6))
    assert newest["env"]["episode_length"].shape == (ENVS,)
    for content in older:
        assert content["env"] == {}
        assert content["learner"]["optimizers"].keys() == {"lower", "upper"}
        assert not torch.equal(
            content["model"]["actors.lower.mlp.0.weight"], newest["model"]["actors.lower.mlp.0.weight"]
        )


def test_the_newest_checkpoint_is_that_of_the_highest_iteration(tmp_path: Path):
    assert newest_checkpoint(tmp_path) is None
    for iteration in (1_000_000, 25, 999_999):
        (tmp_path / f"checkpoint_{iteration:06d}.pt").touch()
    found = [path.name for path in checkpoints_of(tmp_path)]
    assert found == ["checkpoint_000025.pt", "checkpoint_999999.pt", "checkpoint_1000000.pt"]
    assert newest_checkpoint(tmp_path) == tmp_path / found[-1]
    check_run_dir(tmp_path, tmp_path / found[-1])
    with pytest.raises(ValueError, match="newer checkpoint than that"):
        check_run_dir(tmp_path, tmp_path / found[-2])


def test_an_older_checkpoint_goes_on_with_fresh_envs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    make_runner(tmp_path / "a", 4, save_interval=2).learn()
    runner = make_runner(tmp_path / "b", 3)
    runner.load(str(checkpoint(tmp_path / "a", 2)))
    assert "no simulator states" in "".join(capsys.readouterr())
    assert runner.env.samples == 2 * STEPS * ENVS
    runner.learn()
    assert names(tmp_path / "b") == ["checkpoint_000003.pt", "config.json"]


def test_another_number_of_envs_goes_on_with_fresh_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    make_runner(tmp_path / "a", 2).learn()
    runner = make_runner(tmp_path / "b", 3, env=DummyEnv(16))
    runner.load(str(checkpoint(tmp_path / "a", 2)))
    assert "no simulator states" in "".join(capsys.readouterr())
    runner.learn()
    content = load_checkpoint(checkpoint(tmp_path / "b", 3))
    assert content["samples"] == 2 * STEPS * ENVS + STEPS * 16
    assert content["iteration"] == 3


@pytest.mark.parametrize(("collision", "fresh"), [("feet", False), ("full", True)])
def test_envs_of_another_model_start_afresh(tmp_path: Path, collision: str, fresh: bool, capsys: Any):
    def configured(folder: Path, iterations: int, shapes: str) -> DualRunner:
        runner = make_runner(folder, iterations)
        runner.config = {"stage": "base", "training": {"env": {"collision": shapes}}}
        return runner

    configured(tmp_path / "a", 2, "feet").learn()
    configured(tmp_path / "b", 3, collision).load(str(checkpoint(tmp_path / "a", 2)))
    assert ("no simulator states" in "".join(capsys.readouterr())) == fresh


def test_samples_go_on_in_fresh_envs_and_with_them_the_curricula(tmp_path: Path):
    env = robots()
    runner = make_runner(tmp_path, 1, env=env)
    env.samples = 7_000_000
    env.curriculum.samples, env.curriculum.falls_per_s, env.curriculum.arm_motion = 5_000_000, 0.01, 0.5
    runner.runner_cfg.save_envs = False
    runner.save()
    assert load_checkpoint(checkpoint(tmp_path, 0))["env"] == {}
    other = robots(3)
    make_runner(tmp_path / "b", 1, env=other).load(str(checkpoint(tmp_path, 0)))
    assert other.samples == 7_000_000
    assert other.curriculum.state_dict() == {"samples": 5_000_000, "falls_per_s": 0.01, "arm_motion": 0.5}


def test_a_checkpoint_of_weights_alone_does_not_go_on(tmp_path: Path):
    make_runner(tmp_path / "a", 2).learn()
    content = load_checkpoint(checkpoint(tmp_path / "a", 2))
    save_checkpoint(tmp_path / "shipped.pt", content | {"learner": {}, "env": {}})
    with pytest.raises(CheckpointError, match="states that do not fit this run: 'optimizers' is missing"):
        make_runner(tmp_path / "b", 1, seed=5).load(str(tmp_path / "shipped.pt"))


def test_random_numbers_of_a_graphics_card_go_on_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    drawn = {"cuda:1": torch.arange(16, dtype=torch.uint8)}
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device: drawn[device].clone())
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, device: drawn.update({device: state}))
    runner = make_runner(tmp_path, 1)
    runner.learn()
    assert "device_rng" not in load_checkpoint(checkpoint(tmp_path, 1))
    path = str(tmp_path / "card.pt")
    runner.device = "cuda:1"
    monkeypatch.setattr("cotap.agents.runner.load_checkpoint", lambda file, _: load_checkpoint(file))  # there is none
    runner.save(path)
    saved = drawn.pop("cuda:1")
    runner.load(path)
    assert torch.equal(drawn.pop("cuda:1"), saved)
    runner.load(str(checkpoint(tmp_path, 1)))  # made where there was no card
    make_runner(tmp_path / "elsewhere", 1).load(path)
    assert drawn == {}
    save_checkpoint(tmp_path / "odd.pt", load_checkpoint(path) | {"device_rng": 3})
    with pytest.raises(CheckpointError, match="no usable part 'device_rng': 3"):
        runner.load(str(tmp_path / "odd.pt"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda n: n.name)
def test_a_signal_ends_the_run_after_its_iteration_and_loses_nothing(tmp_path: Path, number: signal.Signals):
    before = [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)]
    runner = make_runner(tmp_path / "stopped", 5, save_interval=100)
    runner.env.on_step = lambda step: signal.raise_signal(number) if step == 2 * STEPS + 1 else None
    runner.learn()
    assert [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)] == before
    assert names(tmp_path / "stopped") == ["checkpoint_000003.pt", "config.json"]
    resumed = make_runner(tmp_path / "stopped", 5, save_interval=100, seed=9)
    resumed.load(str(checkpoint(tmp_path / "stopped", 3)))
    resumed.learn()
    make_runner(tmp_path / "straight", 5, save_interval=100).learn()
    assert_same_run(checkpoint(tmp_path / "stopped", 5), checkpoint(tmp_path / "straight", 5))


def test_a_stopped_runner_can_be_told_to_go_on(tmp_path: Path):
    runner = make_runner(tmp_path, 5, save_interval=100)
    runner.env.on_step = lambda step: signal.raise_signal(signal.SIGTERM) if step == 0 else None
    runner.learn()
    assert runner.current_learning_iteration == 1
    runner.learn()
    assert runner.current_learning_iteration == 5


def test_a_second_signal_ends_the_run_at_once(tmp_path: Path):
    before = signal.getsignal(signal.SIGTERM)
    runner = make_runner(tmp_path, 5, save_interval=1)
    runner.env.on_step = lambda step: signal.raise_signal(signal.SIGTERM) if step >= STEPS else None
    with pytest.raises(KeyboardInterrupt):
        runner.learn()
    assert runner.env.steps == STEPS + 1
    assert signal.getsignal(signal.SIGTERM) == before
    assert names(tmp_path) == ["checkpoint_000001.pt", "config.json"]
    load_checkpoint(checkpoint(tmp_path, 1))


def test_a_signal_does_not_cut_the_last_save_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Whoever handles signals outside a run must not get one while the run still saves."""
    outside: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, _frame: outside.append(number))
    try:
        runner = make_runner(tmp_path, 1, save_interval=100)
        save = runner.save

        def save_under_fire() -> None:
            signal.raise_signal(signal.SIGTERM)
            save()

        monkeypatch.setattr(runner, "save", save_under_fire)
        runner.learn()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert outside == []
    load_checkpoint(checkpoint(tmp_path, 1))


def test_a_run_killed_outright_loses_at_most_one_interval(tmp_path: Path):
    """`kill -9` in the sixth iteration of a run that saves every second one."""
    killed = tmp_path / "killed"
    command = [sys.executable, dummy_env.__file__, str(killed), "8", str(int(signal.SIGKILL)), str(5 * STEPS + 3)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert result.returncode == -signal.SIGKILL, result.stderr
    newest = max(killed.glob("checkpoint_*.pt"))
    assert newest == checkpoint(killed, 4)
    resumed = make_runner(killed, 8, seed=9)
    resumed.load(str(newest))
    resumed.learn()
    make_runner(tmp_path / "straight", 8).learn()
    assert_same_run(checkpoint(killed, 8), checkpoint(tmp_path / "straight", 8))


def test_logs_of_a_resumed_run_are_one_curve(tmp_path: Path):
    for iterations in (3, 5):
        runner = make_runner(tmp_path, iterations)
        if iterations == 5:
            runner.load(str(checkpoint(tmp_path, 3)))
        runner.learn()
    logs = EventAccumulator(str(tmp_path))
    logs.Reload()
    tags = logs.Tags()["scalars"]
    assert {"lower/target", "upper/target", "agents/lower/kl", "agents/upper/action_std"} <= set(tags)
    assert "throughput/steps_per_s" in tags
    for tag in tags:
        assert [e.step for e in logs.Scalars(tag)] == [STEPS * ENVS * i for i in (1, 2, 3, 4, 5)], tag


@pytest.mark.parametrize("envs", [4, 16])
def test_logs_count_samples_also_when_the_number_of_envs_changes(tmp_path: Path, envs: int):
    make_runner(tmp_path, 3).learn()
    runner = make_runner(tmp_path, 5, env=DummyEnv(envs))
    runner.load(str(checkpoint(tmp_path, 3)))
    runner.learn()
    logs = EventAccumulator(str(tmp_path))
    logs.Reload()
    before = 3 * ENVS
    expected = [STEPS * n for n in (ENVS, 2 * ENVS, before, before + envs, before + 2 * envs)]
    assert [e.step for e in logs.Scalars("lower/target")] == expected


def test_logged_rewards_are_means_over_the_iteration(tmp_path: Path):
    runner = make_runner(tmp_path, 1)
    seen: list[float] = []
    step = runner.env.step

    def spy(actions: torch.Tensor) -> Any:
        result = step(actions)
        seen.append(float(result[3]["group_rewards"][:, 1].mean()))
        return result

    runner.env.step = spy
    runner.learn()
    logs = EventAccumulator(str(tmp_path))
    logs.Reload()
    assert len(seen) == STEPS
    assert logs.Scalars("upper/target")[0].value == pytest.approx(sum(seen) / STEPS, rel=1e-5)


def test_learner_is_told_what_the_environment_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    runner = make_runner(tmp_path, 3)
    said: list[tuple[torch.Tensor, ...]] = []
    heard: list[tuple[torch.Tensor, ...]] = []
    step, process = runner.env.step, runner.alg.process_step

    def spy(actions: torch.Tensor) -> Any:
        result = step(actions)
        said.append((result[3]["group_rewards"], result[2], result[3]["time_outs"]))
        return result

    monkeypatch.setattr(runner.env, "step", spy)
    monkeypatch.setattr(runner.alg, "process_step", lambda *args: (heard.append(args), process(*args)))
    runner.learn()
    assert_same([list(s) for s in said], [list(h) for h in heard])
    ends = torch.stack([torch.stack(s[1:]) for s in said]).sum((0, 2))
    assert 0 < int(ends[1]) < int(ends[0]), "there were no falls or no time-outs"


@pytest.mark.parametrize("content", [b"", b"rubbish" * 50_000])
def test_an_unreadable_older_checkpoint_does_not_end_a_run(tmp_path: Path, content: bytes):
    tmp_path.joinpath("checkpoint_000000.pt").write_bytes(content)
    make_runner(tmp_path, 2).learn()
    assert load_checkpoint(checkpoint(tmp_path, 2))["iteration"] == 2
    assert tmp_path.joinpath("checkpoint_000000.pt").read_bytes() == content


def fail_saves(monkeypatch: pytest.MonkeyPatch, iterations: Collection[int]) -> None:
    """Saves of these iterations fail as on a full disk."""
    real = torch.save

    def save(content: Any, file: Any) -> None:
        if content["iteration"] in iterations and content["env"]:
            file.write(b"part")
            raise RuntimeError("PytorchStreamWriter failed writing file")
        real(content, file)

    monkeypatch.setattr(torch, "save", save)


def test_a_full_disk_is_reported_and_saving_tried_again_until_it_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    fail_saves(monkeypatch, (4, 5))
    runner = make_runner(tmp_path, 7, save_interval=2)
    runner.learn()
    assert names(tmp_path) == [*(f"checkpoint_{i:06d}.pt" for i in (2, 6, 7)), "config.json"]
    assert runner.failed_saves == 2
    said = "".join(capsys.readouterr())
    for iteration in (4, 5):
        assert f"iteration {iteration}: cannot write checkpoint" in said
    monkeypatch.undo()
    make_runner(tmp_path / "straight", 7).learn()
    assert_same_run(checkpoint(tmp_path, 7), checkpoint(tmp_path / "straight", 7))
    logs = EventAccumulator(str(tmp_path))
    logs.Reload()
    assert [e.value for e in logs.Scalars("faults/failed_saves")] == [0, 0, 0, 0, 1, 2, 2]


def test_a_disk_that_stays_full_ends_the_run_and_keeps_what_was_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fail_saves(monkeypatch, range(3, 9))
    with pytest.raises(OSError, match=r"checkpoint_000006.*failed writing"):
        make_runner(tmp_path, 6, save_interval=2).learn()
    assert names(tmp_path) == ["checkpoint_000002.pt", "config.json"]
    assert load_checkpoint(checkpoint(tmp_path, 2))["env"] != {}


def test_an_older_checkpoint_that_cannot_be_replaced_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    real = torch.save

    def save(content: Any, file: Any) -> None:
        if not content["env"]:
            raise RuntimeError("full")
        real(content, file)

    monkeypatch.setattr(torch, "save", save)
    runner = make_runner(tmp_path, 4, save_interval=2)
    runner.learn()
    assert "checkpoint_000002.pt keeps its simulator states" in "".join(capsys.readouterr())
    assert runner.failed_saves == 0
    assert load_checkpoint(checkpoint(tmp_path, 2))["env"] != {}
    assert load_checkpoint(checkpoint(tmp_path, 4))["env"] != {}


def test_a_step_that_raises_ends_the_run_with_what_to_do(tmp_path: Path):
    runner = make_runner(tmp_path, 9, save_interval=2)

    def fail(step: int) -> None:
        if step == 5 * STEPS + 1:
            raise KeyError("a worker")

    runner.env.on_step = fail
    with pytest.raises(TrainingFault, match=r"iteration 6 failed \(KeyError: 'a worker'\)") as error:
        runner.learn()
    assert f"go on with --resume {checkpoint(tmp_path, 4)}" in str(error.value)
    assert isinstance(error.value.__cause__, KeyError)
    assert load_checkpoint(checkpoint(tmp_path, 4))["env"] != {}


def test_a_reward_that_is_no_number_teaches_its_agent_nothing_and_is_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    runner = make_runner(tmp_path, 1)
    before = weights(runner)
    step = runner.env.step

    def spoiled(actions: torch.Tensor) -> Any:
        result = step(actions)
        result[3]["group_rewards"][2, 0] = math.nan
        return result

    runner.env.step = spoiled
    runner.learn()
    steps = dummy_env.TINY["epochs"] * dummy_env.TINY["mini_batches"]
    assert f"iteration 1: {steps} steps of agent 'lower' skipped" in "".join(capsys.readouterr())
    changed = {k for k, v in weights(runner).items() if not torch.equal(v, before[k])}
    assert not any("lower" in k for k in changed)
    assert any("critics.upper" in k for k in changed)
    assert any("actors.upper" in k for k in changed)
    logs = EventAccumulator(str(tmp_path))
    logs.Reload()
    assert [logs.Scalars(f"agents/{n}/skipped")[0].value for n in ("lower", "upper")] == [steps, 0.0]


@pytest.mark.usefixtures("in_tmp_path")
@pytest.mark.parametrize("fault", ["nan", "force"])
def test_a_env_that_diverges_is_named_counted_and_contained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, fault: str
):
    env = robots()
    apply, calls = env.forces.apply, []

    def planted(xfrc: torch.Tensor, *args: Any) -> None:
        apply(xfrc, *args)
        calls.append(1)
        if len(calls) == STEPS + 2:
            if fault == "nan":
                env.sim.qpos[3, 10] = math.nan
            else:
                xfrc[3, 1, 2] = 1e12

    monkeypatch.setattr(env.forces, "apply", planted)
    runner = make_runner(tmp_path, 3, env=env)
    runner.learn()
    assert "iteration 2: envs diverged 1 times" in "".join(capsys.readouterr())
    assert env.num_diverged == 1
    content = load_checkpoint(checkpoint(tmp_path, 3))
    for part in (content["model"], content["env"]["observations"]):
        assert all(torch.isfinite(v).all() for v in part.values())


def test_what_killed_processes_left_is_removed(tmp_path: Path):
    for name in (".checkpoint_000002.abc.pt", ".config.xyz.json", ".mine"):
        tmp_path.joinpath(name).write_bytes(b"part")
    make_runner(tmp_path, 1).learn()
    assert names(tmp_path) == [".mine", "checkpoint_000001.pt", "config.json"]


def test_a_checkpoint_of_another_robot_is_refused_and_changes_nothing(tmp_path: Path):
    make_runner(tmp_path, 1).learn()
    runner = make_runner(tmp_path / "b", 1, seed=3, env=DummyEnv(robot="other"))
    before = weights(runner)
    with pytest.raises(CheckpointError, match="trained with another robot: 'dummy', here 'other'"):
        runner.load(str(checkpoint(tmp_path, 1)))
    assert_same(weights(runner), before)
    assert runner.current_learning_iteration == 0


def test_a_checkpoint_of_another_observation_layout_is_refused(tmp_path: Path):
    make_runner(tmp_path, 1, env=robots()).learn()
    other = HumanoidEnv(HumanoidEnvConfig(num_envs=ENVS, num_threads=1, observations=ObservationConfig(history=3)))
    with pytest.raises(CheckpointError, match="another history: 5, here 3"):
        make_runner(tmp_path / "b", 1, env=other).load(str(checkpoint(tmp_path, 1)))


def test_a_checkpoint_of_other_networks_is_refused(tmp_path: Path):
    make_runner(tmp_path, 1).learn()
    with pytest.raises(
        CheckpointError, match=r"checkpoint_000001.pt' has other networks: weight actors.* must be of shape"
    ):
        make_runner(tmp_path / "b", 1, hidden=(16, 8)).load(str(checkpoint(tmp_path, 1)))


@pytest.mark.parametrize("missing", ["layout", "model", "learner", "env", "samples"])
def test_a_checkpoint_that_lacks_a_part_is_refused_by_name(tmp_path: Path, missing: str):
    make_runner(tmp_path, 1).learn()
    content = load_checkpoint(checkpoint(tmp_path, 1))
    del content[missing]
    save_checkpoint(tmp_path / "odd.pt", content)
    with pytest.raises(CheckpointError, match=missing):
        make_runner(tmp_path / "b", 1).load(str(tmp_path / "odd.pt"))


def test_a_used_run_directory_is_refused_with_what_to_do(tmp_path: Path):
    make_runner(tmp_path, 4, save_interval=2).learn()
    before = names(tmp_path)
    with pytest.raises(ValueError, match="already holds a run") as error:
        check_run_dir(tmp_path)
    assert f"--resume {checkpoint(tmp_path, 4)}" in str(error.value)
    assert "--run-dir" in str(error.value)
    check_run_dir(tmp_path, checkpoint(tmp_path, 4))
    assert names(tmp_path) == before


def test_a_run_directory_that_another_training_writes_to_is_refused_before_its_first_checkpoint(tmp_path: Path):
    refused = pytest.raises(ValueError, match=r"another training writes to .*choose another --run-dir")
    with sole_writer(tmp_path), refused, sole_writer(tmp_path):
        pass
    with sole_writer(tmp_path):  # and is free again
        pass


def test_going_on_from_an_older_checkpoint_beside_newer_ones_is_refused(tmp_path: Path):
    """The newest would be what auto finds, and the branch would be lost."""
    make_runner(tmp_path, 4, save_interval=2).learn()
    with pytest.raises(ValueError, match="newer checkpoint") as error:
        check_run_dir(tmp_path, checkpoint(tmp_path, 2))
    assert f"--resume {checkpoint(tmp_path, 4)}" in str(error.value)
    check_run_dir(tmp_path / "branch", checkpoint(tmp_path, 2))


def test_a_run_that_is_at_its_end_says_so_and_leaves_its_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    make_runner(tmp_path, 2).learn()
    before = checkpoint(tmp_path, 2).read_bytes()
    there = names(tmp_path)
    tmp_path.joinpath(".checkpoint_000000.abc.pt").write_bytes(b"killed while it shed its simulator states")
    ended = make_runner(tmp_path, 2)
    ended.load(str(checkpoint(tmp_path, 2)))
    ended.learn()
    said = capsys.readouterr()
    assert "at iteration 2 of 2: nothing to do" in said.out + said.err
    assert checkpoint(tmp_path, 2).read_bytes() == before
    assert names(tmp_path) == there


def test_a_new_run_directory_is_made_and_left_empty(tmp_path: Path):
    check_run_dir(tmp_path / "new" / "run")
    assert names(tmp_path / "new" / "run") == []


def test_a_run_directory_that_cannot_be_is_refused(tmp_path: Path):
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(ValueError, match="is a file") as error:
        check_run_dir(file)
    assert repr(str(file)) in str(error.value)
    with pytest.raises(OSError, match="file"):
        check_run_dir(file / "run")
    with pytest.raises(OSError, match="nowhere"):
        check_run_dir(Path("/proc/nowhere/run"))
    assert file.read_text() == "mine"


@pytest.mark.parametrize(
    ("field", "value"), [("iterations", 0), ("iterations", -3), ("save_interval", 0), ("save_interval", 2.5)]
)
def test_bad_durations_are_named(field: str, value: Any):
    with pytest.raises(ValueError, match=f"runner.{field} must be a positive integer, got {value}"):
        RunnerConfig(**{field: value}).check()

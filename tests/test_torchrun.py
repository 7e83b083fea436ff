"""`torchrun -m cotap.train`: one log, one checkpoint, and on after a rank is lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cotap.agents.checkpoint import load_checkpoint

pytestmark = pytest.mark.slow
LAUNCH = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
TINY = ["--num-envs", "4", "--ppo.hidden", "8", "8", "--ppo.steps", "4", "--ppo.precision", "fp32",
        "--runner.save-interval", "2", "--env.assist.full-samples", "0"]  # fmt: skip


def command(run_dir: Path, iterations: int, *launch: str, resume: str = "auto") -> list[str]:
    train = ["-m", "cotap.train", "base", *TINY, "--iterations", str(iterations), "--run-dir", str(run_dir)]
    return [*LAUNCH, *launch, *train, "--resume", resume]


def run(args: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(args, capture_output=True, text=True, timeout=600)


def steps(run_dir: Path) -> list[int]:
    logs = EventAccumulator(str(run_dir))
    logs.Reload()
    return [e.step for e in logs.Scalars("throughput/steps_per_s")]


def test_two_processes_train_one_policy_and_go_on_exactly(tmp_path: Path):
    for folder, stops in (("straight", (5,)), ("parts", (3, 5))):
        for stop in stops:
            result = run(command(tmp_path / folder, stop))
            assert result.returncode == 0, result.stderr
    contents = [load_checkpoint(tmp_path / f / "checkpoint_000005.pt") for f in ("straight", "parts")]
    for key, value in contents[0]["model"].items():
        assert torch.equal(value, contents[1]["model"][key]), key
    content = contents[0]
    assert content["samples"] == 5 * 4 * 2 * 4
    own, other = content["env"], content["others"][0]["env"]
    assert not torch.equal(own["sim"]["state"], other["sim"]["state"])
    share = "_share"
    assert torch.equal(own["parts"]["assistance"][share], other["parts"]["assistance"][share])
    assert float(own["parts"]["assistance"][share]) < 1.0
    for folder in ("straight", "parts"):
        assert steps(tmp_path / folder) == [32 * i for i in range(1, 6)]


def ranks_of(launcher: int) -> list[int]:
    """Processes that train, as the system lists them."""
    children = Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split()
    return [int(c) for c in children if "cotap.train" in Path(f"/proc/{c}/cmdline").read_text()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads Linux's list of processes")
@pytest.mark.parametrize("lost", [0, 1])
def test_a_lost_rank_is_replaced_and_the_run_goes_on(tmp_path: Path, lost: int):
    folder = tmp_path / "run"
    process = subprocess.Popen(
        command(folder, 30, "--max-restarts=1"), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    while not list(folder.glob("checkpoint_*.pt")):
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    os.kill(ranks_of(process.pid)[lost], signal.SIGKILL)
    _, said = process.communicate(timeout=600)
    assert process.returncode == 0, said
    assert load_checkpoint(folder / "checkpoint_000030.pt")["samples"] == 30 * 4 * 2 * 4
    assert steps(folder) == [32 * i for i in range(1, 31)]


def test_what_several_processes_cannot_do_is_refused(tmp_path: Path):
    result = run([*LAUNCH, "-m", "cotap.train", "base", *TINY])
    assert result.returncode != 0
    assert "several processes need one --run-dir" in result.stderr
    result = run([*LAUNCH, "-m", "cotap.train", "--run-dir", str(tmp_path)])
    assert "train stage by stage" in result.stderr

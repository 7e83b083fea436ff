"""`torchrun -m cotap.train`: one log, one checkpoint, and on after a rank is lost."""

from __future__ import annotations

import os
import shutil
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
OWN_STORE = {"TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}
TINY = ["--num-envs", "4", "--ppo.hidden", "8", "8", "--ppo.steps", "4", "--ppo.precision", "fp32",
        "--runner.save-interval", "2", "--env.assist.full-samples", "0"]  # fmt: skip


def command(run_dir: Path, iterations: int, *launch: str, resume: str = "auto") -> list[str]:
    train = ["-m", "cotap.train", "base", *TINY, "--iterations", str(iterations), "--run-dir", str(run_dir)]
    return [*LAUNCH, *launch, *train, "--resume", resume]


def run(args: list[str], **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(args, capture_output=True, text=True, timeout=600, env=os.environ | variables)


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
    assert own["counters"]["samples"] == other["counters"]["samples"] == content["samples"]
    for folder in ("straight", "parts"):
        assert steps(tmp_path / folder) == [32 * i for i in range(1, 6)]


ENDS = """
import os, sys
from pathlib import Path
from cotap.train import main
status = main(sys.argv[1:])
print("threads:", *(task.joinpath("comm").read_text().strip() for task in Path("/proc/self/task").iterdir()))
sys.exit(status)
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads Linux's list of threads")
def test_no_thread_of_the_group_outlives_it(tmp_path: Path):
    script = tmp_path / "ends.py"
    script.write_text(ENDS)
    train = command(tmp_path / "run", 1)[len(LAUNCH) + 2 :]
    result = run([*LAUNCH, str(script), *train])
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("threads:") == 2
    assert "gloo" not in result.stdout


def ranks_of(launcher: int) -> list[int]:
    """Processes that train, as the system lists them."""
    children = Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split()
    return [int(c) for c in children if "cotap.train" in Path(f"/proc/{c}/cmdline").read_text()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads Linux's list of processes")
@pytest.mark.parametrize("lost", [0, 1])
def test_a_lost_rank_is_replaced_and_the_run_goes_on(tmp_path: Path, lost: int):
    folder = tmp_path / "run"
    process = subprocess.Popen(
        command(folder, 30, "--max-restarts=1"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | OWN_STORE,
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


TWO_HOSTS = """
set -e
mount -t tmpfs none /run
for i in 1 2; do ip netns add h$i; done
ip link add v1 netns h1 type veth peer name v2 netns h2
for i in 1 2; do ip -n h$i addr add 10.99.0.$i/24 dev v$i; ip -n h$i link set v$i up; ip -n h$i link set lo up; done
for i in 1 2; do GLOO_SOCKET_IFNAME=v$i ip netns exec h$i "$@" & pids="$pids $!"; done
for pid in $pids; do wait $pid; done
"""
"""Two network namespaces with a cable between them, and the command in each; all of it ends with the shell."""
IN_NAMESPACES = ["unshare", "-rmn", "bash", "-c", TWO_HOSTS, "bash"]


def can_make_hosts() -> bool:
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        return False
    return subprocess.run([*IN_NAMESPACES, "true"], capture_output=True).returncode == 0


def test_two_hosts_train_one_policy(tmp_path: Path):
    """Hosts that reach each other by network alone, and share a folder."""
    if not can_make_hosts():
        pytest.skip("no network namespaces can be made here")
    meet = ["--nnodes=2", "--nproc-per-node=1", "--rdzv-backend=c10d", "--rdzv-endpoint=10.99.0.1:29400"]
    train = command(tmp_path / "run", 3)
    launch = [*LAUNCH[:3], *meet, *train[len(LAUNCH) :]]
    # torchrun knows hosts by their names, which namespaces share: each gets its address, and the first that it is
    # where they meet.
    own = [*launch[:3], "--local-addr", "10.99.0.N", "--rdzv-conf", "is_host=N", *launch[3:]]
    script = 'n=${GLOO_SOCKET_IFNAME#v}; set -- "${@/10.99.0.N/10.99.0.$n}"; exec "${@/is_host=N/is_host=$((2 - n))}"'
    result = run([*IN_NAMESPACES, "bash", "-c", script, "bash", *own])
    assert result.returncode == 0, result.stderr
    content = load_checkpoint(tmp_path / "run" / "checkpoint_000003.pt")
    assert content["samples"] == 3 * 4 * 2 * 4
    assert len(content["others"]) == 1
    assert steps(tmp_path / "run") == [32, 64, 96]


def test_what_several_processes_cannot_do_is_refused(tmp_path: Path):
    result = run([*LAUNCH, "-m", "cotap.train", "base", *TINY])
    assert result.returncode != 0
    assert "several processes need one --run-dir" in result.stderr
    result = run([*LAUNCH, "-m", "cotap.train", "--run-dir", str(tmp_path)])
    assert "train stage by stage" in result.stderr
    result = run(command(tmp_path / "run", 2, "--max-restarts=1"))
    assert "TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1" in result.stderr
    assert list(tmp_path.iterdir()) == []

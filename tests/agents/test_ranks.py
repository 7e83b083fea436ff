"""Several processes learn as one: alike in all that is learned, different in what is lived through."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dummy_env
import pytest
import torch
from dummy_env import DummyEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from cotap.agents.actors import AgentLayout
from cotap.agents.checkpoint import load_checkpoint
from cotap.agents.dual_ppo import DualPPO, DualPPOConfig
from cotap.agents.ranks import Ranks
from cotap.agents.runner import DualRunner, TrainingFault, layout_of
from cotap.agents.runner_config import RunnerConfig

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
SIZE = 2
ENVS = 4
STEPS = dummy_env.TINY["steps"]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def together(task: Callable[..., Any], *args: Any, size: int = SIZE) -> list[Any]:
    """What `task(ranks, *args)` returns in each of `size` connected processes, or their exit status."""
    context = multiprocessing.get_context("fork")
    port, pipes, children = _free_port(), [], []

    def work(rank: int, pipe: Any) -> None:
        torch.set_num_threads(1)
        os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
        ranks = Ranks(rank, size, rank, size)
        with ranks.joined("cpu"):
            pipe.send(task(ranks, *args))

    for rank in range(size):
        mine, theirs = context.Pipe(duplex=False)
        children.append(context.Process(target=work, args=(rank, theirs)))
        children[-1].start()
        theirs.close()
        pipes.append(mine)
    out = []
    for pipe, child in zip(pipes, children, strict=True):
        try:
            out.append(pipe.recv())
        except EOFError:
            out.append(None)
        child.join(60)
        if out[-1] is None:
            out[-1] = child.exitcode
    return out


class SharedEnv(DummyEnv):
    """A dummy that counts the samples of all processes."""

    def __init__(self, ranks: Ranks) -> None:
        super().__init__(ENVS, seed=ranks.seed(0))
        self.size = ranks.size

    def step(self, actions: torch.Tensor) -> Any:
        self.samples += (self.size - 1) * self.num_envs
        return super().step(actions)


def runner_of(ranks: Ranks, folder: Path, iterations: int, save_interval: int = 2) -> DualRunner:
    """As the training command makes one."""
    folder.mkdir(exist_ok=True)
    torch.manual_seed(ranks.rank)  # weights must come from rank 0, whatever each began with
    cfg, ppo = RunnerConfig(iterations, save_interval), DualPPOConfig(**dummy_env.TINY)
    runner = DualRunner(SharedEnv(ranks), cfg, ppo, folder, {"stage": "base"}, ranks=ranks)
    torch.manual_seed(ranks.seed(0))
    return runner


def learned(runner: DualRunner) -> dict[str, Any]:
    weights = {k: v.tolist() for k, v in runner.alg.model.state_dict().items()}
    return {"weights": weights, "rates": runner.alg.learning_rates, "at": runner.current_learning_iteration}


def train(ranks: Ranks, folder: Path, iterations: int, resume: int = 0, stop_at: int = -1) -> tuple[Any, Any]:
    runner = runner_of(ranks, folder, iterations)
    if resume:
        runner.load(str(folder / f"checkpoint_{resume:06d}.pt"))
    if ranks.rank == 1:
        runner.env.on_step = lambda step: signal.raise_signal(signal.SIGTERM) if step == stop_at else None
    runner.learn()
    return learned(runner), runner.env.x.tolist()


def test_ranks_learn_alike_from_envs_of_their_own(tmp_path: Path):
    (one, one_envs), (other, other_envs) = together(train, tmp_path, 4)
    assert one == other
    assert one_envs != other_envs
    assert sorted(p.name for p in tmp_path.glob("*.pt")) == ["checkpoint_000002.pt", "checkpoint_000004.pt"]
    logs = EventAccumulator(str(tmp_path))
    logs.Reload()
    assert [e.step for e in logs.Scalars("lower/target")] == [SIZE * ENVS * STEPS * i for i in (1, 2, 3, 4)]
    assert len(list(tmp_path.glob("events.*"))) == 1


def test_a_stop_of_any_rank_stops_all_and_they_go_on_exactly(tmp_path: Path):
    straight = together(train, tmp_path / "a", 5)
    stopped = together(train, tmp_path / "b", 5, 0, 2 * STEPS + 1)
    assert [s[0]["at"] for s in stopped] == [3, 3]
    assert len(load_checkpoint(tmp_path / "b" / "checkpoint_000003.pt")["others"]) == SIZE - 1
    assert together(train, tmp_path / "b", 5, 3) == straight


def test_another_number_of_ranks_goes_on_with_fresh_envs(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    together(train, tmp_path, 2)
    (alone, _), = together(train, tmp_path, 3, 2, size=1)  # fmt: skip
    assert alone["at"] == 3
    assert "no simulator states" in "".join(capfd.readouterr())


def lose(ranks: Ranks, folder: Path) -> str:
    runner = runner_of(ranks, folder, 50, save_interval=100)
    if ranks.rank == 1:
        runner.env.on_step = lambda step: os.kill(os.getpid(), signal.SIGKILL) if step == 3 * STEPS + 2 else None
    try:
        runner.learn()
    except TrainingFault as error:
        return str(error)
    return ""


def test_a_lost_rank_ends_all_with_what_was_learned_saved(tmp_path: Path):
    start = time.monotonic()
    said, status = together(lose, tmp_path)
    assert time.monotonic() - start < 60.0
    assert status == -signal.SIGKILL
    assert "iteration 4 failed" in said
    saved = tmp_path / "checkpoint_000003.pt"
    assert str(saved) in said
    content = load_checkpoint(saved)
    assert (content["iteration"], content["samples"]) == (3, 3 * SIZE * ENVS * STEPS)
    straight = together(train, tmp_path / "straight", 3)[0][0]
    assert {k: v.tolist() for k, v in content["model"].items()} == straight["weights"]


TINY_LAYOUT: AgentLayout = layout_of(DummyEnv(1))


def learn_from(ranks: Ranks, data: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """One update from a rank's share of given envs: every random number but the weights is in `data`."""
    torch.manual_seed(0)
    share = data["policy"].shape[1] // ranks.size
    mine = slice(ranks.rank * share, (ranks.rank + 1) * share)
    cfg = DualPPOConfig(hidden=(8, 8), steps=3, epochs=1, mini_batches=1, precision="fp32", normalizer_stride=1)
    alg = DualPPO(TINY_LAYOUT, share, cfg, ranks=ranks)
    for t in range(cfg.steps):
        alg.act({g: data[g][t, mine] for g in ("policy", "privileged")})
        part, r = data["actions"][t, mine], alg.rollout
        r.actions[t] = part
        for g, name in enumerate(alg.names):
            own = alg.layout.action_slices[name]
            z = (part[:, own] - r.means[t][:, own]) / alg.model.log_std[name].detach().exp()
            r.log_probs[t, :, g] = (
                torch.distributions.Normal(0.0, 1.0).log_prob(z).sum(1) - alg.model.log_std[name].detach().sum()
            )
        alg.process_step(data["rewards"][t, mine], data["dones"][t, mine], torch.zeros(share))
    alg.compute_returns({g: data[g][-1, mine] for g in ("policy", "privileged")})
    alg.update()
    return {k: v.detach().clone() for k, v in alg.model.state_dict().items()} | {
        f"rate {k}": torch.tensor(v) for k, v in alg.learning_rates.items()
    }


def send(ranks: Ranks, data: dict[str, torch.Tensor]) -> dict[str, list[float]]:
    return {k: v.tolist() for k, v in learn_from(ranks, data).items()}


def test_two_ranks_of_n_envs_learn_what_one_of_2n_does():
    """Normalisers, advantages, divergence and gradients are those of all envs together."""
    rng = torch.Generator().manual_seed(1)
    n, widths = 8, TINY_LAYOUT.observation_widths
    data = {g: 3.0 * torch.randn(3, n, widths[g], generator=rng) + 2.0 for g in ("policy", "privileged")}
    data["actions"] = torch.randn(3, n, 5, generator=rng)
    # Rank 1's envs fare quite differently: local means would not do.
    data["rewards"] = torch.randn(3, n, 2, generator=rng) + torch.linspace(-3.0, 3.0, n)[:, None]
    data["dones"] = torch.rand(3, n, generator=rng) < 0.1
    alone = learn_from(Ranks(), data)
    for result in together(send, data):
        for key, value in result.items():
            torch.testing.assert_close(torch.tensor(value).float(), alone[key].float(), atol=2e-5, rtol=1e-4, msg=key)


def exchange(ranks: Ranks) -> tuple[Any, ...]:
    weight = nn.Parameter(torch.zeros(3))
    weight.grad = torch.tensor([1.0, 2.0, 3.0]) * (1 + ranks.rank)
    ranks.average_gradients([weight])
    value = torch.arange(6.0).reshape(3, 2).square() + 10.0 * ranks.rank
    said = ranks.gather(lambda: {"rank": ranks.rank, "x": torch.zeros(ranks.rank * 5)})
    return (
        weight.grad.tolist(), ranks.any(ranks.rank == 1), ranks.any(False), ranks.mean_of({"a": float(ranks.rank)}),
        ranks.standardize(value).tolist(), [{k: str(v) for k, v in t.items()} for t in said],
    )  # fmt: skip


def test_what_ranks_tell_each_other():
    results = together(exchange, size=3)
    rows = torch.arange(6.0).reshape(3, 2).square()
    everything = torch.cat([rows, rows + 10.0, rows + 20.0])
    expected = (everything - everything.mean(0)) / everything.std(0)
    for rank, (gradient, some, none, mean, standard, _) in enumerate(results):
        assert gradient == [2.0, 4.0, 6.0]
        assert (some, none, mean) == (True, False, {"a": 1.0})
        torch.testing.assert_close(torch.tensor(standard), expected[3 * rank : 3 * rank + 3])
    said = [r[-1] for r in results]
    assert said[1:] == [[], []]
    assert said[0] == [{"rank": str(r), "x": str(torch.zeros(5 * r))} for r in (1, 2)]


def test_a_process_by_itself_tells_nobody_anything():
    ranks = Ranks.from_environment()
    assert (ranks.rank, ranks.size, ranks.leads, ranks.seed(7), ranks.threads(0)) == (0, 1, True, 7, 0)
    assert ranks.gather(lambda: 1 / 0) == []
    assert ranks.device("cuda") == "cuda"


def test_each_rank_has_its_own_seed_and_share_of_the_host(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    ranks = [Ranks(r, 4, r, 4) for r in range(4)]
    assert len({r.seed(0) for r in ranks} | {r.seed(1) for r in ranks}) == 8
    assert [r.threads(0) for r in ranks] == [2] * 4
    assert ranks[3].threads(1) == 1
    assert [r.device("cuda") for r in ranks] == [f"cuda:{i}" for i in range(4)]
    assert ranks[3].device("cpu") == "cpu"


@pytest.mark.parametrize(("name", "value"), [("RANK", "one"), ("RANK", "3"), ("WORLD_SIZE", "0"), ("LOCAL_RANK", "-1")])
def test_an_environment_that_torchrun_would_not_make_is_refused(monkeypatch: pytest.MonkeyPatch, name: str, value: str):
    monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match="RANK, WORLD_SIZE"):
        Ranks.from_environment()

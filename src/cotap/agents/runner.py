"""The training loop: collect, learn, log, save; stops cleanly and goes on exactly."""

from __future__ import annotations

import copy
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from rsl_rl.env import VecEnv
from tqdm import tqdm

from cotap.agents.actors import AgentLayout, Observations, as_dict
from cotap.agents.checkpoint import (
    MALFORMED,
    PARTS,
    CheckpointError,
    load_checkpoint,
    remove_leftovers,
    require_parts,
    save_checkpoint,
    write_json,
)
from cotap.agents.distillation import Guide
from cotap.agents.dual_ppo import DualPPO, DualPPOConfig
from cotap.agents.ranks import Ranks
from cotap.agents.refit import take_over
from cotap.agents.run_log import RunLog, Unfailing, say
from cotap.agents.runner_config import RunnerConfig
from cotap.checks import reason_of

CHECKPOINT_PATTERN = "checkpoint_*.pt"


def checkpoints_of(run_dir: Path) -> list[Path]:
    """A run's checkpoints, oldest first; from a million iterations on, their names are longer."""
    return sorted(run_dir.glob(CHECKPOINT_PATTERN), key=_iteration_key)


def newest_checkpoint(run_dir: Path) -> Path | None:
    """A run's newest checkpoint; None if it has none."""
    return max(run_dir.glob(CHECKPOINT_PATTERN), key=_iteration_key, default=None)


def _iteration_key(path: Path) -> tuple[int, str]:
    """Orders the checkpoints of one run by iteration."""
    return len(path.name), path.name


MODEL = ("collision", "unevenness_m", "fixed_base")
"""Fields of an environment's config that make a model of other shapes or joints."""


def layout_of(env: VecEnv, symmetric: bool = True) -> AgentLayout:
    """Sizes, action slices, observation groups and mirror images (if it has any), asked of the environment.

    Raises:
        ValueError: its groups of rewards are not those of its actions, in one order.
    """
    widths = {group: value.shape[-1] for group, value in env.get_observations().items()}
    groups, slices = env.obs_groups, env.action_slices  # pyright: ignore[reportAttributeAccessIssue]
    rewarded = tuple(getattr(env, "reward_groups", slices))
    if rewarded != tuple(slices):
        raise ValueError(
            f"reward groups {rewarded} must name the agents in the order of their actions, {tuple(slices)}"
        )
    return AgentLayout(widths, groups, slices, getattr(env, "symmetry", None) if symmetric else None)


def check_run_dir(run_dir: Path, resumed: Path | None = None) -> None:
    """Refuse a directory that holds another run's checkpoints, or newer ones than the one that is resumed, or that
    cannot be written to.

    Raises:
        ValueError: the directory is used; the message says what to do.
        OSError: it cannot be created or written to.
    """
    if run_dir.exists() and not run_dir.is_dir():
        raise ValueError(f"run directory {str(run_dir)!r} is a file")
    newest = newest_checkpoint(run_dir)
    own = resumed is not None and resumed.resolve().parent == run_dir.resolve()
    if newest and not (own and resumed and _iteration_key(newest) <= _iteration_key(resumed)):
        what = "has a newer checkpoint than that" if own else "already holds a run"
        raise ValueError(
            f"run directory {str(run_dir)!r} {what}; go on with --resume {newest}, or choose another --run-dir"
        )
    run_dir.mkdir(parents=True, exist_ok=True)
    probe = run_dir / ".writable"
    probe.touch()
    probe.unlink()


@contextmanager
def sole_writer(run_dir: Path) -> Iterator[None]:
    """Keep other trainings out of an existing `run_dir`; the system lets go of it when the process ends, however.

    Raises:
        ValueError: another training writes to it, which may have saved nothing yet.
    """
    lock = FileLock(run_dir / ".lock")
    try:
        lock.acquire(timeout=0.0)
    except Timeout:
        raise ValueError(
            f"another training writes to run directory {str(run_dir)!r}: stop that, or choose another --run-dir"
        ) from None
    except NotImplementedError:  # file systems without locks
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):  # where files that are open cannot be removed
            Path(lock.lock_file).unlink()
        lock.release()


class TrainingFault(RuntimeError):
    """An iteration that could not be finished; the message says why, and what to go on from."""


class DualRunner:
    """Trains two agents in an rsl_rl `VecEnv`, and saves all that the run depends on. The environment needs what
    `HumanoidEnv` has beside: `obs_groups` of actors and critics, `action_slices` and `reward_groups` of the agents,
    `layout()`, `samples`, `curriculum`, `state_dict()` and `load_state_dict()`, and `group_rewards`, `time_outs` and
    `log` among its extras.

    Args:
        env: The environment.
        cfg: How long, how often.
        ppo: Hyperparameters.
        run_dir: Where checkpoints and TensorBoard logs go.
        config: The resolved config as plain data, saved beside the run and in every checkpoint.
        device: Where the networks live.
        guide: A frozen policy to stay close to at first.
        ranks: The processes that learn as one. All call every method alike; rank 0 writes what is written.
    """

    def __init__(
        self, env: VecEnv, cfg: RunnerConfig, ppo: DualPPOConfig, run_dir: Path, config: dict[str, Any],
        device: str = "cpu", guide: Guide | None = None, ranks: Ranks | None = None,
    ) -> None:  # fmt: skip
        cfg.check()
        self.env, self.runner_cfg, self.run_dir, self.config, self.device = env, cfg, run_dir, config, device
        self.ranks = ranks = ranks or Ranks()
        layout = layout_of(env, ppo.symmetric)
        self.alg: DualPPO = DualPPO(layout, env.num_envs, ppo, device, guide, ranks)  # pyright: ignore
        self.current_learning_iteration = 0
        self.wall_seconds = 0.0
        self.failed_saves = 0
        self._saved = -1
        self._save_failed = self._stop = False
        self._kept: dict[str, Any] = {}

    def learn(self) -> None:
        """Train up to `runner.iterations` in all, saving at intervals and at the end.

        A save that fails (a full disk) is reported and tried again after every iteration; envs that diverge and
        steps that are skipped are reported as they are counted.

        Raises:
            TrainingFault: an iteration failed; the message says what to go on from.
            OSError: the last save failed, or logs cannot be written from the start.
        """
        env, alg, ranks = self.env, self.alg, self.ranks
        self._stop = False
        first, last = self.current_learning_iteration, self.runner_cfg.iterations
        if ranks.leads:
            remove_leftovers(self.run_dir)  # also of a run that was killed after its last save
        if first >= last:
            say(f"at iteration {first} of {last}: nothing to do; --iterations says how many in all")
            return
        if not env.episode_length_buf.any():  # or else all envs would end at once
            env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
        ranks.same_everywhere(alg.model)
        run_log = None
        if ranks.leads:
            write_json(self.run_dir / "config.json", self.config)
            run_log = RunLog(self.run_dir, env.samples)  # pyright: ignore[reportAttributeAccessIssue]
            precision = str(alg.dtype).removeprefix("torch.")
            processes = f"{ranks.size} x " if ranks.size > 1 else ""
            envs = f"{processes}{env.num_envs} envs on {env.device}"
            say(f"{envs}, networks {alg.cfg.hidden} in {precision} on {self.device}, {self.run_dir}")
        obs = self._observations()
        self._saved = -1
        bar = tqdm(
            total=last, initial=first, unit="it", dynamic_ncols=True, disable=not ranks.leads,
            file=Unfailing(sys.stderr),
        )  # fmt: skip
        with self._signals(), bar:
            for it in range(first, last):
                try:
                    obs, scalars = self._iterate(obs)
                    stopping = ranks.any(self._stop)
                    self.current_learning_iteration = it + 1
                    if ranks.size > 1:
                        self._kept = copy.deepcopy(self._content(envs=False))
                    if run_log:
                        self._log(run_log, scalars)
                    if (it + 1) % self.runner_cfg.save_interval == 0 or self._save_failed:
                        self._save_or_report()
                except Exception as error:  # whatever it was, a long run must not end without saying how to go on
                    raise TrainingFault(self._fault(it + 1, error)) from error
                bar.update()
                bar.set_postfix_str(_summary(scalars))
                if stopping:
                    say("stopping: saving a checkpoint")
                    break
            if self._saved != self.current_learning_iteration:
                self.save()
        if run_log:
            run_log.close()

    def _log(self, run_log: RunLog, scalars: dict[str, float]) -> None:
        scalars |= {"faults/failed_saves": self.failed_saves, "faults/lost_log_records": run_log.lost}
        if reason := run_log.write(scalars, self.env.samples):  # pyright: ignore[reportAttributeAccessIssue]
            where = f"iteration {self.current_learning_iteration}"
            say(f"{where}: its log record could not be written ({reason})")

    def _iterate(self, obs: Observations) -> tuple[Observations, dict[str, float]]:
        """Collect a rollout and learn from it. Returns the observations after it, and what to log."""
        env, alg = self.env, self.alg
        start = time.perf_counter()
        diverged = getattr(env, "num_diverged", 0)
        log: dict[str, torch.Tensor] = {}
        for _ in range(alg.cfg.steps):
            _, _, dones, extras = env.step(alg.act(obs).to(env.device))
            obs = self._observations()
            alg.process_step(
                extras["group_rewards"].to(self.device), dones.to(self.device), extras["time_outs"].to(self.device)
            )
            for key, value in extras["log"].items():
                log[key] = log[key] + value if key in log else value
        alg.compute_returns(obs)
        collected = time.perf_counter()
        scalars = {key.lstrip("/"): float(value) / alg.cfg.steps for key, value in log.items()}
        learned = alg.update()
        scalars |= {f"agents/{key}": value for key, value in learned.items()}
        end = time.perf_counter()
        self.wall_seconds += end - start
        scalars |= {
            "throughput/steps_per_s": self.ranks.size * alg.cfg.steps * env.num_envs / (end - start),
            "throughput/collect_s": collected - start,
            "throughput/learn_s": end - collected,
        }
        self._report(getattr(env, "num_diverged", 0) - diverged, learned)
        return obs, self.ranks.mean_of(scalars)

    def _report(self, diverged: int, learned: dict[str, float]) -> None:
        """Name in the log what went wrong in an iteration and was contained."""
        where = f"iteration {self.current_learning_iteration + 1}"
        if diverged:
            say(f"{where}: envs diverged {diverged} times; each was ended, counted and started again")
        for name in self.alg.names:
            if skipped := learned[f"{name}/skipped"]:
                say(f"{where}: {skipped:.0f} steps of agent {name!r} skipped, their gradient was not finite")

    def _fault(self, iteration: int, error: Exception) -> str:
        """Why an iteration failed and what to go on from. With other ranks, any of which may be the one that is lost,
        every rank that still runs sees to it that what the last whole iteration learned is saved."""
        if self._kept:
            target = self.run_dir / f"checkpoint_{self._kept['iteration']:06d}.pt"
            try:
                if not target.exists():
                    save_checkpoint(target, self._kept)
            except OSError as failed:
                say(f"what was learned last could not be saved: {failed}")
        newest = newest_checkpoint(self.run_dir)
        way_on = f"go on with --resume {newest}" if newest else "there is no checkpoint yet to go on from"
        what = f"{type(error).__name__}: {error}"
        return f"iteration {iteration} failed ({what}); {way_on}"

    def _save_or_report(self) -> None:
        """Save; if it fails, count it and say so: the run goes on, and every iteration tries again."""
        failed = False
        try:
            self.save()
        except OSError as error:
            failed = True
            self.failed_saves += 1
            say(f"iteration {self.current_learning_iteration}: {error}; trying again after the next iteration")
        self._save_failed = self.ranks.any(failed)
        if self._save_failed:
            self._saved = -1  # on every rank: those that have nothing to write must try along

    def save(self, path: str = "") -> None:
        """Save everything to go on exactly; the previous checkpoint then sheds its simulator states."""
        if self.alg.guide:
            self.alg.guide.verify()
        target = Path(path) if path else self.run_dir / f"checkpoint_{self.current_learning_iteration:06d}.pt"
        others = self.ranks.gather(self._own_state)
        if self.ranks.leads:
            save_checkpoint(target, self._content() | {"others": others})
            older = [path for path in checkpoints_of(self.run_dir) if _iteration_key(path) < _iteration_key(target)]
            if older:
                _shed_simulator_states(older[-1])
        self._saved = self.current_learning_iteration

    def load(self, path: str) -> None:
        """Load a checkpoint of a run. Simulator states that it lacks, or that are of another number of envs or ranks,
        or of another model (`MODEL`), start afresh.

        Raises:
            CheckpointError: the file cannot be used, or was trained for another robot or observation layout.
        """
        content = load_checkpoint(path, self.device)
        require_parts(path, content, PARTS.keys() - {"agents", "kind"})
        env: Any = self.env
        take_over(path, content, self.alg.model, env)
        try:
            self.alg.load_state_dict(content["learner"])
            self.current_learning_iteration = content["iteration"]
            self.wall_seconds = float(content["wall_seconds"])
            mine = self._share_of(content)
            self._take_random_state(mine)
            if self._are_ours(mine["env"], content["config"]):
                env.load_state_dict(mine["env"])
            else:
                env.samples = content["samples"]
                if "curriculum" in content:
                    env.curriculum.load_state_dict(content["curriculum"])
                say(f"{path}: no simulator states for this run; starting those afresh")
        except MALFORMED as error:
            raise CheckpointError(
                f"checkpoint {path!r} has states that do not fit this run: {reason_of(error)} (where only the envs' "
                "configuration is another, another --num-envs starts them afresh)"
            ) from error

    def _share_of(self, content: dict[str, Any]) -> dict[str, Any]:
        """This rank's envs and random numbers in a checkpoint; none, if it is of another number of ranks."""
        states = [content, *content.get("others", [])]
        same_number = len(states) == self.ranks.size
        return states[self.ranks.rank] if same_number else {"env": {}}

    def _are_ours(self, envs: dict[str, Any], config: dict[str, Any]) -> bool:
        """Whether these envs of a run with that config are as many as ours, and of the same model."""
        if not envs or envs["episode_length"].shape[0] != self.env.num_envs:
            return False
        theirs, own = (c.get("training", {}).get("env", {}) for c in (config, self.config))
        return all(theirs.get(name) == own.get(name) for name in MODEL)

    def _own_state(self, envs: bool = True) -> dict[str, Any]:
        """What is this rank's own."""
        env: Any = self.env
        saved = env.state_dict() if envs and self.runner_cfg.save_envs else {}
        # Exploration and mini-batches are drawn where the networks are.
        drawn = {"device_rng": torch.cuda.get_rng_state(self.device)} if self._on_gpu else {}
        return {"env": saved, "rng": torch.get_rng_state(), **drawn}

    @property
    def _kind(self) -> str:
        """Which stage this is."""
        return self.config.get("stage", "base")

    def _take_random_state(self, mine: dict[str, Any]) -> None:
        """Draw on as the run did that saved `mine`; what it did not save, or drew elsewhere, begins anew."""
        if "rng" in mine:
            torch.set_rng_state(mine["rng"].cpu())
        if self._on_gpu and "device_rng" in mine:
            torch.cuda.set_rng_state(mine["device_rng"].cpu(), self.device)

    @property
    def _on_gpu(self) -> bool:
        return torch.device(self.device).type == "cuda"

    def _content(self, envs: bool = True) -> dict[str, Any]:
        env: Any = self.env
        return {
            "kind": self._kind,
            "layout": json.loads(json.dumps(env.layout())),
            "agents": self.alg.layout.to_plain(),
            "config": self.config,
            "model": self.alg.model.state_dict(),
            "learner": self.alg.state_dict(),
            **self._own_state(envs),
            **({"curriculum": env.curriculum.state_dict()} if hasattr(env, "curriculum") else {}),
            "iteration": self.current_learning_iteration,
            "samples": env.samples,
            "wall_seconds": self.wall_seconds,
        }

    def _observations(self) -> dict[str, torch.Tensor]:
        return as_dict(self.env.get_observations(), self.device)

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Ctrl-C and SIGTERM end the run after the present iteration, with a checkpoint; a second one at once."""

        def stop(_number: int, _frame: Any) -> None:
            if self._stop:
                raise KeyboardInterrupt
            self._stop = True

        handlers: dict[int, Callable[..., Any] | int | None] = {}
        try:
            for number in (signal.SIGINT, signal.SIGTERM):
                handlers[number] = signal.signal(number, stop)
        except ValueError:  # not the main thread: whoever owns it handles signals
            pass
        try:
            yield
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _shed_simulator_states(path: Path) -> None:
    """Only a run's newest checkpoint keeps them; a file that is no checkpoint, or cannot be replaced, is left."""
    try:
        content = load_checkpoint(path)
        if content.get("env"):
            save_checkpoint(path, content | {"env": {}, "others": []})
    except CheckpointError:
        return
    except OSError as error:  # a disk that has just become full
        say(f"{path} keeps its simulator states: {error}")


def _summary(s: dict[str, float]) -> str:
    shown = {
        "steps/s": s["throughput/steps_per_s"],
        "err": s.get("command/error_velocity"),
        "slope": s.get("command/slope_x"),
        "falls/s": s.get("episode/falls_per_s"),
    }
    return " ".join(f"{k} {v:.3g}" for k, v in shown.items() if v is not None)

"""Merge two policies of one layout into one: a student that does as the first does while nothing pulls at its hands,
and as the second does while something does (policy distillation, Rusu et al. 2016, on states that the student itself
comes to, as in DAgger, Ross et al. 2011). The result is a checkpoint without optimiser state, beside it a JSON that
says what it was made of."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from average_checkpoints import EMPTY, origin
from tqdm import trange

from cotap.agents.actors import DualActorCritic, Observations, as_dict
from cotap.agents.checkpoint import (
    PARTS,
    CheckpointError,
    load_checkpoint,
    require_layout,
    require_parts,
    save_checkpoint,
    write_json,
)
from cotap.agents.precision import resolve_precision
from cotap.checks import require_positive_int, require_range, require_seed
from cotap.envs import H1Env
from cotap.evaluation.policy import find_checkpoint, load_policy
from cotap.files import require_output
from cotap.train import provenance


@dataclass
class Merging:
    """How the student is taught."""

    num_envs: int = 2048
    """Number of worlds."""
    iterations: int = 100
    """Rollouts, each followed by `epochs` passes over it."""
    steps: int = 24
    """Control steps of a rollout."""
    epochs: int = 2
    """Passes over a rollout."""
    mini_batches: int = 16
    """Parts that each pass is cut into."""
    learning_rate: float = 5e-4
    """Of Adam, falling to zero along half a cosine."""
    loaded_share: float = 0.5
    """Share of the episodes in which hands are loaded, as the second policy was trained with."""
    noise: float = 0.5
    """Deviation of the student's actions while it is taught, in units of the second policy's in training."""
    seed: int = 0
    """Seed of worlds, noise and batches."""
    threads: int = 2
    """Threads of physics and networks."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("num_envs", "iterations", "steps", "epochs", "mini_batches", "threads"):
            require_positive_int(name, getattr(self, name))
        require_range("learning_rate", self.learning_rate, 1e-8, 1.0)
        require_range("loaded_share", self.loaded_share, 0.0, 1.0)
        require_range("noise", self.noise, 0.0, 10.0)
        require_seed("seed", self.seed)


class Lesson:
    """Two teachers, and what a student is to answer.

    Args:
        calm: Does what is right while nothing pulls at the hands.
        loaded: Does what is right while something does.
    """

    def __init__(self, calm: DualActorCritic, loaded: DualActorCritic) -> None:
        self._calm, self._loaded = calm, loaded
        self.names = tuple(loaded.layout.action_slices)
        self.std = torch.cat([loaded.log_std[name].detach().exp() for name in self.names])
        """(A,) deviation of the second teacher's actions."""

    @torch.no_grad()
    def answers(self, observations: Observations, loaded: torch.Tensor) -> torch.Tensor:
        """Actions and values (N, A + G) of the teacher that knows best.

        Args:
            observations: Raw.
            loaded: (N,) bool, where the second does.
        """
        return torch.where(loaded.unsqueeze(1), answer(self._loaded, observations), answer(self._calm, observations))

    def loss(self, told: torch.Tensor, answers: torch.Tensor) -> torch.Tensor:
        """Mean square of how far actions are off, in deviations, and of how far values are, in their own spread.

        Args:
            told: (N, A + G) of the student.
            answers: (N, A + G) of `answers`.
        """
        actions = len(self.std)
        spread = answers[:, actions:].std(0).clamp_min(1e-3)
        off = (told - answers) / torch.cat((self.std, spread))
        return off[:, :actions].square().mean() + off[:, actions:].square().mean()


def answer(model: DualActorCritic, observations: Observations) -> torch.Tensor:
    """Deterministic actions and values (N, A + G) of raw observations."""
    normalized = model.normalize(observations)
    critic_in = model.read("critic", normalized)
    values = [model.critics[name](critic_in) for name in model.layout.action_slices]
    return torch.cat([model.mean_action(normalized), *values], -1)


def teach(student: DualActorCritic, lesson: Lesson, env: H1Env, cfg: Merging) -> list[float]:
    """Let the student act in `env`, and learn what its teachers would have done there. Its normalisers stay as they
    are. Returns the mean loss of each iteration."""
    generator = torch.Generator().manual_seed(cfg.seed)
    dtype = resolve_precision("auto", "cpu")
    weights = [*student.actors.parameters(), *student.critics.parameters()]
    optimizer = torch.optim.Adam(weights, lr=cfg.learning_rate, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, cfg.iterations)
    observations = as_dict(env.reset())
    losses = []
    progress = trange(cfg.iterations, desc="merging")
    for _ in progress:
        seen, right, falls = [], [], 0
        for _ in range(cfg.steps):
            loaded = env.hand_force_w.abs().amax((1, 2)) > 0.0
            seen.append(observations)
            right.append(lesson.answers(observations, loaded))
            with torch.no_grad():
                action = student(observations)
            action = action + cfg.noise * lesson.std * torch.randn(action.shape, generator=generator)
            following, _, _, extras = env.step(action)
            observations = as_dict(following)
            falls += int(extras["falls"].sum())
        inputs = {group: torch.cat([row[group] for row in seen]) for group in seen[0]}
        answers = torch.cat(right)
        total = torch.zeros(())
        for _ in range(cfg.epochs):
            for ids in torch.randperm(len(answers), generator=generator).chunk(cfg.mini_batches):
                with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
                    told = answer(student, {group: value[ids] for group, value in inputs.items()})
                loss = lesson.loss(told.float(), answers[ids])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                total += loss.detach() * len(ids)
        schedule.step()
        losses.append(float(total) / (cfg.epochs * len(answers)))
        progress.set_postfix_str(f"off {losses[-1]:.4f} falls/s {falls / (len(answers) * env.dt):.4f}")
    return losses


def run(calm: Path, loaded: Path, start: Path, output: Path, cfg: Merging, command: str) -> None:
    """Merge and save.

    Raises:
        ValueError: an option is out of its range, a file is no checkpoint, or the checkpoints do not fit each other.
        OSError: the result cannot be written.
    """
    cfg.check()
    require_output("--output", output, (".pt",))
    paths = {"calm": calm, "loaded": loaded, "start": start}
    contents = {role: load_checkpoint(path) for role, path in paths.items()}
    for role, path in paths.items():
        require_parts(path, contents[role], PARTS)
        require_layout(path, contents[role]["layout"], contents["loaded"]["layout"])
        if contents[role]["agents"] != contents["loaded"]["agents"]:
            raise CheckpointError(f"checkpoint {str(path)!r} has other agents than {str(loaded)!r}")
    began = time.monotonic()
    torch.set_num_threads(cfg.threads)
    policies = {role: load_policy(path) for role, path in paths.items()}
    first = contents["loaded"]
    env_config = policies["loaded"].env_config
    env_config.num_envs, env_config.seed, env_config.num_threads = cfg.num_envs, cfg.seed, cfg.threads
    env_config.hand_forces.enabled, env_config.hand_forces.episode_share = True, cfg.loaded_share
    env = H1Env(env_config)
    if "progress" in first:
        env.load_progress(first["progress"])
    lesson = Lesson(policies["calm"].model, policies["loaded"].model)
    student = policies["start"].model
    teach(student, lesson, env, cfg)
    share = {"calm": 1.0 - cfg.loaded_share, "loaded": cfg.loaded_share, "start": 0.0}
    merged = {
        "policies": [{"role": role} | origin(path, share[role], contents[role]) for role, path in paths.items()],
        "options": asdict(cfg),
    }
    config = first["config"] | provenance(command, "auto") | {"merged": merged}
    config.pop("averaged", None)  # told of the second policy, under its name
    # How wide one explores who goes on from it: as the second policy did.
    deviations = {name: value for name, value in first["model"].items() if name.startswith("log_std")}
    samples = first["samples"] + cfg.num_envs * cfg.steps * cfg.iterations
    seconds = first["wall_seconds"] + time.monotonic() - began
    model = student.state_dict() | deviations
    save_checkpoint(
        output, first | EMPTY | {"model": model, "config": config, "samples": samples, "wall_seconds": seconds}
    )
    write_json(output.with_suffix(".json"), {key: config[key] for key in ("command", "commit", "merged")})


def main() -> int:
    """Parse and merge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calm", type=find_checkpoint, required=True, help="whom to follow while nothing pulls")
    parser.add_argument("--loaded", type=find_checkpoint, required=True, help="whom to follow while something does")
    parser.add_argument(
        "--start", type=find_checkpoint, help="what the student begins as, an average of the two say; else --loaded"
    )
    parser.add_argument("--output", type=Path, required=True, help="checkpoint to write; FILE.json goes beside it")
    for name, value in asdict(Merging()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    options = vars(parser.parse_args())
    command = shlex.join(["python", "scripts/merge_policies.py", *sys.argv[1:]])
    calm, loaded, start, output = (options.pop(name) for name in ("calm", "loaded", "start", "output"))
    try:
        run(calm, loaded, start or loaded, output, Merging(**options), command)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Injects faults into small trainings and shows what survives: signals at random moments, disks that fill or turn
read-only, clocks that jump, envs that diverge, steps that raise. Prints a table; POSIX only.

Every training is a forked process that runs the training command itself. One run that nothing happens to is what all
others must end equal to, bit for bit.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cotap import train
from cotap.agents.checkpoint import load_checkpoint, write_json
from cotap.agents.dual_ppo import DualPPO
from cotap.agents.runner import CHECKPOINT_PATTERN, newest_checkpoint
from cotap.envs import HumanoidEnv
from cotap.envs.external_forces import ExternalForces
from cotap.files import require_output

ITERATIONS, INTERVAL, STEPS, ENVS, SICK = 12, 2, 4, 16, 3
"""Of every training: iterations, iterations between saves, steps per iteration, envs, and the env that is hurt."""
OPTIONS = [
    "base", "--num-envs", ENVS, "--iterations", ITERATIONS, "--threads", 1, "--ppo.hidden", 8, 8, "--ppo.steps",
    STEPS, "--ppo.precision", "fp32", "--runner.save-interval", INTERVAL,
]  # fmt: skip
Prepare = Callable[[], None]


@dataclass
class Row:
    """One line of the table."""

    fault: str
    injected: int
    survived: int
    most_lost: int | None
    """Iterations, in the worst case; None where it cannot be said."""
    outcome: str


class Run:
    """A training in a process of its own, watched from outside. One that has a checkpoint goes on from it; one that
    was ended before its first begins again, in the folder that it left."""

    def __init__(self, folder: Path, prepare: Prepare | None = None, log: Path | None = None) -> None:
        self.folder = folder
        self.start = newest_iteration(folder)
        resume = ["--resume", newest_checkpoint(folder)] if self.start else ["--run-dir", folder]
        read, write = os.pipe()
        self.log = log or Path(f"{folder}.log")
        self._status: int | None = None
        self.born = time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(read)
            _train([str(a) for a in (*OPTIONS, *resume)], self.log, write, prepare)
        os.close(write)
        self._beats = read

    def wait(self) -> int:
        """Exit status; minus the signal's number for a process that was killed."""
        if self._status is None:
            self._status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self._status

    def alive(self) -> bool:
        """Whether the process still runs; it is not reaped."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def finished_iterations(self) -> int:
        """Iterations finished in all, once the process is gone."""
        count = 0
        while part := os.read(self._beats, 4096):
            count += len(part)
        os.close(self._beats)
        return self.start + count


def _train(args: list[str], log: Path, beats: int, prepare: Prepare | None) -> None:
    """In the child: train, with a byte into `beats` for every iteration finished, and never return."""
    status = 70
    try:
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        update = DualPPO.update

        def counted(alg: DualPPO) -> dict[str, float]:
            result = update(alg)
            os.write(beats, b".")
            return result

        DualPPO.update = counted
        if prepare:
            prepare()
        status = train.main(args)
    except Exception:  # a forked child leaves by os._exit, which prints nothing: whatever it was must be in its log
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(status)


def newest_iteration(folder: Path) -> int:
    """How far a run can be gone on from."""
    path = newest_checkpoint(folder)
    return load_checkpoint(path)["iteration"] if path else 0


def equal(a: Any, b: Any) -> bool:
    """Whether nested data are equal, tensors bit for bit."""
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(equal, a, b))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else bool(a == b)


def same_end(folder: Path, reference: Path) -> bool:
    """Whether a run ended as the one that nothing happened to: networks, optimisers, envs, random numbers."""
    parts = ("model", "learner", "env", "iteration", "samples", "rng")
    one, other = (load_checkpoint(f / f"checkpoint_{ITERATIONS:06d}.pt") for f in (folder, reference))
    return all(equal(one[p], other[p]) for p in parts)


def curve(folder: Path, tag: str) -> list[tuple[int, float]]:
    """(samples, value) of a curve, as TensorBoard reads it."""
    events = EventAccumulator(str(folder))
    events.Reload()
    return [(e.step, e.value) for e in events.Scalars(tag)]


def one_curve(folder: Path) -> bool:
    """Whether the log has every iteration once, in order."""
    steps = [step for step, _ in curve(folder, "throughput/steps_per_s")]
    return steps == [STEPS * ENVS * (i + 1) for i in range(ITERATIONS)]


def kill_runs(work: Path, reference: Path, kills: int, pace: tuple[float, float], rng: random.Random) -> list[Row]:
    """Kill trainings `kills` times, a third of them during a save, and go on with each from what is left."""
    kinds = anywhere, saving, renaming = ("at any moment", "during a save", "before a rename")
    rows = {kind: Row(f"SIGKILL {kind}", 0, 0, 0, "") for kind in kinds}
    torn, ends, folder = 0, 0, work / "killed0"
    while sum(r.injected for r in rows.values()) < kills:
        kind = rng.choice([anywhere] * 4 + [saving, renaming])
        run = Run(folder, _killed_at_rename(folder, rng.randint(1, 5)) if kind == renaming else None)
        if kind == anywhere:
            _signal_after(run, rng.uniform(0.0, pace[0] + 5.0 * pace[1]))
        elif kind == saving:
            _signal_while_saving(run, rng)
        if run.wait() == -signal.SIGKILL:
            row = rows[kind]
            row.injected += 1
            torn += any(folder.glob(".checkpoint_*"))
            for path in folder.glob(CHECKPOINT_PATTERN):
                load_checkpoint(path)  # raises if it is not whole
            lost = run.finished_iterations() - newest_iteration(folder)
            row.most_lost = max(row.most_lost or 0, lost)
            row.survived += lost <= INTERVAL
        else:
            _require_good_end(run, reference)
            ends += 1
            folder = work / f"killed{ends}"
    _require_good_end(Run(folder), reference)
    ends += 1
    rows[saving].outcome = f"{torn} of all kills left an unfinished file, none under a checkpoint's name"
    rows[
        anywhere
    ].outcome = f"{ends} runs gone on with to their end, bit for bit the undisturbed one; logs without gaps"
    return list(rows.values())


def terminate_runs(work: Path, reference: Path, count: int, pace: tuple[float, float], rng: random.Random) -> list[Row]:
    """Ask trainings to end, while they start and while they save, and go on with each from what is left."""
    begin, saving = Row("SIGTERM during the start", 0, 0, 0, ""), Row("SIGTERM during a save", 0, 0, 0, "")
    asked = 0
    for k in range(count):
        row = (begin, saving)[k % 2]
        folder = work / f"terminated{k}"
        run = Run(folder)
        if row is begin:
            _signal_after(run, rng.uniform(0.0, pace[0]), signal.SIGTERM)
        else:
            _signal_while_saving(run, rng, signal.SIGTERM)
        status = run.wait()
        lost = run.finished_iterations() - newest_iteration(folder)
        # Before it trains it ends at once, and afterwards with a checkpoint of all that it has learned.
        as_asked = status == -signal.SIGTERM or (status == 0 and lost == 0)
        asked += status == 0
        row.injected += 1
        row.most_lost = max(row.most_lost or 0, lost)
        row.survived += as_asked and Run(folder).wait() == 0 and _good_end(folder, reference)
    begin.outcome = saving.outcome = f"{asked} of {count} ended with a checkpoint, the others at once; as if unasked"
    return [begin, saving]


def _ends(folder: Path, reference: Path) -> dict[str, bool]:
    """What must hold of a run that was disturbed, once it has been gone on with to its end."""
    same, gapless = same_end(folder, reference), one_curve(folder)
    return {"bit for bit": same, "log without gaps": gapless, "nothing left over": not list(folder.glob(".*"))}


def _require_good_end(run: Run, reference: Path) -> None:
    if run.wait() or not _good_end(run.folder, reference):
        shown = f"{_ends(run.folder, reference)}\n{run.log.read_text()}"
        raise SystemExit(f"a run that was killed and gone on with did not end as it should: {shown}")


def _good_end(folder: Path, reference: Path) -> bool:
    return all(_ends(folder, reference).values())


def _signal_after(run: Run, seconds: float, number: signal.Signals = signal.SIGKILL) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end and run.alive():
        time.sleep(1e-3)
    os.kill(run.pid, number)


def _signal_while_saving(run: Run, rng: random.Random, number: signal.Signals = signal.SIGKILL) -> None:
    """As soon as an unfinished checkpoint shows, or a few milliseconds later."""
    while run.alive() and not any(run.folder.glob(".checkpoint_*")):
        time.sleep(2e-4)
    time.sleep(rng.uniform(0.0, 4e-3))
    os.kill(run.pid, number)


def _killed_at_rename(folder: Path, number: int) -> Prepare:
    """Ends the process just before it renames a finished file of the run for the `number`-th time."""
    count = 0

    def hook(event: str, args: tuple[Any, ...]) -> None:
        nonlocal count
        if event == "os.rename" and str(folder) in str(args[1]):
            count += 1
            if count == number:
                os.kill(os.getpid(), signal.SIGKILL)

    return lambda: sys.addaudithook(hook)


def at_step(number: int, act: Callable[[HumanoidEnv], None]) -> Prepare:
    """Do something to the environment before one of its steps."""

    def prepare() -> None:
        step, count = HumanoidEnv.step, 0

        def hurt(env: HumanoidEnv, actions: torch.Tensor) -> Any:
            nonlocal count
            count += 1
            if count == number:
                act(env)
            return step(env, actions)

        HumanoidEnv.step = hurt

    return prepare


def diverge(work: Path) -> list[Row]:
    """A position that is not a number, and a force beyond all measure, in one env."""

    def nan(env: HumanoidEnv) -> None:
        env.sim.qpos[SICK, 10] = math.nan

    def push() -> None:
        apply, count = ExternalForces.apply, 0

        def pushed(forces: ExternalForces, xfrc: torch.Tensor, *args: Any) -> None:
            nonlocal count
            apply(forces, xfrc, *args)
            count += 1
            if count == 9:
                xfrc[SICK, 1, 2] = 1e12

        ExternalForces.apply = pushed

    rows = []
    for name, prepare in (("NaN in an env's state", at_step(9, nan)), ("force of 1e12 N on an env", push)):
        folder = work / f"diverged{len(rows)}"
        run = Run(folder, prepare)
        ok = run.wait() == 0 and "envs diverged 1 times" in run.log.read_text()
        ok = (
            ok
            and curve(folder, "episode/diverged")[-1][1] == 1.0
            and _all_finite(load_checkpoint(newest_checkpoint(folder)))
        )
        rows.append(Row(name, 1, int(ok), 0, "the env's episode ends, named and counted once; all else finite"))
    return rows


def bad_reward(work: Path) -> Row:
    """A reward that is not a number."""

    def prepare() -> None:
        step, count = HumanoidEnv.step, 0

        def spoiled(env: HumanoidEnv, actions: torch.Tensor) -> Any:
            nonlocal count
            result = step(env, actions)
            count += 1
            if count == 9:
                result[3]["group_rewards"][SICK, 0] = math.nan
            return result

        HumanoidEnv.step = spoiled

    run = Run(work / "reward", prepare)
    ok = run.wait() == 0 and "steps of agent 'lower' skipped" in run.log.read_text()
    ok = ok and sum(v for _, v in curve(run.folder, "agents/lower/skipped")) > 0.0
    ok = ok and _all_finite(load_checkpoint(newest_checkpoint(run.folder))["model"])
    return Row("NaN in a reward", 1, int(ok), 0, "one agent's steps of one iteration skipped, named and counted")


def _all_finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_all_finite(v) for v in value.values())
    return bool(torch.isfinite(value).all()) if isinstance(value, torch.Tensor) else True


def raising_step(work: Path, reference: Path) -> Row:
    """A step that raises, as when a worker dies."""

    def fail(_env: HumanoidEnv) -> None:
        raise RuntimeError("planted: a worker died")

    folder = work / "raised"
    run = Run(folder, at_step(5 * STEPS + 2, fail))
    said = f"iteration 6 failed (RuntimeError: planted: a worker died); go on with --resume {folder}"
    ok = run.wait() == 1 and said in run.log.read_text()
    lost = run.finished_iterations() - newest_iteration(folder)
    ok = ok and lost <= INTERVAL and Run(folder).wait() == 0 and _good_end(folder, reference)
    return Row("a step that raises", 1, int(ok), lost, "run stops, says why and how to go on; ends bit for bit equal")


def clock_jumps(work: Path, reference: Path) -> list[Row]:
    """The clock is a day ahead, then a day behind, within a run and between its two halves."""
    rows = []
    for name, first, second in (("forward", 0.0, 86400.0), ("back", 86400.0, -86400.0)):
        folder = work / f"clock-{name}"
        stop = at_step(6 * STEPS, lambda _env: os.kill(os.getpid(), signal.SIGTERM))
        ok = Run(folder, _both(_clock(first, -first), stop)).wait() == 0
        ok = ok and Run(folder, _clock(second, -second)).wait() == 0 and _good_end(folder, reference)
        rows.append(Row(f"clock jumps {name} by a day", 2, 2 * ok, 0, "ends bit for bit equal; one curve in the log"))
    return rows


def _both(one: Prepare, other: Prepare) -> Prepare:
    return lambda: (one(), other(), None)[2]


def _clock(early: float, late: float) -> Prepare:
    """A clock that is off by `early` seconds, and after a few hundred readings by `late`."""

    def prepare() -> None:
        now, readings = time.time, 0

        def wrong() -> float:
            nonlocal readings
            readings += 1
            return now() + (early if readings < 5 else late)

        time.time = wrong

    return prepare


def full_disk(work: Path, reference: Path) -> list[Row]:
    """A file system that fills up, for a while and for good, and one that is read-only from the start."""
    disk = work / "disk"
    disk.mkdir()
    try:
        _mount("-t", "tmpfs", "-o", "size=12M", "tmpfs", disk)
    except (OSError, subprocess.CalledProcessError) as error:
        return [Row("full disk", 0, 0, None, f"not injected: file systems cannot be mounted here ({error})")]
    try:
        return _on_disk(disk, work, reference)
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


def _on_disk(disk: Path, work: Path, reference: Path) -> list[Row]:
    ballast = disk / "ballast"

    def fill(_env: HumanoidEnv) -> None:
        with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))

    def free(_env: HumanoidEnv) -> None:
        ballast.unlink()

    folder = disk / "while"
    run = Run(folder, _both(at_step(3 * STEPS, fill), at_step(9 * STEPS, free)))  # its output goes to the full disk too
    done = run.wait() == 0
    failed = int(curve(folder, "faults/failed_saves")[-1][1])
    ok = done and failed > 0 and same_end(folder, reference)
    rows = [Row("disk full for six iterations", 1, int(ok), 0, f"{failed} saves failed; ends bit for bit equal")]

    folder = disk / "for-good"
    shutil.rmtree(disk / "while")
    run = Run(folder, at_step(3 * STEPS, fill), work / "for-good.log")
    status = run.wait()
    done = run.finished_iterations()
    kept = newest_iteration(folder)
    ballast.unlink()
    ok = (
        "trying again after the next iteration" in run.log.read_text()
        and status == 2
        and kept == INTERVAL
        and Run(folder).wait() == 0
        and same_end(folder, reference)
    )
    outcome = "trains on, tries to save after every iteration, ends with an error; last checkpoint whole"
    rows.append(Row("disk full for good", 1, int(ok), done - kept, outcome))

    shutil.rmtree(folder)
    _mount("-o", "remount,ro", disk)
    run = Run(disk / "never", log=work / "never.log")
    ok = run.wait() == 2 and "Read-only file system" in run.log.read_text() and not (disk / "never").exists()
    rows.append(Row("read-only file system", 1, int(ok), 0, "refused before anything is done"))
    return rows


def _mount(*args: Any) -> None:
    subprocess.run(["mount", *map(str, args)], check=True, capture_output=True)


def own_mounts() -> None:
    """Give this process mounts of its own, which end with it. Raises OSError where the system does not allow it."""
    user, group = os.getuid(), os.getgid()
    new_mounts, new_user = 0x00020000, 0x10000000
    if ctypes.CDLL(None, use_errno=True).unshare(new_mounts | (new_user if user else 0)):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    if user:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    _mount("--make-rprivate", "/")


def obey_permissions() -> None:
    """Make this process heed file permissions even if it is root's: give up CAP_DAC_OVERRIDE (Linux)."""
    if os.getuid() == 0:
        libc, version = ctypes.CDLL(None, use_errno=True), 0x20080522
        header, sets = (ctypes.c_uint32 * 2)(version, 0), (ctypes.c_uint32 * 6)()
        libc.capget(header, sets)
        sets[0] &= ~(1 << 1)
        if libc.capset(header, sets):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def locked_folder(work: Path, reference: Path) -> Row:
    """The run's folder loses its write permission for a while."""
    folder = work / "locked"
    lock = at_step(3 * STEPS, lambda _env: folder.chmod(0o555))
    unlock = at_step(9 * STEPS, lambda _env: folder.chmod(0o777))
    run = Run(folder, _both(obey_permissions, _both(lock, unlock)))
    ok = run.wait() == 0 and "Permission denied" in run.log.read_text() and _good_end(folder, reference)
    failed = int(curve(folder, "faults/failed_saves")[-1][1])
    return Row("folder read-only for six iterations", 1, int(ok), 0, f"{failed} saves failed; ends bit for bit equal")


def undisturbed(work: Path) -> tuple[Path, tuple[float, float]]:
    """A run that nothing happens to, and its pace: seconds to the end of the first iteration, and per iteration."""
    run = Run(work / "reference")
    os.read(run._beats, 1)
    first = time.monotonic() - run.born
    if run.wait():
        raise SystemExit(run.log.read_text())
    return run.folder, (first, (time.monotonic() - run.born - first) / (ITERATIONS - 1))


def inject(kills: int, work: Path, seed: int) -> list[Row]:
    """Every fault, one after the other."""
    torch.set_num_threads(1)
    with contextlib.suppress(OSError, subprocess.CalledProcessError, AttributeError):
        own_mounts()
    reference, pace = undisturbed(work)
    rng = random.Random(seed)
    rows = kill_runs(work, reference, kills, pace, rng) + terminate_runs(work, reference, max(2, kills // 2), pace, rng)
    rows += [*diverge(work), bad_reward(work), raising_step(work, reference), *clock_jumps(work, reference)]
    return [*rows, locked_folder(work, reference), *full_disk(work, reference)]


def table(rows: list[Row]) -> str:
    """As Markdown."""
    lines = ["| fault | injected | survived | most lost [iterations] | outcome |", "|---|---|---|---|---|"]
    for r in rows:
        lost = "-" if r.most_lost is None else r.most_lost
        outcome = r.outcome if r.survived == r.injected else "not as it should be"
        lines.append(f"| {r.fault} | {r.injected} | {r.survived} | {lost} | {outcome} |")
    return "\n".join(lines)


def main() -> int:
    """Returns the exit status: 0 if every fault was survived, else 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--kills", type=int, default=50, help="how often to kill a training; half as often one is asked to end"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the moments at which it is killed")
    parser.add_argument("--json", type=Path, help="write the table here")
    options = parser.parse_args()
    try:
        require_output("--json", options.json or "")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    with tempfile.TemporaryDirectory(prefix="cotap-faults-") as work:
        rows = inject(options.kills, Path(work), options.seed)
    print(f"{ENVS} envs, {ITERATIONS} iterations, a save every {INTERVAL}\n\n{table(rows)}")
    if options.json:
        write_json(options.json, [asdict(r) for r in rows])
    return int(any(r.survived < r.injected for r in rows))


if __name__ == "__main__":
    sys.exit(main())

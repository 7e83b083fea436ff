"""The policy outside of its trainer: the paper's section IV-C, by `reports.paper.engines`."""

from __future__ import annotations

import shutil

from reports.paper.book import Book
from reports.paper.words import missing

ENGINES = ("mujoco", "pybullet")
TRIALS, QUICK_TRIALS = 100, 4
WHAT = """The policy as it is deployed, in one ONNX file, one robot at a time: MuJoCo with physics steps of 1 ms and
elliptic friction cones, and PyBullet. {trials} trials of each row, of {seconds:g} s under random commands and
perturbations; in brackets, Wilson's interval of falls and the bootstrap's of measures, over trials that fell too, each
until then; the periodic load is of trials that stood. {missing}"""


def sim_to_sim(book: Book) -> None:
    """Tracking, a load and perturbations in several engines."""
    book.add("", "## Sim to sim (the paper's section IV-C)")
    if not book.has("cotap"):
        book.paragraph(missing("cotap"))
        return
    import os

    from cotap.deployment.graph import export_policy
    from cotap.evaluation.policy import find_checkpoint
    from reports.paper.engines import Comparison, compare, figure, markdown

    trials = min(QUICK_TRIALS if book.quick else TRIALS, book.envs)
    there, absent = installed(book.robot)
    cfg = Comparison(there, trials, trials, trials)
    book.paragraph(WHAT, trials=trials, seconds=cfg.episode_seconds, missing=absent)
    parts = book.evaluations / "sim-to-sim"
    if not book.reuse:
        shutil.rmtree(parts, ignore_errors=True)
    parts.mkdir(parents=True, exist_ok=True)
    policy = parts / "policy.onnx"
    export_policy(find_checkpoint(book.policies["cotap"]), policy, checks=1000)
    result = compare(policy, cfg, book.threads or len(os.sched_getaffinity(0)), parts)
    book.add("", markdown(result).replace("## ", "### ").rstrip())
    figure(result, book.figure("sim_to_sim", "Torque of the elbows under the periodic load."))


def installed(robot: str) -> tuple[tuple[str, ...], str]:
    """The engines that there are, and a sentence about those that are not."""
    from cotap.deployment.engines import EngineConfig, make_engine
    from cotap.robots import ROBOTS

    there, absent = [], []
    for name in ENGINES:
        try:
            make_engine(EngineConfig(name), ROBOTS[robot]()).close()
            there.append(name)
        except ModuleNotFoundError:
            absent.append(f"{name} is not installed: not measured.")
    return tuple(there), " ".join(absent)

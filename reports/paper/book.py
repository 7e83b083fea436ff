"""What a page is made with: policies, evaluations that are run or kept, rows of tables, figures."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reports.paper.tables import PAPER_ROBOT

POLICIES = ("cotap", "base", "no-ratio", "torque-critic", "goals", "facet", "seed-0", "seed-1", "seed-2")
"""Names of all policies that a page may measure: two that ship, ablations, and CoTaP trained with three seeds."""
PAIRED = ("impact", "constant-load", "periodic-load", "velocity-tracking")
"""Protocols that write every env's figures, so that two evaluations are compared env by env."""
KEPT = (
    "protocol", "method", "num_envs", "num_falls", "window", "fidelity", "num_wrong_way", "num_unholdable",
    "num_touching", "error_quantiles", "error_quantiles_ci95", "coverage", "impulse_50", "fall_curve", "falls",
)  # fmt: skip
"""What results.json keeps of an evaluation, beside the measures that the page shows."""
WITHOUT_FALLS = ("impact", "constant-load", "periodic-load")
"""Protocols whose measures the page shows of the envs that stood."""


@dataclass
class Book:
    """Runs evaluations, keeps their results, and collects the page of one robot."""

    robot: str
    folder: Path
    """Where the page goes."""
    evaluations: Path
    """Where evaluations are kept."""
    envs: int = 4096
    """Envs of a row."""
    threads: int = 0
    reuse: bool = False
    """Whether an evaluation that is there, of the same policy and options, is taken instead of run again."""
    quick: bool = False
    policies: dict[str, str] = field(default_factory=dict)
    """Checkpoint of each policy, a file or the name of a shipped one."""
    lines: list[str] = field(default_factory=list)
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    differences: dict[str, dict[str, Any]] = field(default_factory=dict)
    changes: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """Relative change from PD by mode, arms and measure."""
    _columns: int = 0

    @property
    def page(self) -> Path:
        """The file of the page."""
        return self.folder / ("results.md" if self.robot == PAPER_ROBOT else f"results_{self.robot}.md")

    @property
    def assets(self) -> Path:
        """The folder of figures and results.json."""
        return self.folder / "results" / self.robot

    @property
    def paper(self) -> str:
        """Head of columns with what the paper measured."""
        return "paper" if self.robot == PAPER_ROBOT else f"paper ({PAPER_ROBOT.upper()})"

    def has(self, policy: str) -> bool:
        """Whether there is a checkpoint of this policy."""
        from cotap.evaluation.policy import CHECKPOINTS, shipped_names

        given = self.policies.get(policy, "")
        return given in shipped_names() if given in CHECKPOINTS else Path(given).is_file()

    def checkpoint(self, policy: str) -> dict[str, Any]:
        """What is in a policy's checkpoint."""
        from cotap.agents.checkpoint import load_checkpoint
        from cotap.evaluation.policy import find_checkpoint

        return load_checkpoint(find_checkpoint(self.policies[policy]))

    def run(self, name: str, policy: str, *args: str, envs: int = 0) -> dict[str, Any] | None:
        """The result of `cotap evaluate ARGS` under `name`, run once; None where there is no checkpoint of its policy.

        Args:
            name: What the result is kept under.
            policy: Name of the policy.
            args: Protocol and options.
            envs: Envs, those of the book by default.
        """
        if name in self.results or not self.has(policy):
            return self.results.get(name)
        paired = ["--per-env"] if args[0] in PAIRED else []
        arguments = [args[0], "--num-envs", str(envs or self.envs), *paired, *args[1:]]
        path = self.evaluations / f"{name}.json"
        result = kept_or_run(path, arguments, self.policies[policy], self.threads, self.reuse)
        self.results[name] = result | {"policy": policy}
        return self.results[name]

    def add(self, *lines: str) -> None:
        """Add lines to the page."""
        self.lines += lines

    def table(self, *columns: str) -> None:
        """Begin a table."""
        self._columns = len(columns)
        self.add("", row(*columns), "|---" * len(columns) + "|")

    def row(self, *cells: str, last: str | None = None) -> None:
        """A row of the table; empty cells fill it up, before the `last` one if that is given."""
        end = [] if last is None else [last]
        self.add(row(*cells, *[""] * (self._columns - len(cells) - len(end)), *end))

    def paragraph(self, text: str, **values: Any) -> None:
        """A paragraph, its fields filled in."""
        self.add("", " ".join(text.split()).format(**values))

    def figure(self, name: str, caption: str) -> Path:
        """Where a figure goes; its place on the page is here."""
        self.assets.mkdir(parents=True, exist_ok=True)
        self.add("", f"![{name.replace('_', ' ')}](results/{self.robot}/{name}.png)", "", f"*{caption}*")
        return self.assets / f"{name}.png"

    def write(self) -> None:
        """Write the page and results.json."""
        from cotap.agents.checkpoint import write_json
        from cotap.files import write_atomically

        self.assets.mkdir(parents=True, exist_ok=True)
        text = "\n".join(self.lines) + "\n"
        write_json(self.assets / "results.json", self.summary())
        write_atomically(self.page, lambda p: p.write_text(text, encoding="utf-8"))

    def summary(self) -> dict[str, Any]:
        """The content of results.json: no env's own figures, and no path of this machine."""
        rows = {}
        for name, result in self.results.items():
            arguments = result["about"]["arguments"]
            measures = "metrics_without_falls" if result["protocol"] in WITHOUT_FALLS else "metrics"
            rows[name] = {
                "policy": result["policy"],
                "checkpoint_sha256": result["settings"]["checkpoint_sha256"],
                "arguments": [arguments[0], *arguments[3:]],  # without the checkpoint's path
                **{key: result[key] for key in (*KEPT, measures) if key in result},
            }
        return {"robot": self.robot, "rows": rows, "differences": self.differences, "changes": self.changes}


def row(*cells: str) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def slug(text: str) -> str:
    """A file name of a row's name."""
    return "".join(c if c.isalnum() or c == "." else "-" for c in text).replace("--", "-").strip("-")


def kept_or_run(path: Path, arguments: list[str], checkpoint: str, threads: int, reuse: bool) -> dict[str, Any]:
    """The result of `cotap evaluate ARGUMENTS --checkpoint CHECKPOINT`, written to `path`.

    With `reuse` what `path` has is taken if it is of the same checkpoint and arguments.
    """
    from cotap.agents.checkpoint import sha256
    from cotap.evaluate import evaluate
    from cotap.evaluation.policy import find_checkpoint

    asked = [arguments[0], "--checkpoint", checkpoint, *arguments[1:]]
    about = {"arguments": asked, "checkpoint_sha256": sha256(find_checkpoint(checkpoint))}
    return kept(path, reuse, about, lambda: evaluate([*asked, "--threads", str(threads)]))


def kept(path: Path, reuse: bool, about: dict[str, Any], measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What `measure` returns, written to `path`; with `reuse`, what `path` has, if that is `about` the same."""
    from cotap.agents.checkpoint import write_json

    about = json.loads(json.dumps(about))  # as it is read back
    if reuse and path.is_file():
        with contextlib.suppress(ValueError, TypeError, LookupError, RecursionError):  # no such file: measured again
            before = json.loads(path.read_text(encoding="utf-8"))
            if before["about"] == about:
                return before
    print(f"\n{path.stem}", flush=True)
    result = measure() | {"about": about}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, result)
    return result

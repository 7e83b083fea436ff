"""The page that `reproduce_paper.py` writes: evaluations run or kept, numbers and orderings in words, figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reports.kept_evaluations import kept_or_run

SHIPPED = {"cotap": "h1-cotap", "base": "h1-base"}
"""Policies that come with the package; those of ablations are given by `--policies`."""
PAIRED = ("impact", "constant-load")
"""Protocols that write every env's figures, so that two evaluations are compared env by env."""


@dataclass
class Book:
    """Runs evaluations, keeps their results, and collects the page."""

    out: Path
    evaluations: Path
    envs: int
    threads: int
    reuse: bool
    policies: dict[str, str] = field(default_factory=lambda: dict(SHIPPED))
    """Checkpoint of each policy, a file or the name of a shipped one."""
    lines: list[str] = field(default_factory=list)
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    differences: dict[str, dict[str, Any]] = field(default_factory=dict)

    def has(self, policy: str) -> bool:
        """Whether there is a checkpoint of this policy."""
        from cotap.evaluation.policy import CHECKPOINTS, shipped_names

        given = self.policies.get(policy, "")
        return given in shipped_names() if given in CHECKPOINTS else Path(given).is_file()

    def run(self, name: str, policy: str, *args: str, envs: int | None = None) -> dict[str, Any] | None:
        """An evaluation's result under `name`; None where there is no checkpoint of its policy."""
        if not self.has(policy):
            return None
        size = [] if envs == 0 else ["--num-envs", str(envs or self.envs)]
        paired = ["--per-env"] if args[0] in PAIRED else []
        path = self.evaluations / f"{name}.json"
        arguments = [args[0], *size, *paired, *args[1:]]
        self.results[name] = kept_or_run(path, arguments, self.policies[policy], self.threads, self.reuse)
        return self.results[name]

    def add(self, *lines: str) -> None:
        """Add lines to the page."""
        self.lines += lines

    def figure(self, name: str, caption: str) -> Path:
        """Where a figure goes; its place on the page is here."""
        self.add("", f"![{caption}](results/{name}.png)", "", f"*{caption}*")
        return self.out / f"{name}.png"


def number(m: dict[str, Any] | None, digits: int = 3) -> str:
    """A measure as mean and interval."""
    if m is None or m["mean"] is None:
        return "not measured" if m is None else m["reason"]
    if m["ci95"] is None:
        return f"{m['mean']:.{digits}f} ({m['reason']})"
    low, high = m["ci95"]
    return f"{m['mean']:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def fallen(result: dict[str, Any]) -> str:
    """Share of envs that fell until the end of the episode, not in the window alone, with Wilson's interval."""
    from cotap.evaluation.metrics import wilson_interval

    share, envs = result["num_falls"] / result["num_envs"], result["num_envs"]
    low, high = (100.0 * bound for bound in wilson_interval(share, envs))
    return f"{100.0 * share:.1f} % ({low:.1f} to {high:.1f})"


def missing(policy: str) -> str:
    """What stands where a policy would be measured of which there is no checkpoint."""
    return f"no checkpoint of `{policy}`: not measured"


def compared(book: Book, first: str, second: str, measure: str) -> dict[str, Any]:
    """The second row less the first, over the envs that stood in both; `difference` is null where there is none."""
    from cotap.compare import measure_difference

    if not {first, second} <= book.results.keys():
        return {"difference": None, "reason": "not measured"}
    d = measure_difference(book.results[first], book.results[second], measure, without_falls=True)
    book.differences[f"{measure}: {second} - {first}"] = d
    return d


def verdict(book: Book, smaller: str, larger: str, measure: str, digits: int = 3) -> str:
    """Whether a measure is larger in one row than in another, as its interval has it."""
    d = compared(book, smaller, larger, measure)
    if d["difference"] is None:
        return f"not measured ({d['reason']})"
    low, high = d["ci95"]
    word = "holds" if low > 0.0 else "does not hold" if high < 0.0 else "cannot be distinguished"
    return f"**{word}**, difference {d['difference']:+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f})"


def ordering(book: Book, claim: str, smaller: str, larger: str, measure: str, digits: int = 3) -> None:
    """A claim and its verdict in a line of the page."""
    book.add(f"- {claim}: {verdict(book, smaller, larger, measure, digits)}")


def slug(text: str) -> str:
    """A file name of a row's name."""
    return "".join(c if c.isalnum() or c == "." else "-" for c in text).replace("--", "-").strip("-")


def plot_curves(path: Path, curves: dict[str, tuple[list[float], list[float]]], x: str, y: str) -> None:
    """Several curves on one axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from cotap.evaluation.report import save_figure

    figure, axis = plt.subplots(figsize=(8.0, 4.2), constrained_layout=True)
    for name, (time, values) in curves.items():
        if time:
            axis.plot(time, values, label=name)
    axis.axvline(0.0, color="0.6", lw=0.8)
    axis.set(xlabel=x, ylabel=y)
    axis.grid(alpha=0.2)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(frameon=False)
    save_figure(figure, path)


def picture(book: Book, name: str, caption: str, shots: list[tuple[str, list[str], tuple[float, ...]]]) -> None:
    """A row of pictures."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from cotap.evaluate import pictures
    from cotap.evaluation.report import save_figure

    images = []
    for label, args, times in shots:
        images += [(f"{label} {t:g} s".strip(), image) for t, image in zip(times, pictures(args, times), strict=True)]
    figure, axes = plt.subplots(
        1, len(images), figsize=(2.6 * len(images), 2.9), constrained_layout=True, squeeze=False
    )
    for axis, (label, image) in zip(axes[0], images, strict=True):
        axis.imshow(image)
        axis.set_title(label, fontsize=10)
        axis.axis("off")
    save_figure(figure, book.figure(name, caption))


def write(folder: Path, book: Book) -> None:
    """The page and all results in one file."""
    from cotap.agents.checkpoint import write_json
    from cotap.files import write_atomically

    text = "\n".join(book.lines) + "\n"
    write_atomically(folder / "results.md", lambda p: p.write_text(text, encoding="utf-8"))
    kept = (
        "protocol",
        "method",
        "num_envs",
        "num_falls",
        "falls",
        "seconds",
        "metrics",
        "metrics_without_falls",
        "window",
        "fidelity",
        "largest_error",
        "num_wrong_way",
        "error_quantiles",
        "coverage",
        "impulse_50",
        "fall_curve",
        "effective_stiffness",
        "by_change",
        "arguments",
    )
    results = {
        name: {key: result[key] for key in kept if key in result}
        | {"settings": {key: value for key, value in result["settings"].items() if key != "env"}}
        for name, result in book.results.items()
    }  # the environment is in the checkpoint
    write_json(folder / "results.json", {"rows": results, "differences": book.differences})
    print(f"\nwritten: {folder / 'results.md'}")

"""`cotap compare A.json B.json`: what differs between two evaluations, with intervals."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from cotap.checks import is_finite, legible, quoted, shortened
from cotap.files import require_output
from cotap.inputs import InputError, read_text

_MOST, _SHOWN = 1000, 100
"""Measures that are read, and changed settings that are printed; there are some fifty of each."""


@dataclass
class CompareOptions:
    """Differences B - A of two evaluations of one protocol, with 95 % intervals."""

    a: Annotated[str, tyro.conf.Positional]
    """JSON of the first evaluation."""
    b: Annotated[str, tyro.conf.Positional]
    """JSON of the second evaluation."""
    without_falls: bool = False
    """Compare only the envs that did not fall."""
    json: str = ""
    """Write the differences here (JSON)."""


def main(argv: list[str] | None = None) -> int:
    """Parse, compare, report. Returns the exit status: 0, 2 for bad input, or 130 if interrupted."""
    options = tyro.cli(CompareOptions, args=argv, prog="cotap compare")
    try:
        from cotap.agents.checkpoint import write_json

        require_output("--json", options.json)
        result = compare(read(options.a), read(options.b), options.without_falls)
        print(table(result))
        if options.json:
            write_json(Path(options.json), result)
    except (ValueError, OSError, RecursionError) as error:  # the last of settings nested without end
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def read(path: str) -> dict[str, Any]:
    """An evaluation's JSON. Raises ValueError for another file, or none."""
    try:
        content = json.loads(read_text(path))
    except InputError as error:
        raise ValueError(f"{path!r} {error}") from error
    except (ValueError, RecursionError) as error:  # not JSON, or nested without end
        raise ValueError(f"{path!r} is not JSON: {error}") from error
    if not isinstance(content, dict) or not {"protocol", "settings"} <= content.keys():
        raise ValueError(f"{path!r} is not an evaluation: it lacks protocol or settings")
    if "metrics" not in content:
        raise ValueError(f"{path!r}: {quoted(content['protocol'])} has no measures to compare")
    for part in ("metrics", "metrics_without_falls", "settings"):
        if not isinstance(content.get(part, {}), dict):
            raise ValueError(f"{path!r}: {part} must be an object, got {type(content[part]).__name__}")
    for part in ("metrics", "metrics_without_falls"):
        if len(content.get(part, {})) > _MOST:
            raise ValueError(f"{path!r}: {part} has {len(content[part])} measures; at most {_MOST} are read")
        for name, summary in content.get(part, {}).items():
            _require_summary(f"{path!r}: {part}.{name}", summary)
    _require_slopes(path, content)
    if "per_env" in content:
        _require_envs(f"{path!r}: per_env", content["per_env"])
    return content


def _require_slopes(path: str, content: dict[str, Any]) -> None:
    """Raise ValueError unless slopes, if there are any, have an interval or null each."""
    slopes, intervals = content.get("slopes", {}), content.get("slopes_ci95", {})
    if not isinstance(slopes, dict) or not isinstance(intervals, dict) or slopes.keys() != intervals.keys():
        raise ValueError(f"{path!r}: slopes and slopes_ci95 must be objects of the same names")
    if len(slopes) > _MOST:
        raise ValueError(f"{path!r}: slopes has {len(slopes)} measures; at most {_MOST} are read")
    for name, value in slopes.items():
        _require_summary(f"{path!r}: slopes.{name}", {"mean": value, "ci95": intervals[name]})


def _require_summary(where: str, summary: Any) -> None:
    """Raise ValueError unless this is a mean with its interval, or null in place of either."""
    if not isinstance(summary, dict) or not {"mean", "ci95"} <= summary.keys():
        raise ValueError(f"{where} must have mean and ci95")
    mean, interval = summary["mean"], summary["ci95"]
    if mean is not None and not is_finite(mean):
        raise ValueError(f"{where}.mean must be a finite number or null, got {quoted(mean)}")
    pair = isinstance(interval, list) and len(interval) == 2 and all(is_finite(x) for x in interval)
    if interval is not None and not pair:
        raise ValueError(f"{where}.ci95 must be two finite numbers or null, got {quoted(interval)}")


def _require_envs(where: str, envs: Any) -> None:
    """Raise ValueError unless these are lists of numbers or nulls, all of one length, `stood` among them."""
    if not isinstance(envs, dict) or "stood" not in envs or not all(isinstance(v, list) for v in envs.values()):
        raise ValueError(f"{where} must be lists by name, stood among them")
    for name, values in envs.items():
        if len(values) != len(envs["stood"]):
            raise ValueError(f"{where}.{name} has {len(values)} envs, stood has {len(envs['stood'])}")
        if wrong := [v for v in values if v is not None and not is_finite(v)]:
            raise ValueError(f"{where}.{name} must be finite numbers or null, got {quoted(wrong[0])}")
    if wrong := [v for v in envs["stood"] if v not in (0, 1)]:
        raise ValueError(f"{where}.stood must be 0 or 1, got {quoted(wrong[0])}")


def compare(a: dict[str, Any], b: dict[str, Any], without_falls: bool = False) -> dict[str, Any]:
    """Differences of all measures that both have, and the settings in which they differ.

    Where both have every env's figures (`--per-env`) of as many envs and one seed, envs are compared one by one:
    what friction, motion or direction does to a measure it does to both, and drops out. Otherwise the interval of a
    difference follows from those of its terms, taken to be independent (the square-and-add method of Zou and Donner
    2008, Newcombe's for shares).

    Raises:
        ValueError: the protocols differ.
    """
    if a["protocol"] != b["protocol"]:
        raise ValueError(f"protocols differ: {quoted(a['protocol'])} and {quoted(b['protocol'])}")
    key = "metrics_without_falls" if without_falls else "metrics"
    names = [name for name in measures(a, key) if name in measures(b, key)]
    if not names:
        raise ValueError(f"the evaluations have no measure in common in {key}")
    rows = {name: judged(name, measure_difference(a, b, name, without_falls)) for name in names}
    old, new = (flat(x["settings"] | {"method": x.get("method"), "window": x.get("window")}) for x in (a, b))
    settings = {
        name: [old.get(name), new.get(name)]
        for name in sorted(old.keys() | new.keys())
        if old.get(name) != new.get(name)
    }
    return {"protocol": a["protocol"], "differences": rows, "settings": settings}


def judged(name: str, row: dict[str, Any]) -> dict[str, Any]:
    """A measure's difference with what is `better`, less or more (empty: neither), and what `b_is` by its interval:
    better, worse, more or less where neither is better, or not distinguishable."""
    from cotap.evaluation.report import better

    wanted, b_is = better(name), ""
    if row["difference"] is not None:
        low, high = row["ci95"]
        way = "more" if low > 0.0 else "less" if high < 0.0 else ""
        judgement = way if not wanted else "better" if way == wanted else "worse"
        b_is = judgement if way else "not distinguishable"
    return row | {"better": wanted, "b_is": b_is}


def measure_difference(a: dict[str, Any], b: dict[str, Any], name: str, without_falls: bool) -> dict[str, Any]:
    """`b - a` of one measure of two evaluations, env by env where both have them; as `difference`."""
    old, new = (x.get("per_env", {}).get(name, []) for x in (a, b))
    seeds = [x["settings"].get("seed") for x in (a, b)]
    paired = old and len(old) == len(new) and seeds[0] is not None and seeds[0] == seeds[1]
    # A bootstrap of shares has no width where all envs agree; Newcombe's interval has.
    if paired and not {*old, *new} <= {0.0, 1.0, None}:
        return paired_difference(a["per_env"], b["per_env"], name, without_falls)
    if paired and without_falls:
        return difference(*_shares_of_both(a["per_env"], b["per_env"], name))
    key = "metrics_without_falls" if without_falls else "metrics"
    return difference(measures(a, key)[name], measures(b, key)[name])


def _shares_of_both(a: dict[str, Any], b: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """How often something happened in each of two evaluations, over the envs that stood in both and have it in both."""
    import torch

    from cotap.evaluation.metrics import summarize

    stood = [x and y for x, y in zip(a["stood"], b["stood"], strict=True)]
    both = [s and None not in pair for s, *pair in zip(stood, a[name], b[name], strict=True)]
    return [summarize(torch.tensor([bool(v) for v, keep in zip(x[name], both, strict=True) if keep])) for x in (a, b)]


def measures(evaluation: dict[str, Any], key: str) -> dict[str, Any]:
    """Summaries by measure: those of `key`, and the slopes, which are over all envs."""
    slopes = {
        name: {"mean": value, "ci95": evaluation["slopes_ci95"][name], "reason": "the command did not differ"}
        for name, value in evaluation.get("slopes", {}).items()
    }
    return evaluation.get(key, {}) | (slopes if key == "metrics" else {})


def paired_difference(a: dict[str, Any], b: dict[str, Any], name: str, without_falls: bool) -> dict[str, Any]:
    """Mean of `b - a` over the envs that have the measure in both, with its bootstrap interval.

    Args:
        a: Lists by measure, a figure or null for every env.
        b: The same of the other evaluation.
        name: The measure.
        without_falls: Leave out envs that fell in either.
    """
    import torch

    from cotap.evaluation.metrics import summarize

    old, new = (torch.tensor([math.nan if v is None else v for v in x[name]]) for x in (a, b))
    both = torch.isfinite(old) & torch.isfinite(new)
    if without_falls:
        both &= torch.tensor(a["stood"]).bool() & torch.tensor(b["stood"]).bool()
    summary = summarize((new - old)[both])
    if summary["n"] < 2:
        return {"a": None, "b": None, "difference": None, "ci95": None, "reason": "fewer than two envs have both"}
    means = {"a": float(old[both].mean()), "b": float(new[both].mean())}
    return means | {"difference": summary["mean"], "ci95": summary["ci95"], "pairs": summary["n"]}


def difference(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """`b - a` of two summaries with `mean` and `ci95`; null with the reason where one of them is."""
    for which, summary in (("A", a), ("B", b)):
        if summary["mean"] is None or summary["ci95"] is None:
            return {"a": a["mean"], "b": b["mean"], "difference": None, "ci95": None,
                    "reason": f"{which}: {summary.get('reason', 'not measured')}"}  # fmt: skip
    (a_low, a_high), (b_low, b_high) = a["ci95"], b["ci95"]
    d = b["mean"] - a["mean"]
    low = d - math.hypot(b["mean"] - b_low, a_high - a["mean"])
    high = d + math.hypot(b_high - b["mean"], a["mean"] - a_low)
    return {"a": a["mean"], "b": b["mean"], "difference": d, "ci95": [low, high]}


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Nested dicts as one, keys joined by dots."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    out: dict[str, Any] = {}
    for key, value in tree.items():
        out |= flat(value, f"{prefix}.{key}" if prefix else str(key))
    return out


def table(result: dict[str, Any]) -> str:
    """Differences as Markdown, then the settings that differ."""
    lines = ["| measure (better) | A | B | B - A | 95 % interval | B is |", "|---|---|---|---|---|---|"]
    for name, row in result["differences"].items():
        shown = f"{legible(name)} ({row['better']})" if row["better"] else legible(name)
        if row["difference"] is None:
            lines.append(f"| {shown} | - | - | - | {legible(row['reason'])} | |")
            continue
        low, high = row["ci95"]
        lines.append(
            f"| {shown} | {row['a']:.4f} | {row['b']:.4f} | {row['difference']:+.4f} | {low:+.4f} to {high:+.4f} "
            f"| {row['b_is']} |"
        )
    if pairs := [row["pairs"] for row in result["differences"].values() if "pairs" in row]:
        lines += ["", f"Compared env by env, {min(pairs)} to {max(pairs)} envs a measure."]
    settings = result["settings"].items()
    changed = [f"{legible(name)}: {legible(str(old))} -> {legible(str(new))}" for name, (old, new) in settings]
    more = [f"and {len(changed) - _SHOWN} more settings"] if len(changed) > _SHOWN else []
    return "\n".join([*lines, "", *changed[:_SHOWN], *more])


if __name__ == "__main__":
    sys.exit(main())

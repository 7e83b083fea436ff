"""Pictures of what `compare_laws.py` measures."""

from __future__ import annotations

from typing import Any

import numpy as np

from cotap.evaluation.report import pyplot


def draw_static(result: dict[str, Any]) -> Any:
    """Displacement of the hand against load, law by law, with the paper's ideal."""
    plt = pyplot()
    loads = result["loads_n"]
    figure, axis = plt.subplots(figsize=(8.5, 4.6), constrained_layout=True)
    axis.plot(loads, result["ideal"], "k--", lw=1.5, label="ideal")
    colors = plt.get_cmap("tab20")(np.linspace(0.0, 1.0, max(2, len(result["rows"]))))
    for color, (name, row) in zip(colors, result["rows"].items(), strict=True):
        moved, half = ([np.nan if v is None else v for v in row[k]] for k in ("displacement", "half_interval"))
        axis.errorbar(loads, moved, half, marker="o", ms=3, lw=1.2, color=color, label=name)
    axis.set(xlabel="load on the hand, downward [N]", ylabel="displacement, downward [m]", xticks=loads)
    axis.grid(alpha=0.2)
    axis.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def draw_transient(result: dict[str, Any], until_s: float = 1.5) -> Any:
    """Displacement of the struck hand over time, mean and standard deviation over envs: a panel per law and force."""
    plt = pyplot()
    forces = result["forces"]
    columns = max(len(rows) for rows in forces.values())
    size = (2.3 * columns + 0.6, 2.2 * len(forces) + 0.4)
    figure, axes = plt.subplots(
        len(forces), columns, figsize=size, squeeze=False, sharex=True, sharey="row", constrained_layout=True
    )
    for line, (force, rows) in zip(axes, forces.items(), strict=True):
        facet = rows.get("facet", {}).get("curve", {"time": []})
        for axis, (name, row) in zip(line, rows.items(), strict=True):
            c = row["curve"]
            if facet["time"] and name != "facet":
                axis.plot(facet["time"], facet["hand_displacement_x"], color="0.6", lw=0.8, ls=":", label="facet")
            if c["time"]:
                mean, std = (np.array(c[f"hand_displacement_x{end}"]) for end in ("", "_std"))
                axis.fill_between(c["time"], mean - std, mean + std, color="#2171b5", alpha=0.25, lw=0)
                axis.plot(c["time"], mean, color="#2171b5", lw=1.2)
            axis.axhline(0.0, color="0.8", lw=0.6)
            axis.set(xlim=(-0.2, until_s))
            axis.set_title(f"{name}\n{force} N".replace(", PD", ",\nPD"), fontsize=8)
            axis.grid(alpha=0.2)
        line[0].set_ylabel("displacement along x [m]", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time since the push [s]", fontsize=8)
    return figure


def draw_properties(result: dict[str, Any]) -> Any:
    """Bars per law: adjustable, model-aware, unstable poses by wall, trials that energy is drawn from."""
    plt = pyplot()
    rows = result["rows"]
    at = np.arange(len(rows))[::-1]
    figure, axes = plt.subplots(1, 4, figsize=(13.0, 0.34 * len(rows) + 1.4), sharey=True, constrained_layout=True)
    axes[0].barh(at, [r["softer_over_stiffer"] for r in rows.values()], color="#2171b5")
    axes[0].axvline(4.0, color="k", ls="--", lw=0.8)
    axes[0].set(title="adjustable: displacement at half\nover that at twice the stiffness", xlabel="ideal 4")
    axes[1].barh(at, [1e3 * r["wrong_model_shift"] for r in rows.values()], color="#2171b5")
    axes[1].set(title="model-aware: shift of the hand\nunder a wrong model", xlabel="[mm]")
    walls = sorted({x["wall"] for r in rows.values() for x in r["linearised"]})
    for i, wall in enumerate(walls):
        share = [max(x["share_unstable"] for x in r["linearised"] if x["wall"] == wall) for r in rows.values()]
        label = "free" if wall == 0.0 else f"{wall:g} N/m"
        color = plt.get_cmap("viridis")(i / len(walls))
        axes[2].barh(at + 0.3 - 0.6 * i / len(walls), share, 0.6 / len(walls), color=color, label=label)
    axes[2].set(title="unstable poses, hand held by;\nworse of at rest and loaded", xlabel="share")
    for i, (key, color) in enumerate((("constant_stiffness", "#2171b5"), ("changing_stiffness", "#d95f02"))):
        share = [r["energy"][key]["share_drawn"] for r in rows.values()]
        axes[3].barh(at + 0.2 - 0.4 * i, share, 0.38, color=color, label=key.replace("_", " "))
    axes[3].set(title="trials that energy\nis drawn from", xlabel="share")
    for axis in axes[2:]:
        axis.set_xlim(0.0, 1.0)
        axis.legend(frameon=False, fontsize=7)
    axes[0].set_yticks(at, list(rows), fontsize=8)
    for axis in axes:
        axis.title.set_fontsize(9)
        axis.grid(axis="x", alpha=0.2)
    return figure

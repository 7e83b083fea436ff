"""Every table and figure of the paper from the shipped checkpoints, as Markdown, JSON and PNG, beside the paper's own.

`--quick` takes fewer envs and writes to runs/paper-quick, `--only` takes parts and writes to runs/paper; without
them, docs/results.md and docs/results/ are written.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from reports.paper_differences import differences
from reports.paper_page import (
    SHIPPED,
    Book,
    fallen,
    missing,
    number,
    ordering,
    picture,
    plot_curves,
    slug,
    verdict,
    write,
)
from reports.paper_tables import ABLATION, IMPACT, LOAD, ROWS

ARMS = {
    "PD, kp 100": ["--method", "pd"],
    "soft PD, kp 30": ["--method", "soft-pd"],
    "K 100": ["--method", "cotap", "--stiffness", "100", "100", "300"],
    "K 500": ["--method", "cotap", "--stiffness", "500", "500", "300"],
    "K 800": ["--method", "cotap", "--stiffness", "800", "800", "300"],
    "alpha 0.3, K 100": ["--method", "cotap", "--stiffness", "100", "100", "300", "--alpha", "0.3"],
    "alpha 0.7, K 100": ["--method", "cotap", "--stiffness", "100", "100", "300", "--alpha", "0.7"],
    "PD with gravity compensation (alpha 0)": ["--method", "cotap", "--alpha", "0"],
}
MODES = {"stance": ["--mode", "stance"], "walking": ["--mode", "walking", "--random-direction"]}
POLICIES = ("cotap", "base")
ABLATED = 4096
"""Worlds a row of the ablation table."""
PUNCHED = 512
"""Runs of the punch tour, which takes twenty times as long as anything else here."""
SCALED = 10.0
"""Factor on the torque limits at which an impact saturates nothing."""
STRAIGHT = ["--motion", "none", "--arm-pose", "-1.5", "0.3", "0", "1.35"]
"""Both arms stretched forward, all but straight: a condition number of 26."""
BACK = ["--force", "-500", "0", "0"]
CALM = ["--force", "0", "0", "0"]


def impacts(book: Book, mode: str, policy: str, scale: float, motion: str) -> None:
    """One of the two impact tables."""
    scaled = f", torque limits x {scale:g}" if scale != 1.0 else ""
    book.add("", f"### {mode.capitalize()}, policy `{policy}`{scaled}", "")
    key = f"impact-{mode}-{policy}" + (f"-x{scale:g}" if scale != 1.0 else "")
    book.add(
        "| arms | e_torso [m/s] | e_ee [m] | e_ee of the hand that is hit [m] | J_upper [Nm] "
        "| J_upper, first 0.1 s [Nm] | time at torque limit | fell | paper: e_torso / e_ee / J_upper |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    for name, arms in ARMS.items():
        result = book.run(
            f"{key}-{slug(name)}",
            policy,
            "impact",
            *MODES[mode],
            *arms,
            "--motion",
            motion,
            "--torque-limit-scale",
            str(scale),
        )
        printed = " / ".join(f"{v:g}" for v in IMPACT[mode][ROWS.index(name)]) if name in ROWS else "-"
        if result is None:
            book.add(f"| {name} | {missing(policy)} | | | | | | | {printed} |")
            continue
        m = result["metrics_without_falls"]
        book.add(
            f"| {name} | {number(m['e_torso'])} | {number(m['e_ee'])} | {number(m['e_ee_hit'])} "
            f"| {number(m['j_upper'], 1)} | {number(m['j_upper_blow'], 1)} | {number(m['share_at_limit'], 2)} "
            f"| {fallen(result)} | {printed} |"
        )
    book.add("", "| J_upper | over 1 s | over the first 0.1 s |", "|---|---|---|")
    rows = {name: f"{key}-{slug(name)}" for name in ARMS}
    for small, large in (
        ("K 100", "K 500"),
        ("K 500", "K 800"),
        ("K 100", "PD, kp 100"),
        ("K 100", "alpha 0.7, K 100"),
        ("alpha 0.7, K 100", "alpha 0.3, K 100"),
        ("alpha 0.3, K 100", "PD, kp 100"),
    ):
        both = [verdict(book, rows[small], rows[large], measure, 2) for measure in ("j_upper", "j_upper_blow")]
        book.add(f"| {small} below {large} | {' | '.join(both)} |")


LOADS = {
    "K_z 100": ["--method", "cotap", "--stiffness", "300", "300", "100"],
    "K_z 500": ["--method", "cotap", "--stiffness", "300", "300", "500"],
    "K_z 1000": ["--method", "cotap", "--stiffness", "300", "300", "1000"],
    "PD": ["--method", "pd"],
    "alpha 0.5": ["--method", "cotap", "--stiffness", "300", "300", "100", "--alpha", "0.5"],
}


def constant_loads(book: Book) -> None:
    """Hand error over time under -50 N."""
    book.add(
        "",
        "## Constant load (the paper's Fig. 3)",
        "",
        "-50 N in z on the left hand from 1 s on, stance, x and y 300 N/m, window 2 to 4 s from the onset; "
        "displacement is relative to the half second before.",
        "",
    )
    for policy in POLICIES:
        book.add(
            f"### Policy `{policy}`",
            "",
            "| arms | displacement in z [m] | hand error [m] | first beyond its rest by | fell | paper |",
            "|---|---|---|---|---|---|",
        )
        found = {}
        for name, arms in LOADS.items():
            result = book.run(f"load-{policy}-{slug(name)}", policy, "constant-load", *arms)
            if result is None:
                book.add(f"| {name} | {missing(policy)} | | | | {LOAD.get(name, '-')} |")
                continue
            found[name], m = result, result["metrics_without_falls"]
            book.add(
                f"| {name} | {number(m['displacement_z'])} | {number(m['e_ee_hit'])} "
                f"| {number(m['load_overshoot'], 2)} | {fallen(result)} | {LOAD.get(name, '-')} |"
            )
        book.add("")
        rows = {name: f"load-{policy}-{slug(name)}" for name in LOADS}
        for claim, small, large, measure in (
            ("Hand error at K_z 500 below that at 100", "K_z 500", "K_z 100", "e_ee_hit"),
            ("Hand error at alpha 0.5 below that of K_z 100 alone", "alpha 0.5", "K_z 100", "e_ee_hit"),
            ("alpha 0.5 goes less beyond its rest than PD", "alpha 0.5", "PD", "load_overshoot"),
            ("alpha 0.5 goes less beyond its rest than K_z 100 alone", "alpha 0.5", "K_z 100", "load_overshoot"),
        ):
            ordering(book, claim, rows[small], rows[large], measure)
        if found:
            curves = {
                name: (r["curve"]["time"], r["curve"].get("hand_displacement_z", [])) for name, r in found.items()
            }
            caption = f"Left hand's displacement in z under -50 N, policy {policy}; means over envs that stood."
            plot_curves(
                book.figure(f"constant_load_{policy}", caption),
                curves,
                "time since the load set in [s]",
                "displacement in z [m]",
            )
        book.add("")


def samples(book: Book, policy: str) -> int:
    """What a policy was trained on; 0 for one of which there is no checkpoint."""
    from cotap.agents.checkpoint import load_checkpoint
    from cotap.evaluation.policy import find_checkpoint

    return load_checkpoint(find_checkpoint(book.policies[policy]))["samples"] if book.has(policy) else 0


def ablations(book: Book, motion: str, quick: bool) -> None:
    """The ablation table, at K 100 in stance."""
    envs = book.envs if quick else ABLATED
    book.add(
        "",
        "## Ablation (the paper's Table IV)",
        "",
        f"Impact of 500 N in stance at K_ee 100, {envs} envs a row. *No training*: the base's legs, raw reference as "
        "arm target.",
        "",
        "| what | e_torso [m/s] | e_upper [rad] | the same without the push [rad] | fell | paper: e_torso / e_upper |",
        "|---|---|---|---|---|---|",
    )
    rows = {
        "no training": ("base", ["--upper-actions", "reference"]),
        "no training, base policy's own arm actions": ("base", []),
        "without the ratio": ("no-ratio", ["--singularity-ratio", "False"]),
        "CoTaP's policy, the ratio left out of the law alone": ("cotap", ["--singularity-ratio", "False"]),
        "arm torque in the critic's observation": ("torque-critic", []),
        "goals in the observation": ("goals", []),
        "CoTaP": ("cotap", []),
    }
    for name, (checkpoint, args) in rows.items():
        args = [*ARMS["K 100"], "--motion", motion, *args]
        result = book.run(f"ablation-{slug(name)}", checkpoint, "impact", *args, envs=envs)
        printed = " / ".join(f"{v:g}" for v in ABLATION[name]) if name in ABLATION else "-"
        if result is None:
            book.add(f"| {name} | {missing(checkpoint)} | | | | {printed} |")
            continue
        calm = book.run(f"calm-{slug(name)}", checkpoint, "impact", *args, *CALM)
        m, quiet = (r["metrics_without_falls"] for r in (result, calm or result))
        book.add(
            f"| {name} | {number(m['e_torso'])} | {number(m['e_upper'])} | {number(quiet['e_upper'])} "
            f"| {fallen(result)} | {printed} |"
        )
    trained = [(name, samples(book, name)) for name in ("cotap", "no-ratio", "torque-critic", "goals")]
    behind = ", ".join(f"`{name}` {n / 1e6:.1f} M" for name, n in trained if n)
    book.add(
        "",
        f"One seed each, distilled from the same base. Samples behind each: {behind or 'none measured'}.",
        "",
    )
    for other, row in (("without the ratio", "without-the-ratio"), ("without training", "no-training")):
        for push, kind in (("", "ablation"), (", without the push", "calm")):
            claim = f"e_upper of CoTaP below that {other}{push}"
            ordering(book, claim, f"{kind}-CoTaP", f"{kind}-{row}", "e_upper")


def periodic(book: Book) -> None:
    """Elbow torques under a slow load, beside statics."""
    from cotap.evaluation.periodic import PeriodicLoad

    book.add(
        "",
        "## Periodic load (the paper's Fig. 7)",
        "",
        "30 N in z with a period of 4 s on both hands, left arm alpha 0.7 with K_ee 500, right arm PD. "
        "The paper has the left elbow's torque much smaller and the left hand swinging more. A load this slow "
        "asks for gravity less J^T F, whatever the stiffness: that is the prediction beside it.",
        "",
    )
    for policy in POLICIES:
        result = book.run(
            f"periodic-{policy}", policy, "periodic-load", "--left", "cotap:alpha=0.7,stiffness=500", "--right", "pd"
        )
        if result is None:
            book.add(f"Policy `{policy}`: {missing(policy)}.", "")
            continue
        m = result["metrics_without_falls"]
        book.add(
            f"Policy `{policy}` ({fallen(result)} fell):",
            "",
            "| | left (alpha 0.7, K 500) | right (PD) | left over right |",
            "|---|---|---|---|",
        )
        for label, key, digits in (
            ("elbow torque, amplitude [Nm]", "elbow_amplitude", 2),
            ("the same from statics [Nm]", "elbow_amplitude_static", 2),
            ("elbow torque, rms [Nm]", "elbow_rms", 2),
            ("the same from statics [Nm]", "elbow_rms_static", 2),
            ("hand swing in z, amplitude [m]", "hand_swing", 3),
        ):
            ratio = number(m[f"{key}_ratio"]) if f"{key}_ratio" in m else "-"
            book.add(
                f"| {label} | {number(m[f'{key}_left'], digits)} | {number(m[f'{key}_right'], digits)} | {ratio} |"
            )
        path = book.figure(f"periodic_load_{policy}", f"Periodic load, policy {policy}; dotted: statics.")
        PeriodicLoad().plot(path, result)
        book.add("")


def torque_observation(book: Book) -> None:
    """Velocity error with and without arm torque in the actor's observation."""
    book.add(
        "",
        "## Arm torque in the observation (the paper's Fig. 8)",
        "",
        "Walking at 0.5 m/s without disturbance, arms at K_ee 300 following the training mixture.",
        "",
        "| policy | abs. velocity error x [m/s] | y [m/s] | e_torso [m/s] | fell |",
        "|---|---|---|---|---|",
    )
    curves = {}
    for label, checkpoint in (
        ("torque in actor's observation", "cotap"),
        ("torque in critic's", "torque-critic"),
    ):
        result = book.run(
            f"observation-{checkpoint}",
            checkpoint,
            "impact",
            "--mode",
            "walking",
            "--force",
            "0",
            "0",
            "0",
            "--method",
            "cotap",
            "--motion",
            "mixture",
            "--window",
            "0",
            "7",
            "--episode-seconds",
            "8",
        )
        if result is None:
            book.add(f"| {label} | {missing(checkpoint)} | | | |")
            continue
        m = result["metrics_without_falls"]
        book.add(
            f"| {label} | {number(m['e_torso_x'])} | {number(m['e_torso_y'])} | {number(m['e_torso'])} "
            f"| {fallen(result)} |"
        )
        for axis in "xy":
            curves[f"{label}, {axis}"] = (
                result["curve"]["time"],
                result["curve"].get(f"velocity_error_{axis}_abs", []),
            )
    book.add("")
    for measure, what in (("e_torso_x", "Error in x"), ("e_torso_y", "Error in y"), ("e_torso", "e_torso")):
        claim = f"{what} with torque in the actor's observation below that without"
        ordering(book, claim, "observation-cotap", "observation-torque-critic", measure, 4)
    if curves:
        plot_curves(
            book.figure("torque_observation", "Absolute velocity error from the first step on, mean over envs."),
            curves,
            "time since the window began, 1 s after the start [s]",
            "absolute velocity error [m/s]",
        )


def fidelity(book: Book, quick: bool) -> None:
    """How close the felt stiffness is to the commanded one."""
    book.add(
        "",
        "## Fidelity",
        "",
        "Stance, pelvis free, no randomisation: error of the stiffness felt at the left hand, relative to the torso, "
        "against the commanded one of 100, 200, 400 and 800 N/m, on each axis, over poses with condition number up to "
        "8, under loads that should move the hand by 2 cm and need at most nine tenths of the arm's torque (the others "
        "are counted as not tried). Errors by axis are of the mean over poses, which single poses' errors of both "
        "signs leave small; those beside them are of single hands. Aimed at: 12 % with the joint error, 6 % with the "
        "task error.",
        "",
        "| policy | error | largest error | by axis: worst of x / y / z, with 95 % interval "
        "| single hands: median, 95 % within | hands that did not go where the load is | not tried "
        "| cover of the shipped motion | fell |",
        "|---|---|---|---|---|---|---|---|---|",
    )
    rows = [(policy, policy, []) for policy in POLICIES]
    rows.append((f"{POLICIES[-1]}, without its arm actions", POLICIES[-1], ["--upper-actions", "reference"]))
    size = 48 if quick else 384
    for label, policy, args in rows:
        for error in ("joint", "task"):
            name = f"fidelity-{slug(label)}-{error}"
            result = book.run(name, policy, "fidelity", "--error", error, *args, envs=size)
            if result is None:
                book.add(f"| {label} | {error} | {missing(policy)} | | | | | | |")
                continue
            single = result["error_quantiles"]
            worst = [worst_error([r for r in result["fidelity"] if r["axis"] == axis]) for axis in "xyz"]
            book.add(
                f"| {label} | {error} | {largest_error(result['fidelity'])} | {' / '.join(worst)} "
                f"| {share(single['50'], 1)}, {share(single['95'])} "
                f"| {result['num_wrong_way']} | {result['num_unholdable']} | {result['coverage']:.0%} "
                f"| {result['num_falls']} of {result['num_envs']} |"
            )


def share(value: float | None, digits: int = 0) -> str:
    """A share in percent; among hands some of which went the wrong way it may have no bound."""
    return "no bound" if value is None else f"{value:.{digits}%}"


def largest_error(rows: list[dict[str, Any]]) -> str:
    """The largest of these errors of fidelity; one without bound is the largest of all."""
    measured = [r["error"] for r in rows if r["n"] > 0]
    if not measured:
        return "-"
    return "no bound" if None in measured else f"{max(abs(e) for e in measured):.0%}"


def worst_error(rows: list[dict[str, Any]]) -> str:
    """The largest of these errors of fidelity with its sign and interval."""
    measured = [r for r in rows if r["n"] > 0]
    if not measured or None in [r["error"] for r in measured]:
        return largest_error(rows)
    worst = max(measured, key=lambda r: abs(r["error"]))
    interval = f" ({worst['ci95'][0]:+.0%} to {worst['ci95'][1]:+.0%})" if worst.get("ci95") else ""
    return f"{worst['error']:+.0%}{interval}"


def robustness(book: Book, quick: bool) -> None:
    """Fall curves, the punch tour, stiffness changed all the time, a push, uneven ground."""
    book.add("", "## Beyond the paper", "", "| test | policy | arms | result |", "|---|---|---|---|")
    laws = {"PD": ["--method", "pd"], "CoTaP, K 300": ["--method", "cotap"]}
    curves = {}
    for policy in POLICIES:
        for label, law in laws.items():
            key = f"{policy}-{slug(label)}"
            result = book.run(f"fall-curve-{key}", policy, "fall-curve", *law, "--hand", "left")
            if result is None:
                book.add(f"| all | {policy} | {label} | {missing(policy)} |")
                continue
            curves[f"{policy}, {label}"] = result
            book.add(
                f"| impulse at the left hand at which half fall [N s] | {policy} | {label} "
                f"| {number(result['impulse_50'], 1)} |"
            )
            shorter = ["--waypoints", "4", "--episode-seconds", "20"] if quick else []
            result = book.run(f"tour-{key}", policy, "tour", *law, *shorter, envs=64 if quick else PUNCHED)
            if result:
                walk = result["settings"]
                book.add(
                    f"| punch tour, {walk['waypoints']} waypoints in {walk['episode_seconds']:g} s, "
                    f"completed ({result['num_envs']} envs) | {policy} "
                    f"| {label} | {number(result['metrics']['completed_fraction'], 2)} |"
                )
            result = book.run(
                f"push-{key}",
                policy,
                "impact",
                *law,
                "--place",
                "base",
                "--force",
                "300",
                "0",
                "0",
                "--duration",
                "0.1",
                "--random-direction",
                "--mode",
                "walking",
            )
            if result:
                book.add(
                    f"| push of 30 N s on the pelvis while walking, fell | {policy} | {label} | {fallen(result)} |"
                )
            result = book.run(
                f"uneven-{key}",
                policy,
                "impact",
                *law,
                "--mode",
                "walking",
                "--unevenness",
                "0.03",
                "--force",
                "0",
                "0",
                "0",
                "--window",
                "0",
                "9",
                "--episode-seconds",
                "10",
            )
            if result:
                book.add(f"| walking on ground uneven by 3 cm for 10 s, fell | {policy} | {label} | {fallen(result)} |")
        for label, args in (("while walking", ["--mode", "walking"]), ("under 15 N", ["--force", "0", "0", "-15"])):
            result = book.run(f"modulation-{policy}-{slug(label)}", policy, "modulation", *args)
            if result:
                m = result["metrics"]
                book.add(
                    f"| stiffness 80 to 1200 N/m and alpha 0 to 1 stepped and ramped for 10 s, {label} | {policy} "
                    f"| CoTaP | {result['num_falls']} of {result['num_envs']} fell; peak torque "
                    f"{number(m['peak_torque'], 1)} Nm, energy {number(m['energy'], 0)} J |"
                )
    if curves:
        draw_fall_curves(
            book.figure("fall_curve", "Share of envs that fall within 3 s of a push on the left hand."), curves
        )


def draw_fall_curves(path: Path, results: dict[str, dict[str, Any]]) -> None:
    """All fall curves on one axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from cotap.evaluation.fall_curve import draw_fall_curve
    from cotap.evaluation.report import save_figure

    figure, axis = plt.subplots(figsize=(7.0, 4.2), constrained_layout=True)
    for (label, result), color in zip(results.items(), ("#cb181d", "#2171b5", "#fb6a4a", "#6baed6"), strict=False):
        draw_fall_curve(axis, result, color, label)
    axis.set(xlabel="impulse [N s]", ylabel="share of envs that fell", ylim=(-0.02, 1.02))
    axis.grid(alpha=0.2)
    axis.legend(frameon=False)
    save_figure(figure, path)


def frames(book: Book) -> None:
    """Pictures as in the paper's Fig. 1, 5 and 6."""
    book.add("", "## Pictures", "", "Blue balls: the hands' reference. Red: the force.")
    policy = next((name for name in POLICIES if book.has(name)), "")
    if not policy:
        book.add("", f"Not drawn: {missing(POLICIES[0])}.")
        return
    checkpoint = book.policies[policy]
    load = ["constant-load", "--num-envs", "1", "--no-randomize", "--checkpoint", checkpoint]
    stiff = ["--method", "cotap", "--stiffness", "300", "300"]
    picture(
        book,
        "fig1",
        f"A load of -50 N at K_z 100 and 1000 N/m (the paper's Fig. 1), policy {policy}.",
        [("K_z 100", [*load, *stiff, "100"], (3.5,)), ("K_z 1000", [*load, *stiff, "1000"], (3.5,))],
    )
    punch = [
        "impact",
        "--num-envs",
        "1",
        "--no-randomize",
        "--checkpoint",
        checkpoint,
        "--mode",
        "walking",
        "--motion",
        "punch",
        "--seed",
        "1",  # one in which it keeps its feet
        *ARMS["alpha 0.7, K 100"],
    ]
    picture(
        book,
        "fig5",
        f"500 N for 50 ms while walking and punching, alpha 0.7 (the paper's Fig. 5), policy {policy}; "
        "a run in which it keeps its feet, which not all robots do (table above).",
        [("", punch, (1.0, 1.04, 1.2, 1.4, 1.8, 2.6))],
    )
    singular(book)


def singular(book: Book) -> None:
    """A reference with stretched arms, with and without the ratio: how far the arms stay from it, and a picture."""
    rows = {
        "with the ratio": ("cotap", []),
        "trained without the ratio": ("no-ratio", ["--singularity-ratio", "False"]),
        "ratio left out of the law alone": ("cotap", ["--singularity-ratio", "False"]),
    }
    book.add(
        "",
        "### Singular postures (the paper's Fig. 6)",
        "",
        "A reference with both arms stretched forward, condition number 26, K_ee 100, standing; and the same with "
        "500 N for 50 ms backward on the left hand after 1 s. Window 1.5 to 3 s after the start.",
        "",
        "| what | e_upper at rest [rad] | e_upper after the push [rad] | e_ee of the hand that is hit [m] | fell |",
        "|---|---|---|---|---|",
    )
    straight = ["impact", *ARMS["K 100"], *STRAIGHT, "--window", "0.5", "2"]
    for label, (name, args) in rows.items():
        rest = book.run(f"singular-rest-{slug(label)}", name, *straight, *CALM, *args)
        push = book.run(f"singular-{slug(label)}", name, *straight, *BACK, *args)
        if rest is None or push is None:
            book.add(f"| {label} | {missing(name)} | | | |")
            continue
        at_rest, after = (r["metrics_without_falls"] for r in (rest, push))
        book.add(
            f"| {label} | {number(at_rest['e_upper'])} | {number(after['e_upper'])} | {number(after['e_ee_hit'])} "
            f"| {fallen(push)} |"
        )
    book.add("")
    for when, row in (("at rest", "singular-rest"), ("after the push", "singular")):
        ordering(
            book, f"e_upper {when} with the ratio below that of the policy trained without it",
            f"{row}-with-the-ratio", f"{row}-trained-without-the-ratio", "e_upper",
        )  # fmt: skip
    one = [*straight, *BACK, "--num-envs", "1", "--no-randomize"]
    shown = [
        (label, [*one, "--checkpoint", book.policies[name], *args], (2.2,))
        for label, (name, args) in rows.items()
        if book.has(name)
    ]
    if shown:
        picture(book, "fig6", "One robot 1.2 s after the push. Blue balls: where the reference has its hands.", shown)


def main() -> int:
    """Parse, run everything, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="128 envs a row; minutes instead of hours")
    parser.add_argument("--num-envs", type=int, default=0, help="envs a row; 4096, or 128 with --quick")
    parser.add_argument("--threads", type=int, default=0, help="0 takes every CPU")
    parser.add_argument("--motion", default="mixture", help="the arms' reference in the impact tables")
    parser.add_argument(
        "--out",
        type=Path,
        default=None,
        help="folder of results.md; docs, with --only runs/paper",
    )
    parser.add_argument("--reuse", action="store_true", help="keep evaluations that are there already")
    parser.add_argument(
        "--policies", nargs="*", default=[], metavar="NAME=CHECKPOINT",
        help="policies of ablations (no-ratio, torque-critic, goals), or others in place of the shipped cotap and base",
    )  # fmt: skip
    parser.add_argument("--only", nargs="*", default=[], help=f"parts: {', '.join(PARTS)}")
    options = parser.parse_args()
    unknown = sorted(set(options.only) - PARTS.keys())
    if unknown:
        parser.error(f"--only {unknown[0]!r} is unknown; parts: {', '.join(PARTS)}")
    # A part alone is no page to put in the place of the whole one.
    folder = options.out or Path("runs/paper-quick" if options.quick else "runs/paper" if options.only else "docs")
    out = folder / "results"
    evaluations = Path("runs/paper-quick" if options.quick else "runs/paper") / "evaluations"
    for path in (out, evaluations):
        path.mkdir(parents=True, exist_ok=True)
    policies = SHIPPED | {name: path for name, _, path in (text.partition("=") for text in options.policies)}
    envs = options.num_envs or (128 if options.quick else 4096)
    book = Book(out, evaluations, envs, options.threads, options.reuse, policies)
    book.add(
        *HEAD.format(
            command=" ".join(["python -m reports.reproduce_paper", *sys.argv[1:]]), envs=book.envs
        ).splitlines()
    )
    for name, part in PARTS.items():
        if not options.only or name in options.only:
            part(book, options)
    write(folder, book)
    return 0


HEAD = """# The paper's tables and figures, measured here

Written by `{command}`: do not edit. {envs} envs a row unless said otherwise; means with bootstrap 95 %
intervals over the envs that stood (shares of falls: all envs, to the end of the episode, Wilson's). Impact: 500 N
for 50 ms at the left hand, +x in stance, in a random horizontal direction while walking at 0.5 m/s; window 1 s from the
onset at 1 s of 3 s; friction, masses, gains and delay randomised; H1's own torque limits unless a factor is named.
Every policy is simulated as it was trained, with legs, arms and torso that collide. One training seed stands behind
each: intervals are over envs, not over trainings. Differences between two rows are taken env by env, over
those that stood in both, and begin with the same friction, masses, motion and direction. The paper's figures (Isaac
Gym, 4096 envs, window and torque limits not given) stand beside ours: orderings and ratios are what compares, not
digits, and [where they differ](#where-ours-differs-and-why) the page says why.

Its Table I (properties of laws) is in [laws](laws/properties.md), its Table VI (static error) in
[laws under a static load](laws/static.md), its Fig. 9 (after an impact) in [laws after a push](laws/transient.md); all
else of its evaluation is here.
"""


def impact_part(book: Book, options: argparse.Namespace) -> None:
    """All impact tables."""
    book.add("", "## Impact (the paper's Table III)")
    for policy in POLICIES:
        for mode in MODES:
            impacts(book, mode, policy, 1.0, options.motion)
    impacts(book, "stance", POLICIES[0], SCALED, options.motion)
    impacts(book, "stance", POLICIES[1], SCALED, options.motion)


PARTS = {
    "impact": impact_part,
    "load": lambda book, _: constant_loads(book),
    "ablation": lambda book, options: ablations(book, options.motion, options.quick),
    "periodic": lambda book, _: periodic(book),
    "observation": lambda book, _: torque_observation(book),
    "fidelity": lambda book, options: fidelity(book, options.quick),
    "robustness": lambda book, options: robustness(book, options.quick),
    "frames": lambda book, _: frames(book),
    "differences": lambda book, _: differences(book),
}


if __name__ == "__main__":
    sys.exit(main())

"""Walking with and without the arms' torque in the actor's observation: the paper's Fig. 8."""

from __future__ import annotations

from reports.paper.ablation import samples, twin
from reports.paper.arms import CALM
from reports.paper.book import Book
from reports.paper.figures import plot_curves
from reports.paper.words import change, fallen, missing, number, the_paper, verdict

ROWS = {
    "in the actor's observation": "cotap",
    "in the actor's, seed 0": "seed-0",
    "in the critics' only": "torque-critic",
}
WINDOW = ["--window", "0", "7", "--episode-seconds", "8"]
WHY = """{paper} shows errors that are notably larger without the torque, of one robot that steps in MuJoCo after a
training in Isaac Gym. From `{twin}` to the ablation, e_torso of ours changes by {change} m/s, x by {x}, y by {y}. Ours
walks in the simulator that it was trained in, and the ablation begins from the same base, refitted to what it sees."""


def observation(book: Book) -> None:
    """Velocity error with and without arm torque in the actor's observation."""
    book.add("", "## Arm torque in the observation (the paper's Fig. 8)")
    book.paragraph("Walking at 0.5 m/s without a push, arms moving, K_ee 300, from 1 to 8 s.")
    book.table(
        "arm torque",
        "samples [M]",
        "absolute velocity error, x [m/s]",
        "y [m/s]",
        "e_torso [m/s]",
        "fell [%]",
        book.paper,
    )
    curves = {}
    for name, policy in ROWS.items():
        options = ["--mode", "walking", "--method", "cotap", "--stiffness", "300", *CALM, *WINDOW]
        result = book.run(f"observation-{policy}", policy, "impact", *options)
        paper = "larger" if policy == "torque-critic" else "-"
        if result is None:
            book.row(name, missing(policy), last=paper)
            continue
        m = result["metrics_without_falls"]
        errors = (number(m[measure]) for measure in ("e_torso_x", "e_torso_y", "e_torso"))
        book.row(name, samples(book, policy), *errors, fallen(result), last=paper)
        for axis in "xy":
            curves[f"{name}, {axis}"] = (result["curve"]["time"], result["curve"].get(f"velocity_error_{axis}_abs", []))
    if book.has("torque-critic"):
        compare(book)
    if curves:
        path = book.figure("torque_observation", "Absolute velocity error, mean over envs that stood.")
        plot_curves(path, curves, "time since 1 s after the start [s]", "absolute velocity error [m/s]")


def compare(book: Book) -> None:
    """The ablation against the policy that sees the torque."""
    rows = (f"observation-{twin(book)}", "observation-torque-critic")
    values = {"change": "e_torso", "x": "e_torso_x", "y": "e_torso_y"}
    changes = {key: change(book, *rows, value) for key, value in values.items()}
    book.paragraph(WHY, paper=the_paper(book), twin=twin(book), **changes)
    book.paragraph("That the error is larger without the torque: {found}.", found=verdict(book, *rows, "e_torso"))

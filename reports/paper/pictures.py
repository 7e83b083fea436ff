"""Pictures as in the paper's Fig. 1, 5 and 6."""

from __future__ import annotations

from reports.paper.ablation import WITHOUT_RATIO
from reports.paper.arms import cotap
from reports.paper.book import Book
from reports.paper.figures import draw_pictures
from reports.paper.words import missing

ONE = ["--num-envs", "1", "--no-randomize"]
STRAIGHT = (-1.5, 0.3, 0.0, 1.35)
"""Joints of a left arm that is stretched forward, all but straight, from the shoulder to the elbow [rad]; those of a
wrist are 0."""
RATIO = {
    "with the ratio": ("cotap", []),
    "trained without": ("no-ratio", WITHOUT_RATIO),
    "left out of the law alone": ("cotap", WITHOUT_RATIO),
}


def pictures(book: Book) -> None:
    """All three."""
    book.add("", "## Pictures", "", "One robot each. Blue balls: the reference of the hands. Red: the force.")
    if not book.has("cotap"):
        book.add("", f"Not drawn: {missing('cotap')}.")
        return
    policy = ["--checkpoint", book.policies["cotap"]]
    load = ["constant-load", *ONE, *policy]
    draw_pictures(
        book, "fig1", "A load of -50 N at K_z 100 and 1000 N/m (the paper's Fig. 1).",
        [(f"K_z {k}", [*load, *cotap(300, 300, k)], (3.5,)) for k in (100, 1000)],
    )  # fmt: skip
    punch = ["impact", *ONE, *policy, "--mode", "walking", "--motion", "punch", *cotap(100, 100, 300, 0.7)]
    draw_pictures(
        book, "fig5", "500 N for 50 ms while walking and punching, alpha 0.7 (the paper's Fig. 5).",
        [("", punch, (1.0, 1.04, 1.2, 1.4, 1.8, 2.6))],
    )  # fmt: skip
    stretched(book)


def stretched(book: Book) -> None:
    """Arms whose reference is all but straight, after a push, with the ratio and without."""
    pose, condition = straight_arm(book.robot)
    push = ["impact", *ONE, "--motion", "none", "--arm-pose", *(f"{value:g}" for value in pose), "--force", "-500"]
    shots = [
        (name, [*push, "0", "0", *cotap(100, 100, 300), *options, "--checkpoint", book.policies[policy]], (2.2,))
        for name, (policy, options) in RATIO.items()
        if book.has(policy)
    ]
    caption = (
        f"Arms stretched forward (condition number {condition:.0f}), 1.2 s after a push of 500 N for 50 ms backward"
    )
    left_out = "" if book.has("no-ratio") else f" Trained without the ratio: {missing('no-ratio')}."
    draw_pictures(book, "fig6", f"{caption} (the paper's Fig. 6).{left_out}", shots)


def straight_arm(robot: str) -> tuple[tuple[float, ...], float]:
    """A left arm stretched forward [rad], and the condition number of its hand's Jacobian."""
    import torch

    from cotap.compliance import condition_number
    from cotap.robots import ROBOTS
    from cotap.robots.chains import arm_chains

    spec = ROBOTS[robot]()
    joints = len(spec.arms[0].joints)
    pose = (*STRAIGHT, *[0.0] * (joints - len(STRAIGHT)))
    chains = arm_chains(spec)
    both = torch.tensor(pose).expand(1, len(spec.arms), joints)
    return pose, float(condition_number(chains.jacobian(chains.pose(both)))[0, 0])

"""The punch tour: legs under arms that others move, in two engines, beside the figures that others have published."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from cotap.evaluation.tour.field import COLUMNS, FIELD, ROBOT
from reports.paper.book import Book, slug
from reports.paper.words import missing, scaled

PD, SOFT = "PD", "CoTaP, K 300"
LAWS = {PD: ["--method", "pd"], SOFT: ["--method", "cotap", "--stiffness", "300"]}
ROWS = (("base", PD), ("cotap", PD), ("cotap", SOFT))
"""Policies, and what drives their arms."""
RUNS = {"mujoco": 512, "pybullet": 50}
"""Most runs of a row by engine: a run takes twenty times as long as an env of any other test."""
ENGINES = {"mujoco": "MuJoCo", "pybullet": "PyBullet"}
SHORT = ["--waypoints", "4", "--episode-seconds", "20"]
MEASURES = COLUMNS | {"vibration": ("vibration [krad/s²]", 1e-3)}
WHAT = """{length}: what happens, what is measured, and how it differs from the [benchmark]({field}) is on
[its own page](tour.md). Arms follow the tour alone, without the policy's own arm actions; robots are nominal. PD has
the gains of the tour (kp {kp} Nm/rad)."""
HELP = """Whether arms under CoTaP help: with the CoTaP policy, K 300 less PD. Survival is compared run by run, energy
and vibration over the runs that both completed; the others by the intervals of both rows."""
FIELD_URL = "https://github.com/rhoyn/teleop-walking-benchmark"


def tour(book: Book) -> None:
    """All rows in the engines that are there, and what CoTaP changes."""
    engines = [engine for engine in RUNS if engine == "mujoco" or find_spec(engine)]
    book.add("", "## The punch tour")
    length = "4 of 18 waypoints of the tour" if book.quick else "The whole tour"
    book.paragraph(WHAT, length=length, field=FIELD_URL, kp=arm_gains(book.robot))
    book.table("policy", "arms", "engine", "runs", *(title for title, _ in MEASURES.values()))
    for engine in engines:
        for policy, arms in ROWS:
            show(book, engine, policy, arms)
    if book.robot == ROBOT and not book.quick:
        for row in FIELD:
            name, *cells = row.cells()
            book.row(name, PD, "MuJoCo / PhysX", "512 or more", *cells)
    if "pybullet" not in engines:
        book.paragraph("PyBullet is not installed (`pip install 'cotap[pybullet]'`): not measured there.")
    compare_laws(book, engines)


def show(book: Book, engine: str, policy: str, arms: str) -> None:
    """Measure a policy in an engine, and add its row."""
    options = ["--engine", engine, *LAWS[arms], *(SHORT if book.quick else [])]
    runs = min(RUNS[engine], book.envs)
    result = book.run(key(engine, policy, arms), policy, "tour", *options, envs=runs)
    if result is None:
        return book.row(policy, arms, ENGINES[engine], missing(policy))
    cells = (scaled(result["metrics"][measure], scale) for measure, (_, scale) in MEASURES.items())
    return book.row(policy, arms, ENGINES[engine], str(runs), *cells)


def compare_laws(book: Book, engines: list[str]) -> None:
    """The table of what CoTaP changes in each engine."""
    book.paragraph(HELP)
    book.table("measure", *(ENGINES[engine] for engine in engines))
    for measure, (title, scale) in MEASURES.items():
        book.row(title, *(change(book, engine, measure, scale) for engine in engines))


def change(book: Book, engine: str, measure: str, scale: float) -> str:
    """The difference of a measure from PD to CoTaP, and what it means."""
    from cotap.compare import judged, measure_difference

    rows: list[dict[str, Any] | None] = [book.results.get(key(engine, "cotap", arms)) for arms in (PD, SOFT)]
    if rows[0] is None or rows[1] is None:
        return missing("cotap")
    d = judged(measure, measure_difference(rows[0], rows[1], measure, without_falls=False))
    book.differences[f"tour, {engine}: {measure}"] = d
    return f"{scaled({**d, 'mean': d['difference']}, scale)} {d['b_is']}".strip()


def key(engine: str, policy: str, arms: str) -> str:
    """The name of a row's evaluation."""
    return f"tour-{engine}-{policy}-{slug(arms)}"


def arm_gains(robot: str) -> str:
    """Position gains of the arms under PD on the tour [Nm/rad], the least and the largest."""
    from cotap.evaluation.tour.stance import tour_stance
    from cotap.robots import ROBOTS

    gains = tour_stance(ROBOTS[robot]()).arm_kp
    return " to ".join(dict.fromkeys(f"{bound:.0f}" for bound in (float(gains.min()), float(gains.max()))))

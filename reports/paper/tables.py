"""What the paper printed (arXiv 2509.25443), for comparison."""

from __future__ import annotations

PAPER_ROBOT = "h1"
"""What it measured all of this on."""
IMPACT = {
    "stance": {
        "PD": (0.701, 0.092, 49.723), "soft PD": (0.670, 0.110, 43.627), "K 100": (0.861, 0.101, 46.664),
        "K 500": (0.759, 0.095, 48.648), "K 800": (0.771, 0.096, 50.812),
        "alpha 0.3, K 100": (0.711, 0.093, 48.478), "alpha 0.7, K 100": (0.758, 0.096, 47.507),
    },
    "walking": {
        "PD": (2.126, 0.090, 50.811), "soft PD": (2.071, 0.112, 44.440), "K 100": (2.194, 0.100, 46.541),
        "K 500": (2.153, 0.094, 49.169), "K 800": (2.154, 0.094, 51.565),
        "alpha 0.3, K 100": (2.106, 0.092, 48.944), "alpha 0.7, K 100": (2.123, 0.095, 47.524),
    },
}  # fmt: skip
"""Table III: e_torso [m/s], e_ee [m], J_upper [Nm], by mode and arms."""
ORDERINGS = (
    ("e_torso", "PD", "K 100"), ("e_torso", "soft PD", "PD"), ("e_torso", "K 500", "K 100"),
    ("e_torso", "alpha 0.7, K 100", "K 100"),
    ("e_ee", "PD", "K 100"), ("e_ee", "PD", "soft PD"), ("e_ee", "K 500", "K 100"),
    ("e_ee", "alpha 0.7, K 100", "K 100"),
    ("j_upper", "soft PD", "PD"), ("j_upper", "K 100", "K 500"), ("j_upper", "K 500", "K 800"),
    ("j_upper", "K 100", "alpha 0.7, K 100"), ("j_upper", "alpha 0.7, K 100", "alpha 0.3, K 100"),
    ("j_upper", "alpha 0.3, K 100", "PD"),
)  # fmt: skip
"""What Table III shows in both modes: a measure, arms under which it is smaller, arms under which it is larger."""
LOAD = {"K_z 100": "about 0.12 m", "K_z 500": "about 0.05 m", "PD": "about -0.03 m (reversed)", "alpha 0.5": "damped"}
"""Fig. 4: hand error in z under -50 N."""
ABLATION = {"no training": (0.950, 0.252), "without the ratio": (1.008, 0.517), "CoTaP": (0.861, 0.107)}
"""Table IV: e_torso [m/s], e_upper [rad]."""
STATIC = {
    "cotap, joint error": (-0.003, -0.015, 0.058),
    "facet": (0.043, 0.068, 0.106),
    "cotap+facet, joint error": (0.032, 0.046, 0.097),
}
"""Table VI: displacement of the hand in z under 10, 30 and 50 N at 500 N/m [m]."""
PROPERTIES = {
    "dcc": "no / yes / no", "pd": "no / no / no (FALCON)", "facet": "yes / no / no", "hmc": "yes / yes / no",
    "cotap": "yes / yes / yes",
}  # fmt: skip
"""Table I: adjustable / model-aware / stability-accounted, by law."""

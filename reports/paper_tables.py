"""What the paper printed (arXiv 2509.25443), for comparison."""

from __future__ import annotations

ROWS = ("PD, kp 100", "soft PD, kp 30", "K 100", "K 500", "K 800", "alpha 0.3, K 100", "alpha 0.7, K 100")
IMPACT = {
    "stance": (
        (0.701, 0.092, 49.723), (0.670, 0.110, 43.627), (0.861, 0.101, 46.664), (0.759, 0.095, 48.648),
        (0.771, 0.096, 50.812), (0.711, 0.093, 48.478), (0.758, 0.096, 47.507),
    ),
    "walking": (
        (2.126, 0.090, 50.811), (2.071, 0.112, 44.440), (2.194, 0.100, 46.541), (2.153, 0.094, 49.169),
        (2.154, 0.094, 51.565), (2.106, 0.092, 48.944), (2.123, 0.095, 47.524),
    ),
}  # fmt: skip
"""Table III: e_torso [m/s], e_ee [m], J_upper [Nm], in the order of `ROWS`."""
LOAD = {"K_z 100": "about 0.12 m", "K_z 500": "about 0.05 m", "PD": "about -0.03 m (reversed)", "alpha 0.5": "damped"}
"""Fig. 3: hand error in z under -50 N."""
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

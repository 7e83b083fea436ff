"""Which files are mutated, and which tests are meant to notice."""

from __future__ import annotations

HELP = "tests/test_command_line.py::test_help_is_what_the_parsers_read"
"""Knows the default of every option."""
LAWS, PASSIVE, STIFFNESS, SPD = (f"tests/compliance/test_{n}.py" for n in ("laws", "passive_law", "stiffness", "spd"))
AUTOCAST, ADMITTANCE, SMALL = (f"tests/compliance/test_{n}.py" for n in ("autocast", "admittance", "small_matrices"))
PASSIVITY, DYNAMICS, KINEMATICS, INVERSE, TORSO = (
    f"tests/compliance/test_{n}.py" for n in ("passivity", "dynamics", "kinematics", "inverse_kinematics", "torso")
)
LOOP, STOP, ENGINES, EXPORT, ONNX_FILE = (
    f"tests/deployment/test_{n}.py" for n in ("loop", "stop", "engines", "export", "onnx_file")
)
TOUR, TRIAL_ROWS = (f"tests/deployment/test_{n}.py" for n in ("tour_in_engine", "trial_rows"))

ROOMS: dict[str, dict[str, tuple[str, ...]]] = {
    "compliance": {
        "src/cotap/compliance/__init__.py": (SPD,),
        "src/cotap/compliance/admittance.py": (ADMITTANCE,),
        "src/cotap/compliance/arguments.py": (AUTOCAST, SPD, STIFFNESS),
        "src/cotap/compliance/arm_kinematics.py": (STIFFNESS,),
        "src/cotap/compliance/dynamics.py": (DYNAMICS, AUTOCAST, LAWS),
        "src/cotap/compliance/fast.py": (LAWS, STIFFNESS),
        "src/cotap/compliance/force_estimation.py": (AUTOCAST, "tests/envs/test_hand_sensing.py"),
        "src/cotap/compliance/geodesic.py": (PASSIVE, PASSIVITY),
        "src/cotap/compliance/impedance.py": (LAWS, AUTOCAST),
        "src/cotap/compliance/interface.py": (LAWS, ADMITTANCE, PASSIVE),
        "src/cotap/compliance/inverse_kinematics.py": (INVERSE, ADMITTANCE),
        "src/cotap/compliance/kinematics.py": (KINEMATICS, DYNAMICS),
        "src/cotap/compliance/laws.py": (LAWS, ADMITTANCE, PASSIVE, HELP),
        "src/cotap/compliance/passive_law.py": (PASSIVE,),
        "src/cotap/compliance/passivity.py": (PASSIVITY,),
        "src/cotap/compliance/pose_task.py": ("tests/compliance/test_pose_task.py",),
        "src/cotap/compliance/small_matrices.py": (SMALL, DYNAMICS, STIFFNESS),
        "src/cotap/compliance/spd.py": (SPD, STIFFNESS),
        "src/cotap/compliance/stiffness.py": (STIFFNESS, LAWS),
        "src/cotap/compliance/torso.py": (TORSO,),
    },
    "agents' losses": {"src/cotap/agents/losses.py": ("tests/agents/test_losses.py",)},
    "evaluation metrics": {"src/cotap/evaluation/metrics.py": ("tests/evaluation/test_metrics.py",)},
    "rewards": {"src/cotap/envs/rewards.py": ("tests/envs/test_rewards.py", HELP)},
    "deployment": {
        "src/cotap/deployment/controller.py": (LOOP, STOP),
        "src/cotap/deployment/engines.py": (ENGINES, STOP),
        "src/cotap/deployment/golden.py": (EXPORT, "tests/deployment/test_example_runner.py"),
        "src/cotap/deployment/graph.py": (EXPORT,),
        "src/cotap/deployment/joint_law.py": (ENGINES, LOOP, STOP),
        "src/cotap/deployment/keyboard.py": (LOOP,),
        "src/cotap/deployment/metadata.py": (EXPORT,),
        "src/cotap/deployment/mujoco_engine.py": (ENGINES, STOP),
        "src/cotap/deployment/onnx_file.py": (ONNX_FILE,),
        "src/cotap/deployment/policy.py": (ONNX_FILE, LOOP, EXPORT),
        "src/cotap/deployment/pybullet_engine.py": (ENGINES, STOP),
        "src/cotap/deployment/robot.py": (LOOP, STOP),
        "src/cotap/deployment/rotors.py": (ENGINES,),
        "src/cotap/deployment/safety.py": (LOOP, STOP),
        "src/cotap/deployment/scenario.py": (LOOP, STOP),
        "src/cotap/deployment/terms.py": (EXPORT,),
        "src/cotap/deployment/tour.py": (TOUR,),
        "src/cotap/deployment/trial.py": (STOP, LOOP, TRIAL_ROWS),
        "src/cotap/deployment/trials.py": (LOOP,),
    },
}
"""Tests by file, by room; the first ones listed run first, and the first that fails ends a mutant's run."""

"""A robot of your own: the facts of its MJCF, and what is yours to choose."""

import sys
from pathlib import Path

from cotap.__main__ import main
from cotap.robots import ROBOTS, ArmSpec, FootSpec, RobotSpec
from cotap.robots.from_facts import Gains, robot_from_facts

SIDES = {"left": "l", "right": "r"}  # left first
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")


def my_robot() -> RobotSpec:
    return robot_from_facts(
        Path("robot.json"),
        name="my-robot",
        gains={  # by a part of the joint's name: kp [Nm/rad], kd [Nms/rad], and its default angle [rad]
            "hip": Gains(150.0, 4.0),
            "hip_pitch": Gains(150.0, 4.0, -0.2),
            "knee": Gains(200.0, 5.0, 0.4),
            "ankle": Gains(80.0, 3.0, -0.2),
            "waist": Gains(200.0, 5.0),
            "shoulder": Gains(60.0, 2.0),
            "elbow": Gains(60.0, 2.0),
        },
        torso_body="chest",
        # Joints from the torso to the hand; the hand's body and its point there [m]; the body that begins at the elbow.
        arms=tuple(
            ArmSpec(side, tuple(f"{s}_{part}" for part in ARM), f"{s}_forearm", (0.2, 0.0, 0.0), f"{s}_forearm")
            for side, s in SIDES.items()
        ),
        # The body that touches the ground, and the centre of its sole [m].
        feet=tuple(FootSpec(side, f"{s}_foot", (0.04, 0.0, -0.06)) for side, s in SIDES.items()),
    )


ROBOTS["my-robot"] = my_robot

if __name__ == "__main__":
    sys.exit(main())  # the command cotap, which now knows the robot

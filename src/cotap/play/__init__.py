"""A page in the browser on which anyone can push the robot and turn its stiffness: `cotap play`."""

ROBOTS = ("a", "b")
"""The two robots of the page; the second is shown in the side-by-side mode."""

"""A page in the browser on which anyone can push the robot and turn its stiffness: `python -m cotap.play`."""

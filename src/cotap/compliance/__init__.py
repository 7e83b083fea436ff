"""Kinematics of serial arms in pure torch: usable alone, without a simulator."""

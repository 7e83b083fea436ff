"""Policies out of the trainer: ONNX files, and one robot in a loop as it would run on hardware."""

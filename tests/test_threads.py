"""What importing the package does to torch's threads."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


@pytest.mark.slow
@pytest.mark.parametrize(("own", "expected"), [(None, "20000"), ("7", "7")])
def test_threads_of_torch_soon_stop_spinning_unless_told_otherwise(own, expected):
    """Before torch is loaded, which reads it only once."""
    env = {k: v for k, v in os.environ.items() if k != "GOMP_SPINCOUNT"} | ({"GOMP_SPINCOUNT": own} if own else {})
    code = """
import sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            import os
            print(os.environ.get("GOMP_SPINCOUNT"))
sys.meta_path.insert(0, Watch())
import cotap.envs
"""
    shown = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout
    assert shown.split() == [expected]

"""A quick start: what is loaded before the page answers, and before the robot walks."""

from __future__ import annotations

import gc
import subprocess
import sys

import pytest

from cotap.play.startup import uncollected

LOADED = """
import sys
import cotap.play.__main__, cotap.play.server, cotap.play.scene
assert "torch" not in sys.modules, "the page answers, and shows the robot, before torch is loaded"
import torch.compiler
before = torch.compiler.allow_in_graph, torch.compiler.assume_constant_result
import cotap.uncompiled
assert before == (torch.compiler.allow_in_graph, torch.compiler.assume_constant_result)
import cotap.play.app, cotap.play.session
assert "torch._dynamo" not in sys.modules, "torch's compiler was loaded"
assert "rsl_rl.runners" not in sys.modules, "what trains was loaded"
from tensordict import TensorDict
both = torch.stack([TensorDict({"a": torch.ones(3)}, batch_size=[3])] * 2)
assert both.lock_().unlock_()["a"].shape == (2, 3)
"""


@pytest.mark.slow
def test_the_page_answers_without_torch_and_the_simulation_runs_without_its_compiler():
    subprocess.run([sys.executable, "-c", LOADED], check=True)


def fail() -> None:
    assert not gc.isenabled()
    raise ValueError("no such policy")


def test_garbage_is_collected_again_whatever_happens_while_loading():
    before = gc.get_freeze_count()
    with pytest.raises(ValueError, match="no such policy"), uncollected():
        fail()
    assert gc.isenabled()
    assert gc.get_freeze_count() > before
    gc.unfreeze()

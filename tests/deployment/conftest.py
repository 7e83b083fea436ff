from __future__ import annotations

from pathlib import Path

import pytest

from cotap.deployment.graph import export_policy
from cotap.deployment.policy import OnnxPolicy
from cotap.evaluation.policy import shipped_checkpoint


@pytest.fixture(scope="session")
def policy_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped base policy as ONNX."""
    path = tmp_path_factory.mktemp("policy") / "base.onnx"
    export_policy(shipped_checkpoint("base"), path, checks=50)
    return path


@pytest.fixture(scope="session")
def policy(policy_file: Path) -> OnnxPolicy:
    return OnnxPolicy(policy_file)

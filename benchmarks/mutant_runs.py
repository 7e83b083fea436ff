"""Runs tests on mutants, in a copy of the repository, each in a fork of one process that has imported what is slow."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from benchmarks.mutant_rules import Mutant

SLOW_TO_IMPORT = (
    "torch", "torch._dynamo", "torch.export", "numpy", "scipy.spatial.transform", "mujoco", "tensordict", "gymnasium",
    "matplotlib.figure", "hypothesis", "pytest",
)  # fmt: skip
NOT_COPIED = (".*", "__pycache__", "*.egg-info", "runs", "site", "dist", "build")
PATIENCE, GRACE_S = 4.0, 20.0
"""A mutant is killed, too, if its tests take so many times as long as without it, and so much more."""


class Runner:
    """Tests of a copy of the repository."""

    def __init__(self, tree: Path) -> None:
        self._tree = tree
        self._seconds: dict[str, float] = {}
        for name in SLOW_TO_IMPORT:
            importlib.import_module(name)
        importlib.import_module("torch").set_num_threads(1)
        assert "cotap" not in sys.modules, "the fork must import the mutated modules itself"

    def check(self, file: str) -> float:
        """Time that a file of tests takes without a mutant [s]. Raises RuntimeError if one of them fails then."""
        if file not in self._seconds:
            begin = time.perf_counter()
            if self._pytest((file,), 3600.0, quiet=False) != 0:
                raise RuntimeError(f"{file} fails without a mutant")
            self._seconds[file] = time.perf_counter() - begin
        return self._seconds[file]

    def killed(self, mutant: Mutant, tests: tuple[str, ...]) -> bool:
        """Whether one of `tests` fails, or takes far too long, on the mutant."""
        limit = PATIENCE * sum(map(self.check, tests)) + GRACE_S
        file = self._tree / mutant.file
        original, times = file.read_text(encoding="utf-8"), file.stat()
        file.write_text(mutant.source(original), encoding="utf-8")
        try:
            return self._pytest(tests, limit) != 0
        finally:
            file.write_text(original, encoding="utf-8")
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))

    def _pytest(self, tests: Sequence[str], limit_s: float, quiet: bool = True) -> int:
        """Exit status of pytest in a fork that ends with all that it started, after `limit_s` at the latest."""
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            os._exit(self._in_fork(tests, limit_s, quiet))
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        return status

    def _in_fork(self, tests: Sequence[str], limit_s: float, quiet: bool) -> int:
        import pytest

        os.setsid()
        signal.setitimer(signal.ITIMER_REAL, limit_s)
        os.chdir(self._tree)
        sys.path[:0] = [str(self._tree / "src"), str(self._tree)]
        os.environ["PYTHONPATH"] = os.pathsep.join(sys.path[:2])
        if quiet:
            # The copies' compiled files are from the run without a mutant, and stay so.
            sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
            hole = os.open(os.devnull, os.O_WRONLY)
            os.dup2(hole, 1)
            os.dup2(hole, 2)
        order = ShortestFirst(self._tree / "durations.json", learn=not quiet)
        options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", "--hypothesis-seed=0", "-W", "ignore"]
        return int(pytest.main([*options, *tests], plugins=[order]))


class ShortestFirst:
    """Plugin of pytest: in each file the shortest test comes first, for it may be enough. Learns durations, or uses."""

    def __init__(self, file: Path, learn: bool) -> None:
        self._file, self._learn = file, learn
        self._seconds: dict[str, float] = json.loads(file.read_text()) if file.exists() else {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._seconds[report.nodeid] = self._seconds.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        if self._learn:
            self._file.write_text(json.dumps(self._seconds))

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        if not self._learn:
            files = list(dict.fromkeys(item.path for item in items))
            items.sort(key=lambda item: (files.index(item.path), self._seconds.get(item.nodeid, 0.0)))


@contextmanager
def copied_tree(root: Path) -> Iterator[Path]:
    """A copy of the repository that is removed afterwards: a run that is killed leaves no mutant in the original."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        tree = Path(folder) / root.name
        shutil.copytree(root, tree, ignore=shutil.ignore_patterns(*NOT_COPIED))
        yield tree

"""What is installed: dependencies where they belong, a wheel as one would publish it."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
MODULES = {"rsl-rl-lib": "rsl_rl", "pytorch-kinematics": "pytorch_kinematics", "mujoco-warp": "mujoco_warp",
           "warp-lang": "warp", "mujoco-menagerie": "mujoco_menagerie"}  # fmt: skip
"""Modules that are not called as their distributions."""
BROUGHT = {"PIL": "imageio", "trimesh": "viser", "pybullet_utils": "pybullet"}
"""Modules that come with others' dependencies."""
ROOMS = {"play": "play", "deployment": "deploy", "deploy.py": "deploy", "export.py": "deploy"}
"""Rooms that need more than the extra `train`."""
OPTIONAL = {
    "pybullet_engine.py": "pybullet", "batch_simulation.py": "mjbatch", "warp_simulation.py": "warp",
    "visuals.py": "meshes",
}  # fmt: skip
"""Files that need an extra of their own, and are imported only where it is asked for."""


def names(requirements: list[str]) -> set[str]:
    """Modules that requirements bring, those of the extras that they name included."""
    found: set[str] = set()
    for requirement in requirements:
        name = re.split(r"[\[<>=; ]", requirement)[0]
        if name == "cotap":
            extras = re.findall(r"[\w]+", requirement.partition("[")[2])
            found |= names([r for extra in extras for r in EXTRAS[extra]])
        else:
            found.add(MODULES.get(name, name))
    return found


def imported(file: Path) -> set[str]:
    """Modules of others that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return {BROUGHT.get(name, name) for name in found - {"cotap"} - sys.stdlib_module_names - {"tomli"}}


def test_every_import_is_of_a_dependency_that_its_room_declares():
    package = ROOT / "src/cotap"
    for file in package.rglob("*.py"):
        extra = ROOMS.get(file.relative_to(package).parts[0], "train")
        allowed = {"torch"} | names(EXTRAS[extra])
        if file.name in OPTIONAL:
            allowed |= names(EXTRAS[OPTIONAL[file.name]])
        assert imported(file) <= allowed, file


def test_every_dependency_is_imported_somewhere():
    used = set().union(*(imported(file) for file in (ROOT / "src/cotap").rglob("*.py")))
    by_others = {"onnxscript", "imageio-ffmpeg", "tomli"}  # torch's exporter, and imageio's film writer
    assert names([*PROJECT["dependencies"], "cotap[all,warp]"]) - by_others <= used


@pytest.mark.slow
def test_the_compliance_library_needs_torch_alone():
    others = names(["cotap[all,warp]"]) - {"numpy", "filelock"}  # torch imports these two itself where it finds them
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({sorted(others)!r}))\n"
        "import torch, cotap.compliance as c\n"
        "k = torch.eye(3)\n"
        "print(c.resolve_joint_stiffness(torch.eye(3), 300.0 * k, 20.0).diagonal().tolist())\n"
        "print([n for n in c.__all__ if getattr(c, n, None) is None and n != 'ArmKinematics'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-800:]
    assert done.stdout.splitlines()[0] == "[300.0, 300.0, 300.0]"


def test_ranges_are_open_unless_a_reason_is_given():
    text = (ROOT / "pyproject.toml").read_text()
    for line in text.splitlines():
        for exact in re.findall(r'"([\w-]+==[^"]+)"', line):
            assert "#" in line, f"{exact}: say why no other version does"


@pytest.mark.slow
def test_the_wheel_is_what_one_would_publish(tmp_path: Path):
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    done = subprocess.run(build, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-800:]
    (wheel,) = tmp_path.glob("*.whl")
    check = subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", str(wheel)], capture_output=True, text=True, timeout=120
    )
    assert check.returncode == 0, check.stdout
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
        metadata = archive.read(next(n for n in inside if n.endswith("METADATA"))).decode()
    sources = {str(f.relative_to(ROOT / "src")) for f in (ROOT / "src/cotap").rglob("*.py")}
    shipped = {str(f.relative_to(ROOT / "src")) for f in (ROOT / "src/cotap/checkpoints").iterdir()}
    assert sources | shipped | {"cotap/py.typed", "cotap/command_help.json"} <= inside
    assert {name.partition("/")[0].partition("-")[0] for name in inside} == {"cotap"}  # and its dist-info
    assert "Description-Content-Type: text/markdown" in metadata
    assert wheel.stat().st_size < 30 << 20

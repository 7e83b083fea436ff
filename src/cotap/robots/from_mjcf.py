"""`python -m cotap.robots.from_mjcf`: a humanoid's MJCF to a file of facts, which `from_facts` reads."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import json
import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tyro

from cotap.checks import legible, require_range, shortened
from cotap.files import require_output, write_atomically
from cotap.inputs import InputError, require_regular

_SHAPES = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")): name
           for name in ("sphere", "capsule", "cylinder", "ellipsoid", "box")}  # fmt: skip
_HINGE, _FREE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
_SAME_PLACE_M, _SAME_AXIS = 2e-3, 0.999
_FLIP = np.array([1.0, -1.0, 1.0])


@dataclass
class FromMjcfOptions:
    """The facts of a humanoid, from its MJCF: all that a robot's file in `cotap.robots` does not choose."""

    mjcf: str
    """The robot's MJCF. Its base looks along x and its left is y, left and right alike."""
    output: str
    """The file to write (JSON)."""
    velocity_limit: float = 20.0
    """Velocity limit of every joint [rad/s], which MJCF does not have; to be edited in the file, joint by joint."""
    source: str = "not stated"
    """Where the MJCF comes from and its terms, kept in the file."""


def facts_of(path: Path | str, velocity_limit_rad_s: float = 20.0, source: str = "not stated") -> dict[str, Any]:
    """Bodies of a humanoid with their masses, inertias, colliding shapes and joints, and pairs that never collide.

    Bodies without a joint become part of their parents, and meshes that collide boxes, at the mesh's own mass where
    MuJoCo infers it. Visual shapes and dry friction of joints are left out.

    Raises:
        ValueError: the file or a mesh of it cannot be read, or the robot has what a `RobotSpec` cannot express.
    """
    model = _compiled(path)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mirrors = _mirrors(model, data)
    bodies = [_body(model, b, mirrors, velocity_limit_rad_s) for b in range(1, model.nbody)]
    pairs = [divmod(int(signature), 1 << 16) for signature in model.exclude_signature]
    names = [model.body(b).name for b in range(model.nbody)]
    return {
        "source": source,
        "contact_excludes": [[names[first], names[second]] for first, second in pairs if first and second],
        "bodies": bodies,
    }


def facts_text(facts: dict[str, Any]) -> str:
    """JSON, a vector a line."""
    text = json.dumps(facts, indent=1)
    return re.sub(r"\[\s+([^][{}]*?)\s+\]", lambda m: f"[{' '.join(m[1].split())}]", text) + "\n"


def _compiled(path: Path | str) -> mujoco.MjModel:
    """The model, one joint a body."""
    where = f"MJCF {str(path)!r}"
    _require_file(where, path)
    mj = _read(where, lambda: mujoco.MjSpec.from_file(str(path)))
    for mesh in mj.meshes:
        file = Path(path).parent / mj.meshdir / mesh.file
        if mesh.file and file.exists():  # elsewhere MuJoCo may find it, or else says so
            _require_file(f"{where}: mesh {legible(str(file))}", file)
    mj.compiler.fusestatic = True
    for sensor in list(mj.sensors):  # bodies that sensors name would be kept
        mj.delete(sensor)
    roots = [body for body in mj.worldbody.bodies if body.find_all("joint")]
    if len(roots) != 1:
        names = ", ".join(body.name for body in roots) or "none"
        raise ValueError(f"{where}: one body of the world must carry the robot, got {legible(names)}")
    if not roots[0].joints:
        roots[0].add_freejoint()
    for exclude in list(mj.excludes):  # so do bodies that never collide
        exclude.bodyname1, exclude.bodyname2 = (_moved(mj.body(n)) for n in (exclude.bodyname1, exclude.bodyname2))
        if exclude.bodyname1 == exclude.bodyname2:
            mj.delete(exclude)
    weighed = _read(where, mj.compile)
    _require_a_tree(where, weighed)
    for geom in mj.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and (geom.contype or geom.conaffinity):
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
    model = _read(where, mj.compile)
    for inertial in ("body_mass", "body_ipos", "body_iquat", "body_inertia"):  # a box would weigh more than its mesh
        getattr(model, inertial)[:] = getattr(weighed, inertial)
    return model


def _require_a_tree(where: str, model: mujoco.MjModel) -> None:
    """Raise ValueError for what moves joints beside gravity, contacts and one motor each."""
    other = {
        "equality constraints": model.neq,
        "tendons": model.ntendon,
        "bodies with gravcomp": int((model.body_gravcomp != 0.0).sum()),
    }
    for what, number in other.items():
        if number:
            raise ValueError(f"{where}: {what} cannot be expressed, got {number}")


def _require_file(where: str, path: Path | str) -> None:
    try:
        require_regular(path)
    except InputError as error:
        raise ValueError(f"{where} {error}") from error


def _read(where: str, read: Callable[[], Any]) -> Any:
    """What MuJoCo makes of a file; what it says if it cannot has many lines, and no file in it."""
    try:
        return read()
    except ValueError as error:
        raise ValueError(f"{where} cannot be read: {legible(' '.join(str(error).split()), 1000)}") from error


def _moved(body: mujoco.MjsBody) -> str:
    """The nearest body inwards that a joint moves, or the world."""
    while not body.joints and body.name != "world":
        body = body.parent
    return body.name


def _body(model: mujoco.MjModel, body: int, mirrors: dict[int, tuple[str, float]], velocity: float) -> dict[str, Any]:
    b = model.body(body)
    if b.jntnum[0] != 1:
        raise ValueError(f"body {b.name!r} must be moved by one joint, it has {b.jntnum[0]}")
    joint = int(b.jntadr[0])
    if not b.name or (model.jnt_type[joint] != _FREE and not model.joint(joint).name):
        raise ValueError(f"bodies and joints need names; below {model.body(b.parentid[0]).name!r} there is one without")
    geoms = range(b.geomadr[0], b.geomadr[0] + b.geomnum[0])
    return {
        "name": b.name,
        "parent": model.body(b.parentid[0]).name,
        "pos": b.pos.tolist(),
        "quat": b.quat.tolist(),
        "mass": float(b.mass[0]),
        "com": b.ipos.tolist(),
        "inertia_quat": b.iquat.tolist(),
        "diaginertia": b.inertia.tolist(),
        "joint": None if model.jnt_type[joint] == _FREE else _joint(model, joint, mirrors[joint], velocity),
        "collision_geoms": [_geom(model, g) for g in geoms if _collides(model, g)],
    }


def _joint(model: mujoco.MjModel, joint: int, mirror: tuple[str, float], velocity: float) -> dict[str, Any]:
    j, dof = model.joint(joint), int(model.jnt_dofadr[joint])
    if not model.jnt_limited[joint]:
        raise ValueError(f"joint {j.name!r} needs a range")
    if j.pos.any() or j.qpos0[0] != 0.0:
        raise ValueError(f"joint {j.name!r} must lie in its body's origin and count from zero: no pos, no ref")
    if model.jnt_stiffness[joint] != 0.0:
        raise ValueError(f"joint {j.name!r} must have no spring, got stiffness {model.jnt_stiffness[joint]:g}")
    return {
        "name": j.name,
        "axis": j.axis.tolist(),
        "range_rad": j.range.tolist(),
        "torque_limit_nm": _torque_limit(model, joint),
        "velocity_limit_rad_s": velocity,
        "armature": float(model.dof_armature[dof]),
        "damping": float(model.dof_damping[dof]),
        "mirror": mirror[0],
        "mirror_sign": mirror[1],
    }


def _torque_limit(model: mujoco.MjModel, joint: int) -> float:
    """The least of what the joint itself and its actuators, which add up, allow [Nm]."""
    own = abs(model.jnt_actfrcrange[joint]).max() if model.jnt_actfrclimited[joint] else math.inf
    actuators: list[float] = []
    for a in range(model.nu):
        if model.actuator_trntype[a] != mujoco.mjtTrn.mjTRN_JOINT or model.actuator_trnid[a, 0] != joint:
            continue
        gear, limits = abs(model.actuator_gear[a, 0]), [math.inf]
        if model.actuator_forcelimited[a]:
            limits.append(gear * abs(model.actuator_forcerange[a]).max())
        if model.actuator_ctrllimited[a] and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE:
            limits.append(gear * model.actuator_gainprm[a, 0] * abs(model.actuator_ctrlrange[a]).max())
        actuators.append(min(limits))
    limit = min(own, sum(actuators) if actuators else math.inf)
    if limit == math.inf:
        raise ValueError(f"joint {model.joint(joint).name!r} needs a torque limit: give it an actuatorfrcrange")
    return float(limit)


def _collides(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) or geom in {
        *model.pair_geom1, *model.pair_geom2,
    }  # fmt: skip


def _geom(model: mujoco.MjModel, geom: int) -> dict[str, Any]:
    g, kind = model.geom(geom), int(model.geom_type[geom])
    if kind not in _SHAPES:
        raise ValueError(
            f"a colliding shape of body {model.body(g.bodyid[0]).name!r} is a {mujoco.mjtGeom(kind).name}; "
            f"known are {', '.join(_SHAPES.values())} and mesh"
        )
    return {"type": _SHAPES[kind], "size": g.size.tolist(), "pos": g.pos.tolist(), "quat": g.quat.tolist()}


def _mirrors(model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, tuple[str, float]]:
    """Of every hinge the one in the mirrored place at zero angles, and what its angle is multiplied by."""
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == _HINGE]
    base = model.body_rootid[model.nbody - 1]
    turn, origin = data.xmat[base].reshape(3, 3), data.xpos[base]
    places = {j: (data.xanchor[j] - origin) @ turn for j in hinges}
    axes = {j: data.xaxis[j] @ turn for j in hinges}
    out: dict[int, tuple[str, float]] = {}
    for j in hinges:
        # A rotation is mirrored as the plane is: about y it stays, about x and z it turns round.
        signs = {k: float(axes[k] @ (-_FLIP * axes[j])) for k in hinges}
        found = [k for k in hinges if abs(signs[k]) > _SAME_AXIS
                 and np.linalg.norm(places[k] - _FLIP * places[j]) < _SAME_PLACE_M]  # fmt: skip
        if len(found) != 1:
            names = ", ".join(model.joint(k).name for k in found) or "none"
            raise ValueError(f"joint {model.joint(j).name!r} needs one mirror image at zero angles, found {names}")
        out[j] = (model.joint(found[0]).name, 1.0 if signs[found[0]] > 0.0 else -1.0)
    return out


def main(argv: list[str] | None = None) -> int:
    """Parse, convert, report. Returns the exit status: 0, 2 for bad input, or 130 if interrupted."""
    options = tyro.cli(FromMjcfOptions, args=argv, prog="python -m cotap.robots.from_mjcf")
    try:
        require_range("velocity_limit", options.velocity_limit, 0.01, 1e4)
        require_output("--output", options.output, (".json",))
        facts = facts_of(options.mjcf, options.velocity_limit, options.source)
        text = facts_text(facts)
        write_atomically(Path(options.output), lambda path: path.write_text(text, encoding="utf-8"))
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        return 130
    joints = [body["joint"] for body in facts["bodies"] if body["joint"]]
    mass = sum(body["mass"] for body in facts["bodies"])
    print(f"{options.output}: {len(facts['bodies'])} bodies, {len(joints)} joints, {mass:.3f} kg")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""RobotSpec to MuJoCo: the compiled model that everything simulates."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import numpy as np

from cotap.robots.ground import HALF_EXTENT_M, bumps
from cotap.robots.kinematics import default_angles
from cotap.robots.spec import BodySpec, GeomSpec, RobotSpec

COLLISIONS = ("feet", "full")
_GEOM_TYPES = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}
FIXED_BASE_LIFT_M = 0.3
"""How much higher than standing a held base is, so that the feet hang free [m]."""
_VISUAL_GROUP, _COLLISION_GROUP = 2, 3
# Contact bits: the floor meets both; robot parts meet each other only in the full setting.
_FLOOR, _PART = 1, 2


def build_model(
    spec: RobotSpec, collision: str = "feet", timestep_s: float = 0.01, fixed_base: bool = False,
    unevenness_m: float = 0.0,
) -> mujoco.MjModel:  # fmt: skip
    """Compile `spec` on a floor, with a light, a following camera and foot sensors.

    Actuator i drives joint i with `force = ctrl - kp q - kd dq` clipped to the torque limit: `ctrl = kp target` is PD
    control, and with zero gains it is a torque. Damping enters the integrator implicitly (implicitfast).

    Args:
        spec: The robot.
        collision: "feet" (feet against the floor) or "full" (all shapes, against the floor and each other,
            but for the pairs that the robot excludes).
        timestep_s: Physics step [s].
        fixed_base: Hold the base in the air, `FIXED_BASE_LIFT_M` above where it stands.
        unevenness_m: Height of the ground's bumps from lowest to highest, about a height of zero; 0 is flat.

    Raises:
        ValueError: `collision` is unknown.
    """
    mj = build_mjspec(spec, collision, timestep_s)
    if unevenness_m > 0.0:
        _add_bumps(mj, unevenness_m)
    if fixed_base:
        hold_base(mj, spec)
    return mj.compile()


def build_mjspec(spec: RobotSpec, collision: str = "feet", timestep_s: float = 0.01) -> mujoco.MjSpec:
    """As `build_model`, before compilation, for those who add to the scene."""
    if collision not in COLLISIONS:
        raise ValueError(f"collision {collision!r} is unknown; known: {', '.join(COLLISIONS)}")
    mj = mujoco.MjSpec()
    mj.modelname = spec.name
    mj.compiler.degree = False
    mj.option.timestep = timestep_s
    mj.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # MuJoCo would silently restart an env whose state is not finite; cotap ends its episode and counts it instead.
    mj.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    _add_scene(mj)
    bodies: dict[str, mujoco.MjsBody] = {"world": mj.worldbody}
    for body in spec.bodies:
        bodies[body.name] = _add_body(bodies[body.parent], body, spec, collision)
    if collision == "full":
        for first, second in spec.contact_excludes:
            mj.add_exclude(bodyname1=first, bodyname2=second)
    _add_sites_and_sensors(mj, bodies, spec)
    for joint in spec.joints:
        actuator = mj.add_actuator(name=joint.name, target=joint.name)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = 1.0
        actuator.biasprm[:3] = 0.0, -joint.kp, -joint.kd
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [-joint.torque_limit_nm, joint.torque_limit_nm]
    return mj


def hold_base(mj: mujoco.MjSpec, spec: RobotSpec) -> None:
    """Weld the base to the world; stiffly, since what hangs from it is measured to a tenth of a millimetre."""
    weld = mj.add_equality(name="fixed_base", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    weld.name1, weld.name2 = spec.base_body, "world"
    weld.data[:11] = [0.0, 0.0, 0.0, 0.0, 0.0, -(spec.base_height_m + FIXED_BASE_LIFT_M), 1.0, 0.0, 0.0, 0.0, 1.0]
    weld.solimp[:3] = 0.9999, 0.9999, 0.001


def torso_inertia(spec: RobotSpec, model: mujoco.MjModel) -> np.ndarray:
    """Torque over angular acceleration of the torso link about x, y and z, (3,) [kg m^2].

    In the default pose, with motors that let go: a torso that joints carry turns more easily than the robot as a whole.
    """
    data = mujoco.MjData(model)
    data.qpos[:7] = 0.0, 0.0, spec.base_height_m, 1.0, 0.0, 0.0, 0.0
    data.qpos[7:] = default_angles(spec)
    mujoco.mj_forward(model, data)
    jacobian, moved = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, None, jacobian, model.body(spec.torso_body).id)
    mujoco.mj_solveM(model, data, moved, jacobian)
    return 1.0 / (jacobian * moved).sum(1)


def _add_bumps(mj: mujoco.MjSpec, unevenness_m: float) -> None:
    """Bumps above a floor that is lowered to their lowest."""
    heights = bumps()
    rows, columns = heights.shape
    field = mj.add_hfield(name="bumps", nrow=rows, ncol=columns, userdata=heights.ravel())
    field.size = [HALF_EXTENT_M, HALF_EXTENT_M, unevenness_m, 0.1]
    lowest = [0.0, 0.0, -0.5 * unevenness_m]
    mj.geom("floor").pos = lowest
    geom = mj.worldbody.add_geom(
        name="bumps", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="bumps", pos=lowest, material="grid", condim=3
    )
    geom.contype, geom.conaffinity = _FLOOR, _PART


def _add_scene(mj: mujoco.MjSpec) -> None:
    mj.visual.headlight.ambient = [0.35, 0.35, 0.35]
    mj.visual.headlight.diffuse = [0.45, 0.45, 0.45]
    mj.visual.global_.offwidth, mj.visual.global_.offheight = 1280, 960
    mj.visual.quality.shadowsize = 4096
    mj.visual.rgba.haze = [0.75, 0.82, 0.90, 1.0]
    mj.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.75, 0.82, 0.90], rgb2=[0.95, 0.97, 1.0], width=64, height=384,
    )  # fmt: skip
    mj.add_texture(
        name="grid", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE, rgb1=[0.80, 0.82, 0.84], rgb2=[0.74, 0.76, 0.79], markrgb=[0.6, 0.62, 0.65],
        width=300, height=300,
    )  # fmt: skip
    grid = mj.add_material(name="grid", texrepeat=[1, 1], texuniform=True, reflectance=0.05)
    grid.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    floor = mj.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], material="grid", condim=3
    )
    floor.contype, floor.conaffinity = _FLOOR, _PART
    mj.worldbody.add_light(
        pos=[1.0, -1.5, 4.0], dir=[-0.25, 0.35, -1.0], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.55, 0.55, 0.55], castshadow=True,
    )  # fmt: skip


def _add_body(parent: mujoco.MjsBody, body: BodySpec, spec: RobotSpec, collision: str) -> mujoco.MjsBody:
    out = parent.add_body(name=body.name, pos=body.pos, quat=body.quat)
    out.explicitinertial = True
    out.mass, out.ipos, out.iquat, out.inertia = body.mass_kg, body.com, body.inertia_quat, body.diaginertia
    if body.joint is None:
        out.add_freejoint(name=f"{spec.name}_free")
        out.add_camera(
            name="track", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, pos=[1.7, -2.7, 0.45],
            xyaxes=[0.84, 0.54, 0.0, -0.08, 0.13, 0.99],
        )  # fmt: skip
    else:
        joint = spec.joint(body.joint)
        hinge = out.add_joint(name=joint.name, axis=joint.axis, range=joint.range_rad)
        hinge.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        hinge.damping = [joint.damping_nms_rad, 0.0, 0.0]
        hinge.armature = joint.armature_kg_m2
    feet = {f.body for f in spec.feet}
    for geom in body.visual:
        _add_geom(out, geom, spec, _VISUAL_GROUP)
    for i, geom in enumerate(body.collision):
        if body.name not in feet and collision == "feet":
            continue
        shape = _add_geom(out, geom, spec, _COLLISION_GROUP)
        shape.name = f"{body.name}_collision_{i}"
        shape.contype, shape.conaffinity = _PART, _FLOOR | (_PART if collision == "full" else 0)
        shape.condim = 3
        if body.name in feet:
            shape.priority = 1  # the foot's friction is the contact's, so that it can differ between envs
    return out


def _add_geom(body: mujoco.MjsBody, geom: GeomSpec, spec: RobotSpec, group: int) -> mujoco.MjsGeom:
    rgb = spec.colors.get(geom.color, (0.5, 0.5, 0.5))
    return body.add_geom(
        type=_GEOM_TYPES[geom.type], size=geom.size, pos=geom.pos, quat=geom.quat, rgba=[*rgb, 1.0],
        group=group, contype=0, conaffinity=0, mass=0.0,
    )  # fmt: skip


def _add_sites_and_sensors(mj: mujoco.MjSpec, bodies: dict[str, mujoco.MjsBody], spec: RobotSpec) -> None:
    for arm in spec.arms:
        bodies[arm.hand_body].add_site(name=f"{arm.side}_hand", pos=arm.hand_point, size=[0.01] * 3, group=4)
    for foot in spec.feet:
        site = f"{foot.side}_foot"
        # The touch sensor sums normal forces at contacts inside its site: a box around the whole foot.
        bodies[foot.body].add_site(
            name=site, type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.1, 0.06], pos=foot.sole, group=4
        )
        for kind, prefix in (
            (mujoco.mjtSensor.mjSENS_TOUCH, "touch"),
            (mujoco.mjtSensor.mjSENS_FRAMEPOS, "pos"),
            (mujoco.mjtSensor.mjSENS_FRAMELINVEL, "vel"),
            (mujoco.mjtSensor.mjSENS_FRAMEZAXIS, "up"),
            (mujoco.mjtSensor.mjSENS_FRAMEXAXIS, "forward"),
        ):
            mj.add_sensor(name=f"{foot.side}_foot_{prefix}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)

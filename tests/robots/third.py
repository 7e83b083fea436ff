"""A third made-up humanoid, as an MJCF that somebody else wrote: in degrees, arms before legs, right side turned about,
bodies without joints, a mesh for a foot, and torque limits in three places."""

from __future__ import annotations

_SIDE = """
<body name="{s}_upper_arm_1" pos="0 {y}0.15 0.3">
  <inertial mass="0.8" pos="0 {y}0.02 0" diaginertia="0.002 0.002 0.002"/>
  <joint name="{s}_shoulder_pitch" axis="0 1 0" range="-150 120" actuatorfrcrange="-30 30" armature="0.01"/>
  <body name="{s}_upper_arm_2" pos="0 {y}0.04 0">
    <inertial mass="0.7" pos="0 0 -0.02" diaginertia="0.002 0.002 0.001"/>
    <joint name="{s}_shoulder_roll" axis="{t}1 0 0" range="-30 120" actuatorfrcrange="-30 30" armature="0.01"/>
    <body name="{s}_upper_arm_3" pos="0 0 -0.1">
      <inertial mass="0.9" pos="0 0 -0.05" diaginertia="0.003 0.003 0.001"/>
      <joint name="{s}_shoulder_yaw" axis="0 0 {t}1" range="-90 90" actuatorfrcrange="-30 30" armature="0.01"/>
      <geom type="capsule" size="0.035" fromto="0 0 0 0 0 -0.1"/>
      <body name="{s}_forearm" pos="0 0 -0.15">
        <inertial mass="0.6" pos="0.08 0 0" diaginertia="0.001 0.003 0.003"/>
        <joint name="{s}_elbow" axis="0 1 0" range="-60 110" armature="0.01"/>
        <geom type="capsule" size="0.03" fromto="0.02 0 0 0.12 0 0"/>
        <body name="{s}_hand" pos="0.16 0 0" euler="0 0 90">
          <inertial mass="0.3" pos="0 0 0.01" diaginertia="0.0004 0.0003 0.0002"/>
          <geom type="sphere" size="0.04"/>
          <site name="{s}_palm"/>
        </body>
      </body>
    </body>
  </body>
</body>"""
_LEG = """
<body name="{s}_hip_1" pos="0 {y}0.1 -0.05">
  <inertial mass="1" pos="0 0 0" diaginertia="0.003 0.003 0.003"/>
  <joint name="{s}_hip_roll" axis="{t}1 0 0" range="-20 40" actuatorfrcrange="-120 120" armature="0.03"/>
  <body name="{s}_thigh">
    <inertial mass="4" pos="0 0 -0.17" diaginertia="0.05 0.05 0.01"/>
    <joint name="{s}_hip_pitch" axis="0 1 0" range="-120 60" armature="0.03"/>
    <geom type="capsule" size="0.06" fromto="0 0 -0.05 0 0 -0.3"/>
    <body name="{s}_shank" pos="0 0 -0.36">
      <inertial mass="2.5" pos="0 0 -0.15" diaginertia="0.03 0.03 0.005"/>
      <joint name="{s}_knee" axis="0 1 0" range="-3 130" armature="0.03" damping="0.5"/>
      <geom type="capsule" size="0.045" fromto="0 0 -0.05 0 0 -0.3"/>
      <body name="{s}_foot" pos="0 0 -0.36">
        <inertial mass="1" pos="0.03 0 -0.03" diaginertia="0.001 0.003 0.003"/>
        <joint name="{s}_ankle" axis="0 1 0" range="-50 30" actuatorfrcrange="-60 60" armature="0.02"/>
        <geom type="mesh" mesh="sole" pos="0.04 0 -0.045"/>
      </body>
    </body>
  </body>
</body>"""
_CORNERS = " ".join(f"{x} {y} {z}" for x in (-0.11, 0.11) for y in (-0.05, 0.05) for z in (-0.015, 0.015))


def mjcf(base: str = "") -> str:
    """The file; `base` goes into the base."""
    sides = [{"s": "l", "y": "", "t": ""}, {"s": "r", "y": "-", "t": "-"}]
    arms = [_SIDE.format(**side) for side in sides]
    motors = "".join(
        f'<motor joint="{s}_hip_pitch" gear="50" ctrllimited="true" ctrlrange="-3 3"/>'
        f'<position joint="{s}_knee" kp="9" forcelimited="true" forcerange="-140 140"/>'
        f'<motor joint="{s}_elbow" forcelimited="true" forcerange="-25 25"/>'
        for s in ("l", "r")
    )
    return f"""
<mujoco model="third">
  <compiler angle="degree"/>
  <asset><mesh name="sole" vertex="{_CORNERS}"/></asset>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="hips" pos="0 0 1" euler="0 0 40">
      <inertial mass="6" pos="0 0 -0.02" diaginertia="0.05 0.04 0.05"/>
      <geom type="sphere" size="0.09"/>{base}
      <body name="chest" pos="0 0 0.12">
        <inertial mass="14" pos="0 0 0.15" diaginertia="0.25 0.2 0.12"/>
        <joint name="waist" axis="0 0 1" range="-120 120" actuatorfrcrange="-100 100" armature="0.03"/>
        <geom type="box" size="0.08 0.11 0.14" pos="0 0 0.16"/>
        <body name="head" pos="0 0 0.42">
          <inertial mass="2" pos="0.01 0 0" diaginertia="0.01 0.01 0.01"/>
          <geom type="sphere" size="0.08"/>
          <site name="gyroscope"/>
        </body>
        {arms[0]}{arms[1]}
      </body>
      {"".join(_LEG.format(**side) for side in sides)}
    </body>
  </worldbody>
  <contact>
    <exclude body1="hips" body2="l_thigh"/>
    <exclude body1="hips" body2="r_thigh"/>
    <exclude body1="head" body2="hips"/>
  </contact>
  <actuator>{motors}</actuator>
  <sensor><gyro site="gyroscope"/></sensor>
</mujoco>"""

"""Small robots, as text of model files."""

from __future__ import annotations

import zipfile
from pathlib import Path

import mujoco
import numpy as np

# A trunk of 0.4 x 0.2 m; legs of two links of 0.15 m.
_HIPS = {"FL": (0.2, 0.1), "FR": (0.2, -0.1), "RL": (-0.2, 0.1), "RR": (-0.2, -0.1)}
_TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def write_quadruped(folder: Path) -> Path:
    """Write an MJCF with motors, and its mesh in a folder beside it; return its path."""
    legs = "".join(
        f"""
      <body name="{leg}_hip" pos="{x} {y} 0">
        <joint name="{leg}_hip" axis="1 0 0" range="-0.8 0.8" armature="0.005"/>
        <geom type="sphere" size="0.03" mass="0.4" contype="0" conaffinity="0"/>
        <body name="{leg}_thigh">
          <joint name="{leg}_thigh" axis="0 1 0" range="-1 2.5" armature="0.005"/>
          <geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.15" mass="0.4" group="3"/>
          <body name="{leg}_calf" pos="0 0 -0.15">
            <joint name="{leg}_calf" axis="0 1 0" range="-2.6 -0.5" armature="0.005"/>
            <geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.13" mass="0.1" group="3"/>
            <geom type="sphere" size="0.02" pos="0 0 -0.15" mass="0.05" condim="1"/>
          </body>
        </body>
      </body>"""
        for leg, (x, y) in _HIPS.items()
    )
    motors = "".join(
        f'<motor joint="{leg}_{joint}" ctrlrange="-{limit} {limit}"/>'
        for leg in _HIPS
        for joint, limit in (("hip", 20), ("thigh", 20), ("calf", 25))
    )
    path = folder / "dog.xml"
    path.parent.mkdir(parents=True, exist_ok=True)
    (folder / "meshes").mkdir()
    (folder / "meshes" / "shell.obj").write_text(_TETRAHEDRON)
    path.write_text(f"""<mujoco model="dog">
  <compiler angle="radian" meshdir="meshes"/>
  <asset><mesh name="shell" file="shell.obj"/></asset>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body name="trunk" pos="0 0 0.4">
      <freejoint/>
      <geom type="box" size="0.2 0.08 0.05" mass="5" group="3"/>
      <geom type="mesh" mesh="shell" contype="0" conaffinity="0" group="2" mass="0"/>
      <site name="imu"/>{legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>""")
    return path


def write_still_motion(model: mujoco.MjModel, path: Path) -> Path:
    """Write a motion file in which a robot stays at its initial pose; return its path."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frames = {"body_pos_w": data.xpos[1:], "body_quat_w": data.xquat[1:]}
    frames |= {name: np.zeros_like(data.xpos[1:]) for name in ("body_lin_vel_w", "body_ang_vel_w")}
    frames |= {name: np.zeros(model.nv - 6) for name in ("joint_pos", "joint_vel")}
    np.savez(path, fps=[50], **{name: np.repeat(x[None], 10, axis=0) for name, x in frames.items()})
    return path


def write_archive(folder: Path) -> Path:
    """Write the quadruped as an archive; return its path."""
    write_quadruped(folder / "dog")
    path = folder / "dog.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in (folder / "dog").rglob("*"):
            archive.write(file, file.relative_to(folder))
    return path


def write_urdf(folder: Path) -> Path:
    """Write a URDF of the quadruped, its mesh beside the folder of the file; return its path."""
    links, joints = "", ""
    for leg, (x, y) in _HIPS.items():
        parent, origin = "trunk", f"{x} {y} 0"
        for name, axis, limits, end in (
            ("hip", "1 0 0", (-0.8, 0.8), 0.0),
            ("thigh", "0 1 0", (-1.0, 2.5), 0.0),
            ("calf", "0 1 0", (-2.6, -0.5), -0.15),
        ):
            origin = origin if name == "hip" else f"0 0 {end}"
            tip = "0 0 -0.15" if name == "calf" else "0 0 0"
            radius = 0.02 if name == "calf" else 0.03
            links += f"""
  <link name="{leg}_{name}">
    <inertial><origin xyz="0 0 -0.05"/><mass value="0.4"/>
      <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="{tip}"/><geometry><sphere radius="{radius}"/></geometry></collision>
  </link>"""
            joints += f"""
  <joint name="{leg}_{name}" type="revolute">
    <parent link="{parent}"/><child link="{leg}_{name}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>
    <limit lower="{limits[0]}" upper="{limits[1]}" effort="20" velocity="20"/>
  </joint>"""
            parent = f"{leg}_{name}"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "shell.obj").write_text(_TETRAHEDRON)
    path = folder / "urdf" / "dog.urdf"
    path.parent.mkdir()
    path.write_text(f"""<robot name="dog">
  <link name="trunk">
    <inertial><mass value="5"/>
      <inertia ixx="0.05" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://dog/meshes/shell.obj"/></geometry></visual>
    <collision><geometry><box size="0.4 0.16 0.1"/></geometry></collision>
  </link>{links}{joints}
</robot>""")
    return path


def arm_spec() -> mujoco.MjSpec:
    """Return an arm of six links with position servos, with its base at the origin."""
    spec = mujoco.MjSpec()
    spec.modelname = "crane"
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name="base")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=(0.08, 0.05, 0.0))
    for number, axis in enumerate(
        ((0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0))
    ):
        body = body.add_body(name=f"link{number}", pos=(0.0, 0.0, 0.15))
        joint = body.add_joint(name=f"joint{number}", axis=axis, armature=0.1)
        joint.limited, joint.range = True, (-2.0, 2.0)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(0.03, 0, 0), fromto=(0, 0, 0.04, 0, 0, 0.11)
        )
        actuator = spec.add_actuator(
            name=f"servo{number}", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.set_to_position(kp=200.0, kv=20.0)
        actuator.forcelimited, actuator.forcerange = True, (-50.0, 50.0)
    return spec

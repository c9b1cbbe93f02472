"""Small models for engine parity tests, each with every kind of field it can have."""

from __future__ import annotations

from pathlib import Path

import mjlab

CARTPOLE = (Path(mjlab.__file__).parent / "tasks" / "cartpole" / "cartpole.xml").read_text()

LANDING_BOX = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="fixed" pos="0 -2 1" xyaxes="1 0 0 0 .5 1"/>
    <geom name="floor" type="plane" size="3 3 .1"/>
    <body name="box" pos="0 0 .4">
      <freejoint/>
      <geom name="box" type="box" size=".1 .15 .05" mass="1.3"/>
      <geom name="knob" type="sphere" size=".02" pos=".05 0 .06" mass=".2"/>
      <site name="imu" pos=".02 .03 .01" euler="20 30 0"/>
      <camera name="onboard" pos="0 0 .1"/>
    </body>
  </worldbody>
  <sensor>
    <accelerometer site="imu"/>
    <gyro site="imu"/>
    <velocimeter site="imu"/>
    <framepos objtype="site" objname="imu"/>
    <framequat objtype="body" objname="box"/>
    <framelinvel objtype="body" objname="box"/>
    <subtreecom body="box"/>
    <subtreeangmom body="box"/><e_potential/><e_kinetic/>
    <contact geom1="floor" geom2="box" reduce="netforce" data="found force"/>
  </sensor>
</mujoco>
"""

HINGE_CHAIN = """
<mujoco>
  <default>
    <joint type="hinge" axis="0 1 0" limited="true" range="-60 60" damping=".05" armature=".01"
           frictionloss=".02" stiffness=".3"/>
    <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.3" mass=".5" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <body name="upper" pos="0 0 1.5" gravcomp=".5"><joint name="a"/><geom/>
      <body name="middle" pos="0 0 -.3"><joint name="b" axis="1 0 0"/><geom/>
        <body name="lower" pos="0 0 -.3"><joint name="c"/><geom/><site name="tip" pos="0 0 -.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="a" joint="a" kp="30" dampratio="1"/>
    <position name="b" joint="b" kp="20" kv="1" forcerange="-3 3"/>
    <velocity name="c" joint="c" kv=".5" ctrlrange="-2 2"/>
  </actuator>
  <sensor>
    <jointpos joint="a"/><jointvel joint="b"/><actuatorfrc actuator="b"/>
    <jointactuatorfrc joint="c"/><jointlimitfrc joint="a"/><framelinacc objtype="site" objname="tip"/>
  </sensor>
</mujoco>
"""

TENDONS = """
<mujoco>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <site name="anchor" pos=".3 0 1.2"/>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping=".1"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0" mass=".8"/>
      <site name="hook" pos=".35 0 .03"/>
      <body name="hand" pos=".4 0 0">
        <joint name="wrist" axis="0 1 0" damping=".05"/>
        <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass=".3"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="coupled" stiffness="2" damping=".1" limited="true" range="-.4 .4">
      <joint joint="shoulder" coef="1"/><joint joint="wrist" coef="-.5"/>
    </fixed>
    <spatial name="cable" stiffness="15" damping=".2" springlength=".15" armature=".01">
      <site site="anchor"/><site site="hook"/>
    </spatial>
  </tendon>
  <actuator>
    <motor name="pull" tendon="cable" gear="5"/>
    <general name="lagged" tendon="coupled" dyntype="filter" dynprm=".05" gainprm="3"/>
  </actuator>
  <sensor><tendonpos tendon="cable"/><tendonvel tendon="coupled"/></sensor>
</mujoco>
"""

MOCAP = """
<mujoco>
  <worldbody>
    <body name="target" mocap="true" pos="0 0 .6" quat="1 .2 0 0">
      <geom name="target" type="box" size=".03 .03 .03" contype="0" conaffinity="0"/>
      <site name="target" pos="0 0 .05"/>
      <camera name="moving" pos="0 0 .2"/>
    </body>
    <body name="follower" pos=".1 0 .5">
      <freejoint/>
      <geom type="box" size=".05 .04 .03" mass=".4"/>
    </body>
  </worldbody>
  <equality><weld body1="target" body2="follower" solref=".05 1"/></equality>
</mujoco>
"""

EQUALITIES = """
<mujoco>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="left" pos="-.2 0 1"><joint name="left" axis="0 1 0" damping=".1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .2 0 -.2" mass=".5"/></body>
    <body name="right" pos=".2 0 1"><joint name="right" axis="0 1 0" damping=".1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 -.2 0 -.2" mass=".6"/>
      <body name="rod" pos="-.2 0 -.2"><joint name="rod" axis="0 1 0" damping=".1"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.2" mass=".2"/></body></body>
    <body name="slave" pos="0 .5 1"><joint name="slave" axis="0 0 1" damping=".1"/>
      <geom type="box" size=".1 .02 .02" mass=".3"/></body>
  </worldbody>
  <equality>
    <connect body1="left" body2="rod" anchor=".2 0 -.2"/>
    <joint joint1="slave" joint2="left" polycoef=".1 1.5 0 0 0"/>
  </equality>
</mujoco>
"""

MODELS = {
    "cartpole": CARTPOLE,
    "landing_box": LANDING_BOX,
    "hinge_chain": HINGE_CHAIN,
    "tendons": TENDONS,
    "mocap": MOCAP,
    "equalities": EQUALITIES,
}

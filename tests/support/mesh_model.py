"""A model of several files: includes in a subfolder, meshes, a height field and another model."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

# A body that is not symmetric, so that its inertia depends on the mesh.
MESH = """
v 0 0 0
v 0.2 0 0
v 0 0.3 0
v 0 0 0.4
v 0.1 0.1 0.5
f 1 2 3
f 1 2 4
f 2 3 5
f 3 4 1
f 4 5 2
"""

MAIN = """
<mujoco model="tool">
  <compiler meshdir="meshes"/>
  <include file="parts/options.xml"/>
  <asset>
    <mesh name="tool" file="tool.obj"/>
    <hfield name="ground" file="ground.png" size="1 1 0.1 0.1"/>
    <model name="cart" file="../carts/cart.xml"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="ground" pos="0 0 -5"/>
    <body name="tool">
      <joint name="turn" type="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="mesh" mesh="tool" density="800" contype="0" conaffinity="0"/>
    </body>
    <frame pos="3 0 0"><attach model="cart" body="cart" prefix="other_"/></frame>
  </worldbody>
  <actuator><motor name="motor" joint="turn" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""

OPTIONS = """
<mujoco>
  <option timestep="0.005" integrator="RK4"/>
  <include file="parts/sensors.xml"/>
</mujoco>
"""

SENSORS = '<mujoco><sensor><jointpos name="angle" joint="turn"/></sensor></mujoco>'

CART = """
<mujoco model="cart">
  <compiler meshdir="shapes"/>
  <asset><mesh name="wheel" file="wheel.obj"/></asset>
  <worldbody>
    <body name="cart"><joint name="slide" type="slide"/><geom type="mesh" mesh="wheel"/></body>
  </worldbody>
</mujoco>
"""

# The files of the model by their paths.
FILES = {
    "robot/tool.xml": MAIN,
    "robot/parts/options.xml": OPTIONS,
    "robot/parts/sensors.xml": SENSORS,
    "robot/meshes/tool.obj": MESH,
    "robot/meshes/ground.png": None,
    "carts/cart.xml": CART,
    "carts/shapes/wheel.obj": MESH,
}


def write_mesh_model(folder: Path) -> Path:
    """Write the model into a folder, and return its main file."""
    for name, text in FILES.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(_image() if text is None else text.encode())

    return folder / "robot" / "tool.xml"


def _image() -> bytes:
    """A small height field as a PNG image."""
    packed = io.BytesIO()
    Image.linear_gradient("L").resize((4, 4)).save(packed, "png")
    return packed.getvalue()

"""Marbles: small stiff balls that tasks pour and sweep. Cameras take them for background."""

import numpy as np
import trimesh
from pydrake.math import RigidTransform

from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.simulated.scene import SceneObject

FRICTION = 0.2
_DENSITY = 2500.0  # kg/m^3, glass
# Pa. A contact surface with convex pieces is exact where a single contact point has a wrong normal,
# at the edge of a thin floor.
_MODULUS = 1e7


def make_marble(diameter: float) -> ShapeInstance:
    """A ball of this diameter (m) about the origin of its frame."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=diameter / 2)
    shape = ShapeInstance(
        family="marble",
        parameters={"diameter": diameter},
        vertices=ball.vertices,
        faces=ball.faces,
        part_labels=np.zeros(len(ball.faces), dtype=int),
        part_names=("ball",),
        convex_pieces=(ball.vertices,),
    )
    return shape.with_mass(_DENSITY * np.pi / 6 * diameter**3)


def marble_object(
    name: str, shape: ShapeInstance, color: tuple[float, float, float], X_WO: RigidTransform
) -> SceneObject:
    """The marble as a free body whose collision geometry is a stiff sphere."""
    radius = shape.parameters["diameter"] / 2
    mass = shape.mass_properties.mass
    moment = 0.4 * mass * radius**2
    sphere = f"<geometry><sphere><radius>{radius:.9g}</radius></sphere></geometry>"
    sdf = f"""<?xml version="1.0"?>
<sdf version="1.10" xmlns:drake="http://drake.mit.edu">
  <model name="{name}">
    <link name="{name}">
      <inertial>
        <mass>{mass:.9g}</mass>
        <inertia>
          <ixx>{moment:.9g}</ixx><iyy>{moment:.9g}</iyy><izz>{moment:.9g}</izz>
          <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>
        </inertia>
      </inertial>
      <visual name="surface">
        {sphere}
        <material><diffuse>{" ".join(f"{value:.4g}" for value in color)} 1</diffuse></material>
      </visual>
      <collision name="ball">
        {sphere}
        <drake:proximity_properties>
          <drake:compliant_hydroelastic/>
          <drake:hydroelastic_modulus>{_MODULUS:.3g}</drake:hydroelastic_modulus>
          <drake:mesh_resolution_hint>{radius:.9g}</drake:mesh_resolution_hint>
          <drake:mu_static>{FRICTION}</drake:mu_static>
          <drake:mu_dynamic>{FRICTION}</drake:mu_dynamic>
        </drake:proximity_properties>
      </collision>
    </link>
  </model>
</sdf>
"""
    return SceneObject(name, "other", sdf, X_WO)

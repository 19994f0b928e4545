"""A scene as a MuJoCo model to look at: light, sky, paint on the ground, colours, waves.

For MuJoCo's own renderer (`video.py`) and viewer (`viewer.py`). Nothing is added that moves or
touches, so ``qpos`` means what it means in the model that is simulated.
"""

from __future__ import annotations

import mujoco
import numpy as np

from olympics_opt.raycast import SUN
from olympics_opt.scenery import Mark, Terrain, ground_marks, rgb, shape_colors
from olympics_opt.scenery.golf import AREA_X, AREA_Y, FAIRWAY
from sports.humanoid.mjcf import body_name, build_spec
from sports.scene import Scene

THICKNESS, LAYER = 0.001, 0.0002
"""Half the height of paint, and how much higher each later mark lies (m)."""
LAYERS = 40
"""Later marks lie no higher than this many layers: they do not overlap any more."""


def decorated(scene: Scene, ground: Terrain | None = None) -> mujoco.MjModel:
    """The model of a scene (with its props) with light, sky, a grid, marks and colours.

    ``ground``: waves that are drawn instead of the plane.
    """
    spec = build_spec(scene, sensors=False)
    _light(spec)
    plane = spec.geom("ground")
    if ground is None:
        _grid(spec, plane)
    else:
        plane.rgba = (0.0, 0.0, 0.0, 0.0)
        _waves(spec, ground)
    for i, mark in enumerate(ground_marks(scene)):
        if ground is None:
            _paint(spec, mark, i)
    for agent in range(scene.num_agents):
        for link, colors in shape_colors(scene, agent).items():
            for k, color in enumerate(colors):
                spec.geom(f"{body_name(agent, link)}:{k}").rgba = (*rgb(color), 1.0)
    return spec.compile()


def _light(spec: mujoco.MjSpec) -> None:
    spec.visual.headlight.ambient[:] = (0.38, 0.38, 0.38)
    spec.visual.headlight.diffuse[:] = (0.30, 0.30, 0.30)
    spec.visual.headlight.specular[:] = (0.1, 0.1, 0.1)
    spec.visual.quality.shadowsize = 4096
    # Shadows are sharp within this many metres (see the light's place in `video.py`).
    spec.stat.extent = 5.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 40.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=rgb("#9dbfdd"),
        rgb2=rgb("#eef3f7"),
        width=256,
        height=1536,
    )
    light = spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=True,
        diffuse=(0.55, 0.55, 0.52),
        specular=(0.2, 0.2, 0.2),
    )
    light.dir = -SUN


def _grid(spec: mujoco.MjSpec, plane: mujoco.MjsGeom) -> None:
    texture = spec.add_texture(
        name="grid",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=rgb("#d5dbdd"),
        rgb2=rgb("#d5dbdd"),
        markrgb=rgb("#98a5ab"),
        width=128,
        height=128,
    )
    assert texture is not None
    material = spec.add_material(name="grid", texrepeat=(1.0, 1.0), texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    plane.material = "grid"
    plane.rgba = (1.0, 1.0, 1.0, 1.0)


def _paint(spec: mujoco.MjSpec, mark: Mark, layer: int) -> None:
    """A mark as a thin box where it is one along the axes, else as a thin prism."""
    corners = np.asarray(mark.corners)
    low, high = corners.min(0), corners.max(0)
    half = THICKNESS + LAYER * min(layer, LAYERS)
    fields = {"contype": 0, "conaffinity": 0, "rgba": (*rgb(mark.color), 1.0)}
    straight = len(corners) == 4 and np.isin(corners, (low, high)).all()
    if straight:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(*(low + high) / 2, 0.0),
            size=(*(high - low) / 2, half),
            **fields,
        )
        return
    middle = corners.mean(0)
    flat = corners - middle
    x, y = flat.T
    if (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0:
        flat = flat[::-1]  # counter-clockwise, or its faces would look inwards
    points = np.concatenate([np.c_[flat, np.full(len(flat), z)] for z in (-half, half)])
    name = f"mark{layer}"
    spec.add_mesh(
        name=name,
        uservert=points.ravel().tolist(),
        userface=_prism(len(corners)),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=(*middle, 0.0), **fields
    )


def _prism(n: int) -> list[int]:
    """Triangles of an upright prism over n corners, the lower ones first."""
    faces: list[int] = []
    for i in range(1, n - 1):
        faces += [0, i + 1, i, n, n + i, n + i + 1]
    for i in range(n):
        j = (i + 1) % n
        faces += [i, j, n + j, i, n + j, n + i]
    return faces


def _waves(spec: mujoco.MjSpec, ground: Terrain) -> None:
    """Golf's waves as a height field that nothing touches."""
    heights = ground.mesh()[..., 2]
    rows, columns = heights.shape
    (x0, x1), (y0, y1) = AREA_X, AREA_Y
    high, base = ground.highest, 0.05
    spec.add_hfield(
        name="waves",
        size=((x1 - x0) / 2, (y1 - y0) / 2, 2 * high, base),
        nrow=rows,
        ncol=columns,
        userdata=((heights + high) / (2 * high)).ravel().tolist(),
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="waves",
        pos=((x0 + x1) / 2, (y0 + y1) / 2, -high),
        contype=0,
        conaffinity=0,
        rgba=(*rgb(FAIRWAY), 1.0),
    )

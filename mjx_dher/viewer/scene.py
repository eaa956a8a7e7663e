"""A MuJoCo model as a viser scene, with nodes that move with its bodies."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_dher.tools.render import geom_rgba, ghost_rgba

_FLOOR = (0.80, 0.82, 0.85)  # colour of a plane
_TYPES = mujoco.mjtGeom


class Shape(NamedTuple):
    """A visible geom, in its body's frame."""

    name: str
    body: int
    kind: int  # mujoco.mjtGeom
    size: np.ndarray  # [3] as in MuJoCo
    rgba: np.ndarray  # [4] in [0, 1]
    pos: np.ndarray  # [3] m
    quat: np.ndarray  # [4] w, x, y, z
    mesh: int  # index of its mesh, or -1


def shapes(model: Any) -> list[Shape]:
    """Visible geoms of a compiled model, in its order. Raises ValueError if a geom type is not supported."""
    known = {int(kind) for kind in (_TYPES.mjGEOM_PLANE, _TYPES.mjGEOM_SPHERE, _TYPES.mjGEOM_CAPSULE, _TYPES.mjGEOM_ELLIPSOID)}
    known |= {int(kind) for kind in (_TYPES.mjGEOM_CYLINDER, _TYPES.mjGEOM_BOX, _TYPES.mjGEOM_MESH)}
    seen = []
    for index in range(model.ngeom):
        rgba, kind = geom_rgba(model, index), int(model.geom_type[index])
        material = int(model.geom_matid[index])
        if rgba[3] == 0 or model.geom_group[index] > 2:  # groups that MuJoCo's viewer hides
            continue
        if kind not in known:
            raise ValueError(f"the viewer does not draw geoms of kind {_TYPES(kind).name}")
        if kind == int(_TYPES.mjGEOM_PLANE) and material >= 0:
            rgba = np.array([*_FLOOR, 1.0])
        name = model.geom(index).name or f"geom_{index}"
        look = model.geom_size[index].copy(), rgba.copy()
        place = model.geom_pos[index].copy(), model.geom_quat[index].copy()
        seen.append(Shape(name, int(model.geom_bodyid[index]), kind, *look, *place, int(model.geom_dataid[index])))
    return seen


class Poses:
    """Poses of a model's bodies in a configuration."""

    def __init__(self, model: Any):
        self._model, self._data = model, mujoco.MjData(model)

    def at(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions [nbody, 3] in m and orientations [nbody, 4] (w, x, y, z) at a configuration [nq]."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.xpos, self._data.xquat


def front(model: Any, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Position [3] in m, direction [3] and vertical angle in rad of the camera "front" in a configuration [nq], or None."""
    index, data = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "front"), mujoco.MjData(model)
    if index < 0:
        return None
    data.qpos[:] = qpos
    for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):  # it may be in a body, or follow one
        compute(model, data)
    return data.cam_xpos[index], -data.cam_xmat[index].reshape(3, 3)[:, 2], float(np.radians(model.cam_fovy[index]))


def add(scene: Any, model: Any, ghosts: Any = None) -> dict[int, Any]:
    """Adds a model's geoms to a viser scene. Returns the nodes of bodies with geoms, by body number.

    With `ghosts`, only these bodies are added, a second time and in the colours of goals.
    """
    nodes: dict[int, Any] = {}
    folder = "/bodies" if ghosts is None else "/ghosts"
    chosen = shapes(model)
    if ghosts is not None:
        chosen = [shape._replace(rgba=ghost_rgba(shape.rgba)) for shape in chosen if shape.body in ghosts]
    for shape in chosen:
        if shape.body not in nodes:
            nodes[shape.body] = scene.add_frame(f"{folder}/{shape.body}", show_axes=False)
        name = shape.name.replace("/", "|")  # a slash would put it into another geom's frame
        _add_shape(scene, model, shape, f"{folder}/{shape.body}/{name}")
    return nodes


def _add_shape(scene: Any, model: Any, shape: Shape, name: str) -> None:
    rgb = tuple(round(255 * float(x)) for x in shape.rgba[:3])
    x, y, z = map(float, shape.size)
    if shape.kind == int(_TYPES.mjGEOM_PLANE):
        wide, deep = (2 * side if side > 0 else 20.0 for side in (x, y))  # 0 means infinite
        scene.add_grid(
            name,
            wide,
            deep,
            cell_size=0.25,
            section_size=1.0,
            cell_color=_shade(rgb, 0.93),
            section_color=_shade(rgb, 0.86),
            plane_color=rgb,
            plane_opacity=1.0,
            shadow_opacity=0.3,
            position=shape.pos,
            wxyz=shape.quat,
        )
        return
    look: dict[str, Any] = {"color": rgb, "position": shape.pos, "wxyz": shape.quat}
    look["opacity"] = None if shape.rgba[3] >= 1 else float(shape.rgba[3])
    if shape.kind == int(_TYPES.mjGEOM_BOX):
        scene.add_box(name, dimensions=(2 * x, 2 * y, 2 * z), **look)
    elif shape.kind == int(_TYPES.mjGEOM_CYLINDER):
        scene.add_cylinder(name, radius=x, height=2 * y, radial_segments=48, **look)
    elif shape.kind == int(_TYPES.mjGEOM_SPHERE):
        scene.add_icosphere(name, radius=x, subdivisions=3, **look)
    else:
        vertices, faces = _mesh(model, shape)
        scene.add_mesh_simple(name, vertices, faces, **look)


def _mesh(model: Any, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] in m and triangles [F, 3] of a capsule, an ellipsoid or a mesh."""
    import trimesh

    if shape.kind == int(_TYPES.mjGEOM_CAPSULE):
        mesh = trimesh.creation.capsule(height=2 * float(shape.size[1]), radius=float(shape.size[0]), count=[24, 24])
        middle = np.mean(mesh.bounds, axis=0)  # the origin of a capsule depends on trimesh's version
        return np.asarray(mesh.vertices - middle, np.float32), np.asarray(mesh.faces, np.uint32)
    if shape.kind == int(_TYPES.mjGEOM_ELLIPSOID):
        mesh = trimesh.creation.icosphere(subdivisions=3)
        return np.asarray(mesh.vertices * shape.size, np.float32), np.asarray(mesh.faces, np.uint32)
    number = shape.mesh
    start, count = int(model.mesh_vertadr[number]), int(model.mesh_vertnum[number])
    first, faces = int(model.mesh_faceadr[number]), int(model.mesh_facenum[number])
    return model.mesh_vert[start : start + count].copy(), model.mesh_face[first : first + faces].astype(np.uint32)


def _shade(rgb: tuple[int, ...], factor: float) -> tuple[int, ...]:
    return tuple(round(factor * x) for x in rgb)

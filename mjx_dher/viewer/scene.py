"""A MuJoCo model as a viser scene, with nodes that move with its bodies."""

from typing import Any

import mujoco
import numpy as np

from mjx_dher.tools.render import geom_rgba, ghost_rgba

_FLOOR = (0.80, 0.82, 0.85)  # colour of a plane with a material
_TYPES = mujoco.mjtGeom
_ROUND = (_TYPES.mjGEOM_SPHERE, _TYPES.mjGEOM_CAPSULE, _TYPES.mjGEOM_ELLIPSOID, _TYPES.mjGEOM_CYLINDER)
_FLAT = (_TYPES.mjGEOM_PLANE, _TYPES.mjGEOM_BOX, _TYPES.mjGEOM_MESH, _TYPES.mjGEOM_HFIELD)
_KINDS = {int(kind) for kind in (*_ROUND, *_FLAT)}


def visible(model: Any) -> list[int]:
    """Visible geoms of a compiled model. Raises ValueError if one has a type that is not supported."""
    # MuJoCo's viewer hides the groups above 2, too.
    geoms = [geom for geom in range(model.ngeom) if geom_rgba(model, geom)[3] > 0 and model.geom_group[geom] <= 2]
    for kind in model.geom_type[geoms]:
        if kind not in _KINDS:
            raise ValueError(f"the viewer does not draw geoms of kind {_TYPES(kind).name}")
    return geoms


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
    for geom in visible(model):
        body, rgba = int(model.geom_bodyid[geom]), geom_rgba(model, geom)
        if ghosts is not None and body not in ghosts:
            continue
        if body not in nodes:
            nodes[body] = scene.add_frame(f"{folder}/{body}", show_axes=False)
        name = (model.geom(geom).name or f"geom_{geom}").replace("/", "|")  # a slash would put it into another geom's frame
        _add_geom(scene, model, geom, rgba if ghosts is None else ghost_rgba(rgba), f"{folder}/{body}/{name}")
    return nodes


def _add_geom(scene: Any, model: Any, geom: int, rgba: np.ndarray, name: str) -> None:
    kind, (x, y, z) = model.geom_type[geom], map(float, model.geom_size[geom])
    place = {"position": model.geom_pos[geom].copy(), "wxyz": model.geom_quat[geom].copy()}
    if kind == _TYPES.mjGEOM_PLANE:
        wide, deep = (2 * side if side > 0 else 20.0 for side in (x, y))  # 0 means infinite
        rgb = to_bytes(_FLOOR if model.geom_matid[geom] >= 0 else rgba)
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
            **place,
        )
        return
    look: dict[str, Any] = {"color": to_bytes(rgba), "opacity": None if rgba[3] >= 1 else float(rgba[3]), **place}
    if kind == _TYPES.mjGEOM_BOX:
        scene.add_box(name, dimensions=(2 * x, 2 * y, 2 * z), **look)
    elif kind == _TYPES.mjGEOM_CYLINDER:
        scene.add_cylinder(name, radius=x, height=2 * y, radial_segments=48, **look)
    elif kind == _TYPES.mjGEOM_SPHERE:
        scene.add_icosphere(name, radius=x, subdivisions=3, **look)
    else:
        scene.add_mesh_simple(name, *_mesh(model, geom), **look)


def _mesh(model: Any, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] in m and triangles [F, 3] of a capsule, an ellipsoid, a mesh or a height field."""
    import trimesh

    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == _TYPES.mjGEOM_HFIELD:
        return _heights(model, int(model.geom_dataid[geom]))
    if kind == _TYPES.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(height=2 * float(size[1]), radius=float(size[0]), count=[24, 24])
        middle = np.mean(mesh.bounds, axis=0)  # the origin of a capsule depends on trimesh's version
        return np.asarray(mesh.vertices - middle, np.float32), np.asarray(mesh.faces, np.uint32)
    if kind == _TYPES.mjGEOM_ELLIPSOID:
        mesh = trimesh.creation.icosphere(subdivisions=3)
        return np.asarray(mesh.vertices * size, np.float32), np.asarray(mesh.faces, np.uint32)
    number = model.geom_dataid[geom]
    start, count = int(model.mesh_vertadr[number]), int(model.mesh_vertnum[number])
    first, faces = int(model.mesh_faceadr[number]), int(model.mesh_facenum[number])
    return model.mesh_vert[start : start + count].copy(), model.mesh_face[first : first + faces].astype(np.uint32)


def _heights(model: Any, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] in m and triangles [F, 3] of a height field, without its sides and its base."""
    rows, columns, first = (int(at[number]) for at in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    wide, deep, high, _ = model.hfield_size[number]
    y, x = np.meshgrid(np.linspace(-deep, deep, rows), np.linspace(-wide, wide, columns), indexing="ij")
    z = high * model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    at = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    near, far = (at[:-1, :-1], at[:-1, 1:], at[1:, 1:]), (at[:-1, :-1], at[1:, 1:], at[1:, :-1])
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in (near, far)])
    return np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32), faces


def to_bytes(rgba: Any) -> tuple[int, ...]:
    """Red, green and blue of a colour, 0 to 255."""
    return tuple(round(255 * float(x)) for x in rgba[:3])


def _shade(rgb: tuple[int, ...], factor: float) -> tuple[int, ...]:
    return tuple(round(factor * x) for x in rgb)

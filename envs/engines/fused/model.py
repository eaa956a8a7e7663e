# mypy: disable-error-code="valid-type"
"""Structs of Warp arrays that hold a model and an environment's memory."""

from mjx_dher.system.warp_setup import wp

# How a body moves against its parent.
STILL, HINGE, SLIDE, FREE, MOCAP = range(5)
# Pairs of geoms: with flat ones, of round ones, and of ellipsoids; at the end, of round ones with cylinders.
PLANE_BOX, PLANE_CYLINDER, BOX_BOX, CYLINDER_BOX = range(4)
PLANE_SPHERE, PLANE_CAPSULE, SPHERE_SPHERE, SPHERE_CAPSULE, SPHERE_BOX, CAPSULE_CAPSULE, CAPSULE_BOX = range(4, 11)
PLANE_ELLIPSOID, SPHERE_ELLIPSOID, CAPSULE_ELLIPSOID, ELLIPSOID_BOX, SPHERE_CYLINDER, CAPSULE_CYLINDER = range(11, 17)
Polynomial = wp.types.vector(length=5, dtype=float)
Softness = wp.types.vector(length=7, dtype=float)  # stiffness k, damping b; impedance: at 0, at the end, width, middle, power

_ints, _floats, _vec3s, _quats = wp.array(dtype=int), wp.array(dtype=float), wp.array(dtype=wp.vec3), wp.array(dtype=wp.vec4)
# Arguments of functions that Warp compiles.
Ints, Floats, Floats2d = _ints, _floats, wp.array2d(dtype=float)
_mat33s, _soft = wp.array(dtype=wp.mat33), wp.array(dtype=Softness)


@wp.struct
class Bodies:
    """Bodies with one joint at most. A parent comes before its children, and a body's subtree follows it without a gap."""

    number: int
    parent: _ints
    root: _ints  # the body of its tree that hangs on the world
    last: _ints  # the last body below it
    moved_by: _ints  # mask of the degrees of freedom that move it
    kind: _ints  # STILL, HINGE, ...
    qpos: _ints  # index of its first coordinate
    dof: _ints  # index of its first degree of freedom; of a mocap body, its number
    pos: _vec3s  # in the parent's frame
    quat: _quats
    axis: _vec3s  # of the joint, in the body's frame
    anchor: _vec3s
    rest: _floats  # coordinate of the joint in which the body is where `pos` and `quat` say
    com: _vec3s  # centre of mass, in the body's frame
    principal: _mat33s  # axes of `inertia`
    mass: _floats
    inertia: _vec3s


@wp.struct
class Tendons:
    """Fixed tendons with a spring, a damper or an actuator. Each is a sum of terms, which are coefficients of joints."""

    number: int
    terms: int
    tendon: _ints  # [terms] number of its tendon
    begin: _ints  # [number + 1] first term of a tendon
    dof: _ints  # [terms]
    qpos: _ints  # [terms] index of the coordinate
    coef: _floats  # [terms]
    stiffness: _floats
    damping: _floats
    spring: wp.array(dtype=wp.vec2)  # lengths between which the spring is slack
    drive: wp.array(dtype=wp.vec2)  # least and most force of all actuators on it
    actuator_tendon: _ints  # [actuators] or -1


@wp.struct
class Dofs:
    """Degrees of freedom [nv], and the joint limits and actuators on them."""

    number: int
    body: _ints
    armature: _floats
    damping: _floats
    implicit_damping: _floats  # the part that the integrator is implicit in
    implicit: int  # 1 for implicitfast: velocities are implicit in the forces of actuators, too, not in damping alone
    drive: wp.array(dtype=wp.vec2)  # least and most force of all actuators on it
    first_control: int  # index of the first control, behind the poses of mocap bodies
    stiffness: _floats  # 0 except for joints of one coordinate
    qpos: _ints  # index of the coordinate
    rest: _floats
    limits: int  # how many of them have limits; of each, by its number among those:
    limit_dof: _ints
    limit_range: wp.array(dtype=wp.vec2)
    limit_margin: _floats
    limit_soft: _soft
    limit_weight: _floats  # inverse inertia
    actuators: int
    actuator_dof: _ints  # or -1
    actuator_qpos: _ints
    actuator_force: wp.array(dtype=wp.vec4)  # for each of: 1, length, velocity; and the control
    actuator_clip: wp.array(dtype=wp.vec4)  # least and most control; least and most force
    tendons: Tendons


@wp.struct
class Contacts:
    """Geoms that meet [ngeom], pairs of them [npair], and the slots of the pairs' contacts [nslot]."""

    geom_body: _ints
    geom_pos: _vec3s  # in the body's frame
    geom_mat: _mat33s
    geom_size: _vec3s
    geom_reach: _floats  # radius of a sphere around it
    geom_half: _vec3s  # half lengths of a box around it
    pairs: int
    geom1: _ints
    geom2: _ints
    kind: _ints  # PLANE_BOX, ...
    first: _ints  # slot
    most: _ints  # slots
    margin: _floats
    dim: _ints
    edges: _ints  # rows of a contact
    friction: _vec3s  # along both tangents, and about the normal
    rolling: wp.array(dtype=wp.vec2)  # friction about both tangents
    soft: _soft
    weight: _floats  # inverse inertia, as the rows have it
    mu: _floats  # friction of an elliptic cone
    slip: _floats  # damping of its friction
    slots: int
    elliptic: int  # 1 if friction cones are elliptic
    pair: _ints  # pair of each slot
    rounds: int  # 2, in which contacts of a cylinder and a box are looked for
    near: int  # pairs that may be near at once, of all of which contacts are found; 0 if there is memory for all
    near_slots: int  # slots for their contacts, before those that touch are kept


@wp.struct
class Sparse:
    """Rows of constraints with few terms [rows]: friction, then equalities, then limits. A term is a coefficient of a joint."""

    rows: int
    frictions: int
    limits: int  # number of the first limit
    begin: _ints  # [rows + 1] first term of a row
    dof: _ints  # [terms]
    qpos: _ints  # [terms] index of the coordinate
    coef: _floats  # [terms]
    sloped: _ints  # [terms] 1 if the row's slope multiplies the coefficient, else 0
    rest: _floats  # [terms] coordinate from which an equality counts
    row: _ints  # [terms]
    dof_begin: _ints  # [nv + 1] first one in `dof_term` of a degree of freedom
    dof_term: _ints  # [terms] sorted by degrees of freedom
    soft: _soft
    inverse: _floats  # inverse inertia
    loss: _floats  # greatest force of friction
    span: wp.array(dtype=wp.vec2)
    margin: _floats
    poly: wp.array(dtype=Polynomial)  # of an equality


@wp.struct
class World:
    """The rest of a model."""

    timestep: float
    gravity: wp.vec3
    equalities: int  # rows of welds and of connected bodies, which come first
    welds: int  # of each, by its number:
    weld_body: _ints
    weld_target: _ints
    weld_soft: _soft
    weld_weight: wp.array(dtype=wp.vec2)  # inverse inertia of translation and rotation
    connects: int
    connect_body1: _ints
    connect_body2: _ints
    connect_anchor1: _vec3s  # in the body's frame
    connect_anchor2: _vec3s
    connect_soft: _soft
    connect_weight: _floats
    rows: int  # of constraints that there is room for
    tolerance: float
    iterations: int  # of Newton's method, at most
    ls_iterations: int
    scale: float  # of costs, by which they are compared with the tolerance


_matrices, _spatial = wp.array(dtype=wp.mat33), wp.array(dtype=wp.spatial_vector)


@wp.struct
class Memory:
    """Intermediate results of a substep, for one environment.

    Spatial vectors have the angular part first and refer to the place of the tree's first body.
    """

    # These are of no use once forces and the mass matrix are known: `jacobian` takes their place.
    moment: _vec3s  # [nbody] mass times place of the centre of mass
    inertia: _matrices
    force: _spatial  # that `bias` needs
    turning: _spatial  # [nv] acceleration for one unit of qvel
    momentum: _spatial  # [nv] of the body and its descendants, for one unit of qvel
    # These are of no use once the rows of constraints are known: `factor` takes their place.
    pos: _vec3s  # [nbody]
    quat: _quats
    mat: _matrices
    velocity: _spatial
    bias: _spatial  # acceleration without qacc and gravity
    motion: _spatial  # [nv] velocity for one unit of qvel
    distance: _floats  # [nslot]
    place: _vec3s  # [nslot]
    normal: _vec3s  # [nslot] from the first geom to the second
    touching: _ints  # [nslot] slots of the existing contacts
    slot: _ints  # [nslot] first row of each of those contacts
    limited: _ints  # [nlimit] row of each joint at its limit, or -1
    # Kept until the end of the substep.
    mass: _floats  # [nv * (nv + 1) / 2] lower half of the mass matrix, row by row
    smooth: _floats  # [nv] forces except those of constraints
    qacc: _floats  # [nv]
    inert: _floats  # [nv] mass matrix times qacc
    search: _floats  # [nv] direction of Newton's method
    step: _floats  # [nv] mass matrix times search
    qpos: _floats  # [nq]
    qvel: _floats  # [nv]
    counts: _ints  # [2] how many contacts, how many rows; with elliptic cones [3], rows without and with those of contacts
    cone: _ints  # [nslot] first row of an elliptic cone, and 2^16 times the number of its rows
    weight: _floats  # [rows] D, the inverse of a row's softness
    residual: _floats  # [rows] aref, and from the solver on J qacc - aref
    change: _floats  # [rows] J search
    sparse_weight: _floats  # [sparse rows] as above; 0 if a row does not act
    sparse_residual: _floats
    sparse_change: _floats
    sparse_slope: _floats  # side of a limit, and minus the derivative of an equality's polynomial
    factor: _floats  # Cholesky factor in the same order
    jacobian: _floats  # [rows * nv]


@wp.struct
class Layout:
    """Begin and length of each field of `Memory`, and the total size, in floats."""

    size: int
    pair: int  # begin of the pairs of contacts, behind the fields
    begin: _ints  # by the number of the field
    length: _ints

"""Arrays of the contact kernels, grouped: plants and their capsules, rigid geoms, candidates, contacts, warm start.

Sizes in brackets. Positions and velocities are in world axes; a *capsule* always belongs to a plant and a *geom* to a
rigid body. One side of a contact is a capsule; the other is a geom (its number) or another plant's capsule (-1 - its
number).
"""

import warp as wp

from vinesim.kernels.contact.friction_law import Surface

wp.set_module_options({"enable_backward": False})

# entries of ``counters``
AWAKE_TREES = wp.constant(0)
CONTACTS = wp.constant(1)
OVERFLOW = wp.constant(2)
"""Contacts beyond what one tree can have at once."""
IMPACTED_TREES = wp.constant(3)
"""Trees with a contact that closes faster than the impact speed."""
BODIES = wp.constant(4)
"""Plant bodies in contact."""
SORT_AXIS = wp.constant(5)
"""World axis (0, 1, 2) along which the boxes of trees are sorted."""
ISLANDS = wp.constant(6)
BLOCKS = wp.constant(8)
MATRIX_ENTRIES = wp.constant(9)
"""Entries of the matrices of all blocks, or of those of the Newton steps of all islands, whichever are more."""
SKIPPED_GEOMS = wp.constant(7)
"""Static geoms beyond what one tree can be near to."""
GROUPS = wp.constant(10)
"""Groups of sides of contacts."""
RESPONSE_NUMBERS = wp.constant(11)
"""Numbers of the responses to all groups."""
HAVE_ROOM = wp.constant(12)
"""1 if there are contacts, and room for all of them; else 0."""
UNFINISHED = wp.constant(13)
"""Islands whose solve ended at the largest number of sweeps."""
NEAR_ASLEEP = wp.constant(14)
"""Sleeping trees that actors are near to."""
COUNTERS = 15

AABB_BLOCK = wp.constant(32)
"""So many static boxes share one box around them, and are skipped by one comparison."""


@wp.struct
class Parameters:
    """Numbers of the contact model, see :class:`vinesim.scene.physics_parameters.PhysicsParameters`."""

    dt: wp.float64
    """[s]"""
    margin: wp.float64
    """[m] Contacts with movable geoms exist from this gap on."""
    static_margin: wp.float64
    """[m] The same for static geoms and other plants."""
    max_separation_speed: wp.float64
    """[m/s]"""
    impact_speed: wp.float64
    """[m/s] A contact that closes faster is an impact."""
    wire_damping_time: wp.float64
    """[s] damping of a wire over its stiffness."""


@wp.struct
class Aabbs:
    """Axis-aligned boxes [box] m; empty where low > high."""

    low: wp.array(dtype=wp.vec3)
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Trees:
    """State of all trees; a tree is one kinematic tree of a plant."""

    awake: wp.array(dtype=wp.int32)
    """[k] numbers of the trees that this step is about; as many as the thread count says."""
    is_awake: wp.array(dtype=wp.bool)
    """[tree]"""
    is_fine: wp.array(dtype=wp.bool)
    """[tree] whether the clusters of its bunches are free to move."""
    is_remote: wp.array(dtype=wp.bool)
    """[tree] whether another client owns its state."""
    bunch_attached: wp.array(dtype=wp.bool)
    """[bunch]"""


@wp.struct
class PlantBodies:
    """Bodies of all plants."""

    parent: wp.array(dtype=wp.int32)
    """[body] -1 for a root."""
    tree: wp.array(dtype=wp.int32)
    """[body]"""
    is_cut: wp.array(dtype=wp.bool)
    """[body] whether its joint was cut."""
    q: wp.array(dtype=wp.transform)
    """[body] pose of its origin."""
    qd: wp.array(dtype=wp.spatial_vector)
    """[body] velocity (linear, angular) of its origin at the start of the step."""
    qd_free: wp.array(dtype=wp.spatial_vector)
    """[body] the same at the end of the step if there were no contacts."""


@wp.struct
class Capsules:
    """Collision capsules of all plants, sorted by body."""

    tree_start: wp.array(dtype=wp.int32)
    """[tree + 1] first capsule of each tree."""
    tree_last_bunch: wp.array(dtype=wp.int32)
    """[tree] highest number of a bunch in it, -1 for none."""
    body: wp.array(dtype=wp.int32)
    bunch: wp.array(dtype=wp.int32)
    """[capsule] -1 for wood."""
    level: wp.array(dtype=wp.int32)
    """[capsule] level of detail of its tree at which it exists: 0 both, 1 coarse, 2 fine."""
    local_start: wp.array(dtype=wp.vec3)
    """[capsule] m, in the body's frame."""
    local_end: wp.array(dtype=wp.vec3)
    radius: wp.array(dtype=float)
    """[capsule] m"""
    material: wp.array(dtype=wp.int32)
    """[capsule] Material"""
    extent: wp.array(dtype=float)
    """[capsule] m, farthest point from the body's origin."""
    rest_start: wp.array(dtype=wp.vec3)
    """[capsule] m, in the world while all plants rest as they were generated."""
    rest_end: wp.array(dtype=wp.vec3)
    tied_geom: wp.array2d(dtype=wp.int32)
    """[capsule, k] MuJoCo's numbers of wires that it does not collide with, being tied to them; -1 for none."""
    tied_joint: wp.array2d(dtype=wp.int32)
    """[capsule, k] body whose joint connects it with the neighbour that is tied there; -1: it is tied itself."""


@wp.struct
class CapsuleStates:
    """The capsules at the start of the step [capsule]; of sleeping trees, where they fell asleep."""

    start: wp.array(dtype=wp.vec3)
    end: wp.array(dtype=wp.vec3)
    speed: wp.array(dtype=float)
    """[m/s] bound of the speed of all its points."""
    low: wp.array(dtype=wp.vec3)
    """[m] box of the space that it sweeps in the step."""
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Clearances:
    """How far capsules of awake trees were from contact with sleeping trees when they were last compared [capsule]."""

    start: wp.array(dtype=wp.vec3)
    """[m] then."""
    end: wp.array(dtype=wp.vec3)
    distance: wp.array(dtype=float)
    """[m] that they may move from there; negative if they must be compared in any case."""
    reach: wp.array(dtype=float)
    """[m] around the capsule to be searched in this step; 0 for none."""


@wp.struct
class Geoms:
    """Rigid geoms that plants collide with [geom]: first those that can move, then static ones."""

    count: wp.array(dtype=wp.int32)
    """[2] number of those that can move, and of all; there is room for more."""
    id: wp.array(dtype=wp.int32)
    """number in MuJoCo's arrays."""
    body: wp.array(dtype=wp.int32)
    """MuJoCo body."""
    root: wp.array(dtype=wp.int32)
    """root body of its kinematic tree, about whose centre of mass MuJoCo expresses ``cvel`` and ``cdof``."""
    dof: wp.array(dtype=wp.int32)
    """last degree of freedom that moves it, -1 for none."""
    kind: wp.array(dtype=wp.int32)
    """mjtGeom; a mesh is its convex hull."""
    hull: wp.array(dtype=wp.int32)
    """of a mesh, -1 for other kinds."""
    size: wp.array(dtype=wp.vec3d)
    """geom_size of MuJoCo."""
    center: wp.array(dtype=wp.vec3d)
    """[m] in the geom's frame."""
    half: wp.array(dtype=wp.vec3d)
    """[m] half edges of its box, in its own axes."""
    radius: wp.array(dtype=wp.float64)
    """[m] of its bounding sphere."""
    material: wp.array(dtype=wp.int32)
    """Material"""
    friction: wp.array(dtype=wp.float64)
    """[1] its own coefficient, whatever it touches; 0: that of the two materials."""
    is_remote: wp.array(dtype=wp.bool)
    """whether it belongs to the copy of another client's robot or person: that touches remote trees only."""


@wp.struct
class PassingBunches:
    """Free bunches that touch nothing of some trees: they overlapped these when they were picked, and still do."""

    by_tree: wp.array2d(dtype=wp.int32)
    """[tree, k] number of a bunch, -1 for an empty place."""
    of_geom: wp.array(dtype=wp.int32)
    """[geom] bunch that it belongs to, -1 for none."""


@wp.struct
class Hulls:
    """Convex hulls of meshes, each in the frame of its geoms, about their centre."""

    first_plane: wp.array(dtype=wp.int32)
    """[hull + 1]"""
    first_edge: wp.array(dtype=wp.int32)
    """[hull + 1]"""
    plane: wp.array(dtype=wp.vec4d)
    """[plane] outward normal and distance [m] from the centre."""
    edge_start: wp.array(dtype=wp.vec3d)
    """[edge] m"""
    edge_end: wp.array(dtype=wp.vec3d)
    """[edge] m"""
    edge_left: wp.array(dtype=wp.int32)
    """[edge] plane on one side of it."""
    edge_right: wp.array(dtype=wp.int32)
    """[edge] plane on the other side."""


@wp.struct
class GeomStates:
    """The same geoms at the start of the step [geom]."""

    center: wp.array(dtype=wp.vec3d)
    velocity: wp.array(dtype=wp.vec3d)
    """[m/s] of the centre."""
    angular_velocity: wp.array(dtype=wp.vec3d)
    """[rad/s]"""
    speed: wp.array(dtype=wp.float64)
    """[m/s] likely bound of the speed of all its points in the step."""
    offset: wp.array(dtype=wp.vec3d)
    """[m] of a deflected wire: its centre, from where it was drawn."""
    low: wp.array(dtype=wp.vec3)
    """[m] box of the space that it can sweep in the step."""
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Actors:
    """Robots, people, boxes and free bunches [actor]: each a range of the movable geoms."""

    count: wp.array(dtype=wp.int32)
    """[1] number of actors; there is room for more."""
    start: wp.array(dtype=wp.int32)
    """[actor + 1] first geom of each."""
    is_remote: wp.array(dtype=wp.bool)
    may_sleep: wp.array(dtype=wp.bool)
    """Boxes and free bunches wake plants only while MuJoCo has them awake."""


@wp.struct
class RigidBodies:
    """MuJoCo's arrays of the same names, and the velocities of its degrees of freedom."""

    xpos: wp.array(dtype=wp.vec3d)
    """[MuJoCo geom]"""
    xmat: wp.array(dtype=wp.mat33d)
    """[MuJoCo geom]"""
    cvel: wp.array2d(dtype=wp.float64)
    """[MuJoCo body, 6] angular, linear."""
    cdof: wp.array2d(dtype=wp.float64)
    """[dof, 6] angular, linear."""
    subtree_com: wp.array(dtype=wp.vec3d)
    """[MuJoCo body]"""
    dof_parent: wp.array(dtype=wp.int32)
    dof_tree: wp.array(dtype=wp.int32)
    tree_asleep: wp.array(dtype=wp.int32)
    """[MuJoCo tree] negative while it is awake."""
    velocity_free: wp.array(dtype=wp.float64)
    """[dof] at the end of the step if there were no plants."""
    correction: wp.array(dtype=wp.float64)
    """[dof] by which plants changed that prediction in the last step."""
    correction_before: wp.array(dtype=wp.float64)
    """[dof] the same in the step before."""
    tree_island: wp.array(dtype=wp.int32)
    """[MuJoCo tree] label of those that active constraints couple."""


@wp.struct
class RigidFactors:
    """MuJoCo's sparse factors L^T D L of the mass matrix M and of M^, which has the implicit servos in it."""

    tree_dof: wp.array(dtype=wp.int32)
    """tree_dofadr"""
    tree_dof_count: wp.array(dtype=wp.int32)
    row_start: wp.array(dtype=wp.int32)
    """M_rowadr"""
    row_count: wp.array(dtype=wp.int32)
    """M_rownnz"""
    column: wp.array(dtype=wp.int32)
    """M_colind"""
    implicit: wp.array(dtype=wp.float64)
    """qH"""
    implicit_inverse: wp.array(dtype=wp.float64)
    """qHDiagInv; 0 if nothing is implicit in the whole world: then M^ is M."""
    plain: wp.array(dtype=wp.float64)
    """qLD"""
    plain_inverse: wp.array(dtype=wp.float64)
    """qLDiagInv"""


@wp.struct
class Candidates:
    """What the narrowphase finds, by awake tree and slot [awake tree, slot]."""

    count: wp.array(dtype=wp.int32)
    """[awake tree] found; those beyond the number of slots are only counted."""
    is_impact: wp.array(dtype=wp.bool)
    """[awake tree] whether one of them is an impact."""
    near_geoms: wp.array2d(dtype=wp.int32)
    """[awake tree, k] scratch: geoms whose box overlaps that of the tree."""
    near_pairs: wp.array(dtype=wp.vec2i)
    """[awake tree * room + k] scratch: capsules and geoms whose boxes overlap."""
    skipped_geoms: wp.array(dtype=wp.int32)
    """[awake tree] static geoms whose box overlaps it as well, for which ``near_geoms`` has no room."""
    feature: wp.array2d(dtype=wp.int32)
    """2 * capsule + end of the part along a face; -1 for an empty slot."""
    other: wp.array2d(dtype=wp.int32)
    """geom, or -1 - capsule of another plant."""
    gap: wp.array2d(dtype=wp.float64)
    """[m] at the start of the step."""
    end_gap: wp.array2d(dtype=wp.float64)
    """[m] ``gap`` with what the curvature of the motion adds to it in the step; that of the velocity is not in it."""
    normal: wp.array2d(dtype=wp.vec3d)
    """from the other side to the capsule."""
    point: wp.array2d(dtype=wp.vec3d)
    """[m]"""


@wp.struct
class Contacts:
    """Contacts of the step [contact], one after the other."""

    source: wp.array(dtype=wp.int32)
    """awake tree * slots + slot of its candidate."""
    feature: wp.array(dtype=wp.int32)
    other: wp.array(dtype=wp.int32)
    body: wp.array(dtype=wp.int32)
    """plant body."""
    body_slot: wp.array(dtype=wp.int32)
    """place of ``body`` in the list of bodies in contact."""
    other_body: wp.array(dtype=wp.int32)
    """the other plant body, -1 for a geom."""
    other_slot: wp.array(dtype=wp.int32)
    """the same of the other plant body, -1 for a geom."""
    gap: wp.array(dtype=wp.float64)
    surface: wp.array(dtype=Surface)
    """what its two materials make of it; with the friction of a geom that has its own, and the spring of a wire."""
    wire_stiffness: wp.array(dtype=wp.float64)
    """[N/m] of the wire that is its other side; 0: of none, or one that does not give."""
    wire_shift: wp.array(dtype=wp.float64)
    """[m] gap to that wire without load, less that to its geom."""
    point: wp.array(dtype=wp.vec3d)
    axes: wp.array(dtype=wp.mat33d)
    """rows: normal, first and second tangent."""
    island: wp.array(dtype=wp.int32)
    block: wp.array(dtype=wp.int32)
    place: wp.array(dtype=wp.int32)
    """place in the list of the islands."""
    force: wp.array(dtype=wp.vec3d)
    """[N] on the plant."""


@wp.struct
class TouchedBodies:
    """Plant bodies in contact [slot], sorted, each once: those of one tree are neighbours."""

    body: wp.array(dtype=wp.int32)
    tree_start: wp.array(dtype=wp.int32)
    """[slot] first slot of the same tree."""
    tree_end: wp.array(dtype=wp.int32)
    """[slot] slot after the last of the same tree."""
    last_contact: wp.array(dtype=wp.int32)
    """[slot] scratch: the contact of the tree that begins here that was linked last."""


@wp.struct
class SideGroups:
    """Sides of contacts on plants, in groups of at most ten on one tree: see :mod:`vinesim.kernels.contact.row_response`."""

    side: wp.array(dtype=wp.int32)
    """[place] 2 * contact, and 1 more for the other plant body, by trees; in the order of the list of islands."""
    start: wp.array(dtype=wp.int32)
    """[group + 1] first place of each in ``side``."""
    tree: wp.array(dtype=wp.int32)
    """[group + 1] slot of the first touched body of its tree; -1 after the last group."""
    response: wp.array(dtype=wp.int32)
    """[group] first number of its response: by touched bodies of the tree, linear and angular velocity, columns."""
    first: wp.array(dtype=wp.int32)
    """[slot] first group of the tree whose touched bodies begin there."""
    listed: wp.array(dtype=wp.int32)
    """[slot] scratch: where the next side of that tree is listed."""


@wp.struct
class Islands:
    """Islands: sets of contacts that do not affect each other within the step. Each consists of blocks.

    A block is a set of contacts that plants couple. The blocks of an island are coupled by rigid bodies only.
    """

    start: wp.array(dtype=wp.int32)
    """[island + 1] first place of each in ``contact``."""
    first_block: wp.array(dtype=wp.int32)
    """[island + 1]"""
    block_start: wp.array(dtype=wp.int32)
    """[block + 1] first place of each in ``contact``."""
    row_start: wp.array(dtype=wp.int32)
    """[block + 1] first row of each in :class:`vinesim.kernels.contact.island_system.IslandSystem`: a multiple of eight."""
    matrix_start: wp.array(dtype=wp.int32)
    """[block + 1] first entry of its matrix in ``Rows.delassus``."""
    rigid_start: wp.array(dtype=wp.int32)
    """[island + 1] first entry of its rigid Jacobian in the same system."""
    system_start: wp.array(dtype=wp.int32)
    """[island + 1] first entry of its Newton steps in the same system."""
    contact: wp.array(dtype=wp.int32)
    """[place] contacts, island by island and block by block."""
    label: wp.array(dtype=wp.int32)
    """[contact] scratch: the first contact of the same island."""
    block_label: wp.array(dtype=wp.int32)
    """[contact] scratch: the first contact of the same block."""
    first_dof: wp.array(dtype=wp.int32)
    """[island + 1] first place of each in ``dof``."""
    dof: wp.array(dtype=wp.int32)
    """[place] degrees of freedom of the rigid bodies, island by island."""
    rigid_last_contact: wp.array(dtype=wp.int32)
    """[label of rigid bodies] scratch: the contact with these rigid bodies that was linked last."""
    sweeps: wp.array(dtype=wp.int32)
    """[island] Gauss-Seidel sweeps of the last solve."""


@wp.struct
class Rows:
    """Three rows for each contact [row]: normal, first and second tangent."""

    plant_jacobian: wp.array2d(dtype=wp.float64)
    """[row, 12] of the body and of the other plant body, each linear and angular."""
    rigid_jacobian: wp.array2d(dtype=wp.vec3d)
    """[contact, dof] of its three rows"""
    rigid_response: wp.array2d(dtype=wp.vec3d)
    """[contact, dof] M^-1 J^T: change of velocity of the rigid world for unit impulses along them."""
    delassus: wp.array(dtype=wp.float64)
    """J M^-1 J^T of the plants [entry], a matrix for each block, whose rows are filled up with zeros to a multiple of
    eight."""
    velocity_free: wp.array(dtype=wp.float64)
    """[row] m/s along the row at the end of the step without contacts."""
    bias: wp.array(dtype=wp.float64)
    """[row] m/s"""
    impulse: wp.array(dtype=wp.float64)
    """[row] N s"""


@wp.struct
class WarmStart:
    """What the next step starts from [contact of the last step]."""

    count: wp.array(dtype=wp.int32)
    """[1]"""
    feature: wp.array(dtype=wp.int32)
    """-1 if the contact did not press."""
    other: wp.array(dtype=wp.int32)
    normal_impulse: wp.array(dtype=wp.float64)
    friction_impulse: wp.array(dtype=wp.vec3d)
    """world axes."""
    anchor: wp.array(dtype=wp.vec3d)
    """[m] stretch of the tangential spring since the contact began to stick, world axes."""

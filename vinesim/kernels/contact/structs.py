"""Arrays of the contact kernels, grouped: plants and their capsules, rigid geoms, candidates, contacts, warm start.

Sizes are in brackets. Positions and velocities are in world axes. A *capsule* always belongs to a plant and a *geom*
to a rigid body. The first side of a contact is a capsule. The other side is a geom (stored as its index) or a capsule
of another plant (stored as -1 - its index).
"""

import warp as wp

from vinesim.kernels.contact.friction_law import Surface

wp.set_module_options({"enable_backward": False})

# indices into ``counters``; each entry is a count, except those whose docstring describes another meaning
AWAKE_TREES = wp.constant(0)
CONTACTS = wp.constant(1)
OVERFLOW = wp.constant(2)
"""Index in ``counters``: number of contacts that were found beyond the number that one tree can have at once."""
IMPACTED_TREES = wp.constant(3)
"""Index in ``counters``: number of trees with a contact that closes faster than the impact speed."""
BODIES = wp.constant(4)
"""Index in ``counters``: number of plant bodies in contact."""
SORT_AXIS = wp.constant(5)
"""Index in ``counters``: world axis (0, 1, 2) along which the boxes of trees are sorted."""
ISLANDS = wp.constant(6)
BLOCKS = wp.constant(8)
MATRIX_ENTRIES = wp.constant(9)
"""Index in ``counters``: number of entries of the matrices of all blocks, or of the Newton matrices of all islands,
whichever is larger.
"""
SKIPPED_GEOMS = wp.constant(7)
"""Index in ``counters``: number of static geoms near a tree that were left out because the tree's list was full."""
GROUPS = wp.constant(10)
"""Index in ``counters``: number of groups of contact sides; see :class:`SideGroups`."""
RESPONSE_NUMBERS = wp.constant(11)
"""Index in ``counters``: number of values in the responses to all groups of contact sides."""
HAVE_ROOM = wp.constant(12)
"""Index in ``counters``: 1 if there are contacts and the arrays have room for all of them, else 0."""
UNFINISHED = wp.constant(13)
"""Index in ``counters``: number of islands whose solve ended at the largest number of sweeps."""
NEAR_ASLEEP = wp.constant(14)
"""Index in ``counters``: number of sleeping trees that actors are near to."""
CHANGED_BLOCKS = wp.constant(15)
"""Index in ``counters``: number of blocks of tree boxes that contain an awake tree."""
SEARCHING_TREES = wp.constant(16)
"""Index in ``counters``: number of awake trees that are compared with sleeping trees."""
PAIRED_TREES = wp.constant(17)
"""Index in ``counters``: number of awake trees that are compared with each other."""
COUNTERS = 18

AABB_BLOCK = wp.constant(32)
"""Number of boxes in a block. A block has a common bounding box, so that one comparison can skip all its boxes."""


@wp.struct
class Parameters:
    """Numbers of the contact model, see :class:`vinesim.scene.physics_parameters.PhysicsParameters`."""

    dt: wp.float64
    """[s] Time step."""
    margin: wp.float64
    """[m] Gap below which contacts with movable geoms exist."""
    static_margin: wp.float64
    """[m] Gap below which contacts with static geoms and other plants exist."""
    max_separation_speed: wp.float64
    """[m/s] Largest velocity with which a contact pushes overlapping sides apart."""
    impact_speed: wp.float64
    """[m/s] Closing speed above which a contact is an impact."""
    wire_damping_time: wp.float64
    """[s] Damping of a wire divided by its stiffness."""


@wp.struct
class Aabbs:
    """Axis-aligned boxes [box], m. A box is empty where low > high."""

    low: wp.array(dtype=wp.vec3)
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Trees:
    """State of all trees; a tree is one kinematic tree of a plant."""

    awake: wp.array(dtype=wp.int32)
    """[k] Indices of the trees that this step handles. Kernels with a thread for each awake tree have k threads."""
    is_awake: wp.array(dtype=wp.bool)
    """[tree] Whether the tree is awake."""
    is_fine: wp.array(dtype=wp.bool)
    """[tree] Whether the berry clusters of the tree's bunches are free to move."""
    is_remote: wp.array(dtype=wp.bool)
    """[tree] Whether another client owns the tree's state."""
    bunch_attached: wp.array(dtype=wp.bool)
    """[bunch] Whether the bunch still hangs on its tree."""


@wp.struct
class PlantBodies:
    """Bodies of all plants."""

    parent: wp.array(dtype=wp.int32)
    """[body] Index of the parent body; -1 for a root."""
    tree: wp.array(dtype=wp.int32)
    """[body] Index of the tree that the body belongs to."""
    is_cut: wp.array(dtype=wp.bool)
    """[body] Whether the body's joint was cut."""
    q: wp.array(dtype=wp.transform)
    """[body] Pose of the body's origin."""
    qd: wp.array(dtype=wp.spatial_vector)
    """[body] Velocity (linear, angular) of the body's origin at the start of the step."""
    qd_free: wp.array(dtype=wp.spatial_vector)
    """[body] Velocity (linear, angular) of the body's origin at the end of the step if there were no contacts."""


@wp.struct
class Capsules:
    """Collision capsules of all plants, sorted by body."""

    tree_start: wp.array(dtype=wp.int32)
    """[tree + 1] first capsule of each tree."""
    tree_last_bunch: wp.array(dtype=wp.int32)
    """[tree] Highest index of a bunch on the tree; -1 for none."""
    body: wp.array(dtype=wp.int32)
    bunch: wp.array(dtype=wp.int32)
    """[capsule] Index of the bunch that the capsule belongs to; -1 for wood."""
    branch: wp.array(dtype=wp.int32)
    """[capsule] Number of the unbranched axis of its tree; 0 for the main axis, -1 for bunches and peduncles."""
    level: wp.array(dtype=wp.int32)
    """[capsule] Level of detail of the tree at which the capsule exists. 0: always; 1: only while the berry clusters
    are locked to their bunches (coarse); 2: only while the clusters move (fine).
    """
    local_start: wp.array(dtype=wp.vec3)
    """[capsule] Start of the axis, m, in the body's frame."""
    local_end: wp.array(dtype=wp.vec3)
    radius: wp.array(dtype=float)
    """[capsule] Radius, m."""
    stiffness: wp.array(dtype=wp.float64)
    """[capsule] Stiffness of the contacts of a leaf, N/m; 0: that of the two materials."""
    material: wp.array(dtype=wp.int32)
    """[capsule] Material of the surface (``Material``)."""
    extent: wp.array(dtype=float)
    """[capsule] Distance from the body's origin to the farthest point of the capsule, m."""
    rest_start: wp.array(dtype=wp.vec3)
    """[capsule] Start of the axis, m, in the world, while all plants rest as they were generated."""
    rest_end: wp.array(dtype=wp.vec3)
    tied_geom: wp.array2d(dtype=wp.int32)
    """[capsule, k] MuJoCo geom indices of the wires to which the capsule is tied, so that it does not collide with
    them.

    -1 for none.
    """
    tied_joint: wp.array2d(dtype=wp.int32)
    """[capsule, k] Body whose joint connects the capsule's body with the neighbour that is tied to that wire.

    -1 if the capsule's own body is tied.
    """


@wp.struct
class Leaves:
    """Capsules of leaves, which touch robots and people only. They stand after all capsules of :class:`Capsules` that
    belong to the range of a tree."""

    tree_start: wp.array(dtype=wp.int32)
    """[tree + 1] First leaf of each tree."""
    reach: wp.array(dtype=float)
    """[tree] Largest distance of a point of a leaf from the axis of the body that carries it, m."""
    most_reach: float
    """[m] Largest ``reach`` of all trees."""


@wp.struct
class CapsuleStates:
    """Positions and boxes of the capsules [capsule] at the start of the step. For sleeping trees: in the pose in which
    they fell asleep."""

    start: wp.array(dtype=wp.vec3)
    end: wp.array(dtype=wp.vec3)
    speed: wp.array(dtype=float)
    """[m/s] Upper bound of the speed of all points of the capsule."""
    low: wp.array(dtype=wp.vec3)
    """[m] Lower corner of the box around the space that the capsule sweeps in the step."""
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Clearances:
    """Distance of each capsule of an awake tree from contact with sleeping trees at their last comparison [capsule]."""

    start: wp.array(dtype=wp.vec3)
    """[m] Start of the capsule's axis at its last comparison with sleeping trees."""
    end: wp.array(dtype=wp.vec3)
    distance: wp.array(dtype=float)
    """[m] Distance that the capsule may move from ``start`` without a new comparison. Negative: compare in every
    step."""
    reach: wp.array(dtype=float)
    """[m] Distance around the capsule that is searched in this step; 0 for no search."""


@wp.struct
class Geoms:
    """Rigid geoms that plants collide with [geom]: first the geoms that can move, then the static geoms."""

    count: wp.array(dtype=wp.int32)
    """[2] Number of geoms that can move, and number of all geoms. The arrays have room for more."""
    id: wp.array(dtype=wp.int32)
    """[geom] Index in MuJoCo's arrays."""
    body: wp.array(dtype=wp.int32)
    """[geom] Index of the geom's MuJoCo body."""
    root: wp.array(dtype=wp.int32)
    """[geom] Root body of the geom's kinematic tree.

    MuJoCo's ``cvel`` and ``cdof`` refer to the centre of mass of this tree.
    """
    dof: wp.array(dtype=wp.int32)
    """[geom] Last degree of freedom that moves the geom; -1 for none."""
    kind: wp.array(dtype=wp.int32)
    """[geom] Shape (mjtGeom). A mesh collides as its convex hull."""
    hull: wp.array(dtype=wp.int32)
    """[geom] Index of the mesh's convex hull; -1 for geoms that are not meshes."""
    size: wp.array(dtype=wp.vec3d)
    """[geom] MuJoCo's geom_size."""
    center: wp.array(dtype=wp.vec3d)
    """[m] Centre of the geom's box, in the geom's frame."""
    half: wp.array(dtype=wp.vec3d)
    """[m] Half edges of the geom's box, in the box's axes."""
    radius: wp.array(dtype=wp.float64)
    """[m] Radius of the geom's bounding sphere."""
    material: wp.array(dtype=wp.int32)
    """[geom] Material of the surface (``Material``)."""
    friction: wp.array(dtype=wp.float64)
    """[1] The geom's own friction coefficient, for all contacts. 0: the coefficient of the two materials applies."""
    is_remote: wp.array(dtype=wp.bool)
    """[geom] Whether the geom belongs to a copy of another client's robot or person. Such a geom touches remote trees
    only."""
    touches_leaves: wp.array(dtype=wp.bool)
    """[geom] Whether the geom belongs to a robot or a person."""


@wp.struct
class PassingBunches:
    """Free bunches that pass through trees without contact, because they have overlapped these trees since they were
    picked."""

    by_tree: wp.array2d(dtype=wp.int32)
    """[tree, k] Index of a bunch that passes through the tree; -1 for an empty place."""
    of_geom: wp.array(dtype=wp.int32)
    """[geom] Index of the bunch that the geom belongs to; -1 for none."""


@wp.struct
class Hulls:
    """Shapes that a geom's size does not determine: convex hulls of meshes, in the frame of the geoms with that mesh,
    relative to the centre of their box; and uneven ground."""

    first_plane: wp.array(dtype=wp.int32)
    """[hull + 1] Index of the hull's first plane."""
    first_edge: wp.array(dtype=wp.int32)
    """[hull + 1] Index of the hull's first edge."""
    plane: wp.array(dtype=wp.vec4d)
    """[plane] Outward normal, and distance [m] from the centre."""
    edge_start: wp.array(dtype=wp.vec3d)
    """[edge] m, start of the edge."""
    edge_end: wp.array(dtype=wp.vec3d)
    """[edge] m, end of the edge."""
    edge_left: wp.array(dtype=wp.int32)
    """[edge] Index of the plane on one side of the edge."""
    edge_right: wp.array(dtype=wp.int32)
    """[edge] Index of the plane on the other side of the edge."""
    ground: wp.array2d(dtype=wp.float32)
    """[row, column] m, height of the nodes of uneven ground above its inclined plane; empty if the ground is a plane."""
    ground_frame: wp.array(dtype=wp.float64)
    """[5] Position x and y [m] of the first node of uneven ground, distance between nodes [m], and rise [1] of its
    inclined plane along x and y."""


@wp.struct
class GeomStates:
    """Motion of the geoms of :class:`Geoms` at the start of the step [geom]."""

    center: wp.array(dtype=wp.vec3d)
    velocity: wp.array(dtype=wp.vec3d)
    """[m/s] Velocity of the centre."""
    angular_velocity: wp.array(dtype=wp.vec3d)
    """[rad/s] Angular velocity of the geom."""
    speed: wp.array(dtype=wp.float64)
    """[m/s] Likely upper bound of the speed of all points of the geom in the step."""
    offset: wp.array(dtype=wp.vec3d)
    """[m] Displacement of a deflected wire's centre from its position in the scene."""
    low: wp.array(dtype=wp.vec3)
    """[m] Lower corner of the box around the space that the geom can sweep in the step."""
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Actors:
    """Robots, people, boxes and free bunches [actor]. Each actor is a range of the movable geoms."""

    count: wp.array(dtype=wp.int32)
    """[1] Number of actors. The arrays have room for more."""
    start: wp.array(dtype=wp.int32)
    """[actor + 1] Index of the actor's first geom."""
    is_remote: wp.array(dtype=wp.bool)
    may_sleep: wp.array(dtype=wp.bool)
    """[actor] Whether MuJoCo may put the actor to sleep.

    This is true for boxes and free bunches. They wake plants only while they are awake themselves.
    """


@wp.struct
class RigidBodies:
    """MuJoCo arrays under their MuJoCo names, and the velocities of MuJoCo's degrees of freedom."""

    xpos: wp.array(dtype=wp.vec3d)
    """[MuJoCo geom] Position, m."""
    xmat: wp.array(dtype=wp.mat33d)
    """[MuJoCo geom] Rotation."""
    cvel: wp.array2d(dtype=wp.float64)
    """[MuJoCo body, 6] Velocity: angular, linear."""
    cdof: wp.array2d(dtype=wp.float64)
    """[dof, 6] Motion axis: angular, linear."""
    subtree_com: wp.array(dtype=wp.vec3d)
    """[MuJoCo body] Centre of mass of the body's subtree, m."""
    dof_parent: wp.array(dtype=wp.int32)
    dof_tree: wp.array(dtype=wp.int32)
    tree_asleep: wp.array(dtype=wp.int32)
    """[MuJoCo tree] Negative while the tree is awake."""
    velocity_free: wp.array(dtype=wp.float64)
    """[dof] Velocity at the end of the step if there were no plants."""
    correction: wp.array(dtype=wp.float64)
    """[dof] Change of the predicted velocity by plants in the last step."""
    correction_before: wp.array(dtype=wp.float64)
    """[dof] Change of the predicted velocity by plants in the step before the last."""
    tree_island: wp.array(dtype=wp.int32)
    """[MuJoCo tree] Label that all trees coupled by active constraints share."""


@wp.struct
class RigidFactors:
    """MuJoCo's sparse factors L^T D L of the mass matrix M, and of M^, which is M with the implicit servos added."""

    tree_dof: wp.array(dtype=wp.int32)
    """[MuJoCo tree] First degree of freedom of the tree: MuJoCo's tree_dofadr."""
    tree_dof_count: wp.array(dtype=wp.int32)
    row_start: wp.array(dtype=wp.int32)
    """[dof] Index of the first entry of the row in sparse matrices: MuJoCo's M_rowadr."""
    row_count: wp.array(dtype=wp.int32)
    """[dof] Number of entries of the row in sparse matrices: MuJoCo's M_rownnz."""
    column: wp.array(dtype=wp.int32)
    """[entry] Column of the entry in sparse matrices: MuJoCo's M_colind."""
    implicit: wp.array(dtype=wp.float64)
    """MuJoCo's qH: factor of M^."""
    implicit_inverse: wp.array(dtype=wp.float64)
    """MuJoCo's qHDiagInv. 0 if nothing in the whole world is implicit: M^ then equals M."""
    plain: wp.array(dtype=wp.float64)
    """MuJoCo's qLD: factor of M."""
    plain_inverse: wp.array(dtype=wp.float64)
    """[dof] Inverse diagonal of the factor of M: MuJoCo's qLDiagInv."""


@wp.struct
class Candidates:
    """Candidate contacts that the narrowphase finds [awake tree, slot]."""

    count: wp.array(dtype=wp.int32)
    """[awake tree] Number of candidates found. Candidates beyond the number of slots are counted but not stored."""
    is_impact: wp.array(dtype=wp.bool)
    """[awake tree] Whether one of the tree's candidates is an impact."""
    near_geoms: wp.array2d(dtype=wp.int32)
    """[awake tree, k] Scratch: geoms whose box overlaps the tree's box."""
    near_pairs: wp.array(dtype=wp.vec2i)
    """[awake tree * room + k] Scratch: pairs of a capsule and a geom whose boxes overlap."""
    skipped_geoms: wp.array(dtype=wp.int32)
    """[awake tree] Number of static geoms whose box overlaps the tree's but for which ``near_geoms`` had no room."""
    feature: wp.array2d(dtype=wp.int32)
    """[awake tree, slot] 2 * capsule, plus 1 for the second contact point along a face; -1 for an empty slot."""
    other: wp.array2d(dtype=wp.int32)
    """[awake tree, slot] Index of the geom, or -1 - capsule of another plant."""
    gap: wp.array2d(dtype=wp.float64)
    """[m] Gap at the start of the step."""
    end_gap: wp.array2d(dtype=wp.float64)
    """[m] ``gap`` plus its change by the curvature of the motion in the step, without its change by the velocity."""
    normal: wp.array2d(dtype=wp.vec3d)
    """[awake tree, slot] Unit vector from the other side to the capsule."""
    point: wp.array2d(dtype=wp.vec3d)
    """[m] Contact point."""


@wp.struct
class Contacts:
    """Contacts of the step in one list [contact]."""

    source: wp.array(dtype=wp.int32)
    """[contact] Index of the contact's candidate: awake tree * slots + slot."""
    feature: wp.array(dtype=wp.int32)
    other: wp.array(dtype=wp.int32)
    body: wp.array(dtype=wp.int32)
    """[contact] Plant body of the capsule."""
    body_slot: wp.array(dtype=wp.int32)
    """[contact] Index of ``body`` in the list of bodies in contact (:class:`TouchedBodies`)."""
    other_body: wp.array(dtype=wp.int32)
    """[contact] The other plant body; -1 if the other side is a geom."""
    other_slot: wp.array(dtype=wp.int32)
    """[contact] Index of ``other_body`` in the list of bodies in contact; -1 if the other side is a geom."""
    gap: wp.array(dtype=wp.float64)
    surface: wp.array(dtype=Surface)
    """[contact] Contact properties of the two materials. They include the friction coefficient of a geom that has its
    own coefficient, and the spring of a wire.
    """
    wire_stiffness: wp.array(dtype=wp.float64)
    """[N/m] Stiffness of the wire on the contact's other side; 0 for a rigid wire or another shape."""
    wire_shift: wp.array(dtype=wp.float64)
    """[m] Gap to the position that a touched wire would have without this contact's force, minus the gap to the wire's
    geom.
    """
    point: wp.array(dtype=wp.vec3d)
    axes: wp.array(dtype=wp.mat33d)
    """[contact] Rows: normal, first tangent, second tangent."""
    island: wp.array(dtype=wp.int32)
    block: wp.array(dtype=wp.int32)
    place: wp.array(dtype=wp.int32)
    """[contact] Index of the contact in ``Islands.contact``."""
    force: wp.array(dtype=wp.vec3d)
    """[N] Force on the plant."""


@wp.struct
class TouchedBodies:
    """Plant bodies in contact, sorted, each listed once. The bodies of one tree are adjacent. [slot]: index in this
    list.
    """

    body: wp.array(dtype=wp.int32)
    tree_start: wp.array(dtype=wp.int32)
    """[slot] First slot of the tree to which the body in this slot belongs."""
    tree_end: wp.array(dtype=wp.int32)
    """[slot] Slot after the last slot of the tree to which the body in this slot belongs."""
    last_contact: wp.array(dtype=wp.int32)
    """[slot] Scratch, for the first slot of a tree: the contact of this tree that was linked last."""


@wp.struct
class SideGroups:
    """Sides of contacts on plants, in groups of at most ten sides on one tree. A side is one body of a contact; see
    :mod:`vinesim.kernels.contact.row_response`. [slot]: index in :class:`TouchedBodies`.
    """

    side: wp.array(dtype=wp.int32)
    """[k] List of the sides: 2 * contact, plus 1 for the contact's other plant body.

    Sorted by trees, then as in ``Islands.contact``.
    """
    start: wp.array(dtype=wp.int32)
    """[group + 1] Index in ``side`` of the group's first side."""
    tree: wp.array(dtype=wp.int32)
    """[group + 1] Slot of the first touched body of the group's tree; -1 after the last group."""
    response: wp.array(dtype=wp.int32)
    """[group] Index of the first value of the group's response.

    Its dimensions: touched body of the tree, component (linear and angular velocity), column.
    """
    first: wp.array(dtype=wp.int32)
    """[slot] First group of a tree. Only the slot of the tree's first touched body is used."""
    listed: wp.array(dtype=wp.int32)
    """[slot] Scratch: index in ``side`` at which the next side of a tree is listed. Only the slot of the tree's first
    touched body is used.
    """


@wp.struct
class Islands:
    """Islands: sets of contacts. Contacts of different islands do not affect each other within the step. An island
    consists of blocks.

    A block is a set of contacts that a tree or touching trees couple. Only rigid bodies couple the blocks of an island.
    """

    start: wp.array(dtype=wp.int32)
    """[island + 1] Index in ``contact`` of the island's first contact."""
    first_block: wp.array(dtype=wp.int32)
    """[island + 1] Index of the island's first block."""
    block_start: wp.array(dtype=wp.int32)
    """[block + 1] Index in ``contact`` of the block's first contact."""
    row_start: wp.array(dtype=wp.int32)
    """[block + 1] First row of the block in :class:`vinesim.kernels.contact.island_system.IslandSystem`.

    A multiple of eight.
    """
    matrix_start: wp.array(dtype=wp.int32)
    """[block + 1] Index in ``Rows.delassus`` of the first entry of the block's matrix."""
    rigid_start: wp.array(dtype=wp.int32)
    """[island + 1] Index in ``IslandSystem`` of the first entry of the island's rigid Jacobian."""
    system_start: wp.array(dtype=wp.int32)
    """[island + 1] Index in ``IslandSystem`` of the first entry of the island's Newton matrices."""
    contact: wp.array(dtype=wp.int32)
    """[place] Indices of the contacts, sorted by island and then by block."""
    label: wp.array(dtype=wp.int32)
    """[contact] Scratch: the first contact of the contact's island."""
    block_label: wp.array(dtype=wp.int32)
    """[contact] Scratch: the first contact of the contact's block."""
    first_dof: wp.array(dtype=wp.int32)
    """[island + 1] Index in ``dof`` of the island's first degree of freedom."""
    dof: wp.array(dtype=wp.int32)
    """[k] Degrees of freedom of the rigid bodies in contact, sorted by island."""
    rigid_last_contact: wp.array(dtype=wp.int32)
    """[label of rigid bodies] Scratch: the contact with the rigid bodies of this label that was linked last."""
    sweeps: wp.array(dtype=wp.int32)
    """[island] Gauss-Seidel sweeps of the last solve."""


@wp.struct
class Rows:
    """Three rows for each contact [row]: normal, first and second tangent."""

    plant_jacobian: wp.array2d(dtype=wp.float64)
    """[row, 12] Jacobian of the body (linear, angular), then of the other plant body (linear, angular)."""
    rigid_jacobian: wp.array2d(dtype=wp.vec3d)
    """[contact, dof] Jacobian of the contact's three rows."""
    rigid_response: wp.array2d(dtype=wp.vec3d)
    """[contact, dof] M^-1 J^T: change of the rigid world's velocity by unit impulses along the contact's three rows."""
    delassus: wp.array(dtype=wp.float64)
    """[entry] J M^-1 J^T of the plants: one matrix for each block.

    Its rows are padded with zeros to a multiple of eight.
    """
    velocity_free: wp.array(dtype=wp.float64)
    """[row] Velocity along the row at the end of the step without contacts, m/s."""
    bias: wp.array(dtype=wp.float64)
    """[row] Velocity that the solver adds to the residual of the row, m/s."""
    impulse: wp.array(dtype=wp.float64)
    """[row] Impulse along the row, N s."""


@wp.struct
class WarmStart:
    """Values from which the next step's solve starts [contact of the last step]."""

    count: wp.array(dtype=wp.int32)
    """[1] Number of contacts of the last step."""
    feature: wp.array(dtype=wp.int32)
    """[contact] As in :class:`Contacts`; -1 if the contact carried no force."""
    other: wp.array(dtype=wp.int32)
    normal_impulse: wp.array(dtype=wp.float64)
    friction_impulse: wp.array(dtype=wp.vec3d)
    """[N s] Friction impulse, world axes."""
    anchor: wp.array(dtype=wp.vec3d)
    """[m] Stretch of the tangential spring since the contact began to stick, world axes."""

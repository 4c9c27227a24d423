"""Contacts with wires that deflect: springs of the contacts, forces on wires (presses), and positions of wire geoms.

Each kernel runs with one thread: few contacts are with wires, and each of them depends on all other contacts of its
wire. :mod:`vinesim.wires.deflected_wires` describes the model.
"""

import warp as wp

from vinesim.kernels.wires.elastic_supports import (
    LEAST_RISE,
    MOST_TURNS,
    SupportedBodies,
    SupportedSprings,
    SupportNodes,
    Wires,
    wire_spring,
)

wp.set_module_options({"enable_backward": False})

TENSION_STEP = wp.constant(wp.float64(1.0e-4))
"""[1] Change of a wire's tension, as a share of it, that shows how its deflection depends on it."""


@wp.struct
class WireNumbers:
    """Parameters of contacts with wires; :mod:`vinesim.wires.deflected_wires` describes each of them."""

    dt: wp.float64
    followed: wp.float64
    extrapolated: wp.float64
    forgetting: wp.float64  # [1] dt divided by the time constant of the means
    recovery: wp.float64  # [1] share of its deflection that a released wire keeps in a step
    least_weight: wp.float64
    least_share: wp.float64  # [1] least distance between a wire's nodes, as a share of its length
    least_spread: wp.float64
    least_deflection: wp.float64
    max_deflection: wp.float64
    touching: wp.float64
    same_place: wp.float64
    max_normal_along_wire: wp.float64
    out_of_reach: wp.float64


@wp.struct
class WireGeoms:
    """Positions of the wires' collision geoms. Arrays are [piece] over all fixed pieces, unless stated otherwise."""

    start: wp.array(dtype=wp.vec3d)  # [m] start, undeflected
    axis: wp.array(dtype=wp.vec3d)  # unit vector to the end
    offset: wp.array2d(dtype=wp.vec3d)  # [piece, 2] m, displacement of both ends from their undeflected positions
    is_held: wp.array(dtype=wp.bool)  # whether a body presses on the wire or is near it
    deflected: wp.array(dtype=wp.int32)  # [k] pieces whose offset is not 0, in the order in which they were pressed
    count: wp.array(dtype=wp.int32)  # [2] number of deflected pieces, and number of loaded supports
    loaded: wp.array(dtype=wp.int32)  # [k] supports that are loaded, in the order in which they were pressed


@wp.struct
class WireContacts:
    """Contacts with wires in one contact solve. Arrays are [contact]."""

    count: wp.array(dtype=wp.int32)  # [1]
    piece: wp.array(dtype=wp.int32)
    key: wp.array(dtype=wp.int64)  # identifies the pair of shapes
    tree: wp.array(dtype=wp.int32)  # the tree that presses, or -1 minus the kinematic tree of the rigid world
    point: wp.array(dtype=wp.vec3d)  # [m]
    normal: wp.array(dtype=wp.vec3d)  # from the wire to the other side
    gap: wp.array(dtype=wp.float64)  # [m] gap to the wire's geom
    closing: wp.array(dtype=wp.float64)  # [m/s] speed with which the gap would close without the contacts
    force: wp.array(dtype=wp.float64)  # [N] found by the solve
    velocity: wp.array(dtype=wp.float64)  # [m/s] along the normal, found by the solve
    along: wp.array(dtype=wp.float64)  # [m] distance from the wire's start
    stiffness: wp.array(dtype=wp.float64)  # [N/m] of the spring
    shift: wp.array(dtype=wp.float64)  # [m] gap at which the spring is at rest, minus the gap to the geom
    geom: wp.array(dtype=wp.vec3d)  # [m] displacement of the geom at this point from its undeflected position
    place: wp.array(dtype=wp.vec3d)  # [m] displacement of the wire at this point, under the forces of the last step
    last: wp.array(dtype=wp.int32)  # index of the contact's press in the last step, -1 for a new contact
    last_force: wp.array(dtype=wp.float64)  # [N] force of that press, extrapolated
    weight: wp.array(dtype=wp.float64)  # [N] mean of that force
    others: wp.array(dtype=wp.float64)  # [m] mean deflection by the other presses, along the normal


@wp.struct
class WirePresses:
    """Presses: forces on wires, one for each contact of the last step. Arrays are [press]."""

    count: wp.array(dtype=wp.int32)  # [1]
    piece: wp.array(dtype=wp.int32)
    key: wp.array(dtype=wp.int64)
    tree: wp.array(dtype=wp.int32)
    along: wp.array(dtype=wp.float64)  # [m] distance from the wire's start
    normal: wp.array(dtype=wp.vec3d)
    place: wp.array(dtype=wp.vec3d)  # [m] displacement of the wire from its undeflected position
    force: wp.array(dtype=wp.float64)  # [N] force expected in the next step
    pushed: wp.array(dtype=wp.float64)  # [N] force of the last step
    weight: wp.array(dtype=wp.float64)
    others: wp.array(dtype=wp.float64)


@wp.func
def interval_of(piece: int, x: wp.float64, wires: Wires, nodes: SupportNodes):
    """Returns the index of the first node beyond point ``x`` [m] of a wire, and the positions [m] of the two nodes (or
    posts) next to the point.
    """
    low = wp.float64(0.0)
    high = wires.length[piece]
    node = int(0)
    support = wires.support[piece]
    if support >= 0:
        node = nodes.first[support]
        end = nodes.first[support + 1]
        while node < end and wires.node_along[node] < x:
            low = wires.node_along[node]
            node = node + 1
        if node < end:
            high = wires.node_along[node]
    return node, low, high


@wp.func
def deflection_between(piece: int, x: wp.float64, wires: Wires, nodes: SupportNodes, presses: WirePresses):
    """Returns the deflection [m] of a wire's point ``x`` [m] from the line between the two nodes next to it, which
    presses between these nodes cause."""
    zero = wp.float64(0.0)
    _, low, high = interval_of(piece, x, wires, nodes)
    found = wp.vec3d()
    for j in range(presses.count[0]):
        y = presses.along[j]
        if presses.piece[j] == piece and presses.force[j] > zero and y <= high and (y > low or low == zero):
            share = wp.max(wp.min(x, y) - low, zero) * wp.max(high - wp.max(x, y), zero)
            compliance = share / wp.max(wires.tension[piece] * (high - low), wp.float64(1.0e-12))
            found = found - compliance * presses.force[j] * presses.normal[j]
    return found


@wp.func
def bulge_of(piece: int, wires: Wires, nodes: SupportNodes, presses: WirePresses):
    """Returns by how much presses lengthen a wire beyond the line through its nodes, times its tension squared [N^2
    m]: half the sum of force times deflection times tension."""
    total = wp.float64(0.0)
    for j in range(presses.count[0]):
        if presses.piece[j] == piece and presses.force[j] > wp.float64(0.0):
            moved = deflection_between(piece, presses.along[j], wires, nodes, presses)
            total = total - wp.float64(0.5) * wires.tension[piece] * presses.force[j] * wp.dot(presses.normal[j], moved)
    return total


@wp.func
def tangent_stiffness(
    i: int,
    alone: wp.float64,
    deflection: wp.vec3d,
    between: wp.vec3d,
    least_share: wp.float64,
    wires: Wires,
    nodes: SupportNodes,
    bodies: SupportedBodies,
    springs: SupportedSprings,
    loads: wp.array(dtype=wp.vec3d),
    contacts: WireContacts,
):
    """Returns the stiffness [N/m] by which the force of contact ``i`` grows, where the wire's tension grows as well.

    alone: stiffness at constant tension; deflection: displacement of the point of contact, except the part
    ``between`` the nodes, which falls as the tension grows.
    """
    piece = contacts.piece[i]
    tension = wires.tension[piece]
    if wires.resistance[piece] <= wp.float64(0.0):
        return alone
    more = TENSION_STEP * tension
    _stiffness, rest, moved = wire_spring(
        piece, contacts.along[i], tension + more, least_share, wires, nodes, bodies, springs, loads
    )
    fall = wp.dot((deflection - rest - moved) / more + between / tension, contacts.normal[i])
    softer = wires.stretch[piece] * fall * fall / (wp.float64(1.0) + wires.resistance[piece])
    return one_over(one_over(alone) - wp.min(softer, wp.float64(0.95) * one_over(alone)))


@wp.func
def one_over(x: wp.float64):
    """Returns 1 / x."""
    return wp.float64(1.0) / x


@wp.func
def last_press(i: int, same_place: wp.float64, contacts: WireContacts, presses: WirePresses):
    """Returns the index of the last step's press (force on a wire) of contact ``i``: the nearest press with the
    contact's key; -1 if no such press is within ``same_place`` [m].
    """
    best = int(-1)
    nearest = same_place
    for j in range(presses.count[0]):
        if presses.key[j] == contacts.key[i] and presses.force[j] > wp.float64(0.0):
            distance = wp.abs(presses.along[j] - contacts.along[i])
            if distance < nearest:
                nearest = distance
                best = j
    return best


@wp.func
def string_ratio(x: wp.float64, y: wp.float64, length: wp.float64):
    """Returns the deflection of a taut string at ``x`` by a force at ``y``, divided by the deflection at ``x`` by an
    equal force at ``x`` (positions and ``length`` in m)."""
    least = wp.float64(1.0e-3) * length
    here = wp.clamp(x, least, length - least)
    ratio = y / here
    if y > x:
        ratio = (length - y) / (length - here)
    return wp.clamp(ratio, wp.float64(0.0), wp.float64(1.0))


@wp.func
def is_reached(i: int, numbers: WireNumbers, contacts: WireContacts):
    """Returns whether contact ``i`` is new and closes before the step ends."""
    return contacts.last[i] < 0 and contacts.gap[i] - numbers.dt * contacts.closing[i] < numbers.touching


@wp.func
def sharing(i: int, numbers: WireNumbers, wires: Wires, contacts: WireContacts, presses: WirePresses):
    """Returns the factor by which a wire is softer for contact ``i`` because other contacts press on the wire at the
    same time (1 without others)."""
    zero = wp.float64(0.0)
    piece = contacts.piece[i]
    x = contacts.along[i]
    length = wires.length[piece]
    largest = contacts.weight[i]
    for j in range(presses.count[0]):
        if presses.piece[j] == piece:
            largest = wp.max(largest, presses.weight[j])
    mine = wp.max(contacts.weight[i], numbers.least_weight * largest + wp.float64(1.0e-9))
    sum = wp.float64(1.0)
    for j in range(presses.count[0]):
        if presses.piece[j] == piece and j != contacts.last[i] and presses.weight[j] > zero:
            faces = wp.abs(wp.dot(presses.normal[j], contacts.normal[i]))
            sum = sum + presses.weight[j] / mine * string_ratio(x, presses.along[j], length) * faces
    for k in range(contacts.count[0]):
        if contacts.piece[k] == piece and k != i and is_reached(k, numbers, contacts):
            faces = wp.abs(wp.dot(contacts.normal[k], contacts.normal[i]))
            sum = sum + contacts.weight[k] / mine * string_ratio(x, contacts.along[k], length) * faces
    return sum


@wp.kernel
def find_wire_springs(
    # model
    numbers: WireNumbers,
    wires: Wires,
    nodes: SupportNodes,
    # in
    geoms: WireGeoms,
    bodies: SupportedBodies,
    springs: SupportedSprings,
    loads: wp.array(dtype=wp.vec3d),
    presses: WirePresses,
    # out
    contacts_out: WireContacts,
):
    """The only thread computes the springs of all contacts with wires.

    loads: [node] forces on the wires' nodes [N]; presses: presses of the last step; contacts: springs are written here.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    count = contacts_out.count[0]
    for i in range(count):
        piece = contacts_out.piece[i]
        length = wires.length[piece]
        contacts_out.along[i] = wp.clamp(
            wp.dot(contacts_out.point[i] - geoms.start[piece], geoms.axis[piece]), zero, length
        )
        last = last_press(i, numbers.same_place, contacts_out, presses)
        contacts_out.last[i] = last
        weight = wp.float64(1.0e-9)
        if last >= 0:
            weight = presses.weight[last]
        else:  # a new contact is assumed to press as hard as the hardest press on its wire
            for j in range(presses.count[0]):
                if presses.piece[j] == piece:
                    weight = wp.max(weight, presses.weight[j])
        contacts_out.weight[i] = weight
    for i in range(count):
        piece = contacts_out.piece[i]
        x = contacts_out.along[i]
        normal = contacts_out.normal[i]
        last = contacts_out.last[i]
        force = zero
        if last >= 0:
            force = presses.force[last]
        if wires.tension[piece] <= zero:  # broken
            contacts_out.stiffness[i] = one
            contacts_out.shift[i] = numbers.out_of_reach
            contacts_out.geom[i] = wp.vec3d()
            contacts_out.place[i] = wp.vec3d()
            contacts_out.last_force[i] = zero
            contacts_out.others[i] = zero
            continue
        alone, rest, deflection = wire_spring(
            piece, x, wires.tension[piece], numbers.least_share, wires, nodes, bodies, springs, loads
        )
        between = deflection_between(piece, x, wires, nodes, presses)
        tangent = tangent_stiffness(
            i,
            alone,
            rest + deflection,
            between,
            numbers.least_share,
            wires,
            nodes,
            bodies,
            springs,
            loads,
            contacts_out,
        )
        deflection = deflection + between
        shared = sharing(i, numbers, wires, contacts_out, presses)
        stiffness = alone / shared
        # deflection by other presses, plus deflection by this contact's own force
        now = wp.dot(deflection, normal) + force / stiffness
        mean = now
        if last >= 0:
            mean = presses.others[last] + numbers.forgetting * (now - presses.others[last])
        share = x / wp.max(wires.length[piece], wp.float64(1.0e-9))
        geom = (one - share) * geoms.offset[piece, 0] + share * geoms.offset[piece, 1]
        shift = wp.dot(geom - rest, normal) - numbers.followed * now - (one - numbers.followed) * mean
        # a spring of the tangent stiffness has the same force at the present place
        shift = shift + force * (shared / alone - shared / tangent)
        stiffness = tangent / shared
        if contacts_out.gap[i] > numbers.touching:
            shift = zero  # another press holds the wire away from this contact
        if wp.abs(wp.dot(normal, geoms.axis[piece])) > numbers.max_normal_along_wire:
            # if the wire's axis is inside a box, the normal may be along the wire, where a wire does not push
            shift = numbers.out_of_reach
        contacts_out.stiffness[i] = stiffness
        contacts_out.shift[i] = shift
        contacts_out.geom[i] = geom
        contacts_out.place[i] = rest + deflection
        contacts_out.last_force[i] = force
        contacts_out.others[i] = mean


@wp.kernel
def add_presses(
    # model
    numbers: WireNumbers,
    # in
    contacts: WireContacts,
    # out
    found_out: WirePresses,
):
    """The only thread appends the forces and velocities that a contact solve found to the list of presses.

    Contacts for which the list has no room are left out.
    """
    zero = wp.float64(0.0)
    for i in range(contacts.count[0]):
        k = found_out.count[0]
        if k < found_out.piece.shape[0]:
            found_out.count[0] = k + 1
            force = contacts.force[i]
            place = contacts.place[i]
            expected = zero
            weight = zero
            if force > zero:
                last = contacts.last_force[i]
                place = contacts.geom[i] + (contacts.gap[i] + numbers.dt * contacts.velocity[i]) * contacts.normal[i]
                expected = wp.max(force + numbers.extrapolated * (force - last), zero)
                weight = wp.max(contacts.weight[i], force)
                if last > zero:
                    weight = contacts.weight[i] + numbers.forgetting * (force - contacts.weight[i])
            found_out.piece[k] = contacts.piece[i]
            found_out.key[k] = contacts.key[i]
            found_out.tree[k] = contacts.tree[i]
            found_out.along[k] = contacts.along[i]
            found_out.normal[k] = contacts.normal[i]
            found_out.place[k] = place
            found_out.force[k] = expected
            found_out.pushed[k] = force
            found_out.weight[k] = weight
            found_out.others[k] = contacts.others[i]


@wp.func
def copy_press(j: int, k: int, presses: WirePresses, presses_out: WirePresses):
    """Copy press ``j`` (a force on a wire) of the list ``presses`` to index ``k`` of the list ``presses_out``."""
    presses_out.piece[k] = presses.piece[j]
    presses_out.key[k] = presses.key[j]
    presses_out.tree[k] = presses.tree[j]
    presses_out.along[k] = presses.along[j]
    presses_out.normal[k] = presses.normal[j]
    presses_out.place[k] = presses.place[j]
    presses_out.force[k] = presses.force[j]
    presses_out.pushed[k] = presses.pushed[j]
    presses_out.weight[k] = presses.weight[j]
    presses_out.others[k] = presses.others[j]


@wp.func
def load_nodes(
    j: int,
    sign: wp.float64,
    wires: Wires,
    nodes: SupportNodes,
    presses: WirePresses,
    loads_out: wp.array(dtype=wp.vec3d),
    is_loaded_out: wp.array(dtype=wp.bool),
):
    """Distribute press ``j`` (a force on a wire), times ``sign``, to the loads [N] of the two nodes next to it by the
    lever rule.

    With ``sign`` 0 the loads of these nodes are set to zero instead.
    """
    piece = presses.piece[j]
    support = wires.support[piece]
    if support >= 0:
        node, low, high = interval_of(piece, presses.along[j], wires, nodes)
        share = (presses.along[j] - low) / wp.max(high - low, wp.float64(1.0e-9))
        force = -presses.force[j] * presses.normal[j]
        if node > nodes.first[support]:
            loads_out[node - 1] = sign * (loads_out[node - 1] + (wp.float64(1.0) - share) * force)
        if node < nodes.first[support + 1]:
            loads_out[node] = sign * (loads_out[node] + share * force)
        is_loaded_out[support] = sign > wp.float64(0.0)


@wp.func
def rod_through(piece: int, first: int, numbers: WireNumbers, wires: Wires, presses: WirePresses, geoms_out: WireGeoms):
    """Compute the displacement of the straight geom of a wire so that the geom passes through the points that presses
    (forces) displaced.

    If these points are near each other, the geom moves by their mean displacement. ``first``: index of the wire's first
    press.
    """
    zero = wp.float64(0.0)
    presses_hard = bool(False)
    for j in range(presses.count[0]):
        presses_hard = presses_hard or (presses.piece[j] == piece and presses.force[j] > zero)
    low = int(-1)
    high = int(-1)
    mean = wp.vec3d()
    sum = zero
    for j in range(first, presses.count[0]):
        if presses.piece[j] == piece and (presses.force[j] > zero or not presses_hard):
            if low < 0 or presses.along[j] < presses.along[wp.max(low, 0)]:
                low = j
            if high < 0 or presses.along[j] > presses.along[wp.max(high, 0)]:
                high = j
            weight = wp.where(presses_hard, presses.force[j], wp.float64(1.0))
            mean = mean + weight * presses.place[j]
            sum = sum + weight
    length = wires.length[piece]
    spread = presses.along[high] - presses.along[low]
    start = mean / sum
    end = start
    if spread > numbers.least_spread * length:
        slope = (presses.place[high] - presses.place[low]) / spread
        start = presses.place[low] - presses.along[low] * slope
        end = start + length * slope
    geoms_out.offset[piece, 0] = start
    geoms_out.offset[piece, 1] = end


@wp.func
def tighten_alone(
    piece: int,
    wires: Wires,
    bulge: wp.array(dtype=wp.float64),
    tension_out: wp.array(dtype=wp.float64),
    resistance_out: wp.array(dtype=wp.float64),
):
    """Find the tension of a wire without ties under its presses, by Newton's method."""
    straight = wires.straight_tension[piece]
    stretch = wires.stretch[piece]
    if stretch * bulge[piece] <= wp.float64(0.0) or tension_out[piece] <= wp.float64(0.0):
        return
    tension = straight
    resistance = wp.float64(0.0)
    for _turn in range(MOST_TURNS):
        longer = bulge[piece] / (tension * tension)
        resistance = wp.float64(2.0) * stretch * longer / tension
        step = (straight + stretch * longer - tension) / (wp.float64(1.0) + resistance)
        tension = tension + step
        if step < LEAST_RISE * tension:
            break
    tension_out[piece] = tension
    resistance_out[piece] = resistance


@wp.kernel
def deflect_wires(
    # model
    numbers: WireNumbers,
    wires: Wires,
    nodes: SupportNodes,
    # in
    tree_awake: wp.array(dtype=wp.bool),
    rigid_asleep: wp.array(dtype=wp.int32),
    # out
    found_out: WirePresses,
    presses_out: WirePresses,
    loads_out: wp.array(dtype=wp.vec3d),
    is_loaded_out: wp.array(dtype=wp.bool),
    geoms_out: WireGeoms,
    bulge_out: wp.array(dtype=wp.float64),
    tension_out: wp.array(dtype=wp.float64),
    resistance_out: wp.array(dtype=wp.float64),
):
    """The only thread updates the list of presses (forces on wires), the loads on the wires' nodes and the positions of
    the wires' geoms at the end of a step.

    Presses of sleeping trees stay in the list. The geom of a wire without presses moves towards its undeflected
    position step by step. rigid_asleep: [kinematic tree of MuJoCo] not negative while the tree sleeps; found: presses
    of this step, whose count is set to 0; presses: list of the last step, overwritten with the list of this step;
    loads: [node] N; is_loaded: [support]; bulge, tension,
    resistance: [piece] see ``Wires``.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    for j in range(presses_out.count[0]):
        tree = presses_out.tree[j]
        sleeps = bool(False)
        if tree >= 0:
            sleeps = not tree_awake[tree]
        elif -1 - tree < rigid_asleep.shape[0]:
            sleeps = rigid_asleep[-1 - tree] >= 0
        if sleeps and found_out.count[0] < found_out.piece.shape[0]:
            copy_press(j, found_out.count[0], presses_out, found_out)
            found_out.count[0] = found_out.count[0] + 1
        load_nodes(j, zero, wires, nodes, presses_out, loads_out, is_loaded_out)
        piece = presses_out.piece[j]
        geoms_out.is_held[piece] = False
        bulge_out[piece] = zero
        if wires.support[piece] < 0:
            tension_out[piece] = wp.min(tension_out[piece], wires.straight_tension[piece])
            resistance_out[piece] = zero
    presses_out.count[0] = found_out.count[0]
    found_out.count[0] = 0
    loaded = int(0)
    for j in range(presses_out.count[0]):
        copy_press(j, j, found_out, presses_out)
        support = wires.support[presses_out.piece[j]]
        if support >= 0:
            if not is_loaded_out[support]:
                geoms_out.loaded[loaded] = support
                loaded = loaded + 1
        load_nodes(j, one, wires, nodes, presses_out, loads_out, is_loaded_out)
    for j in range(presses_out.count[0]):
        piece = presses_out.piece[j]
        if bulge_out[piece] == zero:
            bulge_out[piece] = bulge_of(piece, wires, nodes, presses_out)
            if wires.support[piece] < 0:
                tighten_alone(piece, wires, bulge_out, tension_out, resistance_out)
    kept = int(0)
    for k in range(geoms_out.count[0]):  # released wires return; wires that are still pressed are placed below
        piece = geoms_out.deflected[k]
        for end in range(2):
            geoms_out.offset[piece, end] = numbers.recovery * geoms_out.offset[piece, end]
        if (
            wp.max(wp.length(geoms_out.offset[piece, 0]), wp.length(geoms_out.offset[piece, 1]))
            > numbers.least_deflection
        ):
            geoms_out.deflected[kept] = piece
            kept = kept + 1
        else:
            geoms_out.offset[piece, 0] = wp.vec3d()
            geoms_out.offset[piece, 1] = wp.vec3d()
    for j in range(presses_out.count[0]):
        piece = presses_out.piece[j]
        if not geoms_out.is_held[piece]:
            geoms_out.is_held[piece] = True
            rod_through(piece, j, numbers, wires, presses_out, geoms_out)
            largest = zero
            for end in range(2):
                size = wp.length(geoms_out.offset[piece, end])
                largest = wp.max(largest, size)
                if size > numbers.max_deflection:
                    geoms_out.offset[piece, end] = numbers.max_deflection / size * geoms_out.offset[piece, end]
            listed = bool(False)
            for k in range(kept):
                listed = listed or geoms_out.deflected[k] == piece
            if not listed and largest > numbers.least_deflection:
                geoms_out.deflected[kept] = piece
                kept = kept + 1
            elif not listed:
                geoms_out.offset[piece, 0] = wp.vec3d()
                geoms_out.offset[piece, 1] = wp.vec3d()
    geoms_out.count[0] = kept
    geoms_out.count[1] = loaded

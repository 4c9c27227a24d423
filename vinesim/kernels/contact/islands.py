"""Islands: the candidates of all trees in one list, the plant bodies in contact, and the sets of contacts that interact.

Contacts interact if they share a tree of plants, or rigid bodies that move each other. One thread runs each of these
kernels, because there are few contacts and their order must not depend on the number of threads.
"""

import warp as wp

from vinesim.kernels.contact.structs import (
    AWAKE_TREES,
    BLOCKS,
    BODIES,
    CONTACTS,
    GROUPS,
    HAVE_ROOM,
    IMPACTED_TREES,
    ISLANDS,
    MATRIX_ENTRIES,
    OVERFLOW,
    RESPONSE_NUMBERS,
    SKIPPED_GEOMS,
    Candidates,
    Capsules,
    Contacts,
    Geoms,
    Islands,
    PlantBodies,
    RigidBodies,
    SideGroups,
    TouchedBodies,
)

wp.set_module_options({"enable_backward": False})

MOST_SIDES = wp.constant(10)
"""Largest number of contact sides in a group: their thirty rows fit into thirty-two columns."""


@wp.kernel
def compact_candidates(
    # in
    candidates: Candidates,
    # out
    contacts_out: Contacts,
    counters_out: wp.array(dtype=wp.int32),
):
    """One thread in all.

    List the candidates of all trees. Candidates beyond the capacity are counted but not listed.
    """
    slots = candidates.feature.shape[1]
    count = int(0)
    overflow = int(0)
    impacted = int(0)
    skipped = int(0)
    for row in range(counters_out[AWAKE_TREES]):
        kept = wp.min(candidates.count[row], slots)
        overflow = overflow + candidates.count[row] - kept
        skipped = skipped + candidates.skipped_geoms[row]
        if candidates.is_impact[row]:
            impacted = impacted + 1
        for slot in range(kept):
            if count < contacts_out.source.shape[0]:
                contacts_out.source[count] = row * slots + slot
            count = count + 1
    counters_out[CONTACTS] = count
    counters_out[HAVE_ROOM] = 0
    if count > 0 and count <= contacts_out.source.shape[0]:
        counters_out[HAVE_ROOM] = 1
    counters_out[OVERFLOW] = overflow
    counters_out[IMPACTED_TREES] = impacted
    counters_out[SKIPPED_GEOMS] = skipped


@wp.func
def island_root(label: wp.array(dtype=wp.int32), contact: int):
    """Returns the root of a contact in the union-find structure ``label``: the first contact of its island."""
    root = int(contact)
    while label[root] != root:
        root = label[root]
    return root


@wp.func
def rigid_island(other: int, geoms: Geoms, rigid: RigidBodies):
    """Returns the label of the rigid bodies that a force on a contact's other side moves; -1 for another plant or a
    static geom."""
    label = int(-1)
    if other >= 0 and geoms.dof[wp.max(other, 0)] >= 0:
        label = rigid.tree_island[rigid.dof_tree[geoms.dof[other]]]
    return label


@wp.func
def insert_sorted(body: int, count: int, bodies_out: wp.array(dtype=wp.int32)):
    """Insert a body into a sorted list of ``count`` bodies without duplicates. A negative body is not inserted.

    Returns the new number of bodies.
    """
    length = count
    if body < 0:
        return length
    at = int(count)
    while at > 0 and bodies_out[at - 1] >= body:
        at = at - 1
    if at == count or bodies_out[at] != body:
        for k in range(count - at):
            bodies_out[count - k] = bodies_out[count - k - 1]
        bodies_out[at] = body
        length = count + 1
    return length


@wp.func
def slot_of(body: int, count: int, sorted_bodies: wp.array(dtype=wp.int32)):
    """Returns the position of a body in a sorted list of ``count`` bodies that contains it."""
    low = int(0)
    high = int(count) - 1
    while low < high:
        middle = (low + high) // 2
        if sorted_bodies[middle] < body:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def bound_trees(count: int, bodies: PlantBodies, touched_out: TouchedBodies):
    """Find the range of each tree in the sorted list of touched plant bodies: the index of its first body, and the
    index after its last body.
    """
    for slot in range(count):
        touched_out.last_contact[slot] = -1
        touched_out.tree_start[slot] = slot
        if slot > 0 and bodies.tree[touched_out.body[slot]] == bodies.tree[touched_out.body[slot - 1]]:
            touched_out.tree_start[slot] = touched_out.tree_start[slot - 1]
    for k in range(count):
        slot = count - 1 - k
        touched_out.tree_end[slot] = slot + 1
        if slot + 1 < count and touched_out.tree_start[slot + 1] == touched_out.tree_start[slot]:
            touched_out.tree_end[slot] = touched_out.tree_end[slot + 1]


@wp.func
def link_contacts(c: int, last_contact_out: wp.array(dtype=wp.int32), place: int, label_out: wp.array(dtype=wp.int32)):
    """Join contact ``c`` with the island of the contact in ``last_contact_out[place]``, if there is one, and write
    ``c`` to that entry.

    ``place``: index of a tree, or of a set of coupled rigid bodies. ``label_out``: union-find structure [contact].
    """
    if last_contact_out[place] >= 0:
        one = island_root(label_out, c)
        two = island_root(label_out, last_contact_out[place])
        label_out[wp.max(one, two)] = wp.min(one, two)
    last_contact_out[place] = c


@wp.func
def flatten_labels(contact_count: int, label_out: wp.array(dtype=wp.int32)):
    """Set every contact's label to the first contact of its island or block."""
    for c in range(contact_count):
        label_out[c] = island_root(label_out, c)


@wp.func
def is_listed_before(a: int, b: int, islands: Islands):
    """Returns whether contact a comes before contact b in the list, which is sorted by island and then by block."""
    before = islands.label[a] < islands.label[b]
    if islands.label[a] == islands.label[b]:
        before = islands.block_label[a] < islands.block_label[b]
    return before


@wp.func
def list_contacts(contact_count: int, islands_out: Islands):
    """List all contacts by island and block, by insertion sort. Contacts are already sorted by tree, so few of them
    move far."""
    for c in range(contact_count):
        at = int(c)
        while at > 0 and is_listed_before(c, islands_out.contact[wp.max(at - 1, 0)], islands_out):
            islands_out.contact[at] = islands_out.contact[at - 1]
            at = at - 1
        islands_out.contact[at] = c


@wp.func
def number_sets(
    contact_count: int, counters_out: wp.array(dtype=wp.int32), contacts_out: Contacts, islands_out: Islands
):
    """Number the islands and blocks in the order in which contacts are listed."""
    islands = int(-1)
    blocks = int(-1)
    for place in range(contact_count):
        c = islands_out.contact[place]
        previous = islands_out.contact[wp.max(place - 1, 0)]
        if place == 0 or islands_out.block_label[c] != islands_out.block_label[previous]:
            blocks = blocks + 1
            islands_out.block_start[blocks] = place
        if place == 0 or islands_out.label[c] != islands_out.label[previous]:
            islands = islands + 1
            islands_out.start[islands] = place
            islands_out.first_block[islands] = blocks
        contacts_out.island[c] = islands
        contacts_out.block[c] = blocks
        contacts_out.place[c] = place
    islands_out.start[islands + 1] = contact_count
    islands_out.first_block[islands + 1] = blocks + 1
    islands_out.block_start[blocks + 1] = contact_count
    counters_out[ISLANDS] = islands + 1
    counters_out[BLOCKS] = blocks + 1


@wp.func
def island_of_dof(dof: int, rigid: RigidBodies, contacts: Contacts, islands: Islands):
    """Returns the island of a degree of freedom; -1 if it has no contact."""
    contact = islands.rigid_last_contact[rigid.tree_island[rigid.dof_tree[dof]]]
    island = int(-1)
    if contact >= 0:
        island = contacts.island[contact]
    return island


@wp.func
def list_dofs(island_count: int, rigid: RigidBodies, contacts: Contacts, islands_out: Islands):
    """List the degrees of freedom of the rigid bodies in contact, island by island."""
    for i in range(island_count + 1):
        islands_out.first_dof[i] = 0
    for dof in range(islands_out.dof.shape[0]):
        island = island_of_dof(dof, rigid, contacts, islands_out)
        if island >= 0:
            islands_out.first_dof[island] = islands_out.first_dof[island] + 1
    listed = int(0)
    for i in range(island_count):
        size = islands_out.first_dof[i]
        islands_out.first_dof[i] = listed
        listed = listed + size
    for dof in range(islands_out.dof.shape[0]):
        island = island_of_dof(dof, rigid, contacts, islands_out)
        if island >= 0:
            islands_out.dof[islands_out.first_dof[island]] = dof
            islands_out.first_dof[island] = islands_out.first_dof[island] + 1
    for k in range(island_count):  # each start index has moved to the start of the next island
        islands_out.first_dof[island_count - k] = islands_out.first_dof[island_count - k - 1]
    islands_out.first_dof[0] = 0


@wp.func
def padded(size: int):
    """Returns ``size`` rounded up to a multiple of eight."""
    return (size + 7) / 8 * 8


@wp.func
def list_side(slot: int, side: int, touched: TouchedBodies, groups_out: SideGroups):
    """Add ``side`` (one body of a contact) to the list of the sides on its tree. A negative ``slot`` (the body is not a
    plant's) adds nothing.
    """
    if slot >= 0:
        tree = touched.tree_start[slot]
        groups_out.side[groups_out.listed[tree]] = side
        groups_out.listed[tree] = groups_out.listed[tree] + 1


@wp.func
def group_sides(
    counters_out: wp.array(dtype=wp.int32),
    touched: TouchedBodies,
    contacts: Contacts,
    islands: Islands,
    groups_out: SideGroups,
):
    """List the sides (bodies) of all contacts by tree, divide the sides of each tree into groups, and assign memory to
    the response of each group.
    """
    for slot in range(counters_out[BODIES]):
        groups_out.listed[slot] = 0
    for c in range(counters_out[CONTACTS]):
        tree = touched.tree_start[contacts.body_slot[c]]
        groups_out.listed[tree] = groups_out.listed[tree] + 1
        if contacts.other_slot[c] >= 0:
            tree = touched.tree_start[contacts.other_slot[c]]
            groups_out.listed[tree] = groups_out.listed[tree] + 1
    place = int(0)
    groups = int(0)
    numbers = int(0)
    slot = int(0)
    while slot < counters_out[BODIES]:
        sides = groups_out.listed[slot]
        groups_out.first[slot] = groups
        groups_out.listed[slot] = place
        of_tree = (sides + MOST_SIDES - 1) / MOST_SIDES
        for k in range(of_tree):
            begin = sides * k / of_tree
            groups_out.start[groups] = place + begin
            groups_out.tree[groups] = slot
            groups_out.response[groups] = numbers
            width = padded(3 * (sides * (k + 1) / of_tree - begin))
            numbers = numbers + (touched.tree_end[slot] - slot) * 6 * width
            groups = groups + 1
        place = place + sides
        slot = touched.tree_end[slot]
    groups_out.start[groups] = place
    groups_out.tree[groups] = -1
    for i in range(counters_out[CONTACTS]):
        c = islands.contact[i]
        list_side(contacts.body_slot[c], 2 * c, touched, groups_out)
        list_side(contacts.other_slot[c], 2 * c + 1, touched, groups_out)
    counters_out[GROUPS] = groups
    counters_out[RESPONSE_NUMBERS] = numbers


@wp.func
def place_systems(counters_out: wp.array(dtype=wp.int32), islands_out: Islands):
    """Assign memory to the solver's data for each block and each island, one after the other."""
    rows = int(0)
    entries = int(0)
    for block in range(counters_out[BLOCKS]):
        islands_out.row_start[block] = rows
        islands_out.matrix_start[block] = entries
        size = 3 * (islands_out.block_start[block + 1] - islands_out.block_start[block])
        rows = rows + padded(size)
        entries = entries + size * padded(size)
    islands_out.row_start[counters_out[BLOCKS]] = rows
    rigid = int(0)
    system = int(0)
    for island in range(counters_out[ISLANDS]):
        islands_out.rigid_start[island] = rigid
        islands_out.system_start[island] = system
        dofs = islands_out.first_dof[island + 1] - islands_out.first_dof[island]
        rigid = rigid + (islands_out.start[island + 1] - islands_out.start[island]) * dofs
        largest = int(0)
        for block in range(islands_out.first_block[island], islands_out.first_block[island + 1]):
            largest = wp.max(largest, 3 * (islands_out.block_start[block + 1] - islands_out.block_start[block]))
        system = system + largest * (padded(1 + dofs) + padded(largest))
    counters_out[MATRIX_ENTRIES] = wp.max(entries, system)


@wp.kernel
def build_islands(
    # model
    capsules: Capsules,
    geoms: Geoms,
    # in
    bodies: PlantBodies,
    rigid: RigidBodies,
    candidates: Candidates,
    # out
    counters_out: wp.array(dtype=wp.int32),
    touched_out: TouchedBodies,
    contacts_out: Contacts,
    islands_out: Islands,
    groups_out: SideGroups,
):
    """One thread in all. List the plant bodies in contact, sorted, each once, and divide the contacts into islands.

    Does nothing if there is no contact, or no room for all contacts (``HAVE_ROOM``).
    """
    if counters_out[HAVE_ROOM] == 0:
        return
    contact_count = counters_out[CONTACTS]
    slots = candidates.feature.shape[1]
    body_count = int(0)
    for c in range(contact_count):
        row = contacts_out.source[c] // slots
        slot = contacts_out.source[c] % slots
        contacts_out.feature[c] = candidates.feature[row, slot]
        contacts_out.other[c] = candidates.other[row, slot]
        contacts_out.body[c] = capsules.body[contacts_out.feature[c] // 2]
        contacts_out.other_body[c] = -1
        if contacts_out.other[c] < 0:
            contacts_out.other_body[c] = capsules.body[-1 - contacts_out.other[c]]
        body_count = insert_sorted(contacts_out.body[c], body_count, touched_out.body)
        body_count = insert_sorted(contacts_out.other_body[c], body_count, touched_out.body)
    counters_out[BODIES] = body_count
    bound_trees(body_count, bodies, touched_out)
    for label in range(islands_out.rigid_last_contact.shape[0]):
        islands_out.rigid_last_contact[label] = -1

    for c in range(contact_count):
        islands_out.label[c] = c
        contacts_out.body_slot[c] = slot_of(contacts_out.body[c], body_count, touched_out.body)
        contacts_out.other_slot[c] = -1
        link_contacts(c, touched_out.last_contact, touched_out.tree_start[contacts_out.body_slot[c]], islands_out.label)
        if contacts_out.other_body[c] >= 0:
            contacts_out.other_slot[c] = slot_of(contacts_out.other_body[c], body_count, touched_out.body)
            place = touched_out.tree_start[contacts_out.other_slot[c]]
            link_contacts(c, touched_out.last_contact, place, islands_out.label)
    flatten_labels(contact_count, islands_out.label)
    for c in range(contact_count):
        islands_out.block_label[c] = islands_out.label[c]
    for c in range(contact_count):
        label = rigid_island(contacts_out.other[c], geoms, rigid)
        if label >= 0:
            link_contacts(c, islands_out.rigid_last_contact, label, islands_out.label)
    flatten_labels(contact_count, islands_out.label)
    list_contacts(contact_count, islands_out)
    number_sets(contact_count, counters_out, contacts_out, islands_out)
    list_dofs(counters_out[ISLANDS], rigid, contacts_out, islands_out)
    place_systems(counters_out, islands_out)
    group_sides(counters_out, touched_out, contacts_out, islands_out, groups_out)

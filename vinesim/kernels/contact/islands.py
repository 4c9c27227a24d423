"""Islands: the candidates of all trees in one list, the plant bodies in contact, and the sets of contacts that interact.

Contacts interact if they share a tree of plants, or rigid bodies that move each other. Each kernel here is run by one
thread: there are few contacts, and the order of the result must not depend on the number of threads.
"""

import warp as wp

from vinesim.kernels.contact.structs import (
    AWAKE_TREES,
    BODIES,
    CONTACTS,
    IMPACTED_TREES,
    ISLANDS,
    OVERFLOW,
    Candidates,
    Capsules,
    Contacts,
    Geoms,
    Islands,
    PlantBodies,
    RigidBodies,
    TouchedBodies,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def compact_candidates(
    # in
    candidates: Candidates,
    # out
    contacts_out: Contacts,
    counters_out: wp.array(dtype=wp.int32),
):
    """One thread in all: list the candidates of all trees; what exceeds the capacity is only counted."""
    slots = candidates.feature.shape[1]
    count = int(0)  # noqa: RUF046 (Warp's way to declare a variable that changes)
    overflow = int(0)  # noqa: RUF046
    impacted = int(0)  # noqa: RUF046
    for row in range(counters_out[AWAKE_TREES]):
        kept = wp.min(candidates.count[row], slots)
        overflow = overflow + candidates.count[row] - kept
        if candidates.is_impact[row]:
            impacted = impacted + 1
        for slot in range(kept):
            if count < contacts_out.source.shape[0]:
                contacts_out.source[count] = row * slots + slot
            count = count + 1
    counters_out[CONTACTS] = count
    counters_out[OVERFLOW] = overflow
    counters_out[IMPACTED_TREES] = impacted


@wp.func
def island_root(label: wp.array(dtype=wp.int32), contact: int):
    """The first contact of the island that a contact is in so far."""
    root = int(contact)
    while label[root] != root:
        root = label[root]
    return root


@wp.func
def rigid_island(other: int, geoms: Geoms, rigid: RigidBodies):
    """Label of the rigid bodies that feel a force on one of them; -1 for another plant or a static geom."""
    label = int(-1)  # noqa: RUF046
    if other >= 0 and geoms.dof[wp.max(other, 0)] >= 0:
        label = rigid.tree_island[rigid.dof_tree[geoms.dof[other]]]
    return label


@wp.func
def insert_sorted(body: int, count: int, bodies_out: wp.array(dtype=wp.int32)):
    """Insert a body (none if negative) into a sorted list of ``count``, each once; returns their number."""
    at = int(count)
    while at > 0 and bodies_out[at - 1] >= body:
        at = at - 1
    length = count
    if body >= 0 and (at == count or bodies_out[at] != body):
        for k in range(count - at):
            bodies_out[count - k] = bodies_out[count - k - 1]
        bodies_out[at] = body
        length = count + 1
    return length


@wp.func
def slot_of(body: int, count: int, sorted_bodies: wp.array(dtype=wp.int32)):
    """Place of a body in a sorted list of ``count`` that contains it; 0 for none (negative)."""
    low = int(0)  # noqa: RUF046
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
    """Find where the touched bodies of each tree begin and end."""
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
    """Join contact ``c`` with the island of the last contact that was linked at this place, and note it there."""
    if last_contact_out[place] >= 0:
        one = island_root(label_out, c)
        two = island_root(label_out, last_contact_out[place])
        label_out[wp.max(one, two)] = wp.min(one, two)
    last_contact_out[place] = c


@wp.func
def list_islands(contact_count: int, contacts_out: Contacts, islands_out: Islands):
    """Number the islands by their first contacts and list their contacts; returns the number of islands."""
    count = int(0)  # noqa: RUF046
    for c in range(contact_count):
        contacts_out.island[c] = island_root(contacts_out.island, c)
    for c in range(contact_count):  # roots come first: a number replaces each root before others look it up
        root = contacts_out.island[c]
        if root == c:
            contacts_out.island[c] = count
            islands_out.start[count] = 0
            count = count + 1
        else:
            contacts_out.island[c] = contacts_out.island[root]
        islands_out.start[contacts_out.island[c]] = islands_out.start[contacts_out.island[c]] + 1
    listed = int(0)  # noqa: RUF046
    for i in range(count):  # from sizes to the places of the first contacts
        size = islands_out.start[i]
        islands_out.start[i] = listed
        listed = listed + size
    for c in range(contact_count):
        i = contacts_out.island[c]
        islands_out.contact[islands_out.start[i]] = c
        islands_out.start[i] = islands_out.start[i] + 1
    for k in range(count):  # each start was moved to the next one's
        islands_out.start[count - k] = islands_out.start[count - k - 1]
    islands_out.start[0] = 0
    return count


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
):
    """One thread in all: number the plant bodies in contact, sorted, each once; part the contacts into islands."""
    contact_count = counters_out[CONTACTS]
    slots = candidates.feature.shape[1]
    body_count = int(0)  # noqa: RUF046
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
        contacts_out.island[c] = c
        contacts_out.body_slot[c] = slot_of(contacts_out.body[c], body_count, touched_out.body)
        contacts_out.other_slot[c] = slot_of(contacts_out.other_body[c], body_count, touched_out.body)
        link_contacts(
            c, touched_out.last_contact, touched_out.tree_start[contacts_out.body_slot[c]], contacts_out.island
        )
        if contacts_out.other_body[c] >= 0:
            place = touched_out.tree_start[contacts_out.other_slot[c]]
            link_contacts(c, touched_out.last_contact, place, contacts_out.island)
        label = rigid_island(contacts_out.other[c], geoms, rigid)
        if label >= 0:
            link_contacts(c, islands_out.rigid_last_contact, label, contacts_out.island)
    counters_out[ISLANDS] = list_islands(contact_count, contacts_out, islands_out)

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
    SKIPPED_GEOMS,
    Candidates,
    Capsules,
    Contacts,
    Geoms,
    Islands,
    PlantBodies,
    RigidBodies,
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
    skipped = int(0)  # noqa: RUF046
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
    counters_out[OVERFLOW] = overflow
    counters_out[IMPACTED_TREES] = impacted
    counters_out[SKIPPED_GEOMS] = skipped


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
def link_contacts(c: int, contacts_out: Contacts, bodies: PlantBodies, geoms: Geoms, rigid: RigidBodies):
    """Join the islands of all contacts before ``c`` that interact with it."""
    tree = bodies.tree[contacts_out.body[c]]
    other_tree = int(-1)  # noqa: RUF046
    if contacts_out.other_body[c] >= 0:
        other_tree = bodies.tree[contacts_out.other_body[c]]
    label = rigid_island(contacts_out.other[c], geoms, rigid)
    for d in range(c):
        tree_d = bodies.tree[contacts_out.body[d]]
        linked = tree_d == tree or tree_d == other_tree
        if contacts_out.other_body[d] >= 0:
            other_tree_d = bodies.tree[contacts_out.other_body[d]]
            linked = linked or other_tree_d == tree or other_tree_d == other_tree
        if not linked and label >= 0:
            linked = label == rigid_island(contacts_out.other[d], geoms, rigid)
        if linked:
            one = island_root(contacts_out.island, c)
            two = island_root(contacts_out.island, d)
            contacts_out.island[wp.max(one, two)] = wp.min(one, two)


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
    touched_bodies_out: wp.array(dtype=wp.int32),
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
        body_count = insert_sorted(contacts_out.body[c], body_count, touched_bodies_out)
        body_count = insert_sorted(contacts_out.other_body[c], body_count, touched_bodies_out)
    for c in range(contact_count):
        contacts_out.body_slot[c] = 0
        contacts_out.other_slot[c] = 0
        for k in range(body_count):
            if touched_bodies_out[k] == contacts_out.body[c]:
                contacts_out.body_slot[c] = k
            if touched_bodies_out[k] == contacts_out.other_body[c]:
                contacts_out.other_slot[c] = k
    counters_out[BODIES] = body_count

    for c in range(contact_count):
        contacts_out.island[c] = c
        link_contacts(c, contacts_out, bodies, geoms, rigid)
    islands = int(0)  # noqa: RUF046
    listed = int(0)  # noqa: RUF046
    for c in range(contact_count):
        if contacts_out.island[c] == c:
            islands_out.start[islands] = listed
            for d in range(c, contact_count):
                if island_root(contacts_out.island, d) == c:
                    islands_out.contact[listed] = d
                    listed = listed + 1
            islands = islands + 1
    islands_out.start[islands] = listed
    for i in range(islands):
        for m in range(islands_out.start[i], islands_out.start[i + 1]):
            contacts_out.island[islands_out.contact[m]] = i
    counters_out[ISLANDS] = islands

"""The state of the plants: joint rotations and rates, poses derived from them, awake trees, cut bodies."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.core.array_fields import StructOfArrays, array
from vinesim.scene.model import Model


@dataclasses.dataclass
class State(StructOfArrays):
    """State of all plants. The state of rigid bodies (robots, boxes, hands) is in MuJoCo."""

    joint_q: np.ndarray = array("body", 4, unit="1", fill=(0.0, 0.0, 0.0, 1.0))
    """Rotation of the body in its joint frame, xyzw."""
    joint_qd: np.ndarray = array("body", 3, unit="rad/s")
    """Angular velocity of the body against its parent, in joint-frame axes."""
    body_q: np.ndarray = array("body", 7, unit="m, 1", fill=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    """World pose (position, quaternion xyzw), derived from ``joint_q``."""
    body_qd: np.ndarray = array("body", 6, unit="m/s, rad/s")
    """World velocity of the body's origin, then angular velocity, derived from ``joint_qd``."""
    body_cut: np.ndarray = array("body", unit="1", dtype=np.bool_)
    """Whether the body has been cut off its parent. A cut body is the floating root of its descendants: ``joint_q`` is
    its rotation in the world and ``joint_qd`` its angular velocity in world axes."""
    joint_x: np.ndarray = array("body", 3, unit="m")
    """World position of the origin of a cut body; unused for other bodies."""
    joint_xd: np.ndarray = array("body", 3, unit="m/s")
    """World velocity of the origin of a cut body; unused for other bodies."""
    joint_set: np.ndarray = array("body", 4, unit="1", fill=(0.0, 0.0, 0.0, 1.0))
    """Set of the wood: the rotation that the joint keeps without load because it was bent too far, xyzw. ``joint_q`` is
    the rotation beyond it: world pose of b = pose of parent * (body_offset, body_rest * joint_set * joint_q)."""
    joint_flow: np.ndarray = array("body", unit="rad")
    """Sum of all rotations by which the set has changed; the wood's remaining strength follows from it."""
    tree_fine: np.ndarray = array("tree", unit="1", dtype=np.bool_)
    """Whether the berry clusters (groups of berries) of the tree's bunches move as separate bodies; if not, each bunch
    is one rigid body."""
    tree_awake: np.ndarray = array("tree", unit="1", dtype=np.bool_)
    bunch_attached: np.ndarray = array("bunch", unit="1", dtype=np.bool_, fill=1)
    tie_slid: np.ndarray = array("tie", unit="m")
    """Distance by which each tie has slipped along its wire."""
    tie_broken: np.ndarray = array("tie", unit="1", dtype=np.bool_)
    """Whether the tie holds nothing any more."""
    tie_flow: np.ndarray = array("tie", unit="m")
    """Sum of all distances by which the tie has slipped, to either side. Of two states of a tie the one with the longer
    way is the later one."""
    cut_segment: np.ndarray = array("bunch", unit="1", dtype=np.int32, fill=-1)
    """Body of the segment of its peduncle in which each bunch was cut off; -1: it hangs, or has parted at its own
    joint."""
    cut_at: np.ndarray = array("bunch", unit="m")
    """Distance of that cut from the segment's origin."""
    stump_of: np.ndarray = array("body", unit="1", dtype=np.int32, fill=-1)
    """For a spare body that a cut has made a stump: the body that was cut, of which it was the part before the cut. -1
    for all other bodies. A stump has the frame of that body."""
    stump_end: np.ndarray = array("body", unit="m")
    """Distance of that cut from the origin of the frame, where the stump ends; 0 for all other bodies."""
    notch_depth: np.ndarray = array("body", unit="1")
    """Depth of the deepest cut that has not gone through a segment of wood, as a share of the diameter there; 0: the
    segment has none."""
    notch_at: np.ndarray = array("body", unit="m")
    """Distance of that cut from the segment's origin."""
    leaf_off: np.ndarray = array("leaf", unit="1", dtype=np.bool_)
    """Whether each leaf has been taken off. The array is replaced, never written, when leaves are taken off."""

    @classmethod
    def at_rest(cls, model: Model) -> State:
        """Returns the state with all trees asleep and without motion in the shape that their generator or builder
        gave them (``Model.joint_settled``)."""
        counts = model.counts()
        state = cls.allocate(**{axis: counts[axis] for axis in ("body", "tree", "bunch", "tie", "leaf")})
        state.joint_q[:] = model.joint_settled
        state.body_q[:] = model.forward_kinematics(state.joint_q)
        return state

    def whole_turn(self, bodies: np.ndarray | slice) -> np.ndarray:
        """Returns the rotations of ``bodies`` [k] from the frames of their joints as grown [k, 4] xyzw: set and elastic
        rotation together. It is ``joint_q`` itself for wood without a set."""
        turned = self.joint_q[bodies]
        kept = self.joint_set[bodies]
        bent = np.flatnonzero((kept[:, :3] != 0.0).any(1))
        if len(bent) == 0:
            return turned
        turned = turned.copy()
        turned[bent] = frames.normalize(frames.multiply(kept[bent].astype(float), turned[bent].astype(float)))
        return turned

    def elastic_turn(self, bodies: np.ndarray | slice, whole: np.ndarray) -> np.ndarray:
        """Returns the part of rotations ``whole`` [k, 4] of ``bodies`` [k] that is not set [k, 4]: the inverse of
        :meth:`whole_turn`."""
        kept = self.joint_set[bodies]
        bent = np.flatnonzero((kept[:, :3] != 0.0).any(1))
        if len(bent) == 0:
            return whole
        turned = np.array(whole)
        turned[bent] = frames.normalize(frames.multiply(frames.conjugate(kept[bent].astype(float)), turned[bent]))
        return turned

"""A new state: all trees asleep, bunches attached, at the model's rest pose."""

import numpy as np

from vinesim.scene import builder
from vinesim.scene.ids import Organ
from vinesim.scene.state import State


def test_a_new_state_is_the_rest_pose():
    tree = builder.TreeBuilder(np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0]))
    tip = tree.add_rod(-1, 1.0, (0.004, 0.003), builder.RodMaterial(5e9, 900.0), 8)[-1]
    stalk = tree.add_rod(tip, 0.06, (0.002, 0.002), builder.RodMaterial(3e8, 900.0), 2, organ=Organ.PEDUNCLE)[-1]
    body = tree.add_body(
        stalk, offset=(0.03, 0, 0), mass=0.5, inertia=(1e-3,) * 3, stiffness=(0.2,) * 3, organ=int(Organ.BUNCH)
    )
    tree.bunches.append({"body": body, "berries": 80})
    tree.solve_rest_pose()
    model = builder.assemble([tree])
    state = State.at_rest(model)
    state.check()
    assert np.array_equal(state.joint_q, model.joint_settled)
    assert np.allclose(state.body_q[:, 2], 2.0, atol=1e-5)
    assert np.allclose(state.body_q[1:9, 0], np.arange(1, 9) / 8.0, atol=1e-5)
    assert not state.joint_qd.any()
    assert not state.body_qd.any()
    assert not state.tree_awake.any()
    assert state.bunch_attached.all()
    assert state.counts() == {"body": 11, "tree": 1, "bunch": 1, "tie": 0, "leaf": 0}

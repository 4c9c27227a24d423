"""What sensors see of a cut peduncle: the stump ends at the cut, the stalk goes with the bunch, and labels are true."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene
from vinesim.core import frames
from vinesim.scene.ids import Organ, label
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.primitive_arrays import CONE
from vinesim.world import Physics


def stems(primitives: Primitives) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts and ends [k, 4] (m, radius) of the pieces of peduncle that are drawn, and whether bunches carry them."""
    kind = primitives.shapes.kind.numpy()
    rows = np.flatnonzero((kind == CONE) & (primitives.organ == int(Organ.PEDUNCLE)))
    assert (primitives.label[rows] == label(Organ.PEDUNCLE, 0)).all()
    ends = (primitives.shapes.a.numpy()[rows], primitives.shapes.b.numpy()[rows])
    return *ends, rows >= primitives.plant_count


@pytest.mark.parametrize("above", [0, 1])
def test_a_cut_peduncle_is_drawn_in_two_parts(above):
    model, body, _ = bunch_scene()
    physics = Physics(model)
    primitives = Primitives(model, grass=0.0)
    primitives.update(physics.snapshot())
    whole = stems(primitives)
    assert not whole[2].any()
    length = np.linalg.norm(whole[1] - whole[0], axis=1).sum()
    segment = body - 1 - above
    physics.cut(segment, 0.013)
    snapshot = physics.snapshot()
    primitives.update(snapshot)
    start, end, carried = stems(primitives)
    seen = (start[:, 3] > 1e-5) & (end[:, 3] > 1e-5)
    assert np.linalg.norm(end[seen] - start[seen], axis=1).sum() == pytest.approx(length, abs=1e-4)
    assert carried[seen].sum() == 1 + above
    pose = snapshot.body_q[segment].astype(float)
    cut = pose[:3] + frames.rotate(pose[3:], np.array([0.013, 0.0, 0.0]))
    assert np.linalg.norm(end[seen & ~carried, :3] - cut, axis=1).min() < 1e-5
    assert np.linalg.norm(start[carried, :3] - cut, axis=1).min() < 1e-5
    for _ in range(30):
        physics.step()
    primitives.update(physics.snapshot())
    fallen = stems(primitives)
    assert (fallen[0][carried, 2] < start[carried, 2] - 0.2).all()
    # a world that was set back has its peduncle again
    primitives.update(Physics(model).snapshot())
    for now, before in zip(stems(primitives), whole, strict=True):
        np.testing.assert_allclose(now, before, atol=1e-6)

"""``vinesim client --role spectator``: watch a vineyard without touching anything."""

from __future__ import annotations

import numpy as np

from vinesim.cli.client_options import ClientOptions
from vinesim.cli.client_session import ClientSession
from vinesim.client.spectator import PictureWriter, Spectator, standing_view
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core.errors import writing


def run(options: ClientOptions) -> int:
    """Watch until a signal or the time limit; pictures go to ``--out``. Returns the exit code."""
    with ClientSession(options) as session:
        pose = options.pose
        if pose is None:
            start = spawn_pose(session.scene, session.spawn)
            pose = float(start[0]), float(start[1]), 2.0 * float(np.arctan2(start[5], start[6]))
        if options.out is not None:
            with writing(options.out):
                options.out.mkdir(parents=True, exist_ok=True)
        spectator = Spectator(
            session.scene,
            session.model,
            None,
            session.bus(session.name),
            pose=standing_view(*pose, session.model.terrain),
            **session.client_options(),
        )
        pictures = None
        if options.out is not None:
            pictures = PictureWriter(
                spectator,
                options.out,
                1.0 / (options.sensor_hz or 1.0),
                options.device,
            )
        session.show_page(spectator)
        session.run(spectator)
        if pictures is not None:
            pictures.save(spectator)
    return 0

"""``vinesim client --role spectator``: watch a vineyard without touching anything."""

from __future__ import annotations

from vinesim.cli.client_options import ClientOptions
from vinesim.cli.client_session import ClientSession
from vinesim.client.page.first_view import first_view
from vinesim.client.spectator import PictureWriter, Spectator, standing_view
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core import frames
from vinesim.core.errors import writing


def run(options: ClientOptions) -> int:
    """Watch until a signal or the time limit; pictures go to ``--out``. Returns the exit code."""
    with ClientSession(options) as session:
        start = spawn_pose(session.scene, session.spawn or 0)
        eyes = standing_view(float(start[0]), float(start[1]), frames.to_yaw(start[3:]), session.model.terrain)
        if session.spawn is None:  # an actor may stand there
            model = session.model
            eyes = first_view(start, model, model.forward_kinematics(model.joint_settled)[:, :3])
        if options.out is not None:
            with writing(options.out):
                options.out.mkdir(parents=True, exist_ok=True)
        spectator = Spectator(
            session.scene,
            session.model,
            None,
            session.bus(session.name),
            pose=eyes,
            **session.client_options(),
        )
        spectator.begins_behind_actor = session.spawn is None
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

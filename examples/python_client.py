"""Runs a server and two clients, each with a robot, in one Python program. Each client receives the other robot's
motion."""

import numpy as np

import vinesim

scene = vinesim.load_scene("demo")
with (
    vinesim.Server("tcp/127.0.0.1:0") as server,  # port 0: any free port
    vinesim.Client(scene, name="ada", connect=server.endpoint, pose=(-2.0, 0.0, 0.0)) as ada,
    vinesim.Client(scene, name="bob", connect=server.endpoint, pose=(-2.0, 2.0, 0.0)) as bob,
):
    while not ("ada" in bob.remote_actors and "bob" in ada.remote_actors):
        ada.run(0.02)
        bob.run(0.02)
    start = bob.actor_pose("ada")[:2]
    for _ in range(200):
        ada.robot.command_base(0.3, 0.0, ada.time)
        ada.run(0.01)
        bob.step()
    way = np.linalg.norm(bob.actor_pose("ada")[:2] - start)
    print(f"bob has seen ada drive {100 * way:.0f} cm; present: {', '.join(('bob', *bob.remote_actors))}")

# %% [markdown]
# # Who hears what
#
# Three robots share a hedge through a server. Ada drives into the vines. Bob stands 3 m away, so his copy of the vines
# must move, too. Eve stands 25 m away and must receive nothing: motion is sent only to actors within 5 m of it.

# %%
import pathlib
import tempfile

import matplotlib.pyplot as plt
import numpy as np

import vinesim

FILE = pathlib.Path(tempfile.mkdtemp()) / "hedge.toml"
FILE.write_text(
    """
name = "hedge"
seed = 1
training = "vsp"
plants = "vine"
[layout]
rows = 1
vines = 3
row_spacing = 2.6
vine_spacing = 2.0
height = 0.85
[season]
leafiness = 0.85
yellow = 0.08
[fruit]
bunches = [7, 11]
varieties = ["black"]
[sun]
azimuth = 2.2
elevation = 0.7
[[spawns]]
name = "alley"
x = 3.0
y = -1.3
"""
)
scene = vinesim.load_scene(FILE)
places = {"ada": (3.0, -0.7, np.pi / 2), "bob": (1.5, -3.4, np.pi / 2), "eve": (28.0, -0.7, np.pi / 2)}


try:
    from IPython.display import display
except ImportError:  # run as a script
    display = print


# %%
def displacement(client: vinesim.Client, rest: np.ndarray) -> np.ndarray:
    """Returns the displacement of each body of the plants in a client's copy [body] m."""
    return np.linalg.norm(client.state.body_q[:, :3] - rest, axis=1)


with vinesim.Server("tcp/127.0.0.1:0") as server:
    clients = {
        name: vinesim.Client(scene, name=name, connect=server.endpoint, pose=place) for name, place in places.items()
    }
    ada, bob, eve = clients.values()
    display(ada.page())  # the hedge, live: fly with W A S D and the mouse
    rest = {name: client.state.body_q[:, :3].copy() for name, client in clients.items()}
    history = []
    for step in range(3000):
        ada.robot.command_base(0.25 if ada.actor_pose("ada")[1] < -0.5 else 0.0, 0.0, ada.time)
        for client in clients.values():
            client.run(0.01)
        if step % 5 == 0:
            moved = {name: displacement(client, rest[name]) for name, client in clients.items()}
            history.append((ada.time, *(each.max() for each in moved.values())))
            body = int(moved["ada"].argmax())  # the one that Ada has moved farthest
            if moved["ada"][body] > 0.05 and abs(moved["ada"][body] - moved["bob"][body]) < 0.01 and step > 150:
                break
    moved = {name: displacement(client, rest[name]) for name, client in clients.items()}
    heard = {name: client.received_bytes for name, client in clients.items()}
    ends = {name: client.actor_pose(name)[:2] for name, client in clients.items()}
    for client in clients.values():
        client.close()
print({name: f"{1e3 * each.max():.1f} mm, {heard[name]} bytes of plants" for name, each in moved.items()})

# %%
figure, (chart, ground) = plt.subplots(1, 2, figsize=(12, 4))
history = np.array(history)
for column, name in enumerate(clients, 1):
    chart.plot(history[:, 0], 1e3 * history[:, column], label=name)
chart.set(xlabel="time [s]", ylabel="largest motion of a shoot [mm]", title="the hedge in each copy")
chart.legend()
touched = rest["ada"][moved["ada"] > 0.01]
ground.plot(*rest["ada"][::20, :2].T, ".", color="lightgreen", label="vines")
ground.plot(*touched[:, :2].T, "r.", label="moved by Ada")
ground.add_patch(plt.Circle(touched[:, :2].mean(0), 5.0, fill=False, linestyle="--"))
for name, (x, y) in ends.items():
    ground.plot(x, y, "ks")
    ground.annotate(f"{name}: {heard[name] / 1e3:.1f} kB", (x, y))
ground.set(xlabel="x [m]", ylabel="y [m]", title="motion is sent up to 5 m")
ground.set_aspect("equal")
ground.legend()
plt.show()

# %% The check
assert moved["ada"].max() > 0.05
assert abs(moved["ada"][body] - moved["bob"][body]) < 0.02
assert heard["bob"] > 0
assert heard["eve"] == 0
assert moved["eve"].max() < 1e-3
apart = 1e3 * abs(moved["ada"][body] - moved["bob"][body])
print(f"Bob's copy has moved as far as Ada's, within {apart:.1f} mm; Eve has received nothing")

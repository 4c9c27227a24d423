# %% [markdown]
# # Picking against clearance
#
# How much room does the open hand need around a bunch? `reachable_grasps` lists the bunches that a hand reaches, with
# the room around each. `attempt_pick` picks one bunch in a separate vineyard. This notebook tries the bunches with
# most, least and medium room; `python -m benchmarks picking` tries all.

# %%
import matplotlib.pyplot as plt
import numpy as np

import vinesim

scene = vinesim.load_scene("demo")
grasps = sorted(vinesim.reachable_grasps(scene), key=lambda grasp: grasp.clearance)
clearance = np.array([grasp.clearance for grasp in grasps])
print(f"{len(grasps)} bunches in reach; clearance {1e3 * clearance.min():.0f} to {1e3 * clearance.max():.0f} mm")

# %%
chosen = [grasps[0], grasps[len(grasps) // 2], grasps[-1]]
attempts = [vinesim.attempt_pick(scene, grasp) for grasp in chosen]
for one in attempts:
    print(f"bunch {one.bunch}, {1e3 * one.clearance:.0f} mm: {'picked' if one.picked else one.reason}")

# %%
figure, axis = plt.subplots(figsize=(7, 4))
axis.hist(1e3 * clearance, bins=12, color="lightgray", label="bunches in reach")
for one in attempts:
    axis.axvline(1e3 * one.clearance, color="green" if one.picked else "red")
axis.set(xlabel="clearance of the open hand [mm]", ylabel="bunches", title="green: picked, red: not picked")
axis.legend()
plt.show()

# %% The check: the bunch with most clearance is picked, and no other bunch comes off
assert len(grasps) > 5
assert attempts[-1].picked, attempts[-1].reason
assert attempts[-1].others == 0
assert all(one.picked or one.reason for one in attempts)
print(f"{sum(one.picked for one in attempts)} of {len(attempts)} picked")

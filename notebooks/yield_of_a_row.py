# %% [markdown]
# # The yield of a row from depth
#
# A camera drives along both sides of a row and takes pictures. The volume of each bunch is measured from the depth of
# its pixels, and the yield is the sum of the masses. The truth stands beside each figure: the scene knows every berry.

# %%
import matplotlib.pyplot as plt
import numpy as np

import vinesim
from vinesim.perception import measure_bunch, true_bunch

DENSITY = 1080.0  # of a berry [kg/m^3]; weigh some berries of your own
MIN_PIXELS = 800
SPACING = 0.4  # between two pictures [m]
DISTANCE = 1.0  # of the camera from the row [m]
simulation = vinesim.Simulation("demo")
camera = vinesim.Camera("d435", quality="fast")

# %% [markdown]
# The row is the one with most bunches: bunches are grouped by the y of their middles.

# %%
truths = [true_bunch(simulation, bunch) for bunch in range(len(simulation.model.bunch_body))]
middles = np.array([truth.centres.mean(axis=0) for truth in truths])
row = np.median(middles[:, 1][middles[:, 1] < middles[:, 1].mean()])
bunches = np.flatnonzero(np.abs(middles[:, 1] - row) < 0.5)
height = middles[bunches, 2].mean()

# %%
frames = []
for x in np.arange(middles[bunches, 0].min(), middles[bunches, 0].max() + SPACING, SPACING):
    for side in (-1.0, 1.0):
        eye = np.array([x, row + side * DISTANCE, height - 0.2])
        frames.append(camera.render(simulation, vinesim.look_at(eye, (x, row, height))))
print(f"{len(frames)} pictures of a row with {len(bunches)} bunches")

# %% [markdown]
# A bunch counts if at least one picture shows enough of it. Its pixels come from the labels, in place of a detector.

# %%
label = int(vinesim.Organ.BUNCH) * 2**20
shown = np.array([[np.count_nonzero(frame.labels == label + bunch) for frame in frames] for bunch in bunches])
found = {}
for depth in ("exact", "measured"):
    masses = []
    for bunch, pixels in zip(bunches, shown, strict=True):
        views = [frames[k] for k in np.flatnonzero(pixels >= MIN_PIXELS)]
        volume = measure_bunch(views, bunch, exact=depth == "exact", berries=False).volume if views else np.nan
        masses.append(DENSITY * volume)
    found[depth] = np.array(masses)
true = np.array([truths[bunch].mass for bunch in bunches])
seen = np.isfinite(found["exact"])
print(f"{seen.sum()} of {len(bunches)} bunches measured, {true[seen].sum():.2f} of {true.sum():.2f} kg hang on them")
for depth, masses in found.items():
    error = masses[seen] / true[seen] - 1.0
    print(
        f"{depth:8} depth: {np.nansum(masses[seen]):.2f} kg; a bunch is off by {100 * np.nanmean(np.abs(error)):.0f} %"
    )

# %%
figure, axis = plt.subplots(figsize=(5, 5))
for depth, masses in found.items():
    axis.plot(true[seen], masses[seen], ".", label=f"{depth} depth")
axis.plot([0.0, true.max()], [0.0, true.max()], "k-", linewidth=0.5)
axis.set_xlabel("true mass of a bunch [kg]")
axis.set_ylabel("measured mass [kg]")
axis.legend()
plt.show()

# %% [markdown]
# The check: the yield of the bunches that were seen is within 10 % of the truth with exact depth, and within 20 % with
# the depth that a D435 measures. Bunches that no picture shows are missing from both.

# %% The check
total = true[seen].sum()
assert seen.sum() > 0.5 * len(bunches)
assert abs(found["exact"][seen].sum() / total - 1.0) < 0.10
assert abs(np.nansum(found["measured"][seen]) / total - 1.0) < 0.20
print(f"{found['exact'][seen].sum():.2f} kg measured, {total:.2f} kg in truth")

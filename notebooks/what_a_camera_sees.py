# %% [markdown]
# # What a camera sees
#
# A D435 looks under a pergola. Its picture has colours, measured depth, exact depth, and a label for every pixel.

# %%
import itertools

import matplotlib.pyplot as plt
import numpy as np

import vinesim

simulation = vinesim.Simulation("demo")
camera = vinesim.Camera("d435", size=(320, 240))
frame = camera.render(simulation, vinesim.look_at((1.5, -1.2, 1.4), (1.5, 0.5, 1.6)))

# %%
figure, axes = plt.subplots(2, 2, figsize=(10, 8))
shown = {
    "colours": frame.rgb,
    "measured depth [m]": np.where(np.isfinite(frame.depth), frame.depth, np.nan),
    "true depth [m]": np.where(frame.exact_depth < 6.0, frame.exact_depth, np.nan),
    "bunches": np.where(frame.organs == vinesim.Organ.BUNCH, frame.instances % 20 + 1.0, np.nan),
}
for axis, (title, picture) in zip(axes.flat, shown.items(), strict=True):
    axis.imshow(picture)
    axis.set_title(title)
    axis.axis("off")
plt.show()

# %% [markdown]
# How large is the error of the measured depth? A stereo camera's noise grows with the square of the distance. At edges
# of leaves the measured depth is between front and back, so the spread is taken from the middle half of the errors.

# %%
measured = np.isfinite(frame.depth) & (frame.exact_depth > 0.5) & (frame.exact_depth < 6.0)
distance = frame.exact_depth[measured]
error = frame.depth[measured] - distance
bounds = np.quantile(distance, np.linspace(0.0, 1.0, 9))
middles, spreads = [], []
for low, high in itertools.pairwise(bounds):
    inside = (distance >= low) & (distance < high)
    middles.append(np.median(distance[inside]))
    spreads.append(0.5 * np.subtract(*np.quantile(error[inside], (0.75, 0.25))))
figure, axis = plt.subplots(figsize=(6, 4))
axis.loglog(middles, 1e3 * np.array(spreads), "o-")
axis.set(xlabel="true distance [m]", ylabel="half of the interquartile range [mm]", title="error of depth in a canopy")
plt.show()

# %% [markdown]
# Which organs fill the picture, and how many pixels have no depth?

# %%
for organ in vinesim.Organ:
    share = np.mean(frame.organs == organ)
    if share > 0.0:
        print(f"{organ.name.lower():10} {100 * share:5.1f} %")
holes = 1.0 - np.isfinite(frame.depth).mean()
print(f"without depth: {100 * holes:.0f} %")

# %% The check
bunch = (frame.organs == vinesim.Organ.BUNCH) & (frame.exact_depth < 3.0)
assert len(np.unique(frame.instances[bunch])) >= 3
assert 0.0 < holes < 0.9
assert np.median(np.abs(error[distance < 2.0])) < 0.02 * 2.0  # the maker's 2 % at 2 m
assert spreads[-1] > spreads[0]
print("the exact depth has no error, the measured depth has")

# %% [markdown]
# # A small perception data set
#
# Pictures from random places in vineyards of several seeds, each with the mask and box of every bunch. Seeds, not
# pictures, are split into training and test, since two pictures of one vineyard show the same bunches. `vinesim
# dataset` does this at scale, with people, robots, weather and the usual formats; this notebook shows the principle.

# %%
import pathlib
import tempfile

import matplotlib.pyplot as plt
import numpy as np

import vinesim

FOLDER = pathlib.Path(tempfile.mkdtemp())
SEEDS = {"train": (0, 1), "test": (2,)}
camera = vinesim.Camera("pinhole", size=(240, 180), quality="fast")


def picture(seed: int) -> dict[str, np.ndarray]:
    """Returns one picture of the vineyard of a seed: colours, depth, bunch number of each pixel (0: none), boxes."""
    rng = np.random.default_rng(seed)
    simulation = vinesim.Simulation(vinesim.load_scene("demo", seed=seed))
    eye = np.array([rng.uniform(0.5, 2.5), -1.0, rng.uniform(1.2, 1.5)])
    frame = camera.render(simulation, vinesim.look_at(eye, eye + np.array([0.0, 1.5, rng.uniform(0.1, 0.4)])))
    mask = np.where(frame.organs == vinesim.Organ.BUNCH, frame.instances + 1, 0)
    boxes = []
    for bunch in np.unique(mask)[1:]:
        rows, columns = np.nonzero(mask == bunch)
        boxes.append((bunch, columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
    return {"rgb": frame.rgb, "depth": frame.exact_depth, "mask": mask, "boxes": np.array(boxes)}


# %%
for split, seeds in SEEDS.items():
    (FOLDER / split).mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        np.savez_compressed(FOLDER / split / f"{seed:03d}.npz", **picture(seed))
files = sorted(FOLDER.rglob("*.npz"))

# %%
figure, axes = plt.subplots(1, len(files), figsize=(5 * len(files), 4))
for axis, file in zip(axes, files, strict=True):
    with np.load(file) as data:
        axis.imshow(data["rgb"])
        for _, left, top, right, bottom in data["boxes"]:
            corners = (left, top), right - left, bottom - top
            axis.add_patch(plt.Rectangle(*corners, fill=False, edgecolor="lime"))
        axis.set_title(f"{file.parent.name}/{file.name}: {len(data['boxes'])} bunches")
    axis.axis("off")
plt.show()

# %% [markdown]
# The check: boxes contain the masks, splits share no vineyard, and the same seed yields the same bits.

# %% The check
again = picture(SEEDS["test"][0])
for file in files:
    with np.load(file) as data:
        assert len(data["boxes"]) > 0, file
        for bunch, left, top, right, bottom in data["boxes"]:
            inside = (data["mask"][top:bottom, left:right] == bunch).sum()
            assert inside == (data["mask"] == bunch).sum()
        if file.parent.name == "test":
            assert all(np.array_equal(data[name], again[name]) for name in again)
names = [{file.name for file in (FOLDER / split).iterdir()} for split in SEEDS]
assert not names[0] & names[1]
print(f"{len(files)} pictures, reproducible to the bit")

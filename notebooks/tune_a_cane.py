# %% [markdown]
# # Tune a cane to its swing
#
# A cane is pulled aside by 10 cm, let go, and filmed for three seconds. The track of its tip determines Young's
# modulus and damping, with 90 % intervals; with a spring balance on the string also the mass.
#
# This track is synthetic, so that the true values are known. Your own track comes from `read_trajectory("pull.csv")`.

# %%
import importlib.util
import pathlib
import tempfile

import matplotlib.pyplot as plt
import numpy as np

from vinesim.tune import Experiment, extract_features, load_specimen, measure, plots, read_trajectory, tune, with_values

FOLDER = pathlib.Path(tempfile.mkdtemp())

# %% [markdown]
# ## The laboratory
#
# The file has the values measured with ruler and scales. The true plant has another modulus and damping.

# %%
FILE = """[specimen]
organ = "cane"
length = { value = 1.0, unit = "m", grade = "READ", source = "tape measure" }
base_diameter = { value = 0.0090, unit = "m", grade = "READ", source = "caliper" }
tip_diameter = { value = 0.0060, unit = "m", grade = "READ", source = "caliper" }
modulus = { value = 5.89e9, unit = "Pa", grade = "GUESSED", source = "data/plants/vine.toml" }
density = { value = 900.0, unit = "kg/m^3", grade = "READ", source = "scales, over the volume" }
damping = { value = 0.004, unit = "s", grade = "GUESSED", source = "a damping ratio of 0.04 at 3.5 Hz" }
markers = { middle = 0.5 }
"""
(FOLDER / "cane.toml").write_text(FILE)
guess = load_specimen(FOLDER / "cane.toml")
truth = with_values(guess, modulus=4.2e9, damping=0.0065)
measure(truth, Experiment(seed=3, force_noise=0.01, markers=("tip", "middle"))).write(FOLDER / "pull.csv")
print((FOLDER / "pull.csv").read_text()[:200])

# %% [markdown]
# ## Without a model
#
# A damped sinusoid that is fitted to the track has a frequency and a logarithmic decrement; a fit must agree with both.

# %%
track = read_trajectory(FOLDER / "pull.csv")
features = extract_features(track)
print(f"{features.frequency:.3f} Hz, damping ratio {features.damping_ratio:.4f}")
print(f"log decrement {features.log_decrement:.3f}")

# %% [markdown]
# ## By hand
#
# Where ipywidgets is installed (`pip install ipywidgets`), two sliders change the model. The modulus sets the
# frequency, the damping the decay.

# %%
pull = Experiment()  # as in the laboratory, without noise


def compare(modulus: float = 5.9, damping: float = 4.0) -> None:
    """Draw the measured track of the tip and that of a model: ``modulus`` [GPa], ``damping`` [ms]."""
    model = measure(with_values(guess, modulus=1e9 * modulus, damping=1e-3 * damping), pull, exact=True)
    plt.figure(figsize=(8, 3))
    plt.plot(track.time, 1e3 * track.position[:, 0, 2], ".", markersize=3, label="track")
    plt.plot(model.time, 1e3 * model.position[:, 0, 2], label=f"model: {modulus:g} GPa, {damping:g} ms")
    plt.xlabel("time [s]")
    plt.ylabel("height of the tip [mm]")
    plt.legend()
    plt.show()


compare()

# %%
if importlib.util.find_spec("ipywidgets"):
    from ipywidgets import FloatSlider, interact

    late = {"continuous_update": False}  # a new curve takes about a second
    interact(
        compare,
        modulus=FloatSlider(5.9, min=2.0, max=8.0, step=0.1, description="GPa", **late),
        damping=FloatSlider(4.0, min=1.0, max=10.0, step=0.5, description="ms", **late),
    )

# %% [markdown]
# ## The fit

# %%
fit = tune(guess, track)
print("\n".join(fit.lines()))

# %% [markdown]
# The track with its 90 % band, and the residuals; posterior and prior. The data determine the modulus hundreds of times
# more exactly than published values do.

# %%
plots.draw_fit(fit, plt.figure(figsize=plots.SIZE, layout="constrained"))

# %% [markdown]
# ## A held-out release
#
# Another pull, half as far and to the side. Only the pull and the time of release are fitted, not the plant.

# %%
other = measure(truth, Experiment(seed=4, displacement=0.05, angle=20.0))
held_out = tune(fit.fitted_specimen(), other, ())
figure, axes = plt.subplots(figsize=(8, 3))
plots.draw_held_out(fit, held_out, axes)
print(f"residuals: {1e3 * held_out.noise:.2f} mm; the camera's noise is 2 mm")

# %% [markdown]
# ## What a swing does not determine
#
# A free swing depends on the ratio of modulus to mass. If both are fitted without a force, there is a ridge as wide as
# the prior; with a spring balance there is none.

# %%
blind = measure(truth, Experiment(seed=3))
ridge = tune(guess, blind, ("modulus", "damping", "mass"))
weighed = tune(guess, track, ("modulus", "damping", "mass"))
for name, one in (("without force", ridge), ("with force", weighed)):
    modulus = one.estimate("modulus")
    print(f"{name:14s} modulus {modulus.low / 1e9:.2f} to {modulus.high / 1e9:.2f} GPa")
print([line for line in ridge.lines() if line.startswith("ridge")])

# %% [markdown]
# ## Into a vineyard
#
# `write_plant` writes a file of plant parameters; a scene loads it with `plants = "fitted.toml"`.

# %%
fit.write_plant(FOLDER / "fitted.toml")
print(load_specimen(FOLDER / "fitted.toml").modulus)

# %% [markdown]
# ## Check

# %%
assert fit.ok
assert held_out.ok
assert abs(fit.estimate("modulus").value / 4.2e9 - 1.0) < 0.03
assert abs(fit.estimate("damping").value / 0.0065 - 1.0) < 0.15
assert abs(fit.frequency / features.frequency - 1.0) < 0.01
assert len(ridge.posterior.ridges) == 1
assert not weighed.posterior.ridges
assert held_out.noise < 1.2 * 2e-3
assert np.isfinite(fit.posterior.covariance).all()
off = {name: fit.estimate(name).value / true - 1.0 for name, true in (("modulus", 4.2e9), ("damping", 0.0065))}
print(", ".join(f"{name} {share:+.1%} from the truth" for name, share in off.items()))
plt.close("all")

# %% [markdown]
# # Tune the swing of a bunch
#
# A bunch hangs on its peduncle like a pendulum on a spring. Its frequency depends mostly on its weight, and also on the
# peduncle. So the mass must be known: the bunch is weighed after picking. The track of its lowest point then determines
# the peduncle's modulus and damping.

# %%
import pathlib
import tempfile

import matplotlib.pyplot as plt
import numpy as np

from vinesim.tune import Experiment, load_specimen, measure, plots, tune, with_values

FOLDER = pathlib.Path(tempfile.mkdtemp())

# %%
FILE = """[specimen]
organ = "bunch"
length = { value = 0.08, unit = "m", grade = "READ", source = "ruler" }
base_diameter = { value = 0.0045, unit = "m", grade = "READ", source = "caliper" }
tip_diameter = { value = 0.0045, unit = "m", grade = "READ", source = "caliper" }
modulus = { value = 0.3e9, unit = "Pa", grade = "GUESSED", source = "data/plants/vine.toml" }
density = { value = 1000.0, unit = "kg/m^3", grade = "GUESSED", source = "data/plants/vine.toml" }
damping = { value = 0.05, unit = "s", grade = "GUESSED", source = "data/plants/vine.toml" }
tip_mass = { value = 0.5, unit = "kg", grade = "READ", source = "scales, after picking" }
segments = 4
"""
(FOLDER / "bunch.toml").write_text(FILE)
guess = load_specimen(FOLDER / "bunch.toml")
truth = with_values(guess, modulus=0.45e9, damping=0.03)
seen = Experiment(seed=3, displacement=0.04, duration=4.0, axes="xy")  # from below: z is not seen
track = measure(truth, seen)

# %%
fit = tune(guess, track, samples=512, seed=1)
print("\n".join(fit.lines()))
plots.draw_fit(fit, plt.figure(figsize=plots.SIZE, layout="constrained"))

# %% [markdown]
# ## How much the weight hides the stiffness
#
# The interval of the modulus is wider than a cane's: a modulus larger by a tenth changes the frequency only by a few
# per cent. Draws from the exact posterior, each a simulated bunch, show whether the normal approximation is good; the
# interval above comes from these draws.

# %%
assert fit.sample is not None
own = fit.estimate("modulus")
low, high = np.exp(fit.posterior.interval("modulus")) * guess.modulus.value / 1e9
print(f"modulus {own.low / 1e9:.3f} to {own.high / 1e9:.3f} GPa by {fit.sample.effective:.0f} effective draws")
print(f"{low:.3f} to {high:.3f} GPa by the normal approximation")

# %% [markdown]
# ## A held-out release

# %%
other = measure(truth, Experiment(seed=2, displacement=0.07, duration=4.0, angle=30.0, axes="xy"))
held_out = tune(fit.fitted_specimen(), other, ())
figure, axes = plt.subplots(figsize=(8, 3))
plots.draw_held_out(fit, held_out, axes)
print(f"residuals: {1e3 * held_out.noise:.2f} mm; the camera's noise is 2 mm")

# %% [markdown]
# ## Check

# %%
assert fit.ok
assert held_out.ok
assert abs(fit.estimate("modulus").value / 0.45e9 - 1.0) < 0.1
assert abs(fit.estimate("damping").value / 0.03 - 1.0) < 0.15
assert abs(fit.frequency / fit.features.frequency - 1.0) < 0.01
assert fit.sample.effective > 100
assert held_out.noise < 1.2 * 2e-3
off = {name: fit.estimate(name).value / true - 1.0 for name, true in (("modulus", 0.45e9), ("damping", 0.03))}
print(", ".join(f"{name} {share:+.1%} from the truth" for name, share in off.items()))
plt.close("all")

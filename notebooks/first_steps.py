# %% [markdown]
# # First steps: one cane
#
# A clamped rod of wood is pulled at its tip and let go. Theory predicts its deflection (F L^3 / 3 E I) and the decay
# of its swing (the logarithmic decrement of the requested damping ratio). The end of the notebook checks both.

# %%
import matplotlib.pyplot as plt
import numpy as np

import vinesim

LENGTH, RADIUS, YOUNG, RATIO = 1.0, 0.006, 5e9, 0.05  # m, m, Pa, 1
cane = vinesim.CaneBuilder(
    length=LENGTH, radius=RADIUS, youngs_modulus=YOUNG, damping_ratio=RATIO, segments=24, shape="equilibrium"
)
simulation = vinesim.Simulation(cane, sleep=False)
start, tip = simulation.tip(), simulation.tip_body()

# %% [markdown]
# Pull sideways with 0.2 N at the tip until the rod rests. The force acts during all steps of one call.

# %%
FORCE = 0.2  # N
simulation.apply_wrench(tip, (0.0, FORCE, 0.0), at=start)
simulation.step(800)  # 8 s
bent = (simulation.tip() - start)[1]
theory = FORCE * LENGTH**3 / (3.0 * YOUNG * np.pi / 4.0 * RADIUS**4)
print(f"deflection {1e3 * bent:.2f} mm; by beam theory {1e3 * theory:.2f} mm")

# %% [markdown]
# Let go: the call above has ended, and the force has ended with it.

# %%
times, way = [], []
for _ in range(300):
    simulation.step()
    times.append(simulation.time)
    way.append((simulation.tip() - start)[1])
times, way = np.array(times) - times[0], np.array(way)
peaks = np.flatnonzero((way[1:-1] > way[:-2]) & (way[1:-1] >= way[2:])) + 1
peaks = peaks[way[peaks] > 0.05 * bent]
decrement = np.log(way[peaks[0]] / way[peaks[-1]]) / (len(peaks) - 1)
seen = decrement / np.hypot(2.0 * np.pi, decrement)
print(f"damping ratio {seen:.3f}, requested {RATIO}; {len(peaks)} peaks")

# %%
figure, axis = plt.subplots(figsize=(8, 3))
axis.plot(times, 1e3 * way, label="tip")
envelope = bent * np.exp(-RATIO * 2.0 * np.pi * np.arange(len(way)) / np.diff(peaks).mean())
axis.plot(times, 1e3 * envelope, "--", label="decay of the requested damping")
axis.set(xlabel="time [s]", ylabel="displacement of the tip [mm]", title="pull and release")
axis.legend()
plt.show()

# %% The check
assert abs(bent - theory) < 0.02 * theory, (bent, theory)
assert abs(seen - RATIO) < 0.01, seen
print("both agree with theory")

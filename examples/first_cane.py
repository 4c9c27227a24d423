"""A cane with a weight at its tip: it is released straight and horizontal, swings, and comes to rest bent downwards."""

import vinesim

cane = vinesim.CaneBuilder(
    length=1.0,  # m
    radius=(0.006, 0.003),  # m, base and tip
    youngs_modulus=5e9,  # Pa
    density=800.0,  # kg/m^3
    tip_mass=0.05,  # kg
    damping_ratio=0.2,  # of the first bending mode
)
simulation = vinesim.Simulation(cane)
start = simulation.tip()
for _ in range(6):
    simulation.step(50)
    sag = 1e3 * (start - simulation.tip())[2]
    energy = simulation.energy()
    print(f"{simulation.time:.1f} s: tip sags by {sag:5.1f} mm, kinetic energy {energy.kinetic:.2e} J")

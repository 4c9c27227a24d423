"""A robot drives against an upright cane. The cane bends, and the contact force acts on cane and robot alike."""

import numpy as np

import vinesim

upwards = vinesim.frames.from_x_axis(np.array([0.0, 0.0, 1.0]))
cane = vinesim.CaneBuilder(
    length=1.2, radius=0.005, damping_ratio=0.1, pose=vinesim.frames.pose([1.0, 0.0, 0.0], upwards)
)
simulation = vinesim.Simulation(cane)
robot = simulation.add_robot("vinebot", pose=(0.0, 0.0, 0.0))  # x, y, yaw
start = simulation.tip()
largest = 0.0
for _ in range(300):
    robot.command_base(0.2, 0.0, simulation.time)  # m/s ahead, rad/s to the left
    simulation.step()
    largest = max(largest, *(np.linalg.norm(contact.force) for contact in simulation.contacts), 0.0)
way = np.linalg.norm(simulation.tip() - start)
links = {contact.link for contact in simulation.contacts}
print(f"contacts of {', '.join(sorted(links))}: up to {largest:.1f} N; the tip moved by {100 * way:.0f} cm")

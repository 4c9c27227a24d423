# %% [markdown]
# # Pushing a robot's arm
#
# All seven joints of the left arm are compliant. A hand pushes the last link with a few newtons, and the arm yields.
# At rest, stiffness times deflection equals the moment of the push about each joint, K dq = J^T F.

# %%
import matplotlib.pyplot as plt
import numpy as np

import vinesim

FORCE = np.array([4.0, -3.0, 5.0])  # N, world axes
STIFFNESS = np.array([60.0, 60.0, 40.0, 40.0, 15.0, 15.0, 15.0])  # N m/rad
ARM, LINK = [f"arm_left_{number}_joint" for number in range(1, 8)], "arm_left_7_link"

simulation = vinesim.Simulation([])
robot = simulation.add_robot("vinebot")
joints = robot.joint_indices(ARM)
robot.command_impedance(STIFFNESS, 0.25 * STIFFNESS, joints)
simulation.step(20)
before = robot.sample(simulation.time).joints

# %% [markdown]
# The force acts at the origin of the last link's frame, for six seconds.

# %%
times, way = [], []
for _ in range(600):
    simulation.push_robot(robot.name, LINK, FORCE, at=robot.frame_pose(LINK)[:3])
    simulation.step()
    times.append(simulation.time)
    way.append(robot.sample(simulation.time).joints.position[joints] - before.position[joints])
pushed = robot.sample(simulation.time).joints

# %% [markdown]
# By virtual work, the moment about a joint is the force times the displacement of that point for a small rotation of
# the joint, per radian. The geometry comes from the URDF.

# %%
TURN = 1e-5  # rad


def point(joint: int, turn: float) -> np.ndarray:
    """Returns the origin of the last link's frame in the base [3] m, after a small rotation of one joint."""
    position = pushed.position.copy()
    position[joint] += turn
    return robot.description.link_poses(position)[LINK][:3]


moment = np.array([FORCE @ (point(joint, TURN) - point(joint, -TURN)) / (2.0 * TURN) for joint in joints])
spring = STIFFNESS * way[-1]
print("K dq  [N m]:", spring.round(3))
print("J^T F [N m]:", moment.round(3))

# %%
figure, (chart, bars) = plt.subplots(1, 2, figsize=(12, 4))
chart.plot(times, np.degrees(way), label=[f"joint {number}" for number in range(1, 8)])
chart.set(xlabel="time [s]", ylabel="deflection [deg]", title="the arm yields")
chart.legend(ncols=2)
bars.bar(np.arange(1, 8) - 0.2, spring, 0.4, label="K dq")
bars.bar(np.arange(1, 8) + 0.2, moment, 0.4, label="J^T F")
bars.set(xlabel="joint", ylabel="N m", title="at rest")
bars.legend()
plt.show()

# %% The check: the law holds, and the arm returns after the push
simulation.step(600)
back = robot.sample(simulation.time).joints.position[joints] - before.position[joints]
assert np.abs(way[-1]).max() > np.radians(2.0)
assert np.abs(spring - moment).max() < 0.01 * np.abs(moment).max(), (spring, moment)
assert np.abs(back).max() < 1e-3, back
print("K dq = J^T F")

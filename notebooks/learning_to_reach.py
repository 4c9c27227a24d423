# %% [markdown]
# # Learning to reach for a bunch
#
# An arm of seven joints stands in front of four shoots with a bunch each. It learns to bring its fingers to the bunch
# that is wanted, in two minutes on two cores, from 64 vineyards that differ. The learner is an evolution strategy
# ([Salimans et al. 2017](https://arxiv.org/abs/1703.03864)) on 28 numbers. It needs NumPy only.
#
# `vinesim train reach` learns neural networks by PPO, on a GPU or a CPU.

# %%
import time

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

WORLDS = 64
env = gymnasium.make_vec("vinesim.learn:vinesim/Reach-v0", num_envs=WORLDS)
print(env.single_observation_space.shape, env.single_action_space.shape)

# %% [markdown]
# ## A policy
#
# The observation contains the vector from the fingers to the wanted bunch in its entries 14 to 16. The speeds of the
# seven joints depend on its direction: they are tanh(M f), where f is the direction and a constant 1. Nearer than 15 cm
# the vector counts with its length, so that the arm slows down. Each world can have a matrix M of its own.


# %%
def actions(matrix: np.ndarray, observation: np.ndarray) -> np.ndarray:
    """Returns the actions [world, 7] of policies ``matrix`` [world, 4, 7]."""
    to_bunch = observation[:, 14:17]
    distance = np.linalg.norm(to_bunch, axis=1, keepdims=True)
    features = np.concatenate([to_bunch / np.maximum(distance, 0.15), np.ones((len(observation), 1))], axis=1)
    return np.tanh(np.einsum("wf,wfj->wj", features, matrix)).astype(np.float32)


def episode(env: gymnasium.vector.VectorEnv, matrix: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the sum of rewards and the success [world] of the first episode of each world.

    A reward counts at least -3, so that a policy that presses hard on a shoot does not outweigh all others.
    """
    observation, _ = env.reset(seed=seed)
    total = np.zeros(len(matrix))
    success = np.zeros(len(matrix), bool)
    going = np.ones(len(matrix), bool)
    for _ in range(75):  # 3 s
        observation, reward, terminated, truncated, info = env.step(actions(matrix, observation))
        total += going * np.maximum(reward, -3.0)
        success |= going & info["success"]
        going &= ~(terminated | truncated)
        if not going.any():
            break
    return total, success


# %% [markdown]
# ## Learning
#
# Each world tries the present matrix with noise, and a world of the other half with the opposite noise. The ranks of
# their results say in which direction the matrix improves; Adam takes the step.

# %%
rng = np.random.default_rng(1)
matrix = np.zeros((4, 7))
momentum = np.zeros_like(matrix)
square = np.zeros_like(matrix)
NOISE = 0.3
curve = []
begin = time.monotonic()
for iteration in range(40):
    half = rng.normal(size=(WORLDS // 2, *matrix.shape))
    noise = np.concatenate([half, -half])
    total, success = episode(env, matrix + NOISE * noise, seed=iteration)
    rank = np.argsort(np.argsort(total)) / (WORLDS - 1) - 0.5
    gradient = np.einsum("w,wfj->fj", rank, noise) / (WORLDS * NOISE)
    momentum = 0.9 * momentum + 0.1 * gradient
    square = 0.99 * square + 0.01 * gradient**2
    step = momentum / (1 - 0.9 ** (iteration + 1)) / (np.sqrt(square / (1 - 0.99 ** (iteration + 1))) + 1e-8)
    matrix = matrix + 0.08 * step
    curve.append(success.mean())
env.close()
print(f"{time.monotonic() - begin:.0f} s")

# %%
plt.figure(figsize=(8, 3))
plt.plot(100 * np.array(curve), ".-")
plt.xlabel("iteration")
plt.ylabel("episodes with success, with noise [%]")
plt.ylim(0, 100)
plt.show()

# %% [markdown]
# ## Vines that it has not seen
#
# The same policy without noise, in 128 worlds with other shoots. Chance decides which of the four bunches is wanted.

# %%
unseen = gymnasium.make_vec("vinesim.learn:vinesim/Reach-v0", num_envs=128, vines_seed=2**31, vines=128)
_, success = episode(unseen, np.repeat(matrix[None], 128, axis=0), seed=7)
unseen.close()
print(f"{success.sum()} of 128 bunches reached")
assert success.mean() > 0.8

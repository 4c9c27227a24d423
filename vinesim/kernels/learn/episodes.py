"""Episodes of the learning tasks: which worlds end and begin again, on the batch's device."""

import warp as wp

wp.set_module_options({"enable_backward": False})

FAULT_REWARD = wp.constant(-10.0)
"""Reward of an action with a fault. GUESSED: less than the costs of a bad episode would let a policy seek faults."""

FAILURE_REWARD = wp.constant(-2.0)
"""Added to the reward of an action after which success is no longer possible. GUESSED: the end of an episode, which
spares its further costs, is no gain then."""


@wp.kernel
def end_episodes(
    # model
    max_steps: int,
    # in
    faults: wp.array(dtype=wp.int32),
    failed: wp.array(dtype=wp.bool),
    # out
    elapsed_out: wp.array(dtype=wp.int32),
    observation_out: wp.array2d(dtype=float),
    reward_out: wp.array(dtype=float),
    success_out: wp.array(dtype=wp.bool),
    terminated_out: wp.array(dtype=wp.bool),
    truncated_out: wp.array(dtype=wp.bool),
    ended_out: wp.array(dtype=wp.bool),
    fault_out: wp.array(dtype=wp.int32),
):
    """One thread per world, after an action. Decide whether the world's episode ends.

    A world with a fault ends without success and with :data:`FAULT_REWARD`; its observation gets 0 for numbers that are
    not finite. failed: [world] whether success is no longer possible. elapsed: [world] number of actions of the episode.
    fault: [world] copy of ``faults``.
    """
    world = wp.tid()
    fault = faults[world]
    for k in range(observation_out.shape[1]):
        if not wp.isfinite(observation_out[world, k]):
            observation_out[world, k] = 0.0
    if failed[world]:
        reward_out[world] = reward_out[world] + FAILURE_REWARD
    if fault != 0:
        reward_out[world] = FAULT_REWARD
        success_out[world] = False
    elapsed = elapsed_out[world] + 1
    terminated = success_out[world] or failed[world] or fault != 0
    truncated = elapsed >= max_steps and not terminated
    ended = terminated or truncated
    if ended:
        elapsed = 0
    elapsed_out[world] = elapsed
    fault_out[world] = fault
    terminated_out[world] = terminated
    truncated_out[world] = truncated
    ended_out[world] = ended


@wp.kernel
def draw_targets(
    # model
    count: int,
    # in
    seed: wp.array(dtype=wp.int32),
    begins: wp.array(dtype=wp.bool),
    # out
    episode_out: wp.array(dtype=wp.int32),
    target_out: wp.array(dtype=wp.int32),
):
    """One thread per world. Draw the target, 0 to ``count`` - 1, of an episode that begins.

    seed: [1]. episode: [world] number of the world's next episode since the seed was set.
    """
    world = wp.tid()
    if begins[world]:
        episode = episode_out[world]
        state = wp.rand_init(seed[0] + episode, world)
        target_out[world] = wp.randi(state, 0, count)
        episode_out[world] = episode + 1


@wp.kernel
def begin_on_way(
    # model
    share: float,
    home: wp.array(dtype=float),
    goals: wp.array3d(dtype=float),
    q: wp.array(dtype=wp.int32),
    # in
    seed: wp.array(dtype=wp.int32),
    begins: wp.array(dtype=wp.bool),
    episode: wp.array(dtype=wp.int32),
    target: wp.array(dtype=wp.int32),
    # out
    qpos_out: wp.array2d(dtype=float),
    targets_out: wp.array2d(dtype=float),
):
    """One thread per world. Let a ``share`` of the episodes that begin do so with the arm on its way from ``home``
    [joint] rad to a goal: at a place of this way that is drawn evenly.

    goals: [world, target, joint] rad, for each target. q: [joint] index in qpos. seed, episode, target: see
    :func:`draw_targets`, which has been launched before. targets: [world, joint] rad, of the servos.
    """
    world = wp.tid()
    if begins[world]:
        state = wp.rand_init(seed[0] - episode[world], world)
        if wp.randf(state) < share:
            way = wp.randf(state)
            for i in range(q.shape[0]):
                angle = home[i] + way * (goals[world, target[world], i] - home[i])
                at = q[i]
                qpos_out[world, at] = angle
                targets_out[world, i] = angle


@wp.kernel
def delay_actions(
    # in
    delay: wp.array(dtype=wp.int32),
    action: wp.array2d(dtype=float),
    # out
    history_out: wp.array3d(dtype=float),
    applied_out: wp.array2d(dtype=float),
):
    """One thread per component of a world's action. Apply the action that was given ``delay`` [world] actions ago.

    history: [world, age, component] actions so far, the newest first; its length is the longest delay + 1.
    """
    world, k = wp.tid()
    ages = history_out.shape[1]
    for back in range(1, ages):
        age = ages - back
        history_out[world, age, k] = history_out[world, age - 1, k]
    history_out[world, 0, k] = action[world, k]
    late = delay[world]
    applied_out[world, k] = history_out[world, late, k]


@wp.kernel
def forget_actions(
    # in
    begins: wp.array(dtype=wp.bool),
    # out
    history_out: wp.array3d(dtype=float),
):
    """One thread per component of a world's action. Let an episode that begins have had actions of 0 before."""
    world, k = wp.tid()
    if begins[world]:
        for age in range(history_out.shape[1]):
            history_out[world, age, k] = 0.0

"""Pure functions of tensors: PD law, torque-speed envelope, power limit, history, rotations, keypoints, reward terms.

The mathematics of the library stands here, without state and without a simulator, so that each formula can be called
and checked alone. This room imports torch and nothing else.
"""

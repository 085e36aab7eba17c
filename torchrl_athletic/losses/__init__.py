"""PPO with minibatches of their own for actor and critic, a learning rate that follows the KL divergence, the stepper.

The terms are functions of tensors and the modules only fetch them. Like ``transforms``, this room knows torch,
tensordict and TorchRL alone, and is linked at the root of the repository.
"""

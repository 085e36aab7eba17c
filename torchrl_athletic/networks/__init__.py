"""Actor, critic, Unsupervised Actuator Net and the encoder of Regularized Online Adaptation, as TensorDict modules.

Checkpoints are written and read here too.
"""

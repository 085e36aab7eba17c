"""TorchRL transforms of the actuation chain and of observations: each fetches keys, calls ``functional``, writes keys.

They know tensordicts, never MuJoCo, so that any TorchRL project can use them; the folder is linked at the root of the
repository for that reason. What must survive a step is carried in the tensordict.
"""

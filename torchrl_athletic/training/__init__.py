"""Training in a corrected simulation: collection, advantages, updates, evaluation, checkpoints, logging."""

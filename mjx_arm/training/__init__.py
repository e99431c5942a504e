"""Training runs: the compiled loop, and what surrounds it: folders, checkpoints, evaluations."""

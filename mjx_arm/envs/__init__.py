"""Environments: an arm of position servos in a scene, and a task for it."""

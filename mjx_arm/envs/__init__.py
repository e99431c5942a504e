"""Environments: what a robot can do in a scene, and what a task asks of it."""

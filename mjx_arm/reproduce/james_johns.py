"""The figures that James & Johns 2016 report (arXiv 1609.03759)."""

from __future__ import annotations

# Trained in, tried in -> successes of 50 episodes at epsilon 0.1 (their section on evaluation).
EPISODES = 50
SUCCESSES = {("A", "A"): 28, ("B", "A"): 32, ("A", "B"): 1, ("B", "B"): 26}
# Success becomes regular from about this episode on.
REGULAR_EPISODE = 1_800
# Steps of the one successful episode whose Q-values they show.
EPISODE_LENGTH = 112

"""Learning algorithms, and what they share: exploration, collecting, the replay and its frames."""

"""What a run tells its user: lines on the screen, metrics on disk, figures and videos."""

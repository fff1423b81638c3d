"""Training: settings, the loop, its state on disk, its log."""

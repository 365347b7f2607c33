"""Training data of restorers: pairs of degraded and true views."""

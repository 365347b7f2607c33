"""Pairs of degraded and true views to train restorers on."""

"""Restorers judged where the truth is known."""

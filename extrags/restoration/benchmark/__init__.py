"""Evaluation and comparison of restorers on views whose truth is known."""

"""Weights of the depth completion, trained by this project; `completion.json` says how."""

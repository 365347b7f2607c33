"""A procedural colon with exact ground truth: the built-in input (see `recording`)."""

from __future__ import annotations

from data_catalog.phantom.config import GENERATOR_VERSION, PhantomConfig

__all__ = ["GENERATOR_VERSION", "PhantomConfig"]

"""Readers of folders, one module for each layout on disk; `data_catalog.folders` lists them."""

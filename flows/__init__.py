"""Prefect flows and the command line: wiring, parameters, names, artifacts."""

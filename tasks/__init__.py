"""Stages as cached Prefect tasks: open refs, call the library, write an artefact, return its ref."""

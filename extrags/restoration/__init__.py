"""Restoration of virtual views: restorers behind one protocol, their training data, errors and benchmark."""

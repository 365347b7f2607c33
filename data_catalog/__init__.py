"""What datasets there are, and how each is read into an `extrags.sequence.Sequence`.

Imports stay light here: the readers are loaded when a sequence is read.
"""

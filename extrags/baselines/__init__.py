"""Other systems' representations of a scene, to be compared with under the same protocol."""

"""One plausible view out of a smooth one: a network that makes laid texture and smooth shapes agree."""

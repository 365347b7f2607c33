"""Restoration of virtual views: pairs, the embedded diffusion, the classical fill, pseudo-observations."""

from __future__ import annotations

from extrags.enhance.pseudo import PseudoObservations as PseudoObservations

"""Numerical stress: every part of the computation at the edges of what it can be given."""

from extrags.stress.rows import Effort as Effort
from extrags.stress.rows import Row as Row
from extrags.stress.rows import run_rows as run_rows
from extrags.stress.table import ROWS as ROWS
